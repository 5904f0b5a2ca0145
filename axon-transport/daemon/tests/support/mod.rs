//! A host for each test: a runtime directory, a daemon binary, and child processes that play applications. A child is
//! this test program itself; the variable `PLAY` names its part.

pub(crate) mod excerpt;
mod kept;

use std::{
    ffi::OsString,
    fs,
    io::{BufRead, BufReader, Lines, Write as _},
    path::Path,
    process::{ChildStdout, Command, Stdio},
    time::{Duration, Instant},
};

use axon_transport::{
    Session, SessionError, SessionOptions,
    config::{Config, ConfigError, DaemonPolicy, OsFiles},
    daemon_status,
    status::Status,
};

pub(crate) use kept::Kept;

/// Long enough for a loaded machine. A test that works never waits this long.
pub(crate) const PATIENCE: Duration = Duration::from_secs(60);
/// The beginning of each line from a child to its test.
const MARK: &str = "## ";

pub(crate) struct Host {
    pub(crate) dir: tempfile::TempDir,
    pub(crate) env: Vec<(String, String)>,
}

impl Host {
    pub(crate) fn new() -> Self {
        let dir = tempfile::tempdir().unwrap();
        let run = dir.path().join("run");
        let env = [
            ("AXON_RUNTIME_DIR", run.to_str().unwrap()),
            ("AXON_DAEMON_PATH", env!("CARGO_BIN_EXE_axon_daemon")),
            ("AXON_BIND_ADDRS", "127.0.0.1"),
            // Hosts of other tests are on the same loopback interface.
            ("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST"),
            ("AXON_LOG", "debug"),
        ];
        Self { env: env.map(|(n, v)| (n.to_owned(), v.to_owned())).into(), dir }
    }

    #[allow(dead_code, reason = "not every test needs it")]
    pub(crate) fn with(mut self, name: &str, value: &str) -> Self {
        self.env.retain(|(n, _)| n != name);
        self.env.push((name.to_owned(), value.to_owned()));
        self
    }

    #[allow(dead_code, reason = "not every test needs it")]
    pub(crate) fn without(mut self, name: &str) -> Self {
        self.env.retain(|(n, _)| n != name);
        self
    }

    /// Returns, for this process, the configuration that its processes read.
    pub(crate) fn config(&self) -> Config {
        self.try_config().unwrap()
    }

    fn try_config(&self) -> Result<Config, ConfigError> {
        let env = self.env.iter().map(|(n, v)| (OsString::from(n), OsString::from(v)));
        Config::resolve(env, None, &OsFiles)
    }

    /// Opens a session in this process with the running daemon. It starts no daemon, which would outlive the test.
    pub(crate) fn session(&self, name: &str) -> Result<Session, SessionError> {
        let mut config = self.config();
        config.daemon = DaemonPolicy::Require;
        Session::open(&config, SessionOptions::new(name))
    }

    pub(crate) fn status(&self) -> Result<Status, SessionError> {
        daemon_status(&self.try_config()?).map(|json| serde_json::from_str(&json).unwrap())
    }

    pub(crate) fn command(&self, program: impl AsRef<Path>) -> Command {
        let mut command = Command::new(program.as_ref());
        let axon = |name: &str| ["AXON_", "ROS_", "XDG_"].iter().any(|p| name.starts_with(p));
        for (name, _) in std::env::vars().filter(|(name, _)| axon(name)) {
            command.env_remove(name);
        }
        command.envs(self.env.iter().map(|(n, v)| (n, v)));
        command
    }

    /// Starts a daemon in the foreground, and waits until it answers.
    pub(crate) fn daemon(&self) -> Kept {
        self.daemon_by(self.command(env!("CARGO_BIN_EXE_axon_daemon")))
    }

    /// Like [`daemon`](Self::daemon); `command` is the daemon, or executes it.
    pub(crate) fn daemon_by(&self, mut command: Command) -> Kept {
        let log = fs::OpenOptions::new().create(true).append(true).open(self.log()).unwrap();
        let kept = Kept(command.stderr(log).spawn().unwrap());
        until("the daemon answers", || self.status().is_ok());
        kept
    }

    /// Returns the log file of daemons in the foreground.
    pub(crate) fn log(&self) -> std::path::PathBuf {
        self.dir.path().join("daemon.txt")
    }

    /// Starts a child that plays `part`.
    pub(crate) fn play(&self, part: &str) -> Player {
        self.play_in(self.command(std::env::current_exe().unwrap()), part)
    }

    /// Like [`play`](Self::play); `command` is this program, or runs the program at the end of its arguments.
    pub(crate) fn play_in(&self, mut command: Command, part: &str) -> Player {
        command.args(["child", "--exact", "--nocapture", "--test-threads=1"]).env("PLAY", part);
        let mut child = command.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().unwrap();
        let lines = BufReader::new(child.stdout.take().unwrap()).lines();
        Player { child: Kept(child), lines }
    }
}

impl Drop for Host {
    fn drop(&mut self) {
        if let Ok(status) = self.status()
            && status.pid != std::process::id()
        {
            // It may have ended by itself meanwhile.
            let _ = try_signal(status.pid, rustix::process::Signal::KILL);
        }
        if std::thread::panicking() {
            let spawned = self.dir.path().join("run/axon-0.log");
            for (name, log) in [("the log of a daemon", self.log()), ("the daemon's log", spawned)]
            {
                if let Ok(text) = fs::read(log) {
                    eprintln!("{}", excerpt::excerpt(name, &String::from_utf8_lossy(&text)));
                }
            }
        }
    }
}

/// A child that plays an application.
pub(crate) struct Player {
    pub(crate) child: Kept,
    lines: Lines<BufReader<ChildStdout>>,
}

impl Player {
    /// Returns the child's next line.
    pub(crate) fn hear(&mut self) -> String {
        loop {
            let line =
                self.lines.next().expect("the child said something before it ended").unwrap();
            // The test harness writes a name without a newline in front of the first.
            if let Some((_, said)) = line.split_once(MARK) {
                return said.to_owned();
            }
        }
    }

    /// Like [`finish`](Self::finish), and checks that the child writes nothing more.
    #[allow(dead_code, reason = "not every test needs it")]
    pub(crate) fn finish_silently(mut self) {
        drop(self.child.0.stdin.take());
        let said: Vec<_> = self.lines.by_ref().map(Result::unwrap).collect();
        assert!(said.iter().all(|line| !line.contains(MARK)), "{said:?}");
        self.finish();
    }

    /// Like [`finish`](Self::finish), and returns everything that the child still writes.
    #[allow(dead_code, reason = "not every test needs it")]
    pub(crate) fn finish_and_tell(mut self) -> Vec<String> {
        drop(self.child.0.stdin.take());
        let said = self.lines.by_ref().map(Result::unwrap).collect();
        self.finish();
        said
    }

    pub(crate) fn pid(&self) -> u32 {
        self.child.0.id()
    }

    /// Tells the child to go on.
    #[allow(dead_code, reason = "not every test needs it")]
    pub(crate) fn go(&mut self) {
        let mut stdin = self.child.0.stdin.as_ref().expect("its input");
        stdin.write_all(b"go\n").unwrap();
    }

    /// Closes the child's standard input, on which it waits, and waits for its end.
    pub(crate) fn finish(mut self) {
        drop(self.child.0.stdin.take());
        let status = self.child.0.wait().unwrap();
        assert!(status.success(), "a child failed: {status}");
    }
}

/// In a child: sends a line to the test.
#[allow(clippy::print_stdout)]
pub(crate) fn say(text: impl std::fmt::Display) {
    println!("{MARK}{text}");
}

/// In a child: opens a session, which starts a daemon if there is none and the test permits it.
#[allow(dead_code, reason = "not every test needs it")]
pub(crate) fn of_child(name: &str) -> Session {
    Session::open(&Config::from_env().unwrap(), SessionOptions::new(name)).unwrap()
}

/// In a child: waits until the test ends it.
pub(crate) fn wait_for_the_end() {
    let mut line = String::new();
    while std::io::stdin().read_line(&mut line).unwrap() > 0 {}
}

/// Waits for a condition that must come true.
#[track_caller]
pub(crate) fn until(what: &str, reached: impl FnMut() -> bool) {
    until_within(PATIENCE, what, reached);
}

/// Like [`until`], for a condition that takes longer than that on a loaded machine.
#[track_caller]
pub(crate) fn until_within(limit: Duration, what: &str, mut reached: impl FnMut() -> bool) {
    let deadline = Instant::now() + limit;
    while !reached() {
        assert!(Instant::now() < deadline, "in vain: {what}");
        std::thread::sleep(Duration::from_millis(10));
    }
}

pub(crate) fn signal(pid: u32, signal: rustix::process::Signal) {
    try_signal(pid, signal).unwrap();
}

/// Sends a signal to a process that may end at any time.
fn try_signal(pid: u32, signal: rustix::process::Signal) -> rustix::io::Result<()> {
    let pid = rustix::process::Pid::from_raw(i32::try_from(pid).unwrap()).unwrap();
    rustix::process::kill_process(pid, signal)
}
