//! A pinned peer that announces more than fits anywhere.

use std::{
    fs,
    sync::atomic::{AtomicBool, AtomicU64, Ordering::Relaxed},
    thread,
    time::{Duration, Instant},
};

use axon_daemon::internal::link::{GraphUpdate, LinkMessage, RouteSubscriber, Subscribe};
use axon_tests::Sizes;
use axon_tls::identity::{Auth, KeyAlgorithm, SigningKey, Trust, TrustFile};
use axon_transport::{
    EndpointSpec,
    config::DaemonLocation,
    daemon_reload_at,
    graph::{Endpoint, EndpointKind},
    ids::{DaemonId, Gid, SessionId},
    internal::SessionKey,
    qos::Qos,
};

use super::{
    mode::pinned,
    pair::{Host, Plan},
    process::{Node, PATIENCE, until},
    stranger::{Claim, Met, Stranger, high_id},
};

/// Endpoints that one daemon id announces, each with four names of 500 bytes: 24 MB.
const MANY: u32 = 12_000;
/// In one message: it is 4 MiB at most before it is compressed.
const PART: u32 = 1_800;
/// Minimum number of bytes that count for each endpoint.
const NAMES: usize = 2_000;
/// Bound of one peer's graph, in bytes.
const BOUND: usize = 16 << 20;

/// Two hosts that know each other, and a peer that A's trust file knows as "camera".
pub(crate) struct Camera {
    pub(crate) stranger: Stranger,
    pub(crate) auth: Auth,
    pub(crate) a: Host,
    pub(crate) b: Host,
    dir: tempfile::TempDir,
}

impl Camera {
    pub(crate) fn new() -> Self {
        Self::under("")
    }

    /// Starts as [`new`](Self::new) does, but host A has these access rules, if any.
    pub(crate) fn under(rules: &str) -> Self {
        let dir = tempfile::tempdir().unwrap();
        let mut settings = pinned(dir.path(), [[false, true], [true, false]]);
        let pem = SigningKey::generate_pem_with(KeyAlgorithm::Ed25519).unwrap();
        let key = SigningKey::from_pem(&pem).unwrap();
        let trust = dir.path().join("host-0.trust");
        let lines = fs::read_to_string(&trust).unwrap();
        fs::write(&trust, lines + &format!("camera {}\n", key.spki_digest())).unwrap();
        let own = fs::read_to_string(dir.path().join("host-0.key")).unwrap();
        let own = SigningKey::from_pem(&own).unwrap().spki_digest();
        let pins = TrustFile::parse(&format!("a {own}")).unwrap();
        let auth = Auth::Pinned { key, trust: Trust::new(pins) };
        if !rules.is_empty() {
            fs::write(dir.path().join("access.toml"), rules).unwrap();
            let path = dir.path().join("access.toml").to_str().unwrap().to_owned();
            settings[0].push(("AXON_ACCESS_FILE", path));
        }
        let [a, b] = Plan::new(settings).start();
        b.link();
        Self { stranger: Stranger::new(), auth, a, b, dir }
    }

    /// Makes host A read these access rules.
    pub(crate) fn set_rules(&self, rules: &str) {
        fs::write(self.dir.path().join("access.toml"), rules).unwrap();
        let report = daemon_reload_at(&DaemonLocation::from(&self.a.config())).unwrap();
        assert_eq!((report.changed, report.error), (vec!["access rules".to_owned()], None));
    }

    pub(crate) fn link(&self, id: u8) -> Met {
        let claim = Claim { daemon: high_id(id), ..Claim::pinned("camera") };
        self.stranger.dial(&self.a, &self.auth, &claim).expect("a link")
    }

    /// Announces `count` endpoints as a whole graph.
    fn announce(&self, met: &mut Met, session: SessionId, count: u32) {
        for from in (0..count).step_by(PART as usize) {
            let to = count.min(from + PART);
            let added = (from..to).map(|number| long(session, number)).collect();
            let (version, before) = (u64::from(to), u64::from(from));
            let more = to < count;
            let graph = GraphUpdate { version, before, added, more, ..GraphUpdate::default() };
            self.stranger.say(met, &LinkMessage::Graph(graph));
        }
    }

    /// Waits until the host has handled all earlier messages on the link.
    fn heard(&self, met: &mut Met, route: u32) {
        let topic = format!("/asked_{route}");
        self.stranger.say(met, &subscribe(route, topic, Vec::new()));
        let ready =
            |m: &LinkMessage| matches!(m, LinkMessage::RouteReady(ready) if ready.route == route);
        self.stranger.hear(met, ready).expect("an answer");
    }

    /// Returns the processor time of host A's daemon.
    fn cpu(&self) -> Duration {
        let pid = self.a.daemon.as_ref().unwrap().0.id();
        let stat = fs::read_to_string(format!("/proc/{pid}/stat")).unwrap();
        let (_, stat) = stat.rsplit_once(") ").unwrap();
        let ticks = stat.split(' ').skip(11).take(2).map(|ticks| ticks.parse::<u64>().unwrap());
        Duration::from_millis(ticks.sum::<u64>() * 10)
    }

    /// Returns the bytes in this line of the status of host A's daemon process: its memory now, or its maximum.
    pub(crate) fn memory(&self, line: &str) -> usize {
        self.a.memory(line)
    }
}

fn long(session: SessionId, number: u32) -> Endpoint {
    let name = |kind: &str| format!("/{kind}_{number}_{}", "n".repeat(500 - 20));
    Endpoint::new(
        Gid::new(session, number),
        EndpointKind::Publisher,
        format!("{:0<500}", name("topic")),
        format!("{:0<500}", name("type")),
    )
    .with_node(format!("{:0<500}", name("node")), format!("{:0<500}", name("space")))
}

fn subscribe(route: u32, topic: String, subscribers: Vec<RouteSubscriber>) -> LinkMessage {
    LinkMessage::Subscribe(Subscribe {
        route,
        topic,
        type_name: "t".into(),
        kind: 0,
        subscribers,
        last: Vec::new(),
        acknowledges: None,
        short_headers: None,
    })
}

/// Does something at the end of its scope, however that ends.
struct OnDrop<F: Fn()>(F);

impl<F: Fn()> Drop for OnDrop<F> {
    fn drop(&mut self) {
        (self.0)();
    }
}

fn short(session: SessionId, number: u32, topic: &str) -> Endpoint {
    let (topic, name) = (topic.to_owned(), String::new);
    {
        let mut endpoint = long(session, number);
        endpoint.topic = topic;
        endpoint.type_name = "t".into();
        endpoint.node = name();
        endpoint.namespace = name();
        endpoint
    }
}

/// Loads a graph. Meanwhile host A's daemon answers status requests, and a stream of host B goes on: at least one
/// sample for each part of the graph. The simulator limits the pauses of either, in `unfair/floods.rs`. This test
/// cannot, because a status names thousands of endpoints and takes longer on a slow machine.
fn serves_others(camera: &Camera, there: &mut Node, load: impl FnOnce()) {
    let over = AtomicBool::new(false);
    let (mut answers, mut longest) = (0_u32, Duration::ZERO);
    let before = there.tally().taken;
    thread::scope(|scope| {
        let (camera, over, answers, longest) = (&camera, &over, &mut answers, &mut longest);
        scope.spawn(move || {
            // Relaxed: the flag orders nothing else.
            while !over.load(Relaxed) {
                let begin = Instant::now();
                let status = camera.a.try_status();
                // A status that comes after the end proves nothing.
                if status.is_some() && !over.load(Relaxed) {
                    (*answers, *longest) = (*answers + 1, (*longest).max(begin.elapsed()));
                }
            }
        });
        load();
        over.store(true, Relaxed);
    });
    let samples = there.tally().taken - before;
    eprintln!("{samples} samples and {answers} answers while it was taken, within {longest:?}");
    assert!(answers > 0, "the status did not answer");
    let tally = there.tally();
    assert_eq!((tally.lost, tally.repeated, tally.corrupt), (0, 0, 0), "{tally:?}");
    assert!(samples >= u64::from(MANY.div_ceil(PART)), "{samples} samples");
}

#[test]
fn graph_is_bounded_for_all_daemon_ids_of_a_peer_and_the_link_stays() {
    let camera = Camera::new();
    let witness = camera.a.session("witness");
    let mut there = camera.a.subscribe(Sizes::Small);
    let publisher = camera.b.publish(Sizes::Small, 1, None);
    there.wait_taken(1);
    let seen = || witness.graph().endpoints.values().filter(|e| e.daemon.is_some()).count();
    let before = camera.memory("VmRSS");
    let (ids, mut links) = ([0xff, 0xfe], [camera.link(0xff), camera.link(0xfe)]);
    let keys = [SessionKey::generate().unwrap(), SessionKey::generate().unwrap()];
    let sessions = [keys[0].id(), keys[1].id()];
    for (at, (link, session)) in links.iter_mut().zip(sessions).enumerate() {
        camera.stranger.prove(link, high_id(ids[at]), &[&keys[at]]);
        serves_others(&camera, &mut there, || {
            camera.announce(link, session, MANY);
            camera.heard(link, 1);
        });
    }
    drop(publisher);
    until("endpoints are shown up to the bound", || (seen() + 1000) * NAMES > BOUND / 2);
    camera.a.wait_refusal("the topics that are left out, by name and why", |text| {
        ["camera", "graph", "/topic_", "more than 16 MiB"].iter().all(|part| text.contains(part))
    });
    until("all of it is known", || {
        let links = camera.a.status().links;
        let mut camera = links.iter().filter(|l| l.host == "camera");
        camera.clone().count() == 2 && camera.all(|l| l.endpoints + l.endpoints_left_out == 12_000)
    });
    assert!(seen() * NAMES <= BOUND, "{} endpoints", seen());
    let most = camera.memory("VmHWM") - before;
    assert!(most < 12 * BOUND, "{} MiB", most >> 20);

    // One goes, another one fits.
    let [first, second] = &mut links;
    let change = |before: u64, added, removed| {
        let version = before + 1;
        LinkMessage::Graph(GraphUpdate {
            version,
            before,
            added,
            removed,
            ..GraphUpdate::default()
        })
    };
    let version = u64::from(MANY);
    let gone = vec![Gid::new(sessions[0], 0)];
    camera.stranger.say(first, &change(version, Vec::new(), gone));
    camera.heard(first, 2);
    let small = short(sessions[1], MANY, "/small");
    let gid = small.gid;
    camera.stranger.say(second, &change(version, vec![small], Vec::new()));
    until("the small one is shown", || witness.graph().endpoints.contains_key(&gid));
    assert!(links.iter().all(|link| link.connection.close_reason().is_none()));

    for link in &links {
        camera.stranger.leave(link);
    }
    until("they are gone", || seen() == 0);
    until("memory is given back", || camera.memory("VmRSS") < before + 2 * BOUND);
    eprintln!("{} MiB more at most, {} MiB before", most >> 20, before >> 20);
}

#[test]
fn graph_change_floods_block_no_session_and_end_in_the_newest_state() {
    /// The flood is under way after this many changes: more than are in flight at a time.
    const BEFORE: u64 = 30_000;
    /// Other endpoints match before the flooder has sent this many more.
    const MEANWHILE: u64 = 60_000;
    /// Number of rounds in which others make progress during the flood.
    const ROUNDS: u32 = 20;
    /// Time between two changes: 25,000 a second, where a daemon takes 16,384.
    const AT_A_TIME: Duration = Duration::from_micros(40);
    let camera = Camera::new();
    let mut there = camera.a.subscribe(Sizes::Small);
    let mut stream = camera.b.publish(Sizes::Small, 1, None);
    there.wait_taken(1);
    let reader = camera.a.session("reader");
    let mut link = camera.link(0xff);
    let key = SessionKey::generate().unwrap();
    let session = key.id();
    camera.stranger.prove(&mut link, DaemonId([0xff; 16]), &[&key]);
    // Every second change is of a topic with a reader, so that the daemon has much work with it.
    let topic = |version: u64| match version % 2 {
        0 => "/read".to_owned(),
        _ => format!("/changed_{version}"),
    };
    let spec = EndpointSpec::new("/read", "t", Qos::default());
    let _reads = reader.create_subscription(spec).unwrap();
    let (start, from) = (Instant::now(), camera.cpu());
    // Relaxed: they order nothing else.
    let (said, enough) = (AtomicU64::new(0), AtomicBool::new(false));
    let all = thread::scope(|scope| {
        let (camera, link, said, enough) = (&camera, &mut link, &said, &enough);
        let flood = scope.spawn(move || {
            let mut version = 0;
            let begun = Instant::now();
            // The limit exceeds the timeout of the waiting threads, which fail first: it only ends the test.
            while version % 2 == 1 || !enough.load(Relaxed) && begun.elapsed() < 4 * PATIENCE {
                version += 1;
                let before = version - 1;
                let added = vec![short(session, 1, &topic(version))];
                let graph = GraphUpdate { version, before, added, ..GraphUpdate::default() };
                camera.stranger.say(link, &LinkMessage::Graph(graph));
                said.store(version, Relaxed);
                // The rate exceeds what the daemon handles, but not what its socket receives: QUIC closes a connection
                // for many lost packets of a stream that is not read.
                let due = AT_A_TIME * u32::try_from(version).expect("a number of a test");
                if version.is_multiple_of(32) {
                    thread::sleep(due.saturating_sub(begun.elapsed()));
                }
            }
            // The newest is like no other.
            version += 1;
            let (before, added) = (version - 1, vec![short(session, 1, &topic(version))]);
            let graph = GraphUpdate { version, before, added, ..GraphUpdate::default() };
            camera.stranger.say(link, &LinkMessage::Graph(graph));
            version
        });
        let end = OnDrop(|| enough.store(true, Relaxed));
        until("it is under way", || said.load(Relaxed) >= BEFORE);
        let start_of_others = said.load(Relaxed);
        let spec = || EndpointSpec::new("/new", "test/Text", Qos::default());
        let begin = Instant::now();
        let subscription = reader.create_subscription(spec()).unwrap();
        let writer = camera.b.session("writer");
        let publisher = writer.create_publisher(spec()).unwrap();
        assert!(publisher.wait_matched(1, PATIENCE) && subscription.wait_matched(1, PATIENCE));
        let (matched, meanwhile) = (begin.elapsed(), said.load(Relaxed) - start_of_others);
        eprintln!("a topic of others matched after {matched:?} and {meanwhile} more changes");
        assert!(meanwhile < MEANWHILE, "{meanwhile} changes were taken before others matched");
        for number in 0..ROUNDS {
            let (taken, before) = (there.tally().taken, said.load(Relaxed));
            publisher.publish(&number.to_ne_bytes()).unwrap();
            let sample = subscription.recv(&mut Vec::new(), Some(PATIENCE)).expect("a sample");
            assert_eq!((sample.sequence, subscription.lost()), (u64::from(number) + 1, 0));
            until("the status is told", || camera.a.try_status().is_some());
            until("a stream goes on", || there.tally().taken > taken);
            until("so does the flood", || said.load(Relaxed) > before);
        }
        assert!(!flood.is_finished(), "all that was while it went on");
        drop(end);
        flood.join().unwrap()
    });
    // In order, and whole.
    let sent = stream.stop();
    there.wait_taken(sent);
    let tally = there.tally();
    assert_eq!((tally.lost, tally.repeated, tally.corrupt), (0, 0, 0), "{tally:?}");
    let gid = Gid::new(session, 1);
    until("the newest state is shown", || {
        let graph = reader.graph();
        graph.endpoints.get(&gid).is_some_and(|entry| entry.endpoint.topic == topic(all))
    });
    let (taken, version) = (start.elapsed(), reader.graph().version);
    eprintln!(
        "{all} changes taken in {taken:?} with {:?} of the daemon's time and {version} changes told",
        camera.cpu() - from
    );
    // The daemon handled the changes in between together: it asked for few of the versions.
    camera.stranger.say(&mut link, &subscribe(1, "/asked".into(), Vec::new()));
    let asked = AtomicU64::new(0);
    let last = camera.stranger.hear(&mut link, |message| {
        asked.fetch_add(u64::from(matches!(message, LinkMessage::Subscribe(_))), Relaxed);
        matches!(message, LinkMessage::RouteReady(_))
    });
    last.expect("an answer");
    let asked = asked.into_inner();
    eprintln!("asked for {asked} times");
    assert!((1..all / 200).contains(&asked), "{asked} of {all}");
    assert_eq!(link.connection.close_reason(), None);
}

#[test]
fn routes_beyond_the_limit_of_a_peer_are_refused_by_name() {
    let camera = Camera::new();
    let mut link = camera.link(0xff);
    let qos = Qos::default();
    // Each announces at most 4 MB, of which three copies are kept. Routes may take four times as much as a graph.
    let key = SessionKey::generate().unwrap();
    camera.stranger.prove(&mut link, DaemonId([0xff; 16]), &[&key]);
    let readers: Vec<_> = (0..40_000)
        .map(|number| RouteSubscriber { gid: Gid::new(key.id(), number), qos })
        .collect();
    for route in 100..108 {
        let (topic, subscribers) = (format!("/read_{route}"), readers.clone());
        camera.stranger.say(&mut link, &subscribe(route, topic, subscribers));
    }
    let refused = |m: &LinkMessage| matches!(m, LinkMessage::RouteRefused(r) if r.route == 107);
    camera.stranger.hear(&mut link, refused).expect("a refusal");
    camera.heard(&mut link, 1);
    until("the route, by name and why", || {
        let links = camera.a.status().links;
        let mut refused = links.iter().flat_map(|link| &link.routes_refused);
        refused.any(|(topic, why)| topic.contains("/read_107") && why.contains("more than 64 MiB"))
    });
    assert_eq!(link.connection.close_reason(), None);
}
