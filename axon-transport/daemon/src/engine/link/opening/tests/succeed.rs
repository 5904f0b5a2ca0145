//! Tests two openings against each other that succeed.

use axon_envelope::{Delivery, Kind, Route, TopicHash};
use axon_tls::qkd::PskResolver;

use super::*;
use crate::link::{MAX_FRAME, MAX_FRAME_BEFORE_HELLO, MAX_INFLATED};
use crate::{keys::Lookup, link::GraphUpdate, wire::link::samples::elected};

const PROOF: [(Side, &str); 4] = [
    (Side::Client, "HELLO"),
    (Side::Server, "HELLO"),
    (Side::Server, "ANNOUNCE"),
    (Side::Client, "READY"),
];

/// Checks that the daemon with the lower id elects, and that no other message comes before.
fn awaits_election(client: &mut OpenedConnection, server: &mut OpenedConnection) {
    assert_eq!((client.hello.daemon, server.hello.daemon), (SERVER, CLIENT));
    assert!(client.order.accept(&elected()).is_err(), "the client has the lower id");
    let graph = LinkMessage::Graph(GraphUpdate::default());
    assert!(server.order.accept(&graph).is_err());
    server.order.accept(&elected()).unwrap();
    server.order.elected();
    server.order.accept(&graph).unwrap();
}

#[test]
fn classic() {
    let mut pair = Pair::new(None);
    pair.run();
    assert_eq!(pair.said, PROOF[..2]);
    let (mut client, mut server) = (pair.client.opened(), pair.server.opened());
    awaits_election(&mut client, &mut server);
    assert!(client.sealing.is_none() && server.sealing.is_none());
    assert_eq!(client.negotiated, hybrid());
    let opening = &pair.server.opening;
    assert_eq!((opening.connection, opening.side), (LINK, Side::Server));
    assert_eq!(pair.client.opening.poll_timeout(), None);
    assert!(pair.kmes.asked.is_empty());
}

#[test]
fn qkd_session() {
    let mut pair = Pair::new(Some(KeyMode::Session));
    pair.run();
    assert_eq!(pair.said, PROOF);
    let (mut client, mut server) = (pair.client.opened(), pair.server.opened());
    awaits_election(&mut client, &mut server);
    assert!(client.sealing.is_none() && server.sealing.is_none());
    assert_eq!(server.hello.sae.as_deref(), Some("sae-a"));
    assert_eq!(pair.kmes.asked.len(), 2, "enc_keys and dec_keys");
}

#[test]
fn messages10_and_the_first_key_seals() {
    const ROUTE: Route = Route { kind: Kind::Topic, topic: TopicHash([7; 16]) };
    let mut pair = Pair::new(Some(KeyMode::Messages10));
    pair.run();
    assert_eq!(pair.said, PROOF);
    let (mut client, mut server) = (pair.client.opened(), pair.server.opened());
    awaits_election(&mut client, &mut server);
    assert!(client.sealing.as_ref().is_some_and(|sealing| sealing.first.is_none()));
    let Sealing { exporters, first } = server.sealing.take().unwrap();
    assert!(first.is_some());

    let (now, ring) = (pair.now, pair.server.ring.as_mut().unwrap());
    ring.attach_sender(now, LINK, &exporters, first).unwrap();
    let sender = ring.sender(LINK).unwrap();
    let mut envelope = vec![0; 5 + sender.overhead()];
    let slot = sender.slot(now, Delivery::Reliable).unwrap();
    let length = slot.seal_into(ROUTE, &[b"hello"], &mut envelope).unwrap();
    envelope.truncate(length);
    let receiver = pair.client.ring.as_mut().unwrap().receiver(LINK).unwrap();
    let opener = receiver.opener(LINK).unwrap();
    assert_eq!(opener.open_in_place(now, ROUTE, &mut envelope).unwrap(), b"hello");
}

#[test]
fn ready_is_said_before_the_client_is_open() {
    let mut pair = Pair::new(Some(KeyMode::Messages10));
    while pair.client.outcome.is_none() {
        pair.pass();
    }
    assert_eq!(pair.said.last(), Some(&(Side::Client, "READY")));
}

#[test]
fn address_that_proved_its_name_has_room_of_its_own() {
    let mut pair = Pair::new(Some(KeyMode::Session));
    pair.run();
    pair.server.opened();
    let ring = pair.server.ring.unwrap();
    let looks_up = |host: [u8; 4]| {
        let resolver = ring.resolver(s(1), host.into());
        let (sae, key_id) = (format!("sae-{}", host[3]), format!("key-{host:?}"));
        let identity = PskIdentity::new(&sae, &key_id).unwrap().to_bytes();
        assert!(Arc::clone(&resolver).resolve(&identity).is_none());
        resolver.outcome().unwrap()
    };
    for number in 1..9 {
        assert_eq!(looks_up([10, 0, 9, number]), Lookup::Fetching);
    }
    assert!(matches!(looks_up([10, 0, 9, 9]), Lookup::Limited(_)), "strangers have eight");
    assert_eq!(looks_up([10, 0, 0, 1]), Lookup::Fetching);
}

#[test]
fn limits_of_frames_grow_with_the_trust() {
    let limits = |frame, inflated| FrameLimits { frame, inflated };
    let (least, most) = (MAX_FRAME_BEFORE_HELLO, limits(MAX_FRAME, MAX_INFLATED));

    let mut end = End::awaiting_hello(s(1), Side::Server, None);
    assert_eq!(end.opening.limits(), limits(least, least));
    end.hears(s(1), &LinkMessage::Hello(theirs(Side::Server, None)));
    assert_eq!(end.opening.limits(), most);

    let end = End::announced(s(1), KeyMode::Session, &mut Kmes::default());
    assert_eq!(end.opening.limits(), limits(MAX_FRAME, least), "not proven");
    let mut pair = Pair::new(Some(KeyMode::Session));
    assert_eq!(pair.server.opening.limits(), limits(least, least));
    pair.run();
    assert_eq!(pair.server.opening.limits(), most);
    assert_eq!(pair.client.opening.limits(), most);
}

#[test]
fn keepalives_during_the_proof_are_skipped() {
    for key_mode in [KeyMode::Session, KeyMode::Messages10] {
        let mut pair = Pair::new(Some(key_mode));
        while pair.said.len() < 2 {
            pair.pass();
        }
        for end in [&mut pair.client, &mut pair.server] {
            end.inbox.push_back(LinkMessage::Keepalive);
        }
        pair.run();
        pair.server.opened();
        pair.client.opened();
    }
}

#[test]
fn hello_of_a_dial_names_the_expected_daemon() {
    let settings = Config::default();
    let dialled = LinkHello { expects: Some(SERVER), ..ours(Side::Client, &settings) };
    let client = End::greeting(s(1), dialled, facts(Side::Client, None), &settings, None);
    let mut pair = Pair { client, ..Pair::new(None) };
    pair.run();
    assert_eq!(pair.server.opened().hello.expects, Some(SERVER));
}
