//! Tests a pinned peer that creates and drops a thousand endpoints a second, beside the samples of another host.
//!
//! The test prints the effect on the age of those samples: `cargo test --release -p axon-tests --test hosts --
//! --nocapture churn`.

use std::{
    sync::atomic::{AtomicU64, Ordering::Relaxed},
    thread,
    time::{Duration, Instant},
};

use axon_daemon::internal::link::{GraphUpdate, LinkMessage};
use axon_transport::{
    EndpointSpec, Publisher, Subscription,
    graph::{Endpoint, EndpointKind},
    ids::{DaemonId, Gid, SessionId},
    internal::SessionKey,
    qos::Qos,
};

use super::{
    greedy::Camera,
    process::{PATIENCE, until},
    stranger::Met,
};

/// Samples in each round, and the time from one to the next.
const SAMPLES: u64 = 1000;
const PACE: Duration = Duration::from_millis(3);
/// Number of endpoints that are created, and dropped, at a time, and the time between two changes: 1,000 endpoints a
/// second.
const AT_A_TIME: u32 = 10;
const TICK: Duration = Duration::from_millis(10);
/// The topic of the peer's endpoints in the rounds in which they match a reader here.
const READ: &str = "/read";

/// The peer's behaviour meanwhile.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Peer {
    /// The peer does nothing.
    Quiet,
    /// The peer's endpoints are of topics without a reader.
    Unmatched,
    /// Each of its endpoints is a publisher of a topic that somebody reads.
    Matched,
}

/// The peer's end of a link, and its graph.
struct Churn {
    link: Met,
    session: SessionId,
    version: u64,
    made: u32,
}

impl Churn {
    /// Drops the current endpoints, and creates as many new ones.
    fn turn(&mut self, camera: &Camera, peer: Peer) {
        let endpoint = |number: u32| {
            let topic = match peer {
                Peer::Matched => READ.to_owned(),
                _ => format!("/churned_{number}"),
            };
            let gid = Gid::new(self.session, number);
            Endpoint::new(gid, EndpointKind::Publisher, topic, "test/Bytes")
                .with_qos(Qos::keep_all())
                .with_node("churn", "/")
        };
        let before = self.made.saturating_sub(AT_A_TIME) + 1..=self.made;
        let removed = before.map(|number| Gid::new(self.session, number)).collect();
        let added = (self.made + 1..=self.made + AT_A_TIME).map(endpoint).collect();
        let (version, before) = (self.version + 1, self.version);
        let graph = GraphUpdate { version, before, added, removed, ..GraphUpdate::default() };
        camera.stranger.say(&mut self.link, &LinkMessage::Graph(graph));
        (self.version, self.made) = (version, self.made + AT_A_TIME);
    }
}

/// Returns the sorted ages of samples from host B to host A.
fn ages(publisher: &Publisher, subscription: &Subscription, taken: &AtomicU64) -> Vec<Duration> {
    let epoch = Instant::now();
    let mut ages = thread::scope(|scope| {
        let reader = scope.spawn(|| {
            let mut bytes = Vec::new();
            let ages = (0..SAMPLES).map(|_| {
                subscription.recv(&mut bytes, Some(PATIENCE)).expect("a sample");
                let sent = u64::from_ne_bytes(bytes[..].try_into().expect("eight bytes"));
                // Relaxed: the counter orders nothing else.
                taken.fetch_add(1, Relaxed);
                epoch.elapsed().saturating_sub(Duration::from_nanos(sent))
            });
            ages.collect::<Vec<_>>()
        });
        for number in 0..SAMPLES {
            let due = PACE * u32::try_from(number).expect("a number of a test");
            thread::sleep(due.saturating_sub(epoch.elapsed()));
            let sent = epoch.elapsed().as_nanos() as u64;
            publisher.publish(&sent.to_ne_bytes()).expect("room");
        }
        reader.join().expect("a reader")
    });
    ages.sort_unstable();
    ages
}

#[test]
fn thousand_endpoints_a_second_hold_up_no_sample_of_another_host() {
    let camera = Camera::new();
    let (reader, writer) = (camera.a.session("reader"), camera.b.session("writer"));
    let spec = || EndpointSpec::new("/samples", "test/Bytes", Qos::keep_all());
    let subscription = reader.create_subscription(spec()).unwrap();
    let _reads = reader.create_subscription(EndpointSpec::new(READ, "test/Bytes", Qos::keep_all()));
    let publisher = writer.create_publisher(spec()).unwrap();
    assert!(publisher.wait_matched(1, PATIENCE));
    let key = SessionKey::generate().unwrap();
    let mut link = camera.link(0xff);
    camera.stranger.prove(&mut link, DaemonId([0xff; 16]), &[&key]);
    let mut churn = Churn { link, session: key.id(), version: 0, made: 0 };
    for peer in [Peer::Quiet, Peer::Unmatched, Peer::Matched, Peer::Quiet] {
        let (taken, from) = (AtomicU64::new(0), churn.made);
        let begun = Instant::now();
        let (ages, turns) = thread::scope(|scope| {
            let measured = scope.spawn(|| ages(&publisher, &subscription, &taken));
            let mut turns = 0;
            while !measured.is_finished() {
                if peer != Peer::Quiet {
                    churn.turn(&camera, peer);
                }
                turns += 1;
                thread::sleep((TICK * turns).saturating_sub(begun.elapsed()));
            }
            (measured.join().expect("ages"), turns)
        });
        let made = f64::from(churn.made - from) / begun.elapsed().as_secs_f64();
        let at = |share: f64| ages[((ages.len() - 1) as f64 * share) as usize];
        eprintln!(
            "{peer:?}: {made:.0} endpoints made a second; age of a sample p50 {:?}, p99 {:?}, at most {:?}",
            at(0.5),
            at(0.99),
            at(1.0)
        );
        assert_eq!(taken.load(Relaxed), SAMPLES, "{peer:?}: every sample comes");
        assert!(turns > 10 || peer == Peer::Quiet, "{peer:?}: the peer had {turns} turns");
        // The host has followed all new endpoints, and the dropped ones are gone.
        let of_peer = || -> Vec<Gid> {
            let graph = reader.graph();
            graph.endpoints.keys().copied().filter(|gid| gid.is_of(&churn.session)).collect()
        };
        let newest = churn.made.saturating_sub(AT_A_TIME) + 1..=churn.made;
        let newest: Vec<_> = newest.map(|number| Gid::new(churn.session, number)).collect();
        until("the newest state is shown", || {
            let mut shown = of_peer();
            shown.sort_unstable();
            shown == newest || churn.made == 0
        });
        assert!(churn.link.connection.close_reason().is_none(), "{peer:?}: the link stands");
    }
    assert_eq!(subscription.lost(), 0);
}
