//! What one session may ask of the daemon, however often it asks.

use super::*;
use crate::{
    graph::EndpointKind,
    qos::Qos,
    session::message::{Announce, EndpointRole, Message, StatusPart},
};

type Label = &'static str;

fn id(number: u8) -> SessionId {
    SessionId([number; 16])
}

fn registry(roles: &[SessionRole]) -> Registry<Label> {
    let mut registry = Registry::default();
    for (number, role) in (1..).zip(roles) {
        let handed = (*role != SessionRole::Tool).then_some(["segment", "doorbell", "pidfd"]);
        registry.connect(id(number), *role, String::new(), 1, handed).unwrap();
        drain(&mut registry, number);
    }
    registry
}

fn drain(registry: &mut Registry<Label>, number: u8) -> Vec<Message> {
    std::iter::from_fn(|| registry.next_output(&id(number)))
        .map(|output| Message::decode(&output.packet).unwrap())
        .collect()
}

fn announce(registry: &mut Registry<Label>, session: u8, number: u32, kind: EndpointKind) {
    let endpoint = Endpoint {
        gid: Gid::new(id(session), number),
        kind,
        topic: "/t".into(),
        type_name: "T".into(),
        type_hash: Vec::new(),
        qos: Qos::default(),
        node: String::new(),
        namespace: String::new(),
        enclave: String::new(),
    };
    let fds = if kind == EndpointKind::Publisher { vec!["ring"] } else { vec![] };
    let role = EndpointRole::Application;
    let message = Message::Endpoint(Announce { endpoint, role, stands_for: vec![] });
    registry.message(&id(session), message, fds).unwrap();
}

fn whole_graphs(messages: &[Message]) -> usize {
    messages.iter().filter(|m| matches!(m, Message::Graph(graph) if graph.whole)).count()
}

#[test]
fn the_pairs_that_a_session_makes_are_bounded_and_others_make_theirs() {
    let mut registry = registry(&[SessionRole::Application; 2]);
    for number in 0..256 {
        announce(&mut registry, 1, number, EndpointKind::Publisher);
    }
    for number in 256..512 {
        announce(&mut registry, 1, number, EndpointKind::Subscription);
    }
    assert_eq!(registry.pairs.len(), MAX_PAIRS);
    drain(&mut registry, 1);
    announce(&mut registry, 1, 512, EndpointKind::Subscription);
    assert_eq!(registry.pairs.len(), MAX_PAIRS, "one too many");
    let refused = drain(&mut registry, 1);
    assert!(refused.iter().any(|m| matches!(m, Message::Refused(r) if r.text.contains("pairs"))));

    announce(&mut registry, 2, 1, EndpointKind::Subscription);
    assert_eq!(registry.pairs.len(), MAX_PAIRS + 256);
    registry.disconnect(&id(1));
    assert!(registry.pairs.is_empty());
    assert_eq!(registry.session(&id(2)).unwrap().pairs, 0, "what is gone does not count");
}

#[test]
fn everything_is_told_anew_once_however_often_it_is_asked_for() {
    let mut registry = registry(&[SessionRole::Application]);
    for _ in 0..100 {
        registry.message(&id(1), Message::Resync, vec![]).unwrap();
    }
    assert_eq!(whole_graphs(&drain(&mut registry, 1)), 1);
    registry.message(&id(1), Message::Resync, vec![]).unwrap();
    assert_eq!(whole_graphs(&drain(&mut registry, 1)), 1);
}

#[test]
fn what_waits_for_a_session_is_bounded_in_bytes() {
    let mut registry = registry(&[SessionRole::Application]);
    let part = Message::Status(StatusPart { part: 0, parts: 1, text: vec![0; 24 << 10] });
    for _ in 0..1000 {
        registry.push(&id(1), &part, vec![]);
        let entry = registry.session(&id(1)).unwrap();
        assert!(entry.queued_bytes <= MAX_QUEUE_BYTES + (25 << 10));
        let bytes: usize = entry.queue.iter().map(|output| output.packet.len()).sum();
        assert_eq!(entry.queued_bytes, bytes);
    }
    assert_eq!(whole_graphs(&drain(&mut registry, 1)), 1, "it is told everything instead");
    assert_eq!(registry.session(&id(1)).unwrap().queued_bytes, 0);
}

#[test]
fn a_tool_that_does_not_listen_is_not_told_the_graph() {
    let mut registry = registry(&[SessionRole::Tool]);
    let part = Message::Status(StatusPart { part: 0, parts: 1, text: vec![0; 24 << 10] });
    assert!(!registry.session(&id(1)).unwrap().awaits_status());
    registry.push(&id(1), &part, vec![]);
    assert!(registry.session(&id(1)).unwrap().awaits_status());
    for _ in 0..1000 {
        registry.push(&id(1), &part, vec![]);
    }
    assert!(drain(&mut registry, 1).iter().all(|m| matches!(m, Message::Status(_))));
    assert!(!registry.session(&id(1)).unwrap().awaits_status());
}
