use std::collections::BTreeMap;
use std::fs;
use std::io::Write as _;
use std::path::{Path, PathBuf};

use super::*;

/// A release that is neither the pinned one nor refused, and that the patches do not fit.
const OTHER: &str = "0.23.45";

#[test]
fn vulnerable_and_invalid_versions_are_refused() {
    for release in 13..=44 {
        let error = admit(&format!("0.23.{release}")).unwrap_err();
        assert!(error.contains("RUSTSEC-2026-0285"), "{error}");
    }
    for version in [
        "",
        "0.23",
        "0.23.",
        "0.23.x",
        "0.23.046",
        "0.23.46 ",
        "0.23.46-rc.1",
        "0.23.46+1",
        "0.22.4",
        "0.24.0",
        "0.24.0-dev.2",
        "1.0.0",
        "=0.23.46",
        "v0.23.46",
        "0.23.-1",
        "0.23.+46",
        "0.23.99999999999",
    ] {
        let error = admit(version).unwrap_err();
        assert!(error.contains("is not a release of rustls 0.23"), "{error}");
    }
    for version in ["0.23.0", "0.23.12", "0.23.45", "0.23.46", "0.23.100"] {
        admit(version).unwrap();
    }
}

const BEFORE: &str = "one\ntwo\nthree\nfour\nfive\nsix\nseven\n";
const PATCH: &str = "\
Why

diff --git a/src/a.rs b/src/a.rs
--- a/src/a.rs
+++ b/src/a.rs
@@ -1,3 +1,4 @@
 one
+one and a half
 two
 three
@@ -5,3 +6,3 @@
 five
-six
+SIX
 seven
";

fn misfits(before: &str) -> (Vec<String>, String) {
    let mut tree = BTreeMap::from([("a.rs".to_owned(), before.to_owned())]);
    let list = fit::misfits(&mut tree, "0001-x.patch", PATCH);
    (list, tree.remove("a.rs").unwrap())
}

#[test]
fn every_hunk_that_does_not_fit_is_listed_with_file_and_line() {
    let after = BEFORE.replace("two", "one and a half\ntwo").replace("six", "SIX");
    assert_eq!(misfits(BEFORE), (vec![], after.clone()));

    let (list, moved) = misfits(&format!("zero\n{BEFORE}"));
    assert_eq!(
        list,
        [
            "patches/0001-x.patch, line 6: src/a.rs:1: has moved to line 2, unchanged",
            "patches/0001-x.patch, line 11: src/a.rs:5: has moved to line 6, unchanged",
        ]
    );
    assert_eq!(moved, format!("zero\n{after}"), "later patches are judged on this");

    let (list, moved) = misfits(&BEFORE.replace("two", "2"));
    assert_eq!(list, ["patches/0001-x.patch, line 6: src/a.rs:1: line 2 is `2`, not `two`"]);
    assert_eq!(moved, BEFORE.replace("two", "2").replace("six", "SIX"));

    let (list, _) = misfits("one\ntwo\nthree\nfour\nfive\nsix");
    assert_eq!(
        list,
        ["patches/0001-x.patch, line 11: src/a.rs:5: the file ends before line 7, `seven`"]
    );
    let (list, _) = misfits(&format!("{BEFORE}{BEFORE}").replacen("one", "1", 1));
    let first = "patches/0001-x.patch, line 6: src/a.rs:1: has moved to line 8, unchanged";
    assert_eq!(list, [first]);
    let (list, _) = misfits(&format!("0\n{BEFORE}{BEFORE}"));
    assert!(list[0].ends_with("src/a.rs:1: fits 2 places, line 2 first"), "{list:?}");

    let list = fit::misfits(&mut BTreeMap::new(), "0001-x.patch", PATCH);
    assert_eq!(list, ["patches/0001-x.patch: src/a.rs does not exist"]);
}

#[test]
fn a_failed_write_leaves_everything_as_it_was() {
    let dir = tempfile::tempdir().unwrap();
    let root = dir.path();
    for (name, contents) in [("a", "old a"), ("b", "old b"), ("Cargo.lock", "old lock")] {
        fs::write(root.join(name), contents).unwrap();
    }
    let before = files(root);

    let mut edits = pin::Edits::new(root);
    assert!(edits.replace("a", "missing", "x").unwrap_err().contains("0 times"));
    edits.replace("a", "old", "new").unwrap();
    edits.replace("a", "new", "newer").unwrap();
    edits.replace("b", "old b", "old b").unwrap();
    assert_eq!(edits.names(), ["a"], "what is right already is no edit");
    let written = edits.write().unwrap();
    assert_eq!(fs::read_to_string(root.join("a")).unwrap(), "newer a");
    fs::write(root.join("Cargo.lock"), "new lock").unwrap();
    drop(written);
    assert_eq!(files(root), before);

    // the second of them cannot be written
    let mut edits = pin::Edits::new(root);
    edits.replace("a", "old", "new").unwrap();
    edits.replace("b", "old", "new").unwrap();
    fs::remove_file(root.join("b")).unwrap();
    fs::create_dir(root.join("b")).unwrap();
    assert!(edits.write().is_err());
    assert_eq!(fs::read_to_string(root.join("a")).unwrap(), "old a");
}

#[test]
fn outcomes_are_counted_by_name() {
    let output = "\nrunning 4 tests\ntest a::b ... ok\ntest c - should panic ... ok\n\
                  test d ... ignored, because\ntest a::b ... FAILED\n\ntest result: FAILED. 2 passed\n";
    let outcomes = suite::parse(output);
    assert_eq!(suite::counts(&outcomes), [2, 1, 1]);
    assert_eq!(outcomes["a::b"].len(), 2);
}

#[test]
fn a_documentation_test_that_moved_is_the_same() {
    let parse = |line| suite::parse(&format!("test x.rs - a::B (line {line}) - compile ... ok\n"));
    assert_eq!(parse(795), parse(807));
    assert_ne!(parse(795), suite::parse("test x.rs - a::B (line 795) ... ok\n"));
}

#[test]
fn a_failed_test_is_listed_with_its_panic_message() {
    let output = |message: &str, line: u32| {
        format!(
            "running 2 tests\ntest a::b ... FAILED\ntest c ... ok\n\nfailures:\n\n\
             ---- a::b stdout ----\nsaid by the test\n\n\
             thread 'a::b' (7) panicked at src/a.rs:{line}:5:\n{message}\n\
             note: run with `RUST_BACKTRACE=1`\n\n\nfailures:\n    a::b\n\n\
             test result: FAILED. 1 passed; 1 failed\n"
        )
    };
    let plain = suite::reasons(&output("assertion failed\n  left: 1\n right: 2", 10));
    let moved = suite::reasons(&output("assertion failed\n  left: 1\n right: 2", 30));
    assert_eq!(plain, moved, "patches move lines");
    assert_eq!(
        suite::failures(&plain, &moved),
        "\n  failed: a::b\n    assertion failed left: 1 right: 2"
    );

    let other = suite::reasons(&output("no such key", 10));
    assert_eq!(
        suite::failures(&plain, &other),
        "\n  failed: a::b\n    unpatched: assertion failed left: 1 right: 2\
         \n    patched:   no such key"
    );
    let list = suite::failures(&suite::Reasons::new(), &other);
    assert!(list.contains("unpatched: did not fail"), "{list}");
    assert_eq!(suite::failures(&suite::Reasons::new(), &suite::Reasons::new()), "");
}

#[test]
fn a_suite_that_did_not_run_to_its_end_is_refused() {
    let ended = "running 1 test\ntest a ... ok\n\ntest result: ok. 1 passed\n";
    suite::check_ran(ended, "").unwrap();

    let crashed = format!("{ended}\nrunning 2 tests\ntest b ... ok\n");
    let error = suite::check_ran(&crashed, "(signal: 11, SIGSEGV)\n").unwrap_err();
    assert!(error.contains("1 of 2 test programs ended before their last test"), "{error}");
    assert!(error.contains("SIGSEGV"), "{error}");

    let errors = "   Compiling rustls\nerror[E0432]: unresolved imports `aws_lc_rs::X`\n --> a.rs\n\
                  error: could not compile `rustls` (lib) due to 1 previous error\n";
    let error = suite::check_ran("", errors).unwrap_err();
    assert!(error.contains("E0432") && error.contains("cargo update -p rustls-webpki"), "{error}");

    let error = suite::check_ran("", "error: no matching package named `x` found\n").unwrap_err();
    assert!(error.contains("no matching package") && !error.contains("cargo update"), "{error}");
}

#[test]
fn tracked_files_that_the_checkout_lacks_are_named() {
    let dir = tempfile::tempdir().unwrap();
    let (repository, copy) = (dir.path().join("repository"), dir.path().join("copy"));
    fs::create_dir_all(repository.join("tests")).unwrap();
    for name in ["Cargo.toml", "tests/vectors.json"] {
        fs::write(repository.join(name), name).unwrap();
    }
    super::super::git(&repository, &["init", "--quiet"]).unwrap();
    super::super::git(&repository, &["add", "--all"]).unwrap();
    fs::remove_file(repository.join("tests/vectors.json")).unwrap();

    assert_eq!(suite::copy_tracked(&repository, &copy).unwrap(), ["tests/vectors.json"]);
    assert_eq!(files(&copy).len(), 1);
}

/// Every file below `dir`, but what cargo keeps for itself.
fn files(dir: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let mut found = BTreeMap::new();
    for entry in fs::read_dir(dir).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            found.extend(files(&path));
        } else {
            let contents = fs::read(&path).unwrap();
            found.insert(path, contents);
        }
    }
    found
}

/// A workspace with rustls-axon alone, as it is here. `None` without a registry.
fn small_workspace() -> Option<tempfile::TempDir> {
    let dir = tempfile::tempdir().unwrap();
    let root = dir.path();
    let krate = workspace().join(CRATE);
    for (path, contents) in files(&krate) {
        let name = path.strip_prefix(&krate).unwrap();
        if name.starts_with("target") {
            continue;
        }
        let to = root.join(CRATE).join(name);
        fs::create_dir_all(to.parent().unwrap()).unwrap();
        fs::write(to, contents).unwrap();
    }
    let manifest = fs::read_to_string(workspace().join("Cargo.toml")).unwrap();
    let (_, rest) = manifest.split_once("[workspace.package]").unwrap();
    let rest = rest.split("\n[workspace.lints").next().unwrap();
    let members = format!("[workspace]\nresolver = \"3\"\nmembers = [\"{CRATE}\"]\n");
    fs::write(root.join("Cargo.toml"), format!("{members}\n[workspace.package]{rest}\n")).unwrap();
    fs::create_dir(root.join("docs")).unwrap();
    for name in ["Cargo.lock", "docs/release.md", "docs/rustls-axon.md"] {
        fs::copy(workspace().join(name), root.join(name)).unwrap();
    }

    let fetched = std::process::Command::new(cargo())
        .args(["update", "--workspace", "--quiet"])
        .current_dir(root)
        .output()
        .unwrap();
    if fetched.status.success() && fetch(&root.join(CRATE), OTHER).is_ok() {
        return Some(dir);
    }
    let why = String::from_utf8_lossy(&fetched.stderr);
    // Past the harness, which would show it only beside a failure.
    let _ = writeln!(std::io::stderr(), "skipped: no registry: {why}");
    None
}

/// Our own version says which rustls it is made from, wherever a page shows it.
#[test]
fn every_page_that_shows_the_version_is_moved() {
    let root = workspace();
    let pinned = upstream::pinned_version(&root.join(CRATE)).unwrap();
    let patches = tree::read_patches(&root.join(CRATE)).unwrap();
    let mut edits = pin::Edits::new(root);
    pin::plan(&mut edits, (&pinned, OTHER), &Tree::new(), &Tree::new(), &patches).unwrap();

    let metadata = format!("+rustls.{pinned}");
    let shown = std::process::Command::new("git")
        .args(["grep", "--files-with-matches", "--fixed-strings", &metadata, "--", ":!*Cargo.lock"])
        .current_dir(root)
        .output()
        .unwrap();
    let shown = String::from_utf8(shown.stdout).unwrap();
    let shown: Vec<&str> = shown.lines().collect();
    assert!(shown.contains(&"third_party/rustls-axon/Cargo.toml"), "{shown:?}");
    for name in shown {
        let text = edits.text(name).unwrap_or_else(|| panic!("{name} is not moved"));
        assert!(!text.contains(&metadata), "{name}");
        assert!(text.contains(&format!("+rustls.{OTHER}")), "{name}");
    }
}

#[test]
fn only_a_release_that_every_patch_fits_is_moved_to() {
    let Some(dir) = small_workspace() else { return };
    let root = dir.path();
    let before = files(root);
    let pinned = upstream::pinned_version(&root.join(CRATE)).unwrap();

    let report = rebase_in(root, &Options::new(&pinned)).unwrap();
    assert!(report.ends_with("nothing to change: this is the pinned release"), "{report}");

    let error = rebase_in(root, &Options::new(OTHER)).unwrap_err();
    assert!(error.contains("nothing was changed"), "{error}");
    assert!(
        error.contains("\n  patches/0007-") && error.contains(": src/client/tls13.rs:"),
        "{error}"
    );

    let error = rebase_in(root, &Options::new("0.23.4000000000")).unwrap_err();
    assert!(error.contains("cannot be had"), "{error}");
    assert_eq!(files(root), before);
}

/// The way back and forth: a workspace that is pinned to another release comes out as this one is.
#[test]
fn a_move_to_the_pinned_release_gives_this_workspace() {
    let Some(dir) = small_workspace() else { return };
    let (root, here) = (dir.path(), files(dir.path()));
    let pinned = upstream::pinned_version(&root.join(CRATE)).unwrap();
    let other = tree::read_dir(&fetch(&root.join(CRATE), OTHER).unwrap()).unwrap();

    // as if the patches had been made for the other release
    let mut edits = pin::Edits::new(root);
    let patches = tree::read_patches(&root.join(CRATE)).unwrap();
    pin::plan(&mut edits, (&pinned, OTHER), &other, &Tree::new(), &patches).unwrap();
    edits.write().unwrap().keep();
    pin::update_locks(root, OTHER).unwrap();
    let there = files(root);

    let options = Options { dry_run: true, ..Options::new(&pinned) };
    let report = rebase_in(root, &options).unwrap();
    assert!(report.contains("dry run, nothing was changed"), "{report}");
    assert_eq!(files(root), there);

    // what the last step finds out puts back what the steps before did
    let lock = root.join("fuzz/Cargo.lock");
    fs::create_dir_all(lock.parent().unwrap()).unwrap();
    fs::write(&lock, format!("\nname = \"rustls\"\nversion = \"{OTHER}\"\n")).unwrap();
    let error = rebase_in(root, &Options::new(&pinned)).unwrap_err();
    assert!(error.contains("fuzz/Cargo.lock cannot be moved"), "{error}");
    fs::remove_dir_all(lock.parent().unwrap()).unwrap();
    assert_eq!(files(root), there);

    let report = rebase_in(root, &Options::new(&pinned)).unwrap();
    for part in [
        &*format!("review list, rustls {OTHER} to {pinned}"),
        "  src/client/hs.rs  +",
        "  patches 0005, 0006",
        "src/client/tls13.rs:",
    ] {
        assert!(report.contains(part), "no {part}: {report}");
    }
    let now = files(root);
    assert_eq!(now.keys().collect::<Vec<_>>(), here.keys().collect::<Vec<_>>());
    for (path, contents) in here {
        assert!(now[&path] == contents, "{}", path.display());
    }
}
