//! What the READMEs say of a checkout: `cargo add --path` and `cargo install`, done as it is written.
//!
//! The other tests take the crates from their packages, as a registry will have them. Until it has,
//! a reader takes them from a checkout, in which rustls-axon is built from patches.

use std::collections::BTreeSet;
use std::fs;
use std::io::{Write, stderr};
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::LazyLock;

use crate::PUBLISHED;
use crate::project::cargo;
use crate::support::{alone, profiles, reached, run, target, workspace};

/// What the pages have readers install. `axon/` is the checkout, and the address is that of its origin.
const INSTALLS: [(&[&str], &str); 5] = [
    (&["--git", env!("CARGO_PKG_REPOSITORY"), "axon-cli"], "axon"),
    (&["--path", "axon-cli"], "axon"),
    (&["--path", "axon/axon-cli"], "axon"),
    (&["--path", "etsi-qkd014", "--features", "sim"], "kme-sim"),
    (&["--path", "axon/etsi-qkd014", "--features", "sim"], "kme-sim"),
];

fn scratch() -> PathBuf {
    Path::new(env!("CARGO_TARGET_TMPDIR")).join("from-checkout")
}

/// A repository with all that git knows or would know of this one. Cargo gives what it keeps of a
/// repository the name of its directory.
const REPOSITORY: &str = "axon-as-a-test-installs-it";

/// A copy of this checkout. `None` without git, and says so. A clone would lack what is not committed, and
/// of a shallow one, as CI has it, cargo makes none.
static ORIGIN: LazyLock<Option<PathBuf>> = LazyLock::new(|| {
    let origin = scratch().join(REPOSITORY);
    let _ = fs::remove_dir_all(&origin);
    fs::create_dir_all(&origin).expect("a directory");
    let known = ["ls-files", "-z", "--cached", "--others", "--exclude-standard"];
    let files = Command::new("git").args(known).current_dir(workspace()).output();
    let Some(files) = files.ok().filter(|files| files.status.success()) else {
        // Past the harness, which would show it only beside a failure.
        let _ = writeln!(stderr(), "skipped: cargo install as the pages say, without git");
        return None;
    };
    for name in String::from_utf8(files.stdout).expect("names").split_terminator('\0') {
        let (from, to) = (workspace().join(name), origin.join(name));
        // One that git knows may have been removed.
        if from.is_file() {
            fs::create_dir_all(to.parent().expect("it is in a directory")).expect("a directory");
            fs::copy(from, to).expect(name);
        }
    }
    let author = ["-c", "user.name=A test", "-c", "user.email=test@axon.invalid"];
    for step in [&["init", "-q"][..], &["add", "-A"], &["commit", "-q", "-m", "As it is"]] {
        run(Command::new("git").args(author).args(step).current_dir(&origin));
    }
    Some(origin)
});

/// Removes what cargo keeps of [`ORIGIN`], also when its test fails: the address is of this machine.
struct ForgetOrigin;

impl Drop for ForgetOrigin {
    fn drop(&mut self) {
        let home = std::env::var_os("CARGO_HOME")
            .map(PathBuf::from)
            .or_else(|| std::env::var_os("HOME").map(|home| PathBuf::from(home).join(".cargo")));
        for kept in ["git/db", "git/checkouts"] {
            let Some(Ok(all)) = home.as_ref().map(|home| fs::read_dir(home.join(kept))) else {
                continue;
            };
            for one in all.flatten() {
                if one.file_name().to_string_lossy().starts_with(REPOSITORY) {
                    let _ = fs::remove_dir_all(one.path());
                }
            }
        }
    }
}

/// Runs `cargo install --locked` with these arguments, one of [`INSTALLS`]; returns the program. Without
/// optimisation, so that what the workspace built is not built again. `None` without a registry or git.
pub(crate) fn installed(arguments: &[&str]) -> Option<PathBuf> {
    let known = INSTALLS.iter().find(|(known, _)| *known == arguments);
    let (_, program) = known.unwrap_or_else(|| panic!("no page says {arguments:?}"));
    let origin = ORIGIN.as_ref()?;
    let [kind, place, rest @ ..] = arguments else { panic!("{arguments:?}") };
    // The checkout has another name here, so that cargo finds in the second way what it built in the first.
    let (dir, place) = match (*kind, place.split_once('/')) {
        ("--git", _) => (scratch(), format!("file://{}", origin.display())),
        (_, Some(("axon", within))) => (scratch(), format!("{REPOSITORY}/{within}")),
        _ => (origin.clone(), (*place).to_owned()),
    };
    let root = scratch().join("root").join(arguments.concat().replace(['/', ':'], "-"));
    let _ = fs::remove_dir_all(&root);
    let mut install = cargo(&dir, &["install", "--locked", kind, &place]);
    let _kept_by_cargo = (*kind == "--git").then_some(ForgetOrigin);
    reached(install.args(rest).args(["--debug", "--root"]).arg(&root))?;
    Some(root.join("bin").join(program))
}

/// All Markdown of the repository but changelogs, which tell of the past.
fn pages() -> Vec<PathBuf> {
    let mut pages = Vec::new();
    let mut dirs = vec![workspace().to_owned()];
    while let Some(dir) = dirs.pop() {
        for entry in fs::read_dir(&dir).expect("a directory").flatten() {
            let (path, name) = (entry.path(), entry.file_name());
            if path.is_dir() {
                let skip = path == target() || name == "target" || name == ".git";
                dirs.extend(Some(path).filter(|path| !skip && !path.is_symlink()));
            } else if path.extension() == Some("md".as_ref()) && name != "CHANGELOG.md" {
                pages.push(path);
            }
        }
    }
    pages
}

/// The rest of each command that begins so, in a block or in a line.
fn told(text: &str, command: &str) -> Vec<String> {
    let ends = |rest: &str| rest.find(['`', '\n', '#']).unwrap_or(rest.len());
    let rests = text.split(command).skip(1).map(|rest| &rest[..ends(rest)]);
    rests.map(|rest| rest.split_whitespace().collect::<Vec<_>>().join(" ")).collect()
}

#[test]
fn each_way_into_a_checkout_that_a_page_shows_is_tried() {
    let (mut adds, mut installs) = (BTreeSet::new(), BTreeSet::new());
    for page in pages() {
        let text = fs::read_to_string(&page).expect("a page");
        adds.extend(told(&text, "cargo add --path "));
        // Tools of others have their own name in a registry's place.
        let ours = |what: &String| !what.starts_with("cargo-");
        installs.extend(told(&text, "cargo install ").into_iter().filter(ours));
    }
    let libraries = PUBLISHED.iter().filter(|(name, _)| *name != "axon-cli");
    assert_eq!(adds, libraries.map(|(_, dir)| format!("axon/{dir}")).collect());
    let tried = INSTALLS.map(|(arguments, _)| format!("--locked {}", arguments.join(" ")));
    assert_eq!(installs, BTreeSet::from(tried));
}

#[test]
fn commands_are_found_in_blocks_and_in_lines() {
    let text = "| `cargo add --path a/b` | and\n```\ncargo add --path  c   # d\n";
    assert_eq!(told(text, "cargo add --path "), ["a/b", "c"]);
}

/// Each with the features that it has by default. One program has all: what each needs by itself shows
/// the test that takes them from their packages.
#[test]
#[ignore = "checks all that the crates depend on"]
fn all_libraries_are_added_from_a_checkout() {
    let dir = scratch().join("adds");
    let _ = fs::remove_dir_all(&dir);
    fs::create_dir_all(dir.join("src")).expect("a directory");
    std::os::unix::fs::symlink(workspace(), dir.join("axon")).expect("a link");
    let own = "[package]\nname = \"adds\"\nversion = \"0.0.0\"\nedition = \"2024\"\n\
               [workspace]\nexclude = [\"axon\"]\n";
    fs::write(dir.join("Cargo.toml"), own.to_owned() + &profiles()).expect("a manifest");
    fs::copy(workspace().join("Cargo.lock"), dir.join("Cargo.lock")).expect("a lock file");
    fs::write(dir.join("src/lib.rs"), "").expect("a file");
    let mut uses = String::new();
    for (name, library) in PUBLISHED.iter().filter(|(name, _)| *name != "axon-cli") {
        let path = format!("axon/{library}");
        if reached(&mut cargo(&dir, &["add", "--path", &path])).is_none() {
            return;
        }
        uses += &format!("use {} as _;\n", name.replace('-', "_"));
    }
    fs::write(dir.join("src/lib.rs"), uses).expect("a file");
    run(&mut cargo(&dir, &["check"]));
}

// `.ci/run` leaves it out: CONTRIBUTING.md has its command.
#[test]
#[ignore = "builds axon-cli once more than the test that has it from a repository"]
fn both_programs_are_installed_by_each_path() {
    for (arguments, _) in INSTALLS.iter().filter(|(arguments, _)| arguments[0] == "--path") {
        let Some(program) = installed(arguments) else { return };
        run(alone(&program).arg("--version"));
    }
}
