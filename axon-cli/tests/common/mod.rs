//! One host for a test: a runtime directory of its own, and the tool under its settings.

#![allow(dead_code, reason = "each test program uses its part")]

use std::{
    io::{BufRead, BufReader},
    process::{Child, ChildStdout, Command, Output, Stdio},
    sync::atomic::{AtomicU32, Ordering},
    time::{Duration, Instant},
};

/// The log that comes with the repository.
pub(crate) const LOG: &str =
    concat!(env!("CARGO_MANIFEST_DIR"), "/../examples/data/mit-csail.mcap");

/// The tool under no setting of AXON or ROS but `settings`.
pub(crate) fn axon<'a>(settings: impl IntoIterator<Item = (&'a str, &'a str)>) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_axon"));
    for (name, _) in std::env::vars_os() {
        let text = name.to_string_lossy();
        if text.starts_with("AXON_") || text.starts_with("ROS_") {
            command.env_remove(&name);
        }
    }
    command.envs(settings).stdin(Stdio::null());
    command
}

/// A host; what it has started ends with it.
pub(crate) struct Host {
    dir: tempfile::TempDir,
    domain: String,
}

impl Host {
    pub(crate) fn new() -> Self {
        static NEXT: AtomicU32 = AtomicU32::new(0);
        let dir = tempfile::tempdir().expect("temporary directory");
        // Tests run at the same time, and daemons outlive them by their grace time: each package's
        // tests have a range of domains to themselves, as has the demo.
        let number = std::process::id().wrapping_mul(7) + NEXT.fetch_add(1, Ordering::Relaxed);
        Self { dir, domain: (100 + number % 60).to_string() }
    }

    pub(crate) fn axon(&self, args: &[&str]) -> Command {
        let dir = self.dir.path().to_str().expect("a path in UTF-8");
        let mut command = axon([
            ("AXON_RUNTIME_DIR", dir),
            ("AXON_BIND_ADDRS", "127.0.0.1"),
            ("ROS_DOMAIN_ID", self.domain.as_str()),
        ]);
        command.args(args);
        command
    }

    pub(crate) fn run(&self, args: &[&str]) -> Output {
        self.axon(args).output().expect("the tool runs")
    }

    pub(crate) fn status(&self) -> Option<serde_json::Value> {
        let output = self.run(&["status", "--json"]);
        output.status.success().then(|| serde_json::from_slice(&output.stdout).expect("JSON"))
    }

    /// The process id of the daemon.
    pub(crate) fn daemon(&self) -> Option<i32> {
        let pid = self.status()?["pid"].as_i64().expect("a process id");
        Some(i32::try_from(pid).expect("a process id"))
    }

    pub(crate) fn kill_daemon(&self, signal: rustix::process::Signal) -> bool {
        let pid = self.daemon().and_then(rustix::process::Pid::from_raw);
        pid.is_some_and(|pid| rustix::process::kill_process(pid, signal).is_ok())
    }
}

impl Drop for Host {
    fn drop(&mut self) {
        self.kill_daemon(rustix::process::Signal::TERM);
    }
}

/// A process that is killed when it is dropped.
pub(crate) struct Running(pub(crate) Child);

impl Running {
    pub(crate) fn start(mut command: Command) -> Self {
        command.stdout(Stdio::piped()).stderr(Stdio::piped());
        Self(command.spawn().expect("the tool starts"))
    }

    pub(crate) fn lines(&mut self) -> impl Iterator<Item = String> + use<> {
        let out: ChildStdout = self.0.stdout.take().expect("standard output");
        BufReader::new(out).lines().map(|line| line.expect("text"))
    }

    pub(crate) fn finish(mut self) -> Output {
        let output = |pipe: Option<&mut dyn std::io::Read>| {
            let mut bytes = Vec::new();
            if let Some(pipe) = pipe {
                pipe.read_to_end(&mut bytes).expect("output");
            }
            bytes
        };
        let stderr = output(self.0.stderr.as_mut().map(|pipe| pipe as _));
        let stdout = output(self.0.stdout.as_mut().map(|pipe| pipe as _));
        let status = self.0.wait().expect("it ends");
        Output { status, stdout, stderr }
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Waits until `reached`; a test that waits in vain fails.
pub(crate) fn eventually(what: &str, mut reached: impl FnMut() -> bool) {
    let deadline = Instant::now() + Duration::from_secs(60);
    while !reached() {
        assert!(Instant::now() < deadline, "in vain: {what}");
        std::thread::sleep(Duration::from_millis(20));
    }
}
