//! Tests addresses at which another daemon answers.

use super::*;

const FIRST: &str = "10.0.0.2:61301";
const SECOND: &str = "10.0.0.7:61301";

fn hear_from(peers: &mut PeerDiscovery, now: f64, daemon: DaemonId, address: &str) {
    let bytes = Datagram::Beacon(beacon(daemon)).encode();
    peers.handle_datagram(secs(now), from(address), Arrival::Shared, &bytes);
}

/// Answers the dials of the daemon: another one is at this address.
fn absent(peers: &mut PeerDiscovery, now: Duration, daemon: DaemonId, address: &str) {
    peers.handle_absent(daemon, from(address));
    fail(peers, now, daemon);
}

/// Runs until this time, and answers each dial. Returns the number of dials.
fn dials_until(peers: &mut PeerDiscovery, mut now: f64, end: f64, address: &str) -> usize {
    let mut count = 0;
    while now < end {
        peers.handle_timeout(secs(now));
        for daemon in dials(peers) {
            count += 1;
            absent(peers, secs(now), daemon, address);
        }
        now += 0.05;
    }
    count
}

#[test]
fn a_daemon_is_dialled_once_at_an_address_where_another_one_is() {
    let mut peers = settled(local());
    hear(&mut peers, 3.0, beacon(HIGHER));
    assert_eq!(dials_until(&mut peers, 3.0, 60.0, FIRST), 1);
    peers.handle_timeout(secs(70.0));
    assert!(peers.records.is_empty(), "its silence ends it");
    hear(&mut peers, 71.0, beacon(HIGHER));
    assert_eq!(dials_until(&mut peers, 71.0, 75.0, FIRST), 1, "a beacon names the address again");
}

#[test]
fn beacons_that_repeat_an_address_where_another_daemon_is_do_not_end_the_backoff() {
    let mut peers = settled(local());
    let mut count = 0;
    for step in 0..1200 {
        let now = 3.0 + f64::from(step) * 0.05;
        hear(&mut peers, now, beacon(HIGHER));
        count += dials_until(&mut peers, now, now + 0.04, FIRST);
    }
    assert!((2..=16).contains(&count), "{count} in 60 s");
}

#[test]
fn the_host_at_one_address_takes_no_other_address() {
    let mut peers = settled(local());
    hear_from(&mut peers, 3.0, HIGHER, SECOND);
    hear_from(&mut peers, 3.0, HIGHER, FIRST);
    dials(&mut peers);
    absent(&mut peers, secs(4.0), HIGHER, FIRST);
    absent(&mut peers, secs(4.0), HIGHER, "10.0.0.99:61301");
    peers.handle_timeout(secs(10.0));
    let dialled = actions(&mut peers).into_iter().filter_map(|action| match action {
        DiscoveryAction::Dial { addrs, .. } => Some(addrs),
        _ => None,
    });
    assert_eq!(dialled.collect::<Vec<_>>(), [[from(SECOND)]]);
}

#[test]
fn advertised_address_where_another_daemon_is_is_not_dialled() {
    let mut peers = settled(local());
    let advertised = vec!["10.0.0.7".parse().unwrap()];
    hear(&mut peers, 3.0, Beacon { addresses: advertised, ..beacon(HIGHER) });
    dials(&mut peers);
    absent(&mut peers, secs(4.0), HIGHER, SECOND);
    peers.handle_timeout(secs(10.0));
    let dial = actions(&mut peers).into_iter().find_map(|action| match action {
        DiscoveryAction::Dial { addrs, .. } => Some(addrs),
        _ => None,
    });
    assert_eq!(dial, Some(vec![from(FIRST)]));
}

#[test]
fn the_address_of_a_link_that_stands_stays() {
    let mut peers = settled(local());
    hear(&mut peers, 3.0, beacon(HIGHER));
    peers.handle_link_up(secs(4.0), HIGHER, from(FIRST), true);
    absent(&mut peers, secs(5.0), HIGHER, FIRST);
    peers.handle_link_down(secs(6.0), HIGHER);
    peers.handle_timeout(secs(7.0));
    assert_eq!(dials(&mut peers), [HIGHER]);
}

#[test]
fn the_link_of_another_daemon_takes_its_address_from_daemons_without_a_link() {
    for (address, dialled) in [(FIRST, 0), (SECOND, 1)] {
        let mut peers = settled(local());
        hear(&mut peers, 3.0, beacon(HIGHER));
        dials(&mut peers);
        fail(&mut peers, secs(3.5), HIGHER);
        peers.handle_link_up(secs(3.6), LOWER, from(address), true);
        peers.handle_timeout(secs(10.0));
        assert_eq!(dials(&mut peers).len(), dialled, "{address}");
    }
}

#[test]
fn a_daemon_whose_link_ends_after_that_of_its_successor_began_is_not_dialled() {
    let mut peers = settled(local());
    hear(&mut peers, 3.0, beacon(HIGHER));
    hear(&mut peers, 3.0, beacon(LOWER));
    peers.handle_link_up(secs(4.0), HIGHER, from(FIRST), true);
    peers.handle_link_up(secs(5.0), LOWER, from(FIRST), true);
    dials(&mut peers);
    // The earlier daemon is silent, and its link stands here until it times out.
    peers.handle_link_down(secs(6.0), LOWER);
    peers.handle_timeout(secs(7.0));
    assert_eq!(dials(&mut peers), [LOWER], "the newest link counts");
    peers.handle_link_up(secs(8.0), LOWER, from(FIRST), true);
    peers.handle_link_down(secs(9.0), HIGHER);
    peers.handle_timeout(secs(20.0));
    assert_eq!(dials(&mut peers), []);
}
