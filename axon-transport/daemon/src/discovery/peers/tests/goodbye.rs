//! Tests goodbyes, from daemons that end and from forgers.

use super::*;
use crate::wire::beacon::{Beacon, Datagram};

#[test]
fn goodbye_counts_after_the_link_ended_and_from_the_address_of_the_peer_alone() {
    let goodbye = Datagram::Goodbye { domain: 0, daemon: HIGHER }.encode();
    let mut peers = settled(local());
    hear(&mut peers, 3.0, beacon(HIGHER));
    peers.handle_link_up(secs(3.1), HIGHER, from("10.0.0.2:61301"), true);
    actions(&mut peers);
    peers.handle_datagram(secs(4.0), from("10.0.0.2:4000"), Arrival::Shared, &goodbye);
    peers.handle_link_down(secs(4.1), HIGHER);
    // Any host could have sent the goodbye: the peer is probed, and not dialled meanwhile.
    assert_eq!(probes(&mut peers).len(), 1);
    peers.handle_timeout(secs(7.0));
    assert_eq!(actions(&mut peers), []);
    peers.handle_timeout(secs(7.2));
    assert_eq!(actions(&mut peers), [DiscoveryAction::Gone { daemon: HIGHER }]);

    let at = |host: &str| format!("10.0.0.{host}:4000").parse().unwrap();
    let heard = Beacon { port: 61301, ..beacon(LOWER) };
    peers.handle_datagram(secs(8.0), at("3"), Arrival::Shared, &Datagram::Beacon(heard).encode());
    let goodbye = Datagram::Goodbye { domain: 0, daemon: LOWER }.encode();
    peers.handle_datagram(secs(8.1), at("66"), Arrival::Shared, &goodbye);
    assert_eq!(actions(&mut peers), [], "said by another");
    peers.handle_datagram(secs(8.2), at("3"), Arrival::Shared, &goodbye);
    assert_eq!(probes(&mut peers).len(), 1);
    peers.handle_timeout(secs(11.3));
    assert_eq!(actions(&mut peers), [DiscoveryAction::Gone { daemon: LOWER }]);
}

#[test]
fn a_peer_that_answers_after_a_goodbye_in_its_name_stays() {
    let goodbye = Datagram::Goodbye { domain: 0, daemon: HIGHER }.encode();
    let mut peers = settled(local());
    hear(&mut peers, 3.0, beacon(HIGHER));
    let address = from("10.0.0.2:61301");
    peers.handle_link_up(secs(3.1), HIGHER, address, true);
    actions(&mut peers);
    peers.handle_datagram(secs(4.0), from("10.0.0.2:4000"), Arrival::Shared, &goodbye);
    peers.handle_link_down(secs(4.1), HIGHER);
    let probes = probes(&mut peers);
    let [(to, nonce)] = probes[..] else { panic!("{probes:?}") };
    assert_eq!(to, address);
    let echo = Datagram::Echo { daemon: HIGHER, nonce }.encode();
    peers.handle_datagram(secs(4.2), address, Arrival::Quic, &echo);
    assert_eq!(dials(&mut peers), [HIGHER]);
    fail(&mut peers, secs(4.3), HIGHER);
    // Further goodbyes have no effect for a while, so that they cost nothing either.
    for _ in 0..100 {
        peers.handle_datagram(secs(4.4), from("10.0.0.2:4000"), Arrival::Shared, &goodbye);
    }
    peers.handle_timeout(secs(6.0));
    assert_eq!(dials(&mut peers), [HIGHER], "and it alone");
}

/// Returns discovery in which two addresses claim a daemon's id, neither of which could be dialled, and then the first
/// says goodbye.
fn contested(now: f64) -> PeerDiscovery {
    let mut peers = settled(local());
    hear(&mut peers, now, beacon(HIGHER));
    let elsewhere = Datagram::Beacon(beacon(HIGHER)).encode();
    peers.handle_datagram(secs(now), from("10.0.0.66:4000"), Arrival::Shared, &elsewhere);
    fail(&mut peers, secs(now + 0.2), HIGHER);
    actions(&mut peers);
    let goodbye = Datagram::Goodbye { domain: 0, daemon: HIGHER }.encode();
    peers.handle_datagram(secs(now + 0.5), from("10.0.0.2:4000"), Arrival::Shared, &goodbye);
    peers
}

#[test]
fn an_address_of_several_is_asked_before_a_goodbye_from_there_counts() {
    let address = from("10.0.0.2:61301");
    let mut peers = contested(3.0);
    let probes = probes(&mut peers);
    let [(to, nonce)] = probes[..] else { panic!("{probes:?}") };
    assert_eq!(to, address);
    let echo = Datagram::Echo { daemon: HIGHER, nonce }.encode();
    peers.handle_datagram(secs(3.6), address, Arrival::Quic, &echo);
    peers.handle_timeout(secs(8.0));
    let record = &peers.records[&HIGHER];
    assert_eq!(
        (record.sources[0].address, record.standing()),
        (address, AddressConfidence::Answered)
    );
}

#[test]
fn an_address_of_several_that_does_not_answer_after_a_goodbye_is_forgotten_alone() {
    let mut peers = contested(3.0);
    peers.handle_timeout(secs(6.4));
    assert_eq!(peers.records[&HIGHER].sources.len(), 2, "an answer may still come");
    peers.handle_timeout(secs(6.6));
    let left: Vec<_> = peers.records[&HIGHER].sources.iter().map(|s| s.address).collect();
    assert_eq!(left, [from("10.0.0.66:61301")]);
}

/// Returns the probes that are to be sent, with their nonces, and checks that there are no other actions.
fn probes(peers: &mut PeerDiscovery) -> Vec<(SocketAddr, [u8; 8])> {
    let sent = actions(peers).into_iter().map(|action| match action {
        DiscoveryAction::SendFromQuicPort { to, bytes } => match Datagram::decode(&bytes) {
            Ok(Datagram::Probe { nonce, .. }) => (to, nonce),
            other => panic!("{other:?}"),
        },
        other => panic!("{other:?}"),
    });
    sent.collect()
}
