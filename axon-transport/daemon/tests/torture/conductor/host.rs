//! The host: its processes, some in a PID namespace of their own, and its daemon.

use std::{
    collections::HashMap,
    env, fs,
    io::{BufRead as _, BufReader, Write as _},
    os::unix::{fs::MetadataExt as _, process::ExitStatusExt as _},
    path::Path,
    process::{Child, ChildStdin, Command, Stdio},
    sync::mpsc::{self, Receiver, RecvTimeoutError, TryRecvError},
    thread,
    time::{Duration, Instant},
};

use rustix::process::{Pid, Signal, kill_process};

use super::{BUDGET_MB, PATIENCE};
use crate::{
    child::ROLE,
    sample::{LONGEST, Random},
};

/// One of this many processes is in its own PID namespace.
const NAMESPACED: u64 = 3;

/// The ways to start a process in its own PID namespace.
#[derive(Debug, Default)]
pub(crate) struct Namespaces {
    /// The arguments of `unshare`: with the `/proc` of the outer namespace, and with a new one.
    ways: Vec<Vec<&'static str>>,
}

impl Namespaces {
    /// Finds out what this machine permits.
    pub(crate) fn find() -> Self {
        let pid = ["--pid", "--fork", "--kill-child"];
        let user = ["--user", "--map-current-user"];
        let works = |ways: &Vec<&str>| {
            let mut unshare = Command::new("unshare");
            let unshare = unshare.args(ways).arg("true").stdin(Stdio::null());
            unshare.stderr(Stdio::null()).status().is_ok_and(|status| status.success())
        };
        let ways = [&[][..], &["--mount-proc"]].into_iter().filter_map(|proc| {
            let with = |user: &[&'static str]| [user, &pid[..], proc].concat();
            [with(&[]), with(&user)].into_iter().find(works)
        });
        Self { ways: ways.collect() }
    }

    pub(crate) fn are_there(&self) -> bool {
        !self.ways.is_empty()
    }

    /// Returns the command that starts a process, and whether the process is a child of the started one.
    fn command(&self, random: &mut Random) -> (Command, bool) {
        let program = env::current_exe().expect("its own path");
        if self.ways.is_empty() || random.below(NAMESPACED) > 0 {
            return (Command::new(program), false);
        }
        let way = random.below(self.ways.len() as u64);
        let mut unshare = Command::new("unshare");
        unshare.args(&self.ways[usize::try_from(way).expect("one of them")]).arg(program);
        (unshare, true)
    }
}

pub(super) struct Host<'a> {
    dir: tempfile::TempDir,
    namespaces: &'a Namespaces,
}

/// The part of a player that ends.
#[derive(Clone, Copy, PartialEq)]
pub(super) enum Ending {
    Publisher,
    Process,
}

/// One of the processes.
pub(super) struct Player {
    process: Child,
    /// True if `process` is the parent of the playing process.
    namespaced: bool,
    /// The playing process in that case.
    inner: Option<u32>,
    /// `None` once it has been told to end.
    orders: Option<ChildStdin>,
    answers: Receiver<String>,
    /// The GID of its KEEP_ALL subscription, once it has reported it.
    reader: Option<String>,
    /// The time until which it is stopped.
    pub(super) stopped: Option<Instant>,
    /// Set if it was told to end this, and has not reported yet that it has.
    pub(super) ending: Option<Ending>,
}

impl<'a> Host<'a> {
    pub(super) fn new(namespaces: &'a Namespaces) -> Self {
        Self { dir: tempfile::tempdir().expect("a directory"), namespaces }
    }

    pub(super) fn start(&self, random: &mut Random) -> Player {
        let seed = random.next();
        let (mut command, namespaced) = self.namespaces.command(random);
        for (name, _) in env::vars().filter(|(name, _)| name.starts_with("AXON_")) {
            command.env_remove(name);
        }
        let mut process = command
            .env(ROLE, seed.to_string())
            .env("AXON_RUNTIME_DIR", self.dir.path().join("run"))
            .env("AXON_DAEMON_PATH", env!("CARGO_BIN_EXE_axon_daemon"))
            // A daemon in a PID namespace sees no process outside, and would relay all of them.
            .env("AXON_DAEMON", if namespaced { "require" } else { "spawn" })
            .env("AXON_BIND_ADDRS", "127.0.0.1")
            .env("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
            .env("AXON_RING_BUFFER_SIZE_MB", BUDGET_MB.to_string())
            .env("AXON_MAX_MESSAGE_MB", LONGEST.div_ceil(1 << 20).to_string())
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .expect("a process");
        let orders = process.stdin.take();
        let lines = BufReader::new(process.stdout.take().expect("a pipe")).lines();
        let (sender, answers) = mpsc::channel();
        thread::spawn(move || lines.map_while(Result::ok).try_for_each(|line| sender.send(line)));
        Player {
            process,
            namespaced,
            inner: None,
            orders,
            answers,
            reader: None,
            stopped: None,
            ending: None,
        }
    }

    /// Returns the daemon's process, if there is one.
    pub(super) fn daemon(&self) -> Option<Pid> {
        let run = self.dir.path().join("run");
        let of_this_host = |pid: &u32| {
            let program = fs::read_link(format!("/proc/{pid}/exe")).unwrap_or_default();
            if program != Path::new(env!("CARGO_BIN_EXE_axon_daemon")) {
                return false;
            }
            let environment = fs::read(format!("/proc/{pid}/environ")).unwrap_or_default();
            let wanted = format!("AXON_RUNTIME_DIR={}", run.display());
            environment.split(|byte| *byte == 0).any(|one| one == wanted.as_bytes())
        };
        processes().find(of_this_host).and_then(pid)
    }
}

impl Drop for Host<'_> {
    fn drop(&mut self) {
        if let Some(daemon) = self.daemon() {
            let _ = kill_process(daemon, Signal::KILL);
        }
    }
}

fn processes() -> impl Iterator<Item = u32> {
    let entries = fs::read_dir("/proc").expect("procfs").flatten();
    entries.filter_map(|entry| entry.file_name().to_str()?.parse().ok())
}

fn pid(process: u32) -> Option<Pid> {
    i32::try_from(process).ok().and_then(Pid::from_raw)
}

impl Player {
    /// Returns the playing process, once it exists.
    pub(super) fn id(&mut self) -> Option<u32> {
        let outer = self.process.id();
        if !self.namespaced {
            return Some(outer);
        }
        if self.inner.is_none() {
            let children = fs::read_to_string(format!("/proc/{outer}/task/{outer}/children"));
            self.inner = children.ok().and_then(|all| all.split(' ').next()?.parse().ok());
        }
        self.inner
    }

    /// Returns whether it is in its own PID namespace.
    pub(super) fn is_namespaced(&self) -> bool {
        self.namespaced
    }

    /// Stops it for `pause`, if it exists. Returns whether it does.
    pub(super) fn stop(&mut self, pause: Duration) -> bool {
        let Some(process) = self.id().and_then(pid) else { return false };
        // A process that was told to end may have ended.
        let is_there = kill_process(process, Signal::STOP).is_ok();
        self.stopped = is_there.then(|| Instant::now() + pause);
        is_there
    }

    /// Continues it, if it was stopped.
    pub(super) fn resume(&mut self) {
        if self.stopped.take().is_some() {
            let process = self.id().and_then(pid).expect("it was stopped");
            let _ = kill_process(process, Signal::CONT);
        }
    }

    pub(super) fn tell(&mut self, order: &str) {
        let orders = self.orders.as_mut().expect("it is not to end yet");
        let told = writeln!(orders, "{order}").and_then(|()| orders.flush());
        if let Err(error) = told {
            panic!("a process cannot be told {order:?} ({error}): {:?}", self.process.wait());
        }
    }

    pub(super) fn hear(&mut self) -> String {
        self.reader();
        self.line()
    }

    /// Returns its next line, if there is one.
    pub(super) fn heard(&mut self) -> Option<String> {
        self.known()?;
        match self.answers.try_recv() {
            Ok(line) => Some(line),
            Err(TryRecvError::Empty) => None,
            Err(TryRecvError::Disconnected) => {
                panic!("a process ended by itself: {:?}", self.process.wait())
            }
        }
    }

    /// Returns the GID of its KEEP_ALL subscription.
    pub(super) fn reader(&mut self) -> String {
        if self.reader.is_none() {
            self.reader = Some(self.line());
        }
        self.reader.clone().expect("just said")
    }

    /// Returns the GID of its KEEP_ALL subscription, if it has reported it.
    pub(super) fn known(&mut self) -> Option<&str> {
        if self.reader.is_none() {
            self.reader = self.answers.try_recv().ok();
        }
        self.reader.as_deref()
    }

    pub(super) fn ask(&mut self, order: &str) -> String {
        self.tell(order);
        self.hear()
    }

    fn line(&mut self) -> String {
        match self.answers.recv_timeout(PATIENCE) {
            Ok(answer) => answer,
            Err(RecvTimeoutError::Timeout) => {
                panic!("a process stands still:\n{}", threads(self.id().unwrap_or(0)))
            }
            Err(RecvTimeoutError::Disconnected) => {
                panic!("a process ended by itself: {:?}", self.process.wait())
            }
        }
    }

    /// Panics if it has ended by itself.
    pub(super) fn must_live(&mut self) {
        if self.ending == Some(Ending::Process) {
            self.has_ended();
        } else if let Some(status) = self.process.try_wait().expect("a child") {
            panic!("a process ended by itself: {status}, signal {:?}", status.signal());
        }
    }

    /// Returns whether it has ended as it was told to. Panics if it failed.
    pub(super) fn has_ended(&mut self) -> bool {
        let status = self.process.try_wait().expect("a child");
        status.inspect(|status| assert!(status.success(), "a process failed: {status}")).is_some()
    }

    /// Ends it, and waits for that.
    pub(super) fn end(mut self) {
        self.orders = None;
        assert!(self.process.wait().expect("a child").success());
    }
}

impl Drop for Player {
    fn drop(&mut self) {
        if self.namespaced
            && let Some(process) = self.id().and_then(pid)
            && matches!(self.process.try_wait(), Ok(None))
        {
            let _ = kill_process(process, Signal::KILL);
        }
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}

/// Returns what each thread of a process waits for, if the system tells.
fn threads(process: u32) -> String {
    let tasks = fs::read_dir(format!("/proc/{process}/task")).into_iter().flatten().flatten();
    let describe = |task: fs::DirEntry| {
        let read = |name| fs::read_to_string(task.path().join(name)).unwrap_or_default();
        let [name, wait, call] = ["comm", "wchan", "syscall"].map(read);
        format!("{} {}: {wait} {}\n", task.path().display(), name.trim(), call.trim())
    };
    tasks.map(describe).collect()
}

/// Returns the bytes of shared memory to which processes hold descriptors, each segment counted once.
pub(super) fn held(pids: impl Iterator<Item = u32>) -> u64 {
    let mut blocks = HashMap::new();
    for pid in pids {
        let Ok(entries) = fs::read_dir(format!("/proc/{pid}/fd")) else { continue };
        for path in entries.flatten().map(|entry| entry.path()) {
            let memfd = fs::read_link(&path)
                .is_ok_and(|to| to.as_os_str().as_encoded_bytes().starts_with(b"/memfd:axon"));
            if memfd && let Ok(found) = fs::metadata(&path) {
                blocks.insert(found.ino(), found.blocks());
            }
        }
    }
    blocks.values().sum::<u64>() * 512
}
