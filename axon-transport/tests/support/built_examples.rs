//! Builds axon-transport's examples.

use std::{
    ffi::OsStr,
    fs,
    path::{Path, PathBuf},
    process::Command,
    sync::Mutex,
    time::SystemTime,
};

/// Returns the folder with the `files` of `examples`. `cargo test` of the workspace builds them; if only one test is
/// requested, this function builds them. `package` is the folder of `axon-transport`.
pub(crate) fn built_examples(package: &Path, examples: &[&str], files: &[&str]) -> PathBuf {
    static BUILDING: Mutex<()> = Mutex::new(());
    let test = std::env::current_exe().unwrap();
    let profile = test.parent().and_then(Path::parent).unwrap();
    let folder = profile.join("examples");
    let _building = BUILDING.lock().unwrap();
    let built =
        |file: &&str| fs::metadata(folder.join(file)).and_then(|facts| facts.modified()).ok();
    // The test program was linked after the crate, and a file of it is as old as it or younger.
    let source = ["src", "shm/src", "examples"].map(|part| newest(&package.join(part)));
    if files.iter().all(|file| built(file) >= source.into_iter().max()) {
        return folder;
    }
    let mut cargo = Command::new(env!("CARGO"));
    cargo.args(["build", "--offline", "-p", "axon-transport", "--features", "sros2"]);
    for example in examples {
        cargo.args(["--example", example]);
    }
    cargo.arg("--target-dir").arg(profile.parent().unwrap());
    if profile.file_name() == Some(OsStr::new("release")) {
        cargo.arg("--release");
    }
    assert!(cargo.status().unwrap().success(), "{cargo:?}");
    folder
}

/// Returns when the newest file in a directory was changed.
fn newest(directory: &Path) -> SystemTime {
    let entries = fs::read_dir(directory).unwrap().map(|entry| entry.unwrap().path());
    let times = entries.map(|path| match path.is_dir() {
        true => newest(&path),
        false => fs::metadata(&path).unwrap().modified().unwrap(),
    });
    times.max().unwrap_or(SystemTime::UNIX_EPOCH)
}
