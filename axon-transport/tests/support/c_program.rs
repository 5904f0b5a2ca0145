//! Builds C programs against the C interface.

#[path = "built_examples.rs"]
mod built_examples;

use std::{
    path::{Path, PathBuf},
    process::Command,
};

use built_examples::built_examples;

/// The system libraries that a static library of Rust needs.
pub(crate) const SYSTEM: &[&str] =
    &["-lgcc_s", "-lutil", "-lrt", "-lpthread", "-lm", "-ldl", "-lc"];
/// The compiler flags of each program.
pub(crate) const WARNINGS: &[&str] = &["-Wall", "-Wextra", "-Wpedantic", "-Werror", "-O1", "-g"];

/// Returns the path of a file of `axon-transport`.
pub(crate) fn path(within: &str) -> PathBuf {
    // The tests of `axon-daemon` use this file, too; its folder is in this one.
    let here = Path::new(env!("CARGO_MANIFEST_DIR"));
    let here = if here.ends_with("daemon") { here.parent().unwrap() } else { here };
    here.join(within)
}

/// Returns the path of a library of the C interface.
pub(crate) fn library(name: &str) -> PathBuf {
    built_examples(&path(""), &["axon_c"], &[name]).join(name)
}

/// Runs a command that must succeed; what it printed.
pub(crate) fn run(command: &mut Command) -> String {
    let output = command.output().unwrap_or_else(|error| panic!("{command:?}: {error}"));
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    let (out, err) = (text(&output.stdout), text(&output.stderr));
    assert!(output.status.success(), "{command:?}: {}\n{out}\n{err}", output.status);
    out
}
