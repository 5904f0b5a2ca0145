//! Builds C programs against the C interface.

use std::{
    ffi::OsStr,
    fs,
    path::{Path, PathBuf},
    process::Command,
    sync::Once,
    time::SystemTime,
};

/// What a static library of Rust needs of the system.
pub(crate) const SYSTEM: &[&str] =
    &["-lgcc_s", "-lutil", "-lrt", "-lpthread", "-lm", "-ldl", "-lc"];
/// How each of the programs is built.
pub(crate) const WARNINGS: &[&str] = &["-Wall", "-Wextra", "-Wpedantic", "-Werror", "-O1", "-g"];

/// Where something of `axon-transport` is.
pub(crate) fn path(within: &str) -> PathBuf {
    // The tests of `axon-daemon` use this file, too; its folder is in this one.
    let here = Path::new(env!("CARGO_MANIFEST_DIR"));
    let here = if here.ends_with("daemon") { here.parent().unwrap() } else { here };
    here.join(within)
}

/// A library of the C interface. `cargo test` builds it with the examples; where only this test is
/// asked for, it is built here.
pub(crate) fn library(name: &str) -> PathBuf {
    static BUILT: Once = Once::new();
    let program = std::env::current_exe().unwrap();
    let profile = program.parent().and_then(Path::parent).unwrap();
    let library = profile.join("examples").join(name);
    BUILT.call_once(|| {
        let changed = |path: &Path| fs::metadata(path).and_then(|facts| facts.modified()).ok();
        // The test program was linked after the crate, and the library is as old as it or younger.
        let source = newest(&path("src"));
        if changed(&library).is_some_and(|built| built >= source) {
            return;
        }
        let mut cargo = Command::new(env!("CARGO"));
        cargo.args(["build", "--offline", "-p", "axon-transport", "--example", "axon_c"]);
        cargo.arg("--target-dir").arg(profile.parent().unwrap());
        if profile.file_name() == Some(OsStr::new("release")) {
            cargo.arg("--release");
        }
        run(&mut cargo);
    });
    library
}

/// When the newest file in a directory was changed.
fn newest(directory: &Path) -> SystemTime {
    let entries = fs::read_dir(directory).unwrap().map(|entry| entry.unwrap().path());
    let times = entries.map(|path| match path.is_dir() {
        true => newest(&path),
        false => fs::metadata(&path).unwrap().modified().unwrap(),
    });
    times.max().unwrap_or(SystemTime::UNIX_EPOCH)
}

/// Runs a command that must succeed; what it printed.
pub(crate) fn run(command: &mut Command) -> String {
    let output = command.output().unwrap_or_else(|error| panic!("{command:?}: {error}"));
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    let (out, err) = (text(&output.stdout), text(&output.stderr));
    assert!(output.status.success(), "{command:?}: {}\n{out}\n{err}", output.status);
    out
}
