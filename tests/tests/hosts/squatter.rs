//! A peer that announces the endpoints of another host as its own.

use axon_daemon::internal::{
    link::{GraphUpdate, LinkMessage, Owners},
    owner::{Proof, prove},
};
use axon_tls::identity::{Auth, SigningKey};
use axon_transport::{
    EndpointSpec, Publisher, Session, Subscription,
    graph::{Endpoint, EndpointKind},
    ids::{DaemonId, Gid},
    internal::SessionKey,
    qos::Qos,
};

use super::{
    greedy::Camera,
    mode::{Kmes, classic},
    pair::Plan,
    process::{PATIENCE, until},
    stranger::{Claim, Stranger, high_id},
};

const TOPIC: &str = "/chatter";
const TYPE: &str = "test/Text";

fn spec(topic: &str) -> EndpointSpec {
    EndpointSpec::new(topic, TYPE, Qos::default())
}

fn numbered(session: Gid, number: u32) -> Gid {
    let mut gid = session;
    gid.0[12..].copy_from_slice(&number.to_be_bytes());
    gid
}

/// Returns the endpoint that a session will make as its `number`th, as the squatter announces it.
fn claim(session: Gid, number: u32) -> Endpoint {
    Endpoint::new(numbered(session, number), EndpointKind::Publisher, TOPIC, TYPE)
        .with_node("squatter", "/")
}

/// Returns the node of an endpoint, as this session sees it.
fn node_of(session: &Session, gid: Gid) -> Option<String> {
    session.graph().endpoints.get(&gid).map(|entry| entry.endpoint.node.clone())
}

/// Checks that ten samples arrive, the first of which has the number `first`.
#[track_caller]
fn flows(publisher: &Publisher, subscription: &Subscription, first: u64) {
    let mut bytes = Vec::new();
    for number in first..first + 10 {
        assert_eq!(publisher.publish(b"from its owner").unwrap(), number);
        let taken = subscription.recv(&mut bytes, Some(PATIENCE)).expect("a sample");
        assert_eq!((taken.sequence, &bytes[..]), (number, &b"from its owner"[..]));
    }
}

#[test]
fn a_pinned_peer_that_announces_gids_first_does_not_keep_their_owner_out() {
    let camera = Camera::new();
    let reader = camera.a.session("reader");
    let subscription = reader.create_subscription(spec(TOPIC)).unwrap();
    let owner = camera.b.session("owner");
    // The announcement reveals the first bytes of the session's GIDs.
    let first = owner.create_publisher(spec("/first")).unwrap();
    until("the owner is known", || node_of(&reader, first.gid()).is_some());

    let mut link = camera.link(0xff);
    let added = (0..64).map(|number| claim(first.gid(), number)).collect();
    let graph = GraphUpdate { version: 1, added, ..GraphUpdate::default() };
    camera.stranger.say(&mut link, &LinkMessage::Graph(graph));
    camera.a.wait_refusal("the claim, by name", |text| {
        ["camera", TOPIC, "did not prove", "session"].iter().all(|part| text.contains(part))
    });

    let publisher = owner.create_publisher(spec(TOPIC)).unwrap();
    assert!(publisher.gid().0[..12] == first.gid().0[..12]);
    assert!(publisher.wait_matched(1, PATIENCE), "while the squatter stays");
    flows(&publisher, &subscription, 1);
    // Samples may come before the graph does.
    until("the node is the one that its owner said", || {
        node_of(&reader, publisher.gid()).as_deref() == Some("")
    });
    // The host asked nothing of the squatter, and its link goes on.
    assert_eq!(link.connection.close_reason(), None);
    camera.stranger.leave(&link);
    flows(&publisher, &subscription, 11);
}

#[test]
fn a_pinned_peer_that_announces_gids_later_takes_nothing_away() {
    let camera = Camera::new();
    let reader = camera.a.session("reader");
    let subscription = reader.create_subscription(spec(TOPIC)).unwrap();
    let owner = camera.b.session("owner");
    let publisher = owner.create_publisher(spec(TOPIC)).unwrap();
    assert!(publisher.wait_matched(1, PATIENCE) && subscription.wait_matched(1, PATIENCE));
    let mut link = camera.link(0xff);
    let mut claimed = claim(publisher.gid(), 0);
    claimed.gid = publisher.gid();
    let added = vec![claimed];
    for version in 1..100 {
        let graph = GraphUpdate { version, added: added.clone(), ..GraphUpdate::default() };
        camera.stranger.say(&mut link, &LinkMessage::Graph(graph));
        let removed = vec![publisher.gid()];
        let (before, version) = (version, version + 1);
        let graph = GraphUpdate { version, before, removed, ..GraphUpdate::default() };
        camera.stranger.say(&mut link, &LinkMessage::Graph(graph));
    }
    camera.a.wait_refusal("the claim, by name", |text| {
        text.contains("camera") && text.contains("did not prove")
    });
    flows(&publisher, &subscription, 1);
    assert_eq!(subscription.lost(), 0);
}

#[test]
fn proof_of_another_connection_or_daemon_is_refused() {
    let camera = Camera::new();
    let witness = camera.a.session("witness");
    let key = SessionKey::generate().unwrap();
    let gid = Gid::new(key.id(), 0);
    let announce = |link: &mut _, version: u64| {
        let graph = GraphUpdate { version, added: vec![claim(gid, 0)], ..GraphUpdate::default() };
        camera.stranger.say(link, &LinkMessage::Graph(graph));
    };
    let left_out = |text: &str| text.contains("did not prove") && text.contains(&gid.to_string());
    let mut link = camera.link(0xff);
    // The proofs are the owner's for another connection, in the name of another daemon, or with a broken signature.
    let daemon = DaemonId([0xff; 16]);
    let replayed = prove(&key, &[7; 32], daemon).unwrap();
    let torn = Proof { signature: [3; 64], ..replayed.clone() };
    camera.stranger.say(&mut link, &LinkMessage::Owners(Owners { proofs: vec![replayed, torn] }));
    camera.stranger.prove(&mut link, high_id(0xfe), &[&key]);
    announce(&mut link, 1);
    camera.a.wait_refusal("the claim, by name", left_out);
    assert_eq!(node_of(&witness, gid), None);
    // A graph that comes before its proof does not count, and one after it does.
    camera.stranger.prove(&mut link, daemon, &[&key]);
    announce(&mut link, 2);
    until("the endpoint is known", || node_of(&witness, gid).as_deref() == Some("squatter"));
    assert_eq!(link.connection.close_reason(), None);
}

#[test]
fn a_flood_of_proofs_blocks_no_session() {
    let camera = Camera::new();
    let mut link = camera.link(0xff);
    let key = SessionKey::generate().unwrap();
    let proof = prove(&key, &[7; 32], DaemonId([0xff; 16])).unwrap();
    let proofs = vec![proof; axon_daemon::internal::link::MAX_PROOFS];
    for _ in 0..32 {
        camera.stranger.say(&mut link, &LinkMessage::Owners(Owners { proofs: proofs.clone() }));
    }
    let (reader, owner) = (camera.a.session("reader"), camera.b.session("owner"));
    let subscription = reader.create_subscription(spec(TOPIC)).unwrap();
    let publisher = owner.create_publisher(spec(TOPIC)).unwrap();
    assert!(publisher.wait_matched(1, PATIENCE) && subscription.wait_matched(1, PATIENCE));
    flows(&publisher, &subscription, 1);
    assert_eq!(link.connection.close_reason(), None);
}

#[test]
fn where_nothing_is_proved_the_first_address_has_a_gid_until_it_leaves() {
    let [a, b] = Plan::new([classic(&[]), classic(&[])]).start();
    b.link();
    let reader = a.session("reader");
    let subscription = reader.create_subscription(spec(TOPIC)).unwrap();
    let owner = b.session("owner");
    let first = owner.create_publisher(spec("/first")).unwrap();
    until("the owner is known", || node_of(&reader, first.gid()).is_some());

    let (stranger, auth) = (Stranger::new(), Auth::None(SigningKey::generate().unwrap()));
    let said = Claim { host: "squatter", daemon: DaemonId([0xff; 16]), auth: 0 };
    let mut link = stranger.dial(&a, &auth, &said).expect("a link");
    let used = u32::from_be_bytes(first.gid().0[12..].try_into().unwrap());
    let added: Vec<_> = (used + 1..used + 64).map(|number| claim(first.gid(), number)).collect();
    let last = added.last().unwrap().gid;
    let graph = GraphUpdate { version: 1, added, ..GraphUpdate::default() };
    stranger.say(&mut link, &LinkMessage::Graph(graph));
    until("the squatter is first", || node_of(&reader, last).is_some());

    let publisher = owner.create_publisher(spec(TOPIC)).unwrap();
    a.wait_log(&["ignored endpoints announced by a peer", "another peer"]);
    assert_eq!(node_of(&reader, publisher.gid()).as_deref(), Some("squatter"));
    stranger.leave(&link);
    // The host asks the owner again, without another link.
    until("the owner has it", || node_of(&reader, publisher.gid()).as_deref() == Some(""));
    assert!(publisher.wait_matched(1, PATIENCE) && subscription.wait_matched(1, PATIENCE));
    flows(&publisher, &subscription, 1);
}

#[test]
fn endpoints_are_proved_again_on_the_next_link_and_by_the_next_daemon() {
    let mut camera = Camera::new();
    let (reader, owner) = (camera.a.session("reader"), camera.b.session("owner"));
    let subscription = reader.create_subscription(spec(TOPIC)).unwrap();
    let publisher = owner.create_publisher(spec(TOPIC)).unwrap();
    assert!(publisher.wait_matched(1, PATIENCE) && subscription.wait_matched(1, PATIENCE));
    flows(&publisher, &subscription, 1);
    let killed = camera.b.kill_daemon();
    camera.b.start();
    until("another daemon takes over", || camera.b.status().daemon != killed.daemon);
    let next = camera.b.status().daemon;
    until("a link to it alone", || {
        let links = camera.a.status().links;
        links.len() == 1 && links[0].peer == next
    });
    until("its session is proved", || {
        let links = camera.a.status().links;
        links.iter().any(|link| link.endpoints > 0 && link.endpoints_left_out == 0)
    });
    let other = owner.create_publisher(spec("/other")).unwrap();
    until("what comes later counts", || node_of(&reader, other.gid()).is_some());
    assert!(publisher.wait_matched(1, PATIENCE));
    let mut bytes = Vec::new();
    until("samples flow", || {
        publisher.publish(b"again").unwrap();
        subscription.recv(&mut bytes, Some(std::time::Duration::from_millis(100))).is_ok()
    });
}

#[test]
fn with_kme_keys_each_daemon_proves_its_sessions() {
    let kmes = Kmes::start();
    let [a, b] = Plan::new([kmes.settings(0, &[]), kmes.settings(1, &[])]).start();
    b.link();
    let (reader, owner) = (a.session("reader"), b.session("owner"));
    let subscription = reader.create_subscription(spec(TOPIC)).unwrap();
    let publisher = owner.create_publisher(spec(TOPIC)).unwrap();
    assert!(publisher.wait_matched(1, PATIENCE) && subscription.wait_matched(1, PATIENCE));
    flows(&publisher, &subscription, 1);
    for host in [&a, &b] {
        assert_eq!(host.link().endpoints_left_out, 0);
    }
}

#[test]
fn a_relayed_session_is_proved_by_the_daemon_that_relays_it() {
    let camera = Camera::new();
    let [reader, owner] = [&camera.a, &camera.b].map(|host| host.relayed_session("relayed"));
    let subscription = reader.create_subscription(spec(TOPIC)).unwrap();
    let publisher = owner.create_publisher(spec(TOPIC)).unwrap();
    assert!(publisher.wait_matched(1, PATIENCE) && subscription.wait_matched(1, PATIENCE));
    flows(&publisher, &subscription, 1);
    for host in [&camera.a, &camera.b] {
        assert_eq!(host.link().endpoints_left_out, 0);
    }
}
