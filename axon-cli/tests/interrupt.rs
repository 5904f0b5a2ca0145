//! A demo that is stopped leaves neither processes nor files behind.

#![forbid(unsafe_code)]

mod common;

use std::{
    io::{BufRead, BufReader},
    path::Path,
};

use common::{Running, axon, eventually};
use rustix::process::{Pid, Signal, kill_process};

/// Processes that were started with `text` in their environment.
fn processes_with(text: &Path) -> usize {
    use std::os::unix::ffi::OsStrExt;
    let needle = text.as_os_str().as_bytes();
    let environment = |process: std::fs::DirEntry| std::fs::read(process.path().join("environ"));
    std::fs::read_dir("/proc")
        .expect("procfs")
        .filter_map(Result::ok)
        .filter_map(|process| environment(process).ok())
        .filter(|environment| environment.windows(needle.len()).any(|part| part == needle))
        .count()
}

/// Starts the demo and sends `signal` when it is in the middle of a replay.
fn stop_with(signal: Signal, temporary: &Path) -> Running {
    let mut command = axon([("TMPDIR", temporary.to_str().expect("UTF-8"))]);
    command.arg("demo");
    let mut demo = Running::start(command);
    let mut stderr = BufReader::new(demo.0.stderr.take().expect("standard error")).lines();
    let replaying = stderr.any(|line| line.expect("text").ends_with(": replaying"));
    assert!(replaying, "the demo ended before it replayed anything");
    assert!(processes_with(temporary) > 4, "two daemons, two subscribers and a player");
    let pid = i32::try_from(demo.0.id()).ok().and_then(Pid::from_raw).expect("a process id");
    kill_process(pid, signal).expect("it runs");
    // The rest of its output must not fill the pipe.
    let _ = stderr.count();
    demo
}

#[test]
fn stopped_by_a_signal_it_ends_its_processes_and_removes_its_files() {
    for signal in [Signal::INT, Signal::TERM] {
        let temporary = tempfile::tempdir().expect("temporary directory");
        let demo = stop_with(signal, temporary.path());
        assert_eq!(demo.finish().status.code(), Some(1));
        assert_eq!(processes_with(temporary.path()), 0, "after {signal:?}");
        let left = std::fs::read_dir(temporary.path()).expect("directory").count();
        assert_eq!(left, 0, "after {signal:?}");
    }
}

#[test]
fn killed_it_cannot_clean_up_but_its_processes_end() {
    let temporary = tempfile::tempdir().expect("temporary directory");
    let demo = stop_with(Signal::KILL, temporary.path());
    demo.finish();
    eventually("the end of its processes", || processes_with(temporary.path()) == 0);
}
