//! Variables that begin with `AXON_` and belong to other programs: the daemon and the session warn
//! of them.

use std::{fs, fs::File};

use super::*;
use crate::support::Kept;

/// A host with such a variable, and with the default logging.
fn host() -> Host {
    Host::new().without("AXON_LOG").with("AXON_EDITOR", "hunter2")
}

/// Returns the lines of a log that name the variable.
fn lines(log: &str) -> Vec<&str> {
    assert!(!log.contains("hunter2"), "the value may be a secret: {log}");
    log.lines().filter(|line| line.contains("AXON_EDITOR")).collect()
}

#[test]
fn a_daemon_warns_in_its_log() {
    let host = host();
    let log = host.dir.path().join("stderr");
    let mut command = host.command(env!("CARGO_BIN_EXE_axon_daemon"));
    let _daemon = Kept(command.stderr(File::create(&log).unwrap()).spawn().unwrap());
    until("the daemon answers", || host.status().is_ok());
    let log = fs::read_to_string(log).unwrap();
    let [line] = lines(&log)[..] else { panic!("one line: {log}") };
    assert!(line.contains("WARN") && line.contains("AXON_STRICT_ENV"), "{line}");
}

#[test]
fn a_process_with_sessions_warns_once() {
    let host = host().with("AXON_DAEMON", "off");
    let log = host.dir.path().join("stderr");
    let mut command = host.command(std::env::current_exe().unwrap());
    command.stderr(File::create(&log).unwrap());
    let mut player = host.play_in(command, "foreign");
    assert_eq!(player.hear(), "opened");
    player.finish();
    let log = fs::read_to_string(log).unwrap();
    let [line] = lines(&log)[..] else { panic!("one line: {log}") };
    assert!(line.contains("WARN") && line.contains("AXON_STRICT_ENV"), "{line}");
}

/// The child: shows what a program sees that collects the log of its libraries.
pub(crate) fn sessions() {
    let log = tracing_subscriber::fmt().with_max_level(tracing::Level::WARN);
    log.with_writer(std::io::stderr).init();
    let _sessions = [(); 2].map(|()| support::of_child("foreign"));
    say("opened");
}
