//! How the source is made: what the build refuses.

use std::collections::BTreeMap;
use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};

#[path = "../build/patch.rs"]
mod patch;
#[allow(dead_code, reason = "writing the tree is for the build script")]
#[path = "../build/tree.rs"]
mod tree;
#[allow(dead_code, reason = "and so is looking for the source")]
#[path = "../build/upstream.rs"]
mod upstream;

const BEFORE: &str = "one\ntwo\nthree\nfour\nfive\nsix\nseven\n";

/// Changes `four` to `FOUR`.
const PATCH: &str = "\
Why

diff --git a/src/a.rs b/src/a.rs
--- a/src/a.rs
+++ b/src/a.rs
@@ -3,3 +3,3 @@ fn context
 three
-four
+FOUR
 five
";

fn apply(before: &str, patch: &str) -> Result<String, String> {
    let mut tree = BTreeMap::from([("a.rs".to_owned(), before.to_owned())]);
    patch::apply(&mut tree, patch)?;
    Ok(tree.remove("a.rs").unwrap())
}

#[test]
fn a_patch_that_does_not_fit_exactly_is_refused() {
    // one line further down, where a lenient applier would find it
    assert!(apply(&format!("zero\n{BEFORE}"), PATCH).is_err());
    // every line of the hunk changed in turn
    for line in ["three", "four", "five"] {
        let error = apply(&BEFORE.replace(line, "other"), PATCH).unwrap_err();
        assert!(error.starts_with("src/a.rs, hunk at patch line 6: "), "{error}");
    }
    // blanks count
    assert!(apply(&BEFORE.replace("three", "three "), PATCH).is_err());
    assert!(apply(&BEFORE.replace('\n', "\r\n"), PATCH).is_err());
    // the file ends too early
    assert!(apply("one\ntwo\nthree\nfour", PATCH).is_err());
    assert!(apply("", PATCH).is_err());
}

#[test]
fn a_patch_that_is_not_one_is_refused() {
    for (from, to) in [
        ("diff --git a/src/a.rs b/src/a.rs\n", ""),
        ("b/src/a.rs\n---", "b/src/b.rs\n---"),
        ("--- a/src/a.rs\n", "--- /dev/null\n"),
        ("+++ b/src/a.rs\n", "+++ /dev/null\n"),
        ("--- a/src/a.rs\n", "new file mode 100644\n--- a/src/a.rs\n"),
        ("src/a.rs", "src/missing.rs"),
        ("src/a.rs", "../a.rs"),
        ("@@ -3,3 +3,3 @@", "@@ -3,3 +4,3 @@"),
        ("@@ -3,3 +3,3 @@", "@@ -3,4 +3,4 @@"),
        ("@@ -3,3 +3,3 @@", "@@ -3,2 +3,3 @@"),
        ("@@ -3,3 +3,3 @@", "@@ -3,3 +3,2 @@"),
        ("@@ -3,3 +3,3 @@", "@@ -0,3 +0,3 @@"),
        ("@@ -3,3 +3,3 @@", "@@ -99999999999999999999,3 +3,3 @@"),
        ("+FOUR\n", "*FOUR\n"),
        (" five\n", ""),
        (" five\n", " five\nmore\n"),
    ] {
        let patch = PATCH.replace(from, to);
        assert_ne!(patch, PATCH, "{from}");
        assert!(apply(BEFORE, &patch).is_err(), "{patch}");
    }
    for end in 0..PATCH.len() - 1 {
        assert!(apply(BEFORE, &PATCH[..end]).is_err(), "cut at {end}");
    }
}

#[test]
fn a_patch_that_fits_is_applied() {
    assert_eq!(apply(BEFORE, PATCH).unwrap(), BEFORE.replace("four", "FOUR"));
}

fn crate_dir() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

/// A crate with one upstream file, one patch and one added file, and the upstream beside it.
fn small_crate() -> (tempfile::TempDir, PathBuf, PathBuf) {
    let dir = tempfile::tempdir().unwrap();
    let (krate, upstream) = (dir.path().join("crate"), dir.path().join("upstream"));
    for (path, contents) in [
        (upstream.join("a.rs"), BEFORE),
        (upstream.join("lib.rs"), "//! Upstream.\n#![no_std]\n\nextern crate alloc;\nmod a;\n"),
        (krate.join("patches/0001-x.patch"), PATCH),
        (krate.join("added/src/b.rs"), "#[cfg(test)]\nmod tests;\n"),
    ] {
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(path, contents).unwrap();
    }
    let digests = tree::digests(&tree::read_dir(&upstream).unwrap(), "rustls 1.2.3");
    fs::write(krate.join("upstream.sha256"), digests).unwrap();
    (dir, krate, upstream)
}

#[test]
fn the_tree_is_the_patched_files_and_the_added_ones() {
    let (_dir, krate, upstream) = small_crate();
    let made = tree::assemble(&upstream, &krate).unwrap();
    let expected = [
        ("a.rs", BEFORE.replace("four", "FOUR")),
        ("b.rs", "#[cfg(any())]\nmod tests;\n".to_owned()),
        ("lib_body.rs", "extern crate alloc;\nmod a;\n".to_owned()),
    ];
    assert_eq!(made, expected.map(|(path, text)| (path.to_owned(), text)).into());
}

#[test]
fn a_changed_upstream_is_refused_by_name() {
    for (file, contents) in [
        ("a.rs", BEFORE.replace("seven", "eight")),
        // where no patch would notice
        ("lib.rs", "//! Upstream.\n#![no_std]\n\nextern crate alloc;\nmod a; \n".to_owned()),
        ("new.rs", String::new()),
    ] {
        let (_dir, krate, upstream) = small_crate();
        fs::write(upstream.join(file), contents).unwrap();
        let error = tree::assemble(&upstream, &krate).unwrap_err();
        assert!(error.contains(&format!("src/{file}")), "{error}");
    }

    let (_dir, krate, upstream) = small_crate();
    fs::remove_file(upstream.join("a.rs")).unwrap();
    let error = tree::assemble(&upstream, &krate).unwrap_err();
    assert_eq!(error, "src/a.rs is listed in upstream.sha256 and does not exist");
}

#[test]
fn an_added_file_never_replaces_one() {
    let (_dir, krate, upstream) = small_crate();
    fs::write(krate.join("added/src/a.rs"), "").unwrap();
    let error = tree::assemble(&upstream, &krate).unwrap_err();
    assert_eq!(error, "added/src/a.rs: rustls has a file of that name");
}

#[test]
fn another_version_is_refused_with_the_way_out() {
    let pinned = upstream::pinned_version(crate_dir()).unwrap();
    assert_eq!(upstream::check_version(&pinned, &pinned), Ok(()));
    let error = upstream::check_version("0.23.99", &pinned).unwrap_err();
    for part in ["rustls 0.23.99", &*pinned, "cargo update -p rustls@0.23.99 --precise"] {
        assert!(error.contains(part), "{error}");
    }
}

/// As in a project that took this crate by its path and resolved a newer rustls: cargo fetched that one, and
/// nothing had it fetch the pinned one.
#[test]
fn a_pinned_rustls_that_cargo_never_fetched_is_named_with_the_command_that_does() {
    let dir = tempfile::tempdir().unwrap();
    let (cargo, home) = (dir.path().join("cargo"), dir.path().join("home"));
    let script = format!(
        "#!/bin/sh\nCARGO_HOME='{}' exec '{}' \"$@\"\n",
        home.display(),
        std::env::var("CARGO").unwrap()
    );
    fs::write(&cargo, script).unwrap();
    fs::set_permissions(&cargo, fs::Permissions::from_mode(0o755)).unwrap();
    let host = "x86_64-unknown-linux-gnu";
    let error = upstream::locate(&cargo, crate_dir(), host, &dir.path().join("where")).unwrap_err();
    let fetch = format!(
        "cargo fetch --locked --manifest-path {}",
        crate_dir().join("Cargo.toml").display()
    );
    assert!(error.contains(&fetch), "{error}");
}

/// The committed patches: one purpose each, said in front, and no more of rustls than a diff needs.
#[test]
fn patches_have_a_reason_and_little_context() {
    let patches = tree::read_dir(&crate_dir().join("patches"));
    // a package has the result instead
    for (name, patch) in patches.into_iter().flatten() {
        let (why, diff) = patch.split_once("\ndiff --git ").expect(&name);
        let (subject, body) = why.split_once("\n\n").expect(&name);
        assert!(subject.len() <= 72 && body.len() > 80, "{name}: what and why");

        let mut context = 0;
        for line in diff.lines() {
            context = if line.starts_with(' ') || line.is_empty() { context + 1 } else { 0 };
            assert!(context <= 6, "{name}: three lines of context after and before a change");
        }
    }
}
