//! Peers that take nothing of a KEEP_ALL topic, and hosts that are switched off: the publisher goes on, and so do others
//! that read it.

use std::time::Duration;

use axon_shm::{
    ids::{DaemonId, Gid},
    qos::Qos,
};
use axon_transport::{
    config::Config,
    graph::{Endpoint, EndpointKind},
};

use crate::{
    engine::sim::{
        rings::FOREIGN,
        tests::{millis, secs},
        world::{Pair, World},
    },
    link::{GraphUpdate, LinkHello, LinkMessage, RouteSubscriber, Subscribe},
};

/// Between two samples.
const EVERY: Duration = Duration::from_millis(50);
/// More samples than a publisher keeps.
const MANY: u64 = 1000;
/// The peer's subscription.
const SUBSCRIPTION: Gid = {
    let mut gid = [7; 16];
    let mut at = 0;
    while at < FOREIGN.len() {
        gid[at] = FOREIGN[at];
        at += 1;
    }
    Gid(gid)
};

/// Host 0 publishes a topic that host 1 reads, and a peer without an engine.
struct Held {
    world: World,
    pair: Pair,
    published: u64,
    /// Bytes of each sample.
    length: usize,
}

impl Held {
    fn new(seed: u64) -> Self {
        let mut world = World::new(seed, 2, |_| Config::default());
        world.add_raw(Config::default(), DaemonId([0xff; 16]));
        let pair = world.pair(0, 1, "/t", Qos::keep_all());
        world.until(secs(5), World::is_whole);
        world.run_for(secs(1));
        Self { world, pair, published: 0, length: 100 }
    }

    /// Makes the peer dial under a daemon id, and ask for the topic.
    fn subscribe(&mut self, id: u8) -> usize {
        self.subscribe_over(id, None)
    }

    /// Does the same over a link that may replace another one.
    fn subscribe_over(&mut self, id: u8, replaces: Option<[u8; 16]>) -> usize {
        let to = self.world.hosts[0].address;
        let world = &mut self.world;
        let link = world.with_raw(0, |raw, now| raw.dial(to, now));
        world.until(secs(5), |world| world.raws[0].links[link].connected);
        world.with_raw(0, |raw, _| {
            // Higher than any other, so that elections are the other side's.
            let mut daemon = DaemonId([0xff; 16]);
            daemon.0[15] = id;
            let hello = LinkHello { daemon, replaces, ..raw.hello() };
            raw.links[link].say(&LinkMessage::Hello(hello));
        });
        world.until(secs(5), |world| world.raws[0].links[link].is_elected());
        let endpoint = Endpoint::new(SUBSCRIPTION, EndpointKind::Subscription, "/t", "T")
            .with_qos(Qos::keep_all())
            .with_node("idle", "/");
        let graph = GraphUpdate { version: 1, added: vec![endpoint], ..GraphUpdate::default() };
        let subscribe = Subscribe {
            route: 1,
            topic: "/t".into(),
            type_name: "T".into(),
            kind: 0,
            subscribers: vec![RouteSubscriber { gid: SUBSCRIPTION, qos: Qos::keep_all() }],
            last: Vec::new(),
            acknowledges: Some(true),
            short_headers: None,
        };
        let mut says = [LinkMessage::Graph(graph), LinkMessage::Subscribe(subscribe)];
        if replaces.is_some() {
            // A route that is asked for before the graph goes on.
            says.reverse();
        }
        world.with_raw(0, |raw, _| says.iter().for_each(|message| raw.links[link].say(message)));
        link
    }

    /// Returns the id that host 0 gave to a link of the peer.
    fn name(&self, link: usize) -> Option<[u8; 16]> {
        self.world.raws[0].links[link].messages.iter().find_map(|message| match message {
            LinkMessage::Elected(elected) => Some(elected.link),
            _ => None,
        })
    }

    /// Publishes for `time`, and calls `each` after each step. Returns whether all samples were published by then.
    fn publish(&mut self, time: Duration, mut each: impl FnMut(&mut World)) -> bool {
        let end = self.world.now + time;
        while self.world.now < end && self.published < MANY {
            self.published += u64::from(self.world.publish(self.pair, self.length));
            self.world.run_for(EVERY);
            each(&mut self.world);
        }
        self.published == MANY
    }

    /// Checks that host 1 has all published samples, and that host 0 reports what it gave up.
    fn ends_well(mut self, case: &str) {
        self.world.run_for(secs(5));
        let received = self.world.received(self.pair);
        assert!(received.into_iter().eq(1..=MANY), "{case}: {}", self.world.describe());
        let host = &self.world.hosts[0];
        assert!(host.rings.given_up(self.pair.publisher.1) > 0, "{case}");
        let refusals: Vec<_> = host.refusals.iter().map(|(_, text)| text).collect();
        let is_told = |text: &&String| text.contains("/t") && text.contains("stalled_s");
        assert!(refusals.iter().any(is_told), "{case}: {refusals:?}");
    }
}

#[test]
fn a_peer_that_sends_a_ping_now_and_then_holds_no_publisher_up_for_long() {
    for every in [7, 8, 15, 19] {
        let case = format!("a PING each {every} s");
        let mut of = Held::new(120 + every);
        let link = of.subscribe(0xff);
        of.world.run_for(secs(1));
        // The peer acknowledges nothing, not even packets.
        of.world.network.cut(&[0], &[2], None);
        let mut next = of.world.now;
        let mut ping = |world: &mut World| {
            if world.now >= next {
                next = world.now + secs(every);
                world.with_raw(0, |raw, _| raw.links[link].quic.ping());
            }
        };
        // Meanwhile the frames that the peer's QUIC sends by itself become rare.
        for _ in 0..40 {
            of.world.run_for(secs(1));
            ping(&mut of.world);
        }
        assert!(of.world.raws[0].links[link].closed.is_none(), "{case}");
        // Twelve seconds until the history is full, three times the limit, and 25 s for the rest.
        assert!(of.publish(secs(75), ping), "{case}: {} {}", of.published, of.world.describe());
        of.ends_well(&case);
    }
}

#[test]
fn a_host_that_is_switched_off_holds_no_publisher_up_for_long() {
    let mut of = Held::new(124);
    of.subscribe(0xff);
    of.world.run_for(secs(1));
    of.world.network.partition(&[2], None);
    assert!(of.publish(secs(85), |_| {}), "{} {}", of.published, of.world.describe());
    of.ends_well("switched off");
}

#[test]
fn a_peer_that_has_one_daemon_after_another_holds_no_publisher_up_for_long() {
    // For samples of 2 KiB the unacknowledged samples exceed the bytes that count as progress.
    for (seed, length) in [(125, 100), (127, 2048)] {
        let mut of = Held { length, ..Held::new(seed) };
        let mut next = Duration::ZERO;
        let (begin, mut ids) = (of.world.now, 0..=0xff);
        // Each daemon takes over the samples that the one before it did not acknowledge.
        while of.world.now < begin + secs(85) && of.published < MANY {
            if of.world.now >= next {
                of.subscribe(ids.next().unwrap());
                next = of.world.now + secs(4);
            }
            of.publish(millis(500), |_| {});
        }
        assert_eq!(of.published, MANY, "{length}: {}", of.world.describe());
        of.ends_well("one daemon after another");
    }
}

#[test]
fn a_peer_that_breaks_its_link_again_and_again_holds_no_publisher_up_for_long() {
    let mut of = Held { length: 2048, ..Held::new(128) };
    let mut link = of.subscribe(0xff);
    let begin = of.world.now;
    // All is sent again over each link.
    while of.world.now < begin + secs(85) && of.published < MANY {
        of.publish(secs(4), |_| {});
        let name = of.name(link);
        link = of.subscribe_over(0xff, name);
    }
    assert_eq!(of.published, MANY, "{}", of.world.describe());
    of.ends_well("one link after another");
}

#[test]
fn an_outage_costs_a_publisher_nothing_that_it_can_keep() {
    // Cuts of any length that QUIC survives: `cuts`. Here the history is half full when the path breaks.
    let mut of = Held::new(126);
    assert!(!of.publish(secs(5), |_| {}));
    let cut = of.world.network.partition(&[1], None);
    of.publish(secs(6), |_| {});
    of.world.run_for(secs(80));
    of.world.network.heal(cut);
    assert!(of.publish(secs(60), |_| {}), "{}", of.world.describe());
    of.world.run_for(secs(5));
    assert!(of.world.received(of.pair).into_iter().eq(1..=MANY), "{}", of.world.describe());
    assert_eq!(of.world.hosts[0].rings.given_up(of.pair.publisher.1), 0);
}
