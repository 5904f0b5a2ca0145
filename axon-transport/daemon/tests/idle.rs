//! An idle process does nothing: its threads are not scheduled. The tests assert counters of the kernel, not times.

#[allow(dead_code, reason = "what other tests need of it")]
mod support;

use std::{
    collections::BTreeMap,
    fs,
    sync::Arc,
    thread,
    time::{Duration, Instant},
};

use axon_transport::{
    EndpointSpec, Session, SessionOptions, Waitable, config::Config, events::EventKind, qos::Qos,
};
use support::{Host, PATIENCE, say, until, wait_for_the_end};

/// How long a process is watched. Several threads of an earlier version woke up every second.
const WATCH: Duration = Duration::from_secs(5);
/// Interval between two checks whether a process has come to rest.
const SETTLE: Duration = Duration::from_millis(500);

/// The lease of the endpoints that have one. It is renewed after each third of it.
const LEASE: Duration = Duration::from_secs(3);

fn spec(topic: &str) -> EndpointSpec {
    EndpointSpec::new(topic, "test/Bytes", Qos::default())
}

/// Not a test of its own: a process with endpoints of all kinds, and with a thread in each kind of wait.
#[test]
fn child() {
    let Ok(part) = std::env::var("PLAY") else { return };
    let lease = (part == "leased").then_some(LEASE);
    let leased = || spec("/a").qos(Qos::default().with_lease(lease));
    let session = Session::open(&Config::from_env().unwrap(), SessionOptions::new(&*part)).unwrap();
    let _node = session.create_node("idle", "/", "/").unwrap();
    let talker = session.create_publisher(leased()).unwrap();
    let heard = session.create_subscription(leased()).unwrap();
    let silent = session.create_subscription(spec("/b")).unwrap();
    let called = session.create_subscription(leased()).unwrap();
    let server = session.create_server(spec("/s")).unwrap();
    let client = session.create_client(spec("/s")).unwrap();
    let lost = silent.event(EventKind::MessageLost).unwrap();
    let never = session.create_guard_condition();
    if part == "callbacks" {
        called.set_on_new_sample(Some(Arc::new(|_| {}))).unwrap();
    }
    assert!(talker.wait_matched(2, PATIENCE) && client.wait_available(PATIENCE));
    // One sample for each reader: a thread that was woken once sleeps again.
    talker.publish(b"once").unwrap();
    let all = [
        Waitable::GuardCondition(&never),
        Waitable::Event(&lost),
        Waitable::Subscription(&silent),
        Waitable::Client(&client),
    ];
    thread::scope(|scope| {
        scope.spawn(|| while heard.recv(&mut Vec::new(), None).is_ok() {});
        scope.spawn(|| silent.recv(&mut Vec::new(), None));
        scope.spawn(|| session.wait(|| silent.has_data(), None));
        scope.spawn(|| server.recv_request(&mut Vec::new(), None));
        scope.spawn(|| session.wait_for(&all, None));
        say("rests");
        wait_for_the_end();
        std::process::exit(0);
    });
}

/// Returns how often each thread of a process has gone to sleep, by thread id and name.
fn sleeps(pid: u32) -> BTreeMap<String, u64> {
    let mut all = BTreeMap::new();
    for task in fs::read_dir(format!("/proc/{pid}/task")).unwrap() {
        let status = fs::read_to_string(task.unwrap().path().join("status")).unwrap();
        let field = |name: &str| {
            let line = status.lines().find_map(|line| line.strip_prefix(name)).unwrap();
            line.trim().to_owned()
        };
        let number = field("voluntary_ctxt_switches:").parse().unwrap();
        all.insert(format!("{} {}", field("Pid:"), field("Name:")), number);
    }
    all
}

/// Waits until the threads of a process have come to rest, except those whose names `busy` accepts.
fn settle(pid: u32, busy: impl Fn(&str) -> bool) {
    let resting = || -> BTreeMap<_, _> {
        sleeps(pid).into_iter().filter(|(thread, _)| !busy(thread)).collect()
    };
    let mut before = resting();
    until("it comes to rest", || {
        thread::sleep(SETTLE);
        let now = resting();
        now == std::mem::replace(&mut before, now.clone())
    });
}

/// Returns how often each thread went to sleep since `before`.
fn since(before: &BTreeMap<String, u64>, pid: u32) -> BTreeMap<String, u64> {
    let mut after = sleeps(pid);
    for (thread, count) in before {
        *after.entry(thread.clone()).or_default() -= count;
    }
    after.retain(|_, count| *count > 0);
    after
}

/// Returns how often the threads of an idle process wake up within [`WATCH`].
fn wakes(pid: u32) -> BTreeMap<String, u64> {
    settle(pid, |_| false);
    let before = sleeps(pid);
    thread::sleep(WATCH);
    since(&before, pid)
}

#[test]
fn a_process_at_rest_does_not_wake_up() {
    let host = Host::new();
    let _daemon = host.daemon();
    let mut players = ["waits", "callbacks"].map(|part| host.play(part));
    players.iter_mut().for_each(|player| assert_eq!(player.hear(), "rests"));
    for player in &players {
        assert_eq!(wakes(player.pid()), BTreeMap::new());
    }
}

/// Each process offers a lease, and watches its own and the other's.
#[test]
fn leases_wake_only_the_control_thread_three_times_per_period() {
    let host = Host::new();
    let _daemon = host.daemon();
    let mut players = [0, 1].map(|_| host.play("leased"));
    players.iter_mut().for_each(|player| assert_eq!(player.hear(), "rests"));
    for player in &players {
        let control = |thread: &str| thread.ends_with(" axon-ctl");
        settle(player.pid(), control);
        // The counts are compared with the time that really passed, in case this process is late.
        let start = Instant::now();
        let before = sleeps(player.pid());
        let mut woken = BTreeMap::new();
        until("it renewed its lease some times", || {
            woken = since(&before, player.pid());
            woken.values().sum::<u64>() >= 3
        });
        let thirds = start.elapsed().as_nanos() / (LEASE / 3).as_nanos();
        let threads: Vec<_> = woken.keys().collect();
        assert!(threads.len() == 1 && control(threads[0]), "{woken:?}");
        assert!(
            woken.values().all(|count| u128::from(*count) <= thirds + 1),
            "{woken:?}, {thirds}"
        );
    }
}

#[test]
fn a_relayed_process_at_rest_does_not_wake_up() {
    let host = Host::new();
    let _daemon = host.daemon();
    let relayed = host.with("AXON_SHM", "off");
    let mut player = relayed.play("alone");
    assert_eq!(player.hear(), "rests");
    assert_eq!(wakes(player.pid()), BTreeMap::new());
}

#[test]
fn a_daemon_whose_sessions_rest_does_not_wake_up() {
    // A domain and an address of its own: other daemons of this host would connect, and peers of a daemon that ended
    // may still send to its port.
    let [.., high, low] = std::process::id().to_be_bytes();
    let host = Host::new()
        .with("ROS_DOMAIN_ID", &(173 + low % 27).to_string())
        .with("AXON_BIND_ADDRS", &format!("127.8.{high}.{low}"));
    let daemon = host.daemon();
    let mut players = ["waits", "callbacks"].map(|part| host.play(part));
    players.iter_mut().for_each(|player| assert_eq!(player.hear(), "rests"));
    assert_eq!(wakes(daemon.0.id()), BTreeMap::new());
}
