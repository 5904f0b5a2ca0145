//! Code that the tests of this crate share: the workspace, commands, and the environment of AXON's programs.
#![allow(dead_code, reason = "each test file uses its own part")]

#[path = "../../../axon-transport/daemon/tests/support/excerpt.rs"]
mod excerpt;

use std::fs;
use std::io::{Write, stderr};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output};

use excerpt::excerpt;

/// The messages of cargo if the registry is unreachable.
const UNREACHABLE: [&str; 6] = [
    "failed to download",
    "download of config.json failed",
    "Could not resolve host",
    "Couldn't resolve host",
    "spurious network error",
    "network failure seems to have happened",
];

pub(crate) fn workspace() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("xtask is in the repository")
}

/// Returns the Rust sources below a folder. Files and folders with a name in `without`, and hidden folders, are left
/// out.
pub(crate) fn rust_sources(folder: &Path, without: &[&str]) -> Vec<PathBuf> {
    let mut sources = Vec::new();
    for entry in fs::read_dir(folder).expect("a folder of sources") {
        let path = entry.expect("an entry").path();
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        if without.contains(&&*name) || name.starts_with('.') {
            continue;
        }
        if path.is_dir() {
            sources.extend(rust_sources(&path, without));
        } else if name.ends_with(".rs") {
            sources.push(path);
        }
    }
    sources
}

/// The workspace's target directory: it has aws-lc, built.
pub(crate) fn target() -> &'static Path {
    Path::new(env!("CARGO_TARGET_TMPDIR")).parent().expect("it is in the target directory")
}

/// The profiles of the workspace's manifest. A project that has them too builds nothing again that was
/// built for the workspace.
pub(crate) fn profiles() -> String {
    let manifest = fs::read_to_string(workspace().join("Cargo.toml")).expect("the manifest");
    manifest[manifest.find("\n[profile.dev]").expect("a profile")..].to_owned()
}

/// Runs a command that has to succeed. If it fails, the panic shows an excerpt of its output.
#[track_caller]
pub(crate) fn run(command: &mut Command) -> Output {
    let output = command.output().unwrap_or_else(|error| panic!("{command:?}: {error}"));
    assert_success(command, &output);
    output
}

#[track_caller]
fn assert_success(command: &Command, output: &Output) {
    if !output.status.success() {
        let part = |name, bytes| excerpt(name, &String::from_utf8_lossy(bytes));
        let (out, err) = (part("stdout", &output.stdout), part("stderr", &output.stderr));
        panic!("{command:?}: {}\n{out}\n{err}", output.status);
    }
}

#[test]
fn of_a_command_that_fails_a_part_is_shown() {
    let mut command = Command::new("sh");
    command.args(["-c", "seq 5000; echo 'error[E0277]: this' >&2; seq 5000 >&2; exit 3"]);
    let failed = catch_unwind(AssertUnwindSafe(|| run(&mut command))).expect_err("it fails");
    let shown = failed.downcast_ref::<String>().expect("a message");
    assert!(shown.lines().count() < 250, "{shown}");
    for part in ["exit status: 3", "\n5000", "error[E0277]: this", "all 5001 lines are in "] {
        assert!(shown.contains(part), "{part}: {shown}");
    }
}

/// Runs a command that needs the registry. `None` where that is out of reach, and says so.
#[track_caller]
pub(crate) fn reached(command: &mut Command) -> Option<()> {
    let output = command.output().expect("cargo runs");
    let why = String::from_utf8_lossy(&output.stderr);
    if !output.status.success() && UNREACHABLE.iter().any(|part| why.contains(part)) {
        let why = excerpt("stderr", &why);
        // Past the harness, which would show it only beside a failure.
        let _ = writeln!(stderr(), "skipped: the registry is out of reach:\n{why}");
        return None;
    }
    assert_success(command, &output);
    Some(())
}

/// Unpacks a `.crate` file into a directory; returns the package's own directory in it.
pub(crate) fn unpack(file: &Path, into: &Path) -> PathBuf {
    // -m: cargo goes by the time of a file, and all packed ones have the same
    run(Command::new("tar").arg("-xmzf").arg(file).arg("-C").arg(into));
    into.join(file.file_stem().expect("name and version"))
}

/// A program with nothing of AXON or ROS 2 in its environment.
pub(crate) fn alone(program: &Path) -> Command {
    let mut command = Command::new(program);
    let ours = |name: &str| name.starts_with("AXON_") || name.starts_with("ROS_");
    for (name, _) in std::env::vars().filter(|(name, _)| ours(name)) {
        command.env_remove(name);
    }
    command
}

/// Returns the same command with a daemon that keeps its files in a directory, ends soon, and talks to no other host.
pub(crate) fn with_daemon(program: &Path, directory: &Path) -> Command {
    let config = directory.join("axon.toml");
    fs::write(&config, "[link]\ngrace_s = 1\n").expect("a file");
    let mut command = alone(program);
    command.env("AXON_CONFIG", config).env("AXON_RUNTIME_DIR", directory.join("run"));
    command.env("AXON_BIND_ADDRS", "127.0.0.1").env("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST");
    command
}

/// A process that does not outlive the test.
pub(crate) struct Kept(pub(crate) Child);

impl Drop for Kept {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}
