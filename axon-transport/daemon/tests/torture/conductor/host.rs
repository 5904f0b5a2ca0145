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

/// Of so many processes one is in a PID namespace of its own.
const NAMESPACED: u64 = 3;

/// What starts a process in a PID namespace of its own.
#[derive(Debug, Default)]
pub(crate) struct Namespaces {
    /// Arguments of `unshare`: with the `/proc` of the outer namespace, and with a new one.
    ways: Vec<Vec<&'static str>>,
}

impl Namespaces {
    /// Tries what this machine allows.
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

    /// The command that a process is started by, and whether it starts the process as a child of its own.
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

/// When a player's publisher ends, and what ends with it.
#[derive(Clone, Copy, PartialEq)]
pub(super) enum Ending {
    Publisher,
    Process,
}

/// One of the processes.
pub(super) struct Player {
    process: Child,
    /// Whether `process` is the parent of the process that is meant.
    namespaced: bool,
    /// That process.
    inner: Option<u32>,
    /// Until it is to end.
    orders: Option<ChildStdin>,
    answers: Receiver<String>,
    /// Its KEEP_ALL subscription, once it has said so.
    reader: Option<String>,
    /// Until when it is stopped.
    pub(super) stopped: Option<Instant>,
    /// It was told so, and has not said yet that it has.
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
            // A daemon in a PID namespace sees no process outside it, and would relay all of them.
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

    /// The daemon's process, if there is one.
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
    /// The process that plays, once it is there.
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

    /// Whether it is in a PID namespace of its own.
    pub(super) fn is_namespaced(&self) -> bool {
        self.namespaced
    }

    /// Stops it for `pause`, if it is there.
    pub(super) fn stop(&mut self, pause: Duration) -> bool {
        let Some(process) = self.id().and_then(pid) else { return false };
        // One that is to end may have ended.
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

    /// What it says next, if it has said something.
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

    /// Its KEEP_ALL subscription.
    pub(super) fn reader(&mut self) -> String {
        if self.reader.is_none() {
            self.reader = Some(self.line());
        }
        self.reader.clone().expect("just said")
    }

    /// The same, if it has said so.
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

    /// Whether it has ended as it was told to; panics if otherwise.
    pub(super) fn has_ended(&mut self) -> bool {
        let status = self.process.try_wait().expect("a child");
        status.inspect(|status| assert!(status.success(), "a process failed: {status}")).is_some()
    }

    /// Has it end, and waits for that.
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

/// What each thread of a process waits for, as far as the system tells.
fn threads(process: u32) -> String {
    let tasks = fs::read_dir(format!("/proc/{process}/task")).into_iter().flatten().flatten();
    let describe = |task: fs::DirEntry| {
        let read = |name| fs::read_to_string(task.path().join(name)).unwrap_or_default();
        let [name, wait, call] = ["comm", "wchan", "syscall"].map(read);
        format!("{} {}: {wait} {}\n", task.path().display(), name.trim(), call.trim())
    };
    tasks.map(describe).collect()
}

/// Bytes of shared memory that processes hold descriptors of, each counted once.
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
