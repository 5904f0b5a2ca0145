//! One host for a test: a runtime directory of its own, and the tool under its settings.

#![allow(dead_code, reason = "each test program uses its part")]

#[path = "../../../axon-transport/daemon/tests/support/excerpt.rs"]
mod excerpt;

use std::{
    fmt,
    io::{BufRead, BufReader},
    ops::Deref,
    process::{Child, ChildStdout, Command, Output, Stdio},
    sync::atomic::{AtomicU32, Ordering},
    time::{Duration, Instant},
};

/// The standard error of a program. A failed assertion shows an excerpt of it.
pub(crate) struct Stderr(String);

impl Stderr {
    pub(crate) fn of(bytes: &[u8]) -> Self {
        Self(String::from_utf8_lossy(bytes).into_owned())
    }
}

impl Deref for Stderr {
    type Target = str;

    fn deref(&self) -> &str {
        &self.0
    }
}

impl fmt::Display for Stderr {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&excerpt::excerpt("stderr", self))
    }
}

impl fmt::Debug for Stderr {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&excerpt::excerpt("stderr", &format!("{:?}", self.0)))
    }
}

/// The log that comes with the repository.
pub(crate) const LOG: &str =
    concat!(env!("CARGO_MANIFEST_DIR"), "/../examples/data/mit-csail.mcap");

/// Returns the command of the tool, with no settings of AXON or ROS except `settings`.
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
    address: String,
    /// The other host of a pair.
    peer: Option<String>,
}

impl Host {
    pub(crate) fn new() -> Self {
        Self::at("127.0.0.1".to_owned(), None, Self::domain())
    }

    /// Creates two hosts that list each other.
    pub(crate) fn pair() -> [Self; 2] {
        let (net, domain) = (1 + std::process::id() % 250, Self::domain());
        let [a, b] = [1, 2].map(|host| format!("127.9.{net}.{host}"));
        [(a.clone(), b.clone()), (b, a)]
            .map(|(address, peer)| Self::at(address, Some(peer), domain.clone()))
    }

    fn at(address: String, peer: Option<String>, domain: String) -> Self {
        let dir = tempfile::tempdir().expect("temporary directory");
        Self { dir, domain, address, peer }
    }

    /// Returns a domain. Tests run at the same time, and daemons outlive them by their grace time, so each package's
    /// tests have a range of domains of their own, as has the demo.
    fn domain() -> String {
        static NEXT: AtomicU32 = AtomicU32::new(0);
        let number = std::process::id().wrapping_mul(7) + NEXT.fetch_add(1, Ordering::Relaxed);
        (100 + number % 60).to_string()
    }

    pub(crate) fn axon(&self, args: &[&str]) -> Command {
        let dir = self.dir.path().to_str().expect("a path in UTF-8");
        let mut command = axon([
            ("AXON_RUNTIME_DIR", dir),
            ("AXON_BIND_ADDRS", self.address.as_str()),
            ("AXON_DAEMON_PEERS", self.peer.as_deref().unwrap_or_default()),
            ("ROS_DOMAIN_ID", self.domain.as_str()),
        ]);
        command.args(args);
        command
    }

    /// Opens a session of this process with the daemon of the host, which runs already.
    pub(crate) fn session(&self, name: &str) -> axon_transport::Session {
        let config = axon_transport::config::Config::builder()
            .runtime_dir(self.dir.path())
            .domain(self.domain.parse().expect("a number"))
            .build()
            .expect("settings");
        let options = axon_transport::SessionOptions::new(name);
        axon_transport::Session::open(&config, options).expect("a session")
    }

    pub(crate) fn run(&self, args: &[&str]) -> Output {
        self.axon(args).output().expect("the tool runs")
    }

    pub(crate) fn status(&self) -> Option<serde_json::Value> {
        let output = self.run(&["status", "--json"]);
        output.status.success().then(|| serde_json::from_slice(&output.stdout).expect("JSON"))
    }

    /// Returns the number of messages that are published here.
    pub(crate) fn published(&self) -> u64 {
        let Some(status) = self.status() else { return 0 };
        let topics = status["topics"].as_array().expect("topics");
        topics.iter().map(|topic| topic["published"].as_u64().expect("a count")).sum()
    }

    /// Returns the process id of the daemon.
    pub(crate) fn daemon(&self) -> Option<i32> {
        let pid = self.status()?["pid"].as_i64().expect("a process id");
        Some(i32::try_from(pid).expect("a process id"))
    }

    /// Waits until the daemon answers, and returns its pid.
    pub(crate) fn wait_daemon(&self) -> i32 {
        let mut daemon = None;
        eventually("a daemon answers", || {
            daemon = self.daemon();
            daemon.is_some()
        });
        daemon.expect("it answered")
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

/// An `echo` for each topic of the log, its messages awaited.
pub(crate) struct Echoes([(Running, u64); 3]);

impl Echoes {
    pub(crate) fn start(host: &Host) -> Self {
        Self([("/scan", 1_988), ("/odom", 1_988), ("/tf", 1_988)].map(|(topic, count)| {
            let text = count.to_string();
            let args = ["echo", topic, "--qos", "keep-all", "--json", "--count", &text];
            (Running::start(host.axon(&args)), count)
        }))
    }

    /// Checks that every message came, once and in order.
    pub(crate) fn assert_whole(self) {
        for (mut echo, count) in self.0 {
            let sequences: Vec<u64> = echo.lines().map(|line| sequence(&line)).collect();
            assert_eq!(sequences, (1..=count).collect::<Vec<_>>());
            assert!(echo.finish().status.success());
        }
    }
}

pub(crate) fn sequence(line: &str) -> u64 {
    let message: serde_json::Value = serde_json::from_str(line).expect("JSON");
    message["sequence"].as_u64().expect("a sequence number")
}

/// Waits until `reached`; a test that waits in vain fails.
pub(crate) fn eventually(what: &str, mut reached: impl FnMut() -> bool) {
    let deadline = Instant::now() + Duration::from_secs(60);
    while !reached() {
        assert!(Instant::now() < deadline, "in vain: {what}");
        std::thread::sleep(Duration::from_millis(20));
    }
}
