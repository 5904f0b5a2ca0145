//! Tests the installation by `cargo xtask install-c`. Programs in C build and run with it as the README of
//! axon-transport says, linked with either library. The shared library exports only the functions that the header
//! declares.
//!
//! It builds axon-transport by itself, with other features than the workspace's, so that all that it
//! depends on may be built once more: `cargo test -p xtask --test install_c -- --include-ignored`.

mod support;

use std::collections::BTreeSet;
use std::fs;
use std::io::{Write, stderr};
use std::path::{Path, PathBuf};
use std::process::Command;

use support::{Kept, run, target, with_daemon, workspace};

/// A program that prints the errors of a session with permissions of an enclave.
const LIMITED: &str = "#include <axon.h>
#include <stdio.h>
int main(void) {
    axon_session_options_t options;
    axon_session_t session;
    if (axon_session_options_init(&options, AXON_SESSION_ABI) != AXON_RET_OK) {
        return 1;
    }
    options.permissions_path = \"permissions.p7s\";
    options.enclave = \"/arm\";
    int returned = axon_session_open(&options, &session);
    printf(\"%d %s\\n\", returned, axon_session_last_error());
    return 0;
}
";

/// Runs a command and returns its output.
fn printed(command: &mut Command) -> String {
    String::from_utf8_lossy(&run(command).stdout).into_owned()
}

/// The directory of the installation.
struct Installed(tempfile::TempDir);

impl Installed {
    fn new() -> Self {
        let prefix = tempfile::tempdir().unwrap();
        let mut install = Command::new(env!("CARGO_BIN_EXE_xtask"));
        // The build of the workspace is reused here.
        install.env("CARGO_TARGET_DIR", target()).args(["install-c"]).arg(prefix.path()).arg("dev");
        run(&mut install);
        Self(prefix)
    }

    fn path(&self, within: &str) -> PathBuf {
        self.0.path().join(within)
    }

    /// The functions that the header declares.
    fn declared(&self) -> BTreeSet<String> {
        let header = fs::read_to_string(self.path("include/axon.h")).unwrap();
        let declarations =
            header.split('(').filter_map(|before| before.rsplit([' ', '*', '\n']).next());
        // Types of functions have a parenthesis behind the name, too.
        let functions =
            declarations.filter(|name| name.starts_with("axon_") && !name.ends_with(')'));
        functions.map(str::to_owned).collect()
    }

    /// Returns the functions that the shared library exports.
    fn exported(&self) -> BTreeSet<String> {
        let library = self.path("lib/libaxon_transport.so");
        let symbols = printed(Command::new("nm").args(["-D", "--defined-only"]).arg(library));
        symbols.lines().filter_map(|line| line.split(' ').nth(2)).map(str::to_owned).collect()
    }

    /// Returns the answer of pkg-config.
    fn asked(&self, options: &[&str]) -> Vec<String> {
        let mut ask = Command::new("pkg-config");
        ask.env("PKG_CONFIG_PATH", self.path("lib/pkgconfig")).args(options).arg("axon-transport");
        printed(&mut ask).split_whitespace().map(str::to_owned).collect()
    }

    /// An example, built as the README says.
    fn example(&self, name: &str, options: &[&str]) -> PathBuf {
        let source = workspace().join("axon-transport/examples/c").join(name).with_extension("c");
        let program = self.path(name);
        run(Command::new("cc").arg(source).args(self.asked(options)).arg("-o").arg(&program));
        program
    }

    /// A program among which there is a daemon of theirs, which does not stay long.
    fn command(&self, program: &Path) -> Command {
        let mut command = with_daemon(program, self.0.path());
        command.env("LD_LIBRARY_PATH", self.path("lib"));
        command.env("AXON_DAEMON_PATH", self.asked(&["--variable=daemon"]).concat());
        command
    }
}

#[test]
#[ignore = "builds all that axon-transport depends on once more"]
fn c_programs_build_and_run_against_the_installed_files() {
    let installed = Installed::new();
    let declared = installed.declared();
    assert!(declared.len() > 30, "{declared:?}");
    assert_eq!(installed.exported(), declared);

    if !Command::new("pkg-config").arg("--version").output().is_ok_and(|o| o.status.success()) {
        // Past the harness, which would show it only beside a failure.
        let _ = writeln!(stderr(), "skipped: pkg-config is not installed");
        return;
    }
    let talker = installed.example("talker", &["--cflags", "--libs"]);
    let needed =
        printed(Command::new("ldd").env("LD_LIBRARY_PATH", installed.path("lib")).arg(&talker));
    assert!(needed.contains("libaxon_transport.so => "), "{needed}");
    // The linker takes the static library where the other is missing.
    let shared = installed.path("lib/libaxon_transport.so");
    let aside = installed.path("libaxon_transport.so");
    fs::rename(&shared, &aside).unwrap();
    let listener = installed.example("listener", &["--cflags", "--libs", "--static"]);
    fs::rename(&aside, &shared).unwrap();

    // Built without the feature sros2, it opens no session that it could not limit.
    let limited = installed.path("limited.c");
    fs::write(&limited, LIMITED).unwrap();
    let program = installed.path("limited");
    let options = installed.asked(&["--cflags", "--libs"]);
    run(Command::new("cc").arg(&limited).args(options).arg("-o").arg(&program));
    let refused = printed(&mut installed.command(&program));
    assert!(refused.starts_with("3 ") && refused.contains("feature sros2"), "{refused}");

    let _talker = Kept(installed.command(&talker).spawn().unwrap());
    let heard = printed(&mut installed.command(&listener));
    assert_eq!(heard.lines().filter(|line| line.starts_with("heard hello ")).count(), 3, "{heard}");
}
