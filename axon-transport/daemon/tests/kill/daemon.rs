//! The daemon dies in the middle of an attachment.
//!
//! A daemon affects other processes only by system calls. So killing it before and after each system call is as good as
//! killing it at every instruction.

use std::{
    collections::BTreeSet,
    fs,
    sync::atomic::{AtomicBool, Ordering},
    thread,
    time::{Duration, Instant},
};

use axon_transport::{EndpointSpec, Publisher, Session, Subscription, qos::Qos};
use nix::{
    sys::{
        ptrace::{self, Options},
        signal::{Signal, kill},
        wait::{WaitPidFlag, WaitStatus, waitpid},
    },
    unistd::Pid,
};

use crate::{
    report::Report,
    support::{Host, Kept, PATIENCE, until},
    survivor::Holdings,
};

/// Its name in the table.
pub(crate) const NAME: &str = "daemon: attach a reader";
/// Number of kills of a bounded run.
const BOUNDED: u64 = 6;

pub(crate) fn run(full: bool) -> Report {
    let (stops, _) = attach(None);
    let mut points: BTreeSet<u64> = BTreeSet::from([0, stops]);
    if full {
        points.extend(0..=stops);
    } else {
        points.extend((1..BOUNDED).map(|n| n * stops / BOUNDED));
    }
    Report {
        name: NAME.to_owned(),
        dies: "daemon".to_owned(),
        instructions: format!("{} calls", stops / 2),
        states: String::new(),
        kills: points.len(),
        shown: points.iter().filter(|point| attach(Some(**point)).1).count(),
        skipped: String::new(),
    }
}

/// A publisher and a subscription, each in its own session.
struct Pair {
    publisher: Publisher,
    subscription: Subscription,
    _sessions: [Session; 2],
    published: u64,
}

impl Pair {
    fn new(sessions: [Session; 2], topic: &str) -> Self {
        let spec = || EndpointSpec::new(topic, "test/Bytes", Qos::keep_all());
        Self {
            publisher: sessions[0].create_publisher(spec()).expect("a publisher"),
            subscription: sessions[1].create_subscription(spec()).expect("a subscription"),
            _sessions: sessions,
            published: 0,
        }
    }

    fn is_matched(&self) -> bool {
        !self.publisher.matched().is_empty() && !self.subscription.matched().is_empty()
    }

    /// Checks that every sample arrives exactly once.
    fn pass(&mut self, count: u64) {
        let mut bytes = Vec::new();
        for _ in 0..count {
            self.published += 1;
            let payload = self.published.to_le_bytes();
            self.publisher.publish(&payload).expect("room");
            let got = self.subscription.recv(&mut bytes, Some(PATIENCE)).expect("a sample");
            assert_eq!((got.sequence, &bytes[..]), (self.published, &payload[..]));
        }
        assert!(!self.subscription.has_data(), "a sample is repeated");
        assert_eq!((self.subscription.received(), self.subscription.lost()), (self.published, 0));
    }
}

/// Attaches a reader, and kills the daemon at its stop number `point`. Returns the number of stops, and whether the two
/// were attached before the next daemon started.
fn attach(point: Option<u64>) -> (u64, bool) {
    let before = Holdings::now();
    let host = Host::new().with("AXON_LOG", "error");
    let daemon = host.daemon();
    let sessions = || ["a", "b"].map(|name| host.session(name).expect("a session"));
    let mut known = Pair::new(sessions(), "/known");
    until("the first two are attached", || known.is_matched());
    known.pass(3);
    let both = sessions();
    let (mut pair, stops) = trace(&daemon, point, move || Pair::new(both, "/attached"));
    let attached = pair.is_matched();
    drop(daemon);
    // Attached pairs go on without a daemon.
    known.pass(3);
    let _another = host.daemon();
    until("the two are attached", || pair.is_matched());
    pair.pass(3);
    known.pass(3);
    drop((pair, known, _another, host));
    // Another thread closes descriptors.
    let start = Instant::now();
    while Holdings::now() != before && start.elapsed() < PATIENCE {
        thread::sleep(Duration::from_millis(5));
    }
    assert_eq!(Holdings::now(), before, "something is left");
    (stops, attached)
}

/// Makes a pair in a thread while the daemon is traced. The daemon is killed after `point` stops, or when the two are
/// attached. Returns the pair and the number of stops.
fn trace(daemon: &Kept, point: Option<u64>, make: impl FnOnce() -> Pair + Send) -> (Pair, u64) {
    let pid = Pid::from_raw(i32::try_from(daemon.0.id()).expect("a pid"));
    for thread in threads(pid) {
        let options = Options::PTRACE_O_TRACESYSGOOD
            | Options::PTRACE_O_TRACECLONE
            | Options::PTRACE_O_EXITKILL;
        ptrace::seize(thread, options).expect("its tracer");
        ptrace::interrupt(thread).expect("its tracer");
    }
    let over = AtomicBool::new(false);
    thread::scope(|scope| {
        let made = scope.spawn(|| {
            let pair = make();
            let start = Instant::now();
            while !pair.is_matched() && !over.load(Ordering::Relaxed) {
                assert!(start.elapsed() < PATIENCE, "the two are never attached");
                thread::sleep(Duration::from_micros(200));
            }
            over.store(true, Ordering::Relaxed);
            pair
        });
        let mut stops = 0;
        while !over.load(Ordering::Relaxed) {
            stops += u64::from(step(pid));
            if point.is_some_and(|point| stops >= point) {
                over.store(true, Ordering::Relaxed);
            }
        }
        kill(pid, Signal::SIGKILL).expect("a daemon");
        loop {
            match waitpid(None, Some(WaitPidFlag::__WALL)) {
                // The main thread is reaped last.
                Ok(WaitStatus::Signaled(thread, ..)) if thread == pid => break,
                Ok(_) => {}
                Err(errno) => panic!("daemon {pid}: {errno}"),
            }
        }
        (made.join().expect("no panic"), stops)
    })
}

/// Checks once for a stop of any of its threads, and continues the thread. Returns whether the stop was at a system
/// call.
fn step(pid: Pid) -> bool {
    match waitpid(None, Some(WaitPidFlag::__WALL | WaitPidFlag::WNOHANG)) {
        Ok(WaitStatus::PtraceSyscall(thread)) => {
            let _ = ptrace::syscall(thread, None);
            true
        }
        Ok(WaitStatus::PtraceEvent(thread, ..)) => {
            let _ = ptrace::syscall(thread, None);
            false
        }
        Ok(WaitStatus::Stopped(thread, signal)) => {
            let _ = ptrace::syscall(thread, Some(signal));
            false
        }
        Ok(WaitStatus::StillAlive) => {
            thread::sleep(Duration::from_micros(50));
            false
        }
        other => panic!("daemon {pid}: {other:?}"),
    }
}

fn threads(pid: Pid) -> Vec<Pid> {
    let tasks = fs::read_dir(format!("/proc/{pid}/task")).expect("a daemon").flatten();
    tasks.filter_map(|task| task.file_name().to_str()?.parse().ok()).map(Pid::from_raw).collect()
}
