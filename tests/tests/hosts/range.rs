//! The discovery range is each session's own: which session started the daemon does not matter, and both
//! hosts decide for each pair.

use std::time::Duration;

use axon_tests::Sizes;
use axon_tls::identity::{Auth, SigningKey};
use axon_transport::{
    EndpointSpec, Publisher, Session, SessionOptions, Subscription,
    config::{Config, DaemonPolicy, DiscoveryRange},
    ids::{DaemonId, Gid},
    qos::Qos,
    status::SessionStatus,
};

use super::{
    mode::classic,
    pair::{Host, Plan, TOPIC},
    process::{PATIENCE, until},
    stranger::{Claim, Stranger},
    unread::{SUBSCRIPTION, subscribe},
};
use DiscoveryRange::{Localhost, Off, Subnet};

/// Samples of each publisher, none of which may cross that must not.
const SAMPLES: u64 = 400;

/// The environment of this process is not the host's: a daemon that this process started would be another one.
const REQUIRE: DaemonPolicy = DaemonPolicy::Require;

fn spec() -> EndpointSpec {
    EndpointSpec::new(TOPIC, "test/Bytes", Qos::keep_all())
}

/// Opens a session of this process on `host`, with a range and static peers of its own.
fn open(host: &Host, range: DiscoveryRange, lists: &[&Host]) -> Session {
    Session::open(&ranged(host, range, lists), SessionOptions::new(range.name())).unwrap()
}

/// Opens a session like [`open`], but without memory that it shares with its daemon.
fn open_relayed(host: &Host, range: DiscoveryRange, lists: &[&Host]) -> Session {
    let mut config = ranged(host, range, lists);
    config.shm = false;
    Session::open(&config, SessionOptions::new("relayed")).unwrap()
}

fn ranged(host: &Host, range: DiscoveryRange, lists: &[&Host]) -> Config {
    let static_peers = lists.iter().map(|peer| peer.address.to_string()).collect();
    let mut config = host.config();
    (config.range, config.static_peers, config.daemon) = (range, static_peers, REQUIRE);
    config
}

fn publisher(session: &Session) -> Publisher {
    session.create_publisher(spec()).unwrap()
}

fn subscription(session: &Session) -> Subscription {
    session.create_subscription(spec()).unwrap()
}

fn publish(publisher: &Publisher) {
    for number in 1..=SAMPLES {
        publisher.publish(&number.to_be_bytes()).unwrap();
    }
}

/// Takes `SAMPLES` of `writer`, and nothing of anybody else.
#[track_caller]
fn take_all_of(subscription: &Subscription, writer: Gid) {
    let mut bytes = Vec::new();
    for number in 1..=SAMPLES {
        let info = subscription.recv(&mut bytes, Some(PATIENCE)).expect("a sample");
        assert_eq!((info.publisher, info.sequence), (writer, number));
    }
}

/// Takes all, until `SAMPLES` of `writer` have come.
#[track_caller]
fn take_of(subscription: &Subscription, writer: Gid) {
    let mut bytes = Vec::new();
    loop {
        let info = subscription.recv(&mut bytes, Some(PATIENCE)).expect("a sample");
        if (info.publisher, info.sequence) == (writer, SAMPLES) {
            return;
        }
    }
}

/// Returns whether no sample waits.
fn is_empty(subscription: &Subscription) -> bool {
    !subscription.has_data()
}

#[track_caller]
fn meet(publisher: &Publisher, subscription: &Subscription) {
    let what = "a publisher and a subscription that are in range meet";
    until(what, || {
        publisher.matched().contains(&subscription.gid())
            && subscription.matched().contains(&publisher.gid())
    });
}

#[track_caller]
fn apart(session: &Session, publisher: &Publisher, other: &Session, subscription: &Subscription) {
    assert!(!publisher.matched().contains(&subscription.gid()), "the publisher counts it");
    assert!(!subscription.matched().contains(&publisher.gid()), "the subscription counts it");
    assert!(!session.graph().endpoints.contains_key(&subscription.gid()), "it is in the graph");
    assert!(!other.graph().endpoints.contains_key(&publisher.gid()), "it is in the other's graph");
}

fn session_of(host: &Host, name: &str) -> SessionStatus {
    let sessions = host.status().sessions;
    sessions.into_iter().find(|session| session.name == name).expect("the session is listed")
}

/// Prepares two hosts. With `daemons` they have daemons without a range of their own.
fn hosts(daemons: bool) -> [Host; 2] {
    let silent = || classic(&[("ROS_AUTOMATIC_DISCOVERY_RANGE", "OFF")]);
    let plan = Plan::new(if daemons { [silent(), silent()] } else { [classic(&[]), classic(&[])] });
    if daemons { plan.start() } else { plan.prepare() }
}

/// Tests a LOCALHOST session beside a SUBNET one. Samples of the first stay on the host, and samples of the second
/// arrive at the other host. Either session may have started the daemon.
fn localhost_beside_subnet(first: &[(&str, &str)]) {
    let [a, b] = hosts(false);
    // It starts the daemon of A, and one of B's own range starts that of B.
    let _first = a.node_with(first, &["publish", "/first", Sizes::Small.name(), "0", "stream"]);
    let _of_b = b.node(&["publish", "/of_b", Sizes::Small.name(), "0", "stream"]);
    until("the daemons stand", || a.try_status().is_some() && b.try_status().is_some());

    let near = open(&a, Localhost, &[]);
    let wide = open(&a, Subnet, &[]);
    let there = open(&b, Subnet, &[]);
    let (here, away) = (subscription(&wide), subscription(&there));
    let (kept, sent) = (publisher(&near), publisher(&wide));
    meet(&kept, &here);
    meet(&sent, &away);
    publish(&kept);
    take_all_of(&here, kept.gid());
    apart(&near, &kept, &there, &away);
    publish(&sent);
    take_all_of(&away, sent.gid());
    assert!(is_empty(&away), "not one of the LOCALHOST session's");

    // In the other direction, samples that are published there do not reach the LOCALHOST session.
    let (far, from_there) = (subscription(&near), publisher(&there));
    meet(&from_there, &here);
    meet(&sent, &far);
    publish(&from_there);
    take_of(&here, from_there.gid());
    apart(&there, &from_there, &near, &far);

    // The same holds for services.
    let service = || EndpointSpec::new("/service", "test/Set", Qos::default());
    let _server = near.create_server(service()).unwrap();
    let [near_client, far_client] = [&wide, &there].map(|s| s.create_client(service()).unwrap());
    assert!(near_client.wait_available(PATIENCE));
    assert!(!far_client.wait_available(Duration::from_millis(500)));

    let status = a.status();
    let topic = status.topics.iter().find(|topic| topic.topic == TOPIC).unwrap();
    let pair = topic.out_of_range.iter().find(|pair| pair.writer == kept.gid().to_string());
    let pair = pair.expect("why the pair is refused");
    assert_eq!(pair.reader, away.gid().to_string());
    assert!(pair.reason.contains("LOCALHOST") && pair.reason.contains("ROS_STATIC_PEERS"));
    assert_eq!(status.discovery.range, "SUBNET");
    assert_eq!(session_of(&a, "LOCALHOST").range.as_deref(), Some("LOCALHOST"));
    assert_eq!(session_of(&a, "SUBNET").range.as_deref(), Some("SUBNET"));
}

#[test]
fn a_localhost_session_that_started_the_daemon_does_not_keep_a_subnet_one_in() {
    localhost_beside_subnet(&[("ROS_LOCALHOST_ONLY", "1")]);
}

#[test]
fn a_subnet_session_that_started_the_daemon_does_not_let_a_localhost_one_out() {
    localhost_beside_subnet(&[("ROS_AUTOMATIC_DISCOVERY_RANGE", "SUBNET")]);
}

#[test]
fn an_off_session_reaches_itself_alone() {
    let [a, b] = hosts(true);
    let there = open(&b, Subnet, &[&a]);
    let off = open(&a, Off, &[&b]);
    let beside = open(&a, Subnet, &[]);
    let (itself, own) = (publisher(&off), subscription(&off));
    let (here, away) = (subscription(&beside), subscription(&there));
    let (sent, from_there) = (publisher(&beside), publisher(&there));
    meet(&itself, &own);
    meet(&sent, &away);
    meet(&from_there, &here);
    publish(&itself);
    take_all_of(&own, itself.gid());
    for (session, subscription) in [(&beside, &here), (&there, &away)] {
        apart(&off, &itself, session, subscription);
    }
    for (session, publisher) in [(&beside, &sent), (&there, &from_there)] {
        apart(session, publisher, &off, &own);
    }
    assert!(is_empty(&here) && is_empty(&away));
    let topics = a.status().topics;
    let topic = topics.iter().find(|topic| topic.topic == TOPIC).unwrap();
    assert!(topic.out_of_range.iter().any(|pair| pair.reason.contains("OFF")), "{topic:?}");
}

/// A static peer on one side is enough, for the session that lists it alone.
#[test]
fn a_localhost_session_meets_the_hosts_that_it_lists() {
    let [a, b] = hosts(true);
    let there = open(&b, Localhost, &[]);
    let unlisting = open(&a, Localhost, &[]);
    let (kept, away) = (publisher(&unlisting), subscription(&there));
    let from_there = publisher(&there);
    assert!(a.status().links.is_empty() && b.status().links.is_empty());

    let listing = open(&a, Localhost, &[&b]);
    let (sent, here) = (publisher(&listing), subscription(&listing));
    meet(&sent, &away);
    meet(&from_there, &here);
    publish(&kept);
    publish(&sent);
    take_all_of(&away, sent.gid());
    publish(&from_there);
    take_of(&here, from_there.gid());
    apart(&unlisting, &kept, &there, &away);
    // These samples are of the session that lists B, and not of the session that lists no host.
    take_all_of(&away, from_there.gid());
    assert!(is_empty(&away));
    let shown = session_of(&a, "LOCALHOST");
    assert!(shown.range_stated);
    let listed = a.status().sessions.into_iter().find(|session| !session.lists.is_empty()).unwrap();
    assert_eq!(listed.static_peers, [b.address.to_string()]);
    assert_eq!(listed.lists, [b.status().daemon]);
}

#[test]
fn discovery_looks_as_far_as_the_sessions_that_there_are() {
    let [a, b] = hosts(true);
    let there = open(&b, Subnet, &[]);
    let away = subscription(&there);
    let near = open(&a, Localhost, &[]);
    let kept = publisher(&near);
    assert_eq!(a.status().discovery.range, "LOCALHOST");
    assert!(a.status().discovery.hosts.is_empty(), "AXON_DAEMON_PEERS is for SUBNET sessions");
    for _ in 0..3 {
        let wide = open(&a, Subnet, &[]);
        let sent = publisher(&wide);
        meet(&sent, &away);
        assert_eq!(a.status().discovery.range, "SUBNET");
        let gid = sent.gid();
        drop((sent, wide));
        until("it is gone there", || !there.graph().endpoints.contains_key(&gid));
        until("nobody looks that far", || a.status().discovery.range == "LOCALHOST");
        apart(&near, &kept, &there, &away);
    }
    // A session on B lists this host, so this host is in its range while that session exists.
    let listing = open(&b, Subnet, &[&a]);
    let listens = subscription(&listing);
    meet(&kept, &listens);
    apart(&near, &kept, &there, &away);
    publish(&kept);
    take_all_of(&listens, kept.gid());
    drop((listens, listing));
    until("nobody there is in range", || kept.matched().is_empty());
    assert!(is_empty(&away));
}

#[test]
fn ranges_hold_after_a_daemon_was_restarted() {
    let [mut a, b] = hosts(true);
    let there = open(&b, Subnet, &[]);
    let near = open(&a, Localhost, &[]);
    let wide = open(&a, Subnet, &[]);
    let listing = open(&a, Localhost, &[&b]);
    let away = subscription(&there);
    let (kept, sent, listed) = (publisher(&near), publisher(&wide), publisher(&listing));
    meet(&sent, &away);
    meet(&listed, &away);
    for _ in 0..2 {
        let old = a.kill_daemon().daemon;
        let _starts = a.node(&["publish", "/next", Sizes::Small.name(), "0", "stream"]);
        until("another daemon takes over", || a.try_status().is_some_and(|s| s.daemon != old));
        let new = a.status().daemon;
        until("the new daemon is linked", || b.status().links.iter().any(|l| l.peer == new));
        meet(&sent, &away);
        meet(&listed, &away);
        apart(&near, &kept, &there, &away);
    }
    publish(&kept);
    publish(&sent);
    take_all_of(&away, sent.gid());
    assert!(is_empty(&away));
}

#[test]
fn ranges_are_kept_for_a_relayed_session() {
    let [a, b] = hosts(true);
    let there = open(&b, Subnet, &[]);
    let away = subscription(&there);
    let near = open_relayed(&a, Localhost, &[]);
    let wide = open(&a, Subnet, &[]);
    let (here, kept, sent) = (subscription(&wide), publisher(&near), publisher(&wide));
    meet(&kept, &here);
    meet(&sent, &away);
    publish(&kept);
    take_all_of(&here, kept.gid());
    apart(&near, &kept, &there, &away);
    assert!(is_empty(&away));
    assert_eq!(session_of(&a, "relayed").range.as_deref(), Some("LOCALHOST"));
    drop((kept, near));

    let listing = open_relayed(&a, Localhost, &[&b]);
    let listed = publisher(&listing);
    meet(&listed, &away);
    publish(&listed);
    take_all_of(&away, listed.gid());

    let off = open_relayed(&a, Off, &[&b]);
    let (own, silent) = (subscription(&off), publisher(&off));
    meet(&silent, &own);
    apart(&off, &silent, &wide, &here);
    apart(&wide, &sent, &off, &own);
}

/// A peer that heeds no range asks for a topic of which one publisher here is LOCALHOST: this host decides.
#[test]
fn a_peer_that_heeds_no_range_gets_nothing_of_a_localhost_session() {
    const SAMPLES: usize = 20;
    let [host, _other] = Plan::new([classic(&[]), classic(&[])]).start();
    let (near, wide) = (open(&host, Localhost, &[]), open(&host, Subnet, &[]));
    let (kept, sent) = (publisher(&near), publisher(&wide));
    let (stranger, auth) = (Stranger::new(), Auth::None(SigningKey::generate().unwrap()));
    let claim = Claim { host: "greedy", daemon: DaemonId([0xff; 16]), auth: 0 };
    let mut met = stranger.dial(&host, &auth, &claim).expect("a link");
    let came = stranger.read_streams(&met);
    subscribe(&stranger, &mut met, TOPIC);
    until("it is served", || sent.matched().contains(&SUBSCRIPTION));
    let [of_kept, of_sent] = ["near", "wide"].map(|text| text.repeat(16).into_bytes());
    for _ in 0..SAMPLES {
        kept.publish(&of_kept).unwrap();
        sent.publish(&of_sent).unwrap();
    }
    let count = |of: &[u8]| {
        let came = came.lock().unwrap();
        came.windows(of.len()).filter(|window| *window == of).count()
    };
    until("what is in range comes", || count(&of_sent) == SAMPLES);
    assert_eq!(count(&of_kept[..16]), 0, "what a LOCALHOST session published left the host");
    assert!(!kept.matched().contains(&SUBSCRIPTION), "it counts as matched");
    let status = host.status();
    let topic = status.topics.iter().find(|topic| topic.topic == TOPIC).unwrap();
    let (kept, asked) = (kept.gid().to_string(), SUBSCRIPTION.to_string());
    assert!(
        topic.out_of_range.iter().any(|pair| pair.writer == kept && pair.reader == asked),
        "{topic:?}"
    );
}
