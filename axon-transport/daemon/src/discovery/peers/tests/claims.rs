//! Tests that a link whose peer did not prove its id does not prevent dials to other hosts that may have the id.

use super::*;
use crate::wire::beacon::Datagram;

const OWNER: &str = "10.0.0.2:61301";
const OTHER: &str = "10.0.0.9:61301";

/// Delivers the peer's beacon, and the peer's answer to the probe that follows, if there is one. Returns the dialled
/// daemons.
fn hear_and_answer(peers: &mut PeerDiscovery, now: f64) -> Vec<DaemonId> {
    hear(peers, now, beacon(HIGHER));
    let mut dialled = Vec::new();
    for action in actions(peers) {
        match action {
            DiscoveryAction::SendFromQuicPort { to, bytes } => {
                let Ok(Datagram::Probe { nonce, .. }) = Datagram::decode(&bytes) else { continue };
                assert_eq!(to, from(OWNER));
                let echo = Datagram::Echo { daemon: HIGHER, nonce }.encode();
                peers.handle_datagram(secs(now), to, Arrival::Quic, &echo);
                dialled.extend(dials(peers));
            }
            DiscoveryAction::Dial { daemon, addrs, .. } => {
                assert_eq!(addrs, [from(OWNER)]);
                dialled.push(daemon);
            }
            _ => {}
        }
    }
    dialled
}

#[test]
fn the_owner_is_dialled_where_it_answers_until_it_is_linked() {
    let mut peers = settled(local());
    peers.handle_link_up(secs(3.0), HIGHER, from(OTHER), false);
    assert_eq!(dials(&mut peers), []);
    assert_eq!(hear_and_answer(&mut peers, 4.0), [HIGHER]);
    // A failed dial is repeated, at long intervals: the other host may be an older daemon with two addresses.
    for standing in AddressConfidence::ALL {
        peers.handle_dial_failed(secs(4.1), HIGHER, standing);
    }
    assert_eq!(hear_and_answer(&mut peers, 5.0), []);
    let mut now = secs(5.0);
    while now < secs(60.0) {
        now += secs(1.0);
        peers.handle_timeout(now);
        let dialled = dials(&mut peers);
        if !dialled.is_empty() {
            assert_eq!(dialled, [HIGHER]);
            break;
        }
    }
    assert!(now >= secs(15.0) && now < secs(60.0), "{now:?}");
    peers.handle_link_down(secs(61.0), HIGHER);
    peers.handle_link_up(secs(61.1), HIGHER, from(OWNER), true);
    actions(&mut peers);
    assert_eq!(hear_and_answer(&mut peers, 62.0), []);
    peers.handle_timeout(secs(200.0));
    assert_eq!(dials(&mut peers), []);
}

#[test]
fn a_listed_owner_is_dialled_at_once() {
    let mut peers = settled(local());
    peers.set_listed(secs(3.0), vec![("10.0.0.2".parse().unwrap(), None)]);
    peers.handle_link_up(secs(3.0), LOWER, from(OTHER), false);
    actions(&mut peers);
    hear(&mut peers, 3.1, beacon(LOWER));
    assert_eq!(dials(&mut peers), [LOWER]);
}

#[test]
fn a_peer_of_an_older_version_is_not_dialled_where_it_was_found() {
    let mut peers = settled(local());
    hear(&mut peers, 3.0, beacon(HIGHER));
    assert_eq!(dials(&mut peers), [HIGHER]);
    peers.handle_link_up(secs(3.1), HIGHER, from(OWNER), false);
    assert_eq!(hear_and_answer(&mut peers, 4.0), []);
    // The peer is not dialled at its second address either, once it was found there.
    let elsewhere = Datagram::Beacon(beacon(HIGHER)).encode();
    let second = from("10.0.0.3:61301");
    peers.set_listed(secs(4.0), vec![(second.ip(), None)]);
    peers.handle_datagram(secs(5.0), second, Arrival::Shared, &elsewhere);
    assert_eq!(dials(&mut peers), [HIGHER]);
    peers.handle_link_up(secs(5.1), HIGHER, second, false);
    for now in 6..100 {
        peers.handle_datagram(secs(now.into()), second, Arrival::Shared, &elsewhere);
        hear(&mut peers, now.into(), beacon(HIGHER));
        peers.handle_timeout(secs(now.into()));
        assert_eq!(dials(&mut peers), []);
    }
}

#[test]
fn a_host_that_is_only_heard_of_is_not_dialled_while_a_link_stands() {
    let mut peers = settled(local());
    peers.handle_link_up(secs(3.0), HIGHER, from(OTHER), false);
    actions(&mut peers);
    for now in 4..100 {
        // Beacons are easily forged: no daemon answers there.
        hear(&mut peers, now.into(), beacon(HIGHER));
        peers.handle_timeout(secs(now.into()));
        assert_eq!(dials(&mut peers), []);
    }
}
