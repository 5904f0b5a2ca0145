//! A process of the same user that keeps the daemon's control plane busy: the others are served beside it.

#[allow(dead_code, reason = "what other tests need of it")]
mod support;

use std::{
    thread,
    time::{Duration, Instant},
};

use axon_transport::{
    qos::Qos,
    session::{EndpointSpec, address::Address},
};
use support::{Host, of_child, say, until, wait_for_the_end};

/// Publishers, and as many subscriptions, of one topic.
const MANY: usize = 1000;
/// What the honest process does, so often; `ROUNDS=5000` for longer.
const ROUNDS: usize = 200;
/// Connections that say nothing.
const SILENT: usize = 800;

fn spec(topic: &str) -> EndpointSpec {
    EndpointSpec::new(topic, "test/Bytes", Qos { depth: 1, ..Qos::default() })
}

/// Not a test of its own: what the other processes do.
#[test]
fn child() {
    let Ok(part) = std::env::var("PLAY") else { return };
    if part == "silent" {
        let config = axon_transport::config::Config::from_env().unwrap();
        let address = Address::of(&config);
        let end = thread::spawn(wait_for_the_end);
        let mut silent = std::collections::VecDeque::new();
        say("begins");
        while !end.is_finished() {
            // One that the daemon closed, or does not take, is made anew.
            match address.connect() {
                Ok(connection) => silent.push_back(connection),
                Err(_) => thread::sleep(Duration::from_millis(1)),
            }
            if silent.len() > SILENT {
                silent.pop_front();
                thread::sleep(Duration::from_millis(1));
            }
        }
        return;
    }
    let session = of_child(&part);
    say("begins");
    let publishers: Vec<_> =
        (0..MANY).map(|_| session.create_publisher(spec("/crowd")).unwrap()).collect();
    let subscriptions: Vec<_> =
        (0..MANY).map(|_| session.create_subscription(spec("/crowd")).unwrap()).collect();
    // Of the pairs as many meet as the session has lanes.
    until("some are matched", || publishers.iter().any(|one| !one.matched().is_empty()));
    say("matched");
    wait_for_the_end();
    drop((publishers, subscriptions));
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

/// An honest process is served beside one that plays `part`, while it begins, goes on and ends.
fn is_served_beside(part: &str) {
    let host = Host::new().with("AXON_LOG", "warn");
    let _daemon = host.daemon();
    let mut alone = Longest::default();
    (0..20).for_each(|_| alone.round(&host));
    let mut player = host.play(part);
    assert_eq!(player.hear(), "begins");
    let rounds = std::env::var("ROUNDS").map_or(ROUNDS, |rounds| rounds.parse().unwrap());
    let mut beside = Longest::default();
    (0..rounds).for_each(|_| beside.round(&host));
    if part == "crowd" {
        assert_eq!(player.hear(), "matched");
    }
    let player = thread::spawn(move || player.finish());
    let mut after = Longest::default();
    (0..rounds).for_each(|_| after.round(&host));
    player.join().unwrap();
    eprintln!("alone {alone:?}\nbeside {part} {beside:?}\nwhile it ends {after:?}");
}

#[test]
fn a_million_pairs_of_one_process_hold_up_no_other() {
    is_served_beside("crowd");
}

#[test]
fn connections_that_say_nothing_hold_up_no_process() {
    is_served_beside("silent");
}
