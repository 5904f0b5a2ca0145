//! Example messages for tests.

use axon_envelope::{IndexMask, KeyId};
use axon_shm::{
    ids::{DaemonId, Gid},
    qos::Qos,
};
use axon_transport::internal::wire::session::CheckedUse;

use super::*;
use crate::{daemon_key::DaemonProof, owner::Proof, wire::keys::KeyMessage};

pub(crate) fn key_id(id: &str) -> KeyId {
    KeyId::new(id).unwrap()
}

pub(crate) fn hello() -> LinkHello {
    LinkHello {
        protocol_min: 1,
        protocol_max: 1,
        domain: 0,
        daemon: DaemonId([1; 16]),
        mode: 1,
        key_mode: 2,
        kex: 1,
        cipher: 0,
        sae: Some("sae-a".into()),
        host: "robot".into(),
        auth: None,
        replaces: None,
        expects: None,
        static_peer: false,
        routes: None,
        proof: None,
        paths: None,
        beside: None,
    }
}

pub(crate) fn peer() -> LinkHello {
    LinkHello { daemon: DaemonId([2; 16]), sae: Some("sae-b".into()), ..hello() }
}

pub(crate) fn elected() -> LinkMessage {
    LinkMessage::Elected(Elected { link: [9; 16], election: 3, standby: None })
}

/// Returns example messages, HELLO first.
pub(crate) fn messages() -> Vec<LinkMessage> {
    let qos = Qos::keep_all().with_lifespan(std::time::Duration::from_nanos(7));
    vec![
        LinkMessage::Hello(LinkHello {
            replaces: Some([3; 16]),
            expects: Some(DaemonId([4; 16])),
            paths: Some(2),
            beside: Some([8; 16]),
            proof: Some(DaemonProof { key: [5; 32], signature: [6; 64] }),
            ..hello()
        }),
        elected(),
        LinkMessage::Elected(Elected { link: [9; 16], election: 4, standby: Some(true) }),
        LinkMessage::SwitchOver,
        LinkMessage::Graph(GraphUpdate {
            version: 2,
            before: 1,
            added: vec![],
            removed: vec![Gid([5; 16])],
            more: true,
            localhost: None,
            listing: None,
            denied: Some(vec![]),
        }),
        LinkMessage::GraphResync(GraphResync { version: 2 }),
        LinkMessage::Subscribe(Subscribe {
            route: 1,
            topic: "/scan".into(),
            type_name: "sensor_msgs/msg/LaserScan".into(),
            kind: 0,
            subscribers: vec![RouteSubscriber { gid: Gid([6; 16]), qos }],
            last: vec![LastSeen { publisher: Gid([7; 16]), sequence: 42 }],
            acknowledges: Some(true),
            short_headers: Some(true),
        }),
        LinkMessage::Received(ReceivedUpTo {
            flows: vec![ReceivedOf { route: 1, publisher: Gid([7; 16]), sequence: 43, dropped: 1 }],
        }),
        LinkMessage::RouteRefused(RouteRefused {
            route: 1,
            reason: "why".into(),
            retry_s: Some(10),
        }),
        LinkMessage::RouteUnasked(RouteUnasked {
            topic: "/chatter".into(),
            type_name: "std_msgs/msg/String".into(),
            kind: 0,
            reason: Some("why".into()),
        }),
        LinkMessage::Unsubscribe(Unsubscribe { route: 1 }),
        LinkMessage::RouteReady(RouteReady { route: 1, publishers: vec![Gid([7; 16])] }),
        LinkMessage::Keepalive,
        LinkMessage::Asserted(LivelinessAsserted { publishers: vec![Gid([7; 16]), Gid([8; 16])] }),
        LinkMessage::Owners(Owners { proofs: vec![Proof { key: [1; 32], signature: [2; 64] }; 2] }),
        LinkMessage::LinkClosed(LinkClosed { link: [3; 16] }),
        LinkMessage::ReceiveLimits(ReceiveLimits { unread: 33 << 20, messages: 64 << 20 }),
        LinkMessage::Denied(DeniedUses {
            denied: vec![DeniedUse { verb: 0, name: "/cmd_vel".into(), reason: "line 4".into() }],
            lifted: vec![DeniedUse { verb: 3, name: "/dock".into(), reason: String::new() }],
        }),
        LinkMessage::AccessCheck(LinkAccessCheck {
            number: 5,
            uses: vec![CheckedUse { verb: 4, name: "/scan".into() }],
        }),
        LinkMessage::AccessDecisions(AccessDecisions {
            number: 5,
            decisions: vec![UseDecision { allowed: true, reason: "line 4".into() }],
        }),
        LinkMessage::Keys(KeyMessage::Announce(vec![key_id("k1"), key_id("k2")])),
        LinkMessage::Keys(KeyMessage::Ready { key_id: key_id("k1"), proof: [8; 32] }),
        LinkMessage::Keys(KeyMessage::Failed { key_id: key_id("k2"), reason: "unknown".into() }),
        LinkMessage::Keys(KeyMessage::Retire {
            key_id: key_id("k1"),
            used: IndexMask::from_bits(0x3ff).unwrap(),
            reliable: IndexMask::from_bits(0x155).unwrap(),
        }),
    ]
}
