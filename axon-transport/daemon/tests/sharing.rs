//! A process of the same user keeps the daemon's control plane busy; other processes are served meanwhile.

#[allow(dead_code, reason = "what other tests need of it")]
mod support;

use std::{
    collections::VecDeque,
    sync::{
        Arc,
        atomic::{AtomicUsize, Ordering},
    },
    thread,
    time::{Duration, Instant},
};

use axon_transport::{
    EndpointSpec,
    internal::session::daemon::{address::Address, socket},
    qos::Qos,
    status::{SessionStatus, Status},
};
use rustix::process::Signal;
use support::{Host, Player, of_child, say, signal};

/// Number of publishers, and of subscriptions, of one topic.
const MANY: usize = 1000;
/// Number of rounds of the honest process; `ROUNDS=5000` for longer.
const ROUNDS: usize = 200;
/// Minimum number of rounds before the daemon has handled the crowd's endpoints.
const BEFORE: usize = 20;
/// Time limit until the crowd's pairs are matched, while the honest process has priority. The first match takes seconds
/// on an idle machine, and took almost a minute on a loaded one.
const MEETING: Duration = Duration::from_secs(600);
/// Number of the crowd's pairs that must match: of a million, those for which the session has lanes.
const PAIRS: usize = 100_000;
/// Maximum number of the crowd's pairs that match during one round of other processes.
const MOST_PAIRS_A_ROUND: usize = 5_000;
/// Number of silent connections.
const SILENT: usize = 800;
/// More silent connections than a daemon keeps.
const MORE: usize = 300;
/// The daemon closes a silent connection after this time at the latest, or soon after.
const SOON: Duration = Duration::from_secs(4);

fn spec(topic: &str) -> EndpointSpec {
    EndpointSpec::new(topic, "test/Bytes", Qos::default().with_depth(1))
}

/// The code of the other processes; not a test of its own.
#[test]
fn child() {
    let Ok(part) = std::env::var("PLAY") else { return };
    if part == "silent" {
        return say_nothing();
    }
    let session = of_child(&part);
    say("begins");
    std::io::stdin().read_line(&mut String::new()).unwrap();
    let publishers: Vec<_> =
        (0..MANY).map(|_| session.create_publisher(spec("/crowd")).unwrap()).collect();
    let subscriptions: Vec<_> =
        (0..MANY).map(|_| session.create_subscription(spec("/crowd")).unwrap()).collect();
    say("made");
    // On request, reports how many of the pairs have matched. In the end there are as many as the session has lanes.
    for line in std::io::stdin().lines() {
        line.unwrap();
        say(publishers.iter().map(|one| one.matched().len()).sum::<usize>());
    }
    drop((publishers, subscriptions));
}

/// Keeps [`SILENT`] silent connections. Replaces a connection that the daemon closed or refused. On request, opens
/// [`MORE`] and reports how many were closed so far.
fn say_nothing() {
    let address = Address::of(&axon_transport::config::Config::from_env().unwrap());
    let asked = Arc::new(AtomicUsize::new(0));
    let hears = Arc::clone(&asked);
    let end = thread::spawn(move || {
        // Relaxed: the counter orders nothing else.
        let lines = std::io::stdin().lines().map_while(Result::ok);
        lines.for_each(|_| _ = hears.fetch_add(1, Ordering::Relaxed));
    });
    let mut silent = VecDeque::new();
    let (mut made, mut closed, mut answered) = (0, 0_usize, 0);
    let mut more = None;
    say("begins");
    while !end.is_finished() {
        match address.connect() {
            Ok(connection) => {
                silent.push_back(connection);
                made += 1;
            }
            Err(_) => thread::sleep(Duration::from_millis(1)),
        }
        if silent.len() > SILENT {
            closed += usize::from(silent.pop_front().is_some_and(|oldest| is_closed(&oldest)));
            thread::sleep(Duration::from_millis(1));
        }
        if asked.load(Ordering::Relaxed) > answered && made >= *more.get_or_insert(made + MORE) {
            say(closed);
            (answered, more) = (answered + 1, None);
        }
    }
}

/// Returns whether the daemon closed a connection.
fn is_closed(connection: &impl std::os::fd::AsFd) -> bool {
    matches!(socket::receive(connection, &mut Vec::new()), Err(socket::SocketError::Closed))
}

/// The longest duration of each operation.
#[derive(Debug, Default)]
struct Longest {
    status: Duration,
    session: Duration,
    matched: Duration,
}

impl Longest {
    /// Does once what an honest process does.
    fn round(&mut self, host: &Host) {
        let begin = Instant::now();
        host.status().expect("the status");
        self.status = self.status.max(begin.elapsed());
        let begin = Instant::now();
        let one = host.session("honest").expect("a session");
        self.session = self.session.max(begin.elapsed());
        let other = host.session("too").expect("a session");
        let begin = Instant::now();
        let publisher = one.create_publisher(spec("/honest")).unwrap();
        let subscription = other.create_subscription(spec("/honest")).unwrap();
        assert!(publisher.wait_matched(1, support::PATIENCE));
        self.matched = self.matched.max(begin.elapsed());
        drop(subscription);
    }
}

fn rounds() -> usize {
    std::env::var("ROUNDS").map_or(ROUNDS, |rounds| rounds.parse().unwrap())
}

/// Checks that an honest process is also served while a player ends.
fn is_served_while_it_ends(host: &Host, player: Player) {
    let mut after = Longest::default();
    thread::scope(|scope| {
        scope.spawn(|| player.finish());
        (0..rounds()).for_each(|_| after.round(host));
    });
    eprintln!("while it ends {after:?}");
}

fn alone(host: &Host) {
    let mut alone = Longest::default();
    (0..20).for_each(|_| alone.round(host));
    eprintln!("alone {alone:?}");
}

#[test]
fn a_million_pairs_of_one_process_hold_up_no_other() {
    let host = Host::new().with("AXON_LOG", "warn");
    let daemon = host.daemon();
    alone(&host);
    let mut crowd = host.play("crowd");
    assert_eq!(crowd.hear(), "begins");
    // All of its requests are there at once.
    signal(daemon.0.id(), Signal::STOP);
    crowd.go();
    assert_eq!(crowd.hear(), "made");
    signal(daemon.0.id(), Signal::CONT);
    let pid = crowd.pid();
    let of_crowd = |session: &&SessionStatus| session.pid == pid;
    let taken = |status: &Status| status.sessions.iter().find(of_crowd).unwrap().endpoints;
    let (mut beside, mut before) = (Longest::default(), None);
    for round in 0..rounds() {
        beside.round(&host);
        if before.is_none() && taken(&host.status().expect("the status")) == 2 * MANY {
            before = Some(round);
        }
    }
    let before = before.unwrap_or_else(rounds);
    eprintln!("{before} rounds before the crowd was taken; beside it {beside:?}");
    assert!(before >= BEFORE, "{before} rounds before the crowd was taken");
    // Then its pairs match. The test counts the daemon's work for them in pairs, and its work for others in rounds.
    let mut met = || {
        crowd.go();
        crowd.hear().parse::<usize>().unwrap()
    };
    let (mut pairs, mut meanwhile) = (met(), 0);
    let (first, begin) = (pairs, Instant::now());
    while pairs < PAIRS {
        assert!(begin.elapsed() < MEETING, "{pairs} pairs have met");
        (0..10).for_each(|_| beside.round(&host));
        meanwhile += 10;
        pairs = met();
    }
    eprintln!("{meanwhile} rounds while {} pairs met; beside them {beside:?}", pairs - first);
    let least = (PAIRS.saturating_sub(first)) / MOST_PAIRS_A_ROUND;
    assert!(meanwhile >= least, "{meanwhile} rounds while {} pairs met", pairs - first);
    is_served_while_it_ends(&host, crowd);
}

#[test]
fn connections_that_say_nothing_hold_up_no_process() {
    let host = Host::new().with("AXON_LOG", "warn");
    let _daemon = host.daemon();
    alone(&host);
    let address = Address::of(&host.config());
    let mut silent = host.play("silent");
    assert_eq!(silent.hear(), "begins");
    let mut beside = Longest::default();
    let (mut kept, mut closed) = (0, 0);
    for _ in 0..rounds() / 10 {
        // This process is silent for a while, too.
        let (begin, honest) = (Instant::now(), address.connect().unwrap());
        silent.go();
        (0..10).for_each(|_| beside.round(&host));
        closed = silent.hear().parse().unwrap();
        let is_closed = is_closed(&honest);
        if begin.elapsed() < SOON {
            assert!(!is_closed, "an honest connection was closed for a silent one");
            kept += 1;
        }
    }
    eprintln!("{closed} silent connections were closed and none of {kept} honest; {beside:?}");
    assert!(kept > 0 && closed > 0, "{kept} and {closed}");
    is_served_while_it_ends(&host, silent);
}
