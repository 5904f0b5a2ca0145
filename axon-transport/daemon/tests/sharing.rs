//! A process of the same user that keeps the daemon's control plane busy: the others are served beside it.

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

/// Publishers, and as many subscriptions, of one topic.
const MANY: usize = 1000;
/// What the honest process does, so often; `ROUNDS=5000` for longer.
const ROUNDS: usize = 200;
/// So many of the rounds before the daemon has taken what the crowd asks for.
const BEFORE: usize = 20;
/// How long it may take until the crowd's pairs have met: the honest process goes first all the while. Until the first has
/// it is seconds on an idle machine, and was almost a minute on a loaded one.
const MEETING: Duration = Duration::from_secs(600);
/// So many of its pairs meet at least: of a million those for which the session has lanes.
const PAIRS: usize = 100_000;
/// So many of them meet at most while others have one round.
const MOST_PAIRS_A_ROUND: usize = 5_000;
/// Connections that say nothing.
const SILENT: usize = 800;
/// More than a daemon keeps that say nothing.
const MORE: usize = 300;
/// A connection that says nothing for this long is closed in any case, or soon.
const SOON: Duration = Duration::from_secs(4);

fn spec(topic: &str) -> EndpointSpec {
    EndpointSpec::new(topic, "test/Bytes", Qos::default().with_depth(1))
}

/// Not a test of its own: what the other processes do.
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
    // Asked, how many of the pairs have met. It is as many in the end as the session has lanes.
    for line in std::io::stdin().lines() {
        line.unwrap();
        say(publishers.iter().map(|one| one.matched().len()).sum::<usize>());
    }
    drop((publishers, subscriptions));
}

/// Keeps so many connections that say nothing. One that the daemon closed, or does not take, is made anew.
/// Asked to go on, it makes [`MORE`] and says how many were closed so far.
fn say_nothing() {
    let address = Address::of(&axon_transport::config::Config::from_env().unwrap());
    let asked = Arc::new(AtomicUsize::new(0));
    let hears = Arc::clone(&asked);
    let end = thread::spawn(move || {
        // Relaxed: nothing else is told by it.
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

/// Whether the daemon closed a connection.
fn is_closed(connection: &impl std::os::fd::AsFd) -> bool {
    matches!(socket::receive(connection, &mut Vec::new()), Err(socket::SocketError::Closed))
}

/// The longest that anything took.
#[derive(Debug, Default)]
struct Longest {
    status: Duration,
    session: Duration,
    matched: Duration,
}

impl Longest {
    /// Does what an honest process does, once.
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

/// An honest process is served while a player ends, too.
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
    // All that it asks for is there at once.
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
    // Then its pairs meet. What the daemon does for them is counted in pairs, what it does for others in rounds.
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
        // This process says nothing for a while, either.
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
