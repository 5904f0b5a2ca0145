//! The process whose memory is searched.

use std::{
    fs::File,
    io::{BufRead, BufReader, Lines, Read, Write},
    os::fd::AsFd,
    process::{Child, ChildStdin, ChildStdout, Command, Stdio},
};

/// The variable that gives the test binary its task as the child.
const VARIABLE: &str = "AXON_RESIDUE";

/// In the child: returns the task.
pub(crate) fn task() -> Option<String> {
    std::env::var(VARIABLE).ok()
}

/// In the child: returns standard input, without a buffer that would keep the bytes that were read.
pub(crate) fn input() -> File {
    std::io::stdin().as_fd().try_clone_to_owned().unwrap().into()
}

/// In the child: reports that it has reached this point, and waits until it has been searched.
pub(crate) fn pause(input: &mut File) {
    std::io::stdout().write_all(b"paused\n").unwrap();
    input.read_exact(&mut [0]).unwrap();
}

/// The child, which ends with this.
pub(crate) struct Searched {
    child: Child,
    stdin: ChildStdin,
    lines: Lines<BufReader<ChildStdout>>,
}

impl Searched {
    /// Runs `test` of this binary in a process of its own, which then finds its [`task`].
    pub(crate) fn start(test: &str, task: &str) -> Self {
        let mut child = Command::new(std::env::current_exe().unwrap())
            .args(["--exact", test, "--nocapture"])
            .env(VARIABLE, task)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let stdin = child.stdin.take().unwrap();
        let lines = BufReader::new(child.stdout.take().unwrap()).lines();
        Self { child, stdin, lines }
    }

    pub(crate) fn pid(&self) -> u32 {
        self.child.id()
    }

    /// Sends it bytes.
    pub(crate) fn send(&mut self, bytes: &[u8]) {
        self.stdin.write_all(bytes).unwrap();
    }

    /// Waits until it pauses.
    pub(crate) fn paused(&mut self) {
        let paused =
            self.lines.find(|line| line.as_ref().is_ok_and(|line| line.ends_with("paused")));
        assert!(paused.is_some(), "the child ended before its time");
    }

    /// Lets it go on.
    pub(crate) fn resume(&mut self) {
        self.send(b"\n");
    }
}

impl Drop for Searched {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
