//! Tests one state machine with hand-made events.

mod absent;
mod claims;
mod flood;
mod goodbye;
mod simulation;

use axon_transport::config::QkdPeers;
use proptest::{collection::vec, prelude::*};

use super::*;
use crate::{
    discovery::PeerMismatch,
    wire::{
        SecurityTerms,
        beacon::{Beacon, Datagram, Foreign},
    },
};

const CLASSIC: SecurityTerms =
    SecurityTerms { mode: 0, key_mode: 0, kex: 0, cipher: 0, auth: Some(1) };
const QKD: SecurityTerms = SecurityTerms { mode: 1, key_mode: 2, kex: 1, cipher: 0, auth: None };
pub(super) const OWN: DaemonId = DaemonId([0x80; 16]);
pub(super) const LOWER: DaemonId = DaemonId([0x01; 16]);
pub(super) const HIGHER: DaemonId = DaemonId([0xf0; 16]);

pub(super) fn secs(seconds: f64) -> Duration {
    Duration::from_secs_f64(seconds)
}

pub(super) fn local() -> LocalDaemon {
    LocalDaemon {
        daemon: OWN,
        domain: 0,
        terms: CLASSIC,
        sae: None,
        range: DiscoveryRange::Subnet,
        bind: vec!["10.0.0.1".parse().unwrap()],
        advertise: Vec::new(),
        has_two_paths: false,
    }
}

fn in_qkd() -> LocalDaemon {
    let peers = QkdPeers::Listed(vec!["sae-b".to_owned()]);
    LocalDaemon { terms: QKD, sae: Some(("sae-a".to_owned(), peers)), ..local() }
}

/// Returns discovery after its first beacons, so that its next outputs concern its peers.
pub(super) fn settled(local: LocalDaemon) -> PeerDiscovery {
    let mut peers = PeerDiscovery::new(local, 1);
    let interface = Interface {
        name: "eth0".to_owned(),
        index: 2,
        address: "10.0.0.1".parse().unwrap(),
        prefix: 24,
        broadcast: None,
        loopback: false,
    };
    peers.set_interfaces(Duration::ZERO, vec![interface]);
    peers.set_port(Duration::ZERO, 61300);
    for _ in 0..5 {
        // A daemon that looks for no peers sends no beacons, so it has no timer.
        let Some(at) = peers.poll_timeout() else { break };
        assert!(at <= secs(2.0));
        peers.handle_timeout(at);
    }
    actions(&mut peers);
    peers
}

pub(super) fn actions(peers: &mut PeerDiscovery) -> Vec<DiscoveryAction> {
    std::iter::from_fn(|| peers.poll_output())
        .filter_map(|output| match output {
            PeersOutput::Action(action) => Some(action),
            PeersOutput::Multicast(_) => None,
        })
        .collect()
}

pub(super) fn dials(peers: &mut PeerDiscovery) -> Vec<DaemonId> {
    let dialled = actions(peers).into_iter().filter_map(|action| match action {
        DiscoveryAction::Dial { daemon, .. } => Some(daemon),
        _ => None,
    });
    dialled.collect()
}

pub(super) fn beacon(daemon: DaemonId) -> Beacon {
    Beacon {
        protocols: (1, 1),
        domain: 0,
        daemon,
        terms: CLASSIC,
        sae: None,
        port: 61301,
        addresses: Vec::new(),
        graph: 0,
        answer_wanted: false,
        localhost: false,
    }
}

pub(super) fn from(text: &str) -> SocketAddr {
    text.parse().unwrap()
}

pub(super) fn hear(peers: &mut PeerDiscovery, now: f64, beacon: Beacon) {
    let bytes = Datagram::Beacon(beacon).encode();
    peers.handle_datagram(secs(now), from("10.0.0.2:4000"), Arrival::Shared, &bytes);
}

/// Fails all dials to the peer that are in flight.
pub(super) fn fail(peers: &mut PeerDiscovery, now: Duration, daemon: DaemonId) {
    AddressConfidence::ALL
        .into_iter()
        .for_each(|standing| peers.handle_dial_failed(now, daemon, standing));
}

fn mismatches(peers: &mut PeerDiscovery) -> Vec<PeerMismatch> {
    let told = actions(peers).into_iter().filter_map(|action| match action {
        DiscoveryAction::Mismatch(mismatch) => Some(mismatch),
        DiscoveryAction::Dial { daemon, .. } => panic!("dialled {daemon}"),
        _ => None,
    });
    told.collect()
}

#[test]
fn a_peer_of_other_terms_is_told_apart_once_and_never_dialled() {
    let mut peers = settled(local());
    for n in 0..20 {
        hear(
            &mut peers,
            3.0 + f64::from(n),
            Beacon {
                terms: QKD,
                sae: Some("sae-b".to_owned()),
                answer_wanted: true,
                ..beacon(LOWER)
            },
        );
        peers.handle_timeout(secs(3.5 + f64::from(n)));
    }
    let all = actions(&mut peers);
    let told: Vec<_> = all.iter().filter(|a| matches!(a, DiscoveryAction::Mismatch(_))).collect();
    let DiscoveryAction::Mismatch(mismatch) = told[0] else { unreachable!() };
    assert_eq!(told.len(), 1);
    assert_eq!((mismatch.peer, mismatch.setting), (LOWER, "AXON_SECURITY_MODE"));
    assert_eq!((&*mismatch.ours, &*mismatch.theirs), ("classic", "qkd"));
    assert!(!all.iter().any(|action| matches!(action, DiscoveryAction::Dial { .. })));
    let answer = |a: &&DiscoveryAction| matches!(a, DiscoveryAction::SendFromQuicPort { to, .. } if *to == from("10.0.0.2:61301"));
    assert_eq!(all.iter().filter(answer).count(), 20, "it is answered, so that it can say why too");
}

#[test]
fn reports_are_rationed_not_lost() {
    let mut peers = settled(local());
    let other = |n: u8| Beacon { terms: QKD, sae: Some("s".into()), ..beacon(DaemonId([n; 16])) };
    for n in 0..100 {
        hear(&mut peers, 3.0, other(n));
    }
    let first = mismatches(&mut peers).len();
    assert!((1..=32).contains(&first), "{first}");
    for second in 0..15 {
        for n in 0..50 {
            hear(&mut peers, 4.0 + f64::from(second), other(n));
        }
    }
    assert!(first + mismatches(&mut peers).len() >= 40);
}

#[test]
fn qkd_peers_must_be_listed_and_other_than_we() {
    let qkd = |daemon, sae: &str| Beacon { terms: QKD, sae: Some(sae.into()), ..beacon(daemon) };
    let mut peers = settled(in_qkd());
    hear(&mut peers, 3.0, qkd(LOWER, "sae-a"));
    hear(&mut peers, 3.0, qkd(HIGHER, "sae-x"));
    let told: Vec<_> = mismatches(&mut peers).into_iter().map(|m| (m.setting, m.theirs)).collect();
    let expected = [("AXON_SAE_ID", "sae-a"), ("AXON_QKD_PEERS", "sae-x")];
    assert_eq!(told, expected.map(|(setting, theirs)| (setting, theirs.to_owned())));

    // SAE IDs decide which side dials first: sae-a is below sae-b whatever their daemons' ids.
    hear(&mut peers, 4.0, qkd(DaemonId([2; 16]), "sae-b"));
    match &actions(&mut peers)[..] {
        [DiscoveryAction::Dial { sae: Some(sae), .. }] => assert_eq!(sae, "sae-b"),
        other => panic!("{other:?}"),
    }
}

#[test]
fn other_domains_and_protocols_are_told_apart() {
    let mut peers = settled(local());
    hear(&mut peers, 3.0, Beacon { domain: 9, ..beacon(LOWER) });
    let foreign = Foreign { protocols: (7, 9), domain: 0, daemon: HIGHER };
    let bytes = Datagram::Foreign(foreign).encode();
    peers.handle_datagram(secs(3.0), from("10.0.0.3:4000"), Arrival::Shared, &bytes);
    let told: Vec<_> = mismatches(&mut peers).into_iter().map(|m| (m.setting, m.theirs)).collect();
    assert_eq!(told[0], ("ROS_DOMAIN_ID", "9".to_owned()));
    assert_eq!(told[1], ("protocol version", "7 to 9".to_owned()));
}

#[test]
fn forged_beacons_change_nothing_for_a_peer_that_was_acceptable() {
    let forged = || Beacon { terms: QKD, sae: Some("s".into()), ..beacon(HIGHER) };
    let mut peers = settled(local());
    hear(&mut peers, 3.0, beacon(HIGHER));
    assert_eq!(dials(&mut peers), [HIGHER]);
    hear(&mut peers, 3.1, forged());
    fail(&mut peers, secs(3.2), HIGHER);
    peers.handle_timeout(secs(4.5));
    assert_eq!(dials(&mut peers), [HIGHER], "still dialled");

    peers.handle_link_up(secs(5.0), HIGHER, from("10.0.0.2:61301"), true);
    hear(&mut peers, 5.1, forged());
    let goodbye = Datagram::Goodbye { domain: 0, daemon: HIGHER }.encode();
    peers.handle_datagram(secs(5.2), from("10.0.0.2:4000"), Arrival::Shared, &goodbye);
    peers.handle_timeout(secs(500.0));
    let quiet = |a: &DiscoveryAction| matches!(a, DiscoveryAction::SendFromQuicPort { .. });
    assert!(actions(&mut peers).iter().all(quiet), "a link is neither closed nor forgotten");
    peers.handle_link_down(secs(501.0), HIGHER);
    assert_eq!(dials(&mut peers), [HIGHER]);
}

#[test]
fn the_lower_id_dials_at_once_the_other_after_a_start() {
    let mut peers = settled(local());
    hear(&mut peers, 3.0, beacon(HIGHER));
    assert_eq!(dials(&mut peers), [HIGHER]);

    hear(&mut peers, 3.0, beacon(LOWER));
    assert_eq!(dials(&mut peers), []);
    peers.handle_timeout(secs(3.299));
    assert_eq!(dials(&mut peers), []);
    peers.handle_timeout(secs(3.3));
    assert_eq!(dials(&mut peers), [LOWER]);

    // A listed peer may be behind a NAT that only lets this host begin.
    let mut peers = settled(local());
    peers.set_listed(secs(3.0), vec![("10.0.0.2".parse().unwrap(), None)]);
    hear(&mut peers, 3.0, beacon(LOWER));
    assert_eq!(dials(&mut peers), [LOWER]);

    // The peer's own dial made the link meanwhile.
    let mut peers = settled(local());
    hear(&mut peers, 3.0, beacon(LOWER));
    peers.handle_link_up(secs(3.2), LOWER, from("10.0.0.2:61301"), true);
    peers.handle_timeout(secs(4.0));
    assert_eq!(dials(&mut peers), []);
}

#[test]
fn failed_dials_back_off_up_to_eight_seconds() {
    let mut peers = settled(local());
    hear(&mut peers, 3.0, beacon(HIGHER));
    assert_eq!(dials(&mut peers), [HIGHER]);
    let mut now = secs(3.0);
    let mut waits = Vec::new();
    while waits.len() < 30 {
        fail(&mut peers, now, HIGHER);
        let failed = now;
        loop {
            now = peers.poll_timeout().unwrap();
            // The peer continues to send beacons.
            hear(&mut peers, now.as_secs_f64(), beacon(HIGHER));
            peers.handle_timeout(now);
            if dials(&mut peers) == [HIGHER] {
                break;
            }
        }
        waits.push(now - failed);
    }
    assert!(waits.iter().all(|wait| (secs(1.0)..=secs(12.0)).contains(wait)), "{waits:?}");
    assert!(waits[10..].iter().all(|wait| *wait >= secs(4.0)), "{waits:?}");

    fail(&mut peers, now, HIGHER);
    peers.set_interfaces(now + secs(1.0), Vec::new());
    assert_eq!(dials(&mut peers), [HIGHER], "another interface is another chance");
    // A dial without a reported outcome counts as failed in the end.
    let lost = now + secs(31.0);
    hear(&mut peers, lost.as_secs_f64(), beacon(HIGHER));
    peers.handle_timeout(lost);
    peers.handle_timeout(lost + secs(2.0));
    assert_eq!(dials(&mut peers), [HIGHER]);
}

#[test]
fn strangers_are_bounded_and_push_out_no_linked_peer() {
    let mut peers = settled(local());
    let linked: Vec<DaemonId> = (0..100).map(|n| DaemonId([n; 16])).collect();
    for daemon in &linked {
        peers.handle_link_up(secs(3.0), *daemon, from("10.0.0.9:61300"), true);
    }
    for n in 0..5_000_u32 {
        let mut id = [0xee; 16];
        id[..4].copy_from_slice(&n.to_be_bytes());
        hear(&mut peers, 4.0 + f64::from(n) / 1e4, beacon(DaemonId(id)));
        assert!(peers.records.len() <= 100 + MOST_UNAUTHENTICATED);
        assert!(peers.in_flight() <= MOST_IN_FLIGHT);
    }
    assert!(linked.iter().all(|daemon| peers.records[daemon].linked));
    peers.handle_timeout(secs(1e4));
    peers.handle_timeout(secs(2e4));
    assert_eq!(peers.records.len(), 100, "the silent are forgotten");
}

#[test]
fn answers_are_rationed() {
    let mut peers = settled(local());
    for n in 0..1_000_u32 {
        let mut id = [0xee; 16];
        id[..4].copy_from_slice(&n.to_be_bytes());
        hear(&mut peers, 3.0, Beacon { answer_wanted: true, ..beacon(DaemonId(id)) });
    }
    let sent = actions(&mut peers).into_iter().filter(|action| match action {
        DiscoveryAction::SendFromQuicPort { bytes, .. } => {
            matches!(Datagram::decode(bytes), Ok(Datagram::Beacon(_)))
        }
        _ => false,
    });
    assert_eq!(sent.count(), 64);
    assert!(peers.poll_timeout().unwrap() <= secs(4.0), "the rest by one beacon to all");
}

#[test]
fn ranges_are_kept() {
    let heard = |range, from: &str, arrival, localhost| {
        let mut peers = settled(LocalDaemon { range, ..local() });
        let bytes = Datagram::Beacon(Beacon { localhost, ..beacon(HIGHER) }).encode();
        peers.handle_datagram(secs(3.0), from.parse().unwrap(), arrival, &bytes);
        dials(&mut peers) == [HIGHER]
    };
    use Arrival::{Quic, Shared};
    use DiscoveryRange::{Localhost, Subnet};
    let (here, there) = ("10.0.0.1:4000", "10.0.0.2:4000");
    assert!(heard(Subnet, there, Shared, false));
    assert!(!heard(Subnet, there, Shared, true), "it does not want strangers");
    assert!(heard(Subnet, there, Quic, true), "it lists us");
    assert!(!heard(Localhost, there, Shared, false));
    assert!(heard(Localhost, there, Quic, false), "it lists us");
    assert!(heard(Localhost, here, Shared, true));

    let mut off = PeerDiscovery::new(LocalDaemon { range: DiscoveryRange::Off, ..local() }, 1);
    off.set_port(Duration::ZERO, 61300);
    off.set_listed(Duration::ZERO, vec![("10.0.0.2".parse().unwrap(), None)]);
    hear(&mut off, 1.0, beacon(HIGHER));
    off.handle_timeout(secs(1.0));
    assert_eq!(off.poll_output(), None);

    let mut alone =
        PeerDiscovery::new(LocalDaemon { range: Localhost, bind: Vec::new(), ..local() }, 1);
    alone.set_port(Duration::ZERO, 61300);
    alone.handle_timeout(Duration::ZERO);
    assert_eq!((alone.poll_output(), alone.poll_timeout()), (None, None), "it lists nobody");
    alone.set_listed(secs(1.0), vec![("10.0.0.2".parse().unwrap(), None)]);
    alone.handle_timeout(secs(1.0));
    let sent: Vec<_> = std::iter::from_fn(|| alone.poll_output()).collect();
    assert_eq!(sent.len(), 16, "the QUIC ports of the host that it lists");
    assert!(!sent.iter().any(|output| matches!(output, PeersOutput::Multicast(_))));
}

#[test]
fn a_range_that_changes_is_followed() {
    use DiscoveryRange::{Localhost, Off, Subnet};
    let multicasts = |peers: &mut PeerDiscovery, now: f64| {
        peers.handle_timeout(secs(now));
        let sent: Vec<_> = std::iter::from_fn(|| peers.poll_output()).collect();
        sent.iter().filter(|output| matches!(output, PeersOutput::Multicast(_))).count()
    };
    let mut peers = PeerDiscovery::new(LocalDaemon { range: Off, ..local() }, 1);
    peers.set_port(Duration::ZERO, 61300);
    assert_eq!(peers.poll_timeout(), None, "it is silent");
    assert_eq!(multicasts(&mut peers, 0.0), 0);
    peers.set_range(secs(1.0), Localhost);
    assert_eq!(multicasts(&mut peers, 1.0), 0);
    peers.set_range(secs(2.0), Subnet);
    assert_eq!(multicasts(&mut peers, 2.0), 1);
    hear(&mut peers, 3.0, beacon(HIGHER));
    assert_eq!(dials(&mut peers), [HIGHER]);
    peers.handle_link_up(secs(3.0), HIGHER, from("10.0.0.2:61301"), true);

    // A link stays; once it is down, it is not made again without a wish of the peer.
    peers.set_range(secs(4.0), Localhost);
    assert_eq!(multicasts(&mut peers, 30.0), 0);
    peers.handle_link_down(secs(31.0), HIGHER);
    peers.handle_timeout(secs(60.0));
    assert_eq!(dials(&mut peers), []);
    hear(&mut peers, 61.0, beacon(HIGHER));
    assert_eq!(dials(&mut peers), [], "by multicast");
    let bytes = Datagram::Beacon(beacon(HIGHER)).encode();
    peers.handle_datagram(secs(62.0), from("10.0.0.2:61301"), Arrival::Quic, &bytes);
    assert_eq!(dials(&mut peers), [HIGHER], "it lists this host");

    peers.set_range(secs(63.0), Off);
    fail(&mut peers, secs(64.0), HIGHER);
    actions(&mut peers);
    peers.handle_datagram(secs(65.0), from("10.0.0.2:61301"), Arrival::Quic, &bytes);
    peers.handle_timeout(secs(90.0));
    assert_eq!(peers.poll_output(), None);
    peers.say_goodbye();
    assert_eq!(peers.poll_output(), None);
}

#[test]
fn probes_are_echoed_and_own_beacons_ignored() {
    let mut peers = settled(local());
    hear(&mut peers, 3.0, beacon(OWN));
    assert!(peers.records.is_empty());
    let probe = Datagram::Probe { daemon: HIGHER, nonce: [7; 8] }.encode();
    peers.handle_datagram(secs(3.0), from("[::ffff:10.0.0.2]:61301"), Arrival::Quic, &probe);
    let echo = Datagram::Echo { daemon: OWN, nonce: [7; 8] }.encode();
    let to = from("10.0.0.2:61301");
    assert_eq!(actions(&mut peers), [DiscoveryAction::SendFromQuicPort { to, bytes: echo }]);
    peers.handle_datagram(secs(3.0), to, Arrival::Shared, &probe);
    assert_eq!(actions(&mut peers), [], "to the shared port nobody probes");
}

#[test]
fn listed_peers_are_tried_on_every_port_or_the_one_given() {
    let mut peers = settled(local());
    let listed = vec![("10.9.9.9".parse().unwrap(), None), ("10.0.0.7".parse().unwrap(), Some(9))];
    peers.set_listed(secs(3.0), listed);
    peers.handle_timeout(secs(3.0));
    let to: Vec<_> = actions(&mut peers)
        .into_iter()
        .map(|action| match action {
            DiscoveryAction::SendFromQuicPort { to, .. } => to,
            other => panic!("{other:?}"),
        })
        .collect();
    assert_eq!(to.len(), 17);
    assert_eq!((to[0], to[16]), (from("10.9.9.9:61300"), from("10.0.0.7:9")));
}

proptest! {
    #[test]
    fn no_sequence_of_events_makes_it_panic_or_overflow(
        seed in any::<u64>(),
        steps in vec((0..9_u8, 0..6_u8, 0..3_000_u64, vec(any::<u8>(), 0..40)), 0..80),
    ) {
        let mut peers = settled(in_qkd());
        let mut now = secs(3.0);
        for (step, who, wait, bytes) in steps {
            now += Duration::from_millis(wait);
            let daemon = DaemonId([who; 16]);
            let at = SocketAddr::new([10, 0, 0, who].into(), 61300);
            let quic = if wait % 2 == 0 { Arrival::Quic } else { Arrival::Shared };
            match step {
                0 => peers.handle_link_up(now, daemon, at, true),
                1 => peers.handle_link_down(now, daemon),
                2 => fail(&mut peers, now, daemon),
                3 => peers.handle_datagram(now, at, quic, &bytes),
                4 => {
                    let goodbye = Datagram::Goodbye { domain: 0, daemon }.encode();
                    peers.handle_datagram(now, at, quic, &goodbye);
                }
                5 => peers.set_listed(now, vec![(at.ip(), Some(who.into())); usize::from(who) * 60]),
                6 => peers.set_interfaces(now, Vec::new()),
                _ => {
                    let sae = Some(format!("sae-{}", char::from(b'a' + who)));
                    let terms = SecurityTerms { cipher: seed as u8 % 3, ..QKD };
                    let answer_wanted = seed % 2 == 0;
                    let heard = Beacon { terms, sae, answer_wanted, ..beacon(daemon) };
                    peers.handle_datagram(now, at, quic, &Datagram::Beacon(heard).encode());
                }
            }
            peers.handle_timeout(now);
            if let Some(at) = peers.poll_timeout() {
                prop_assert!(at > now, "nothing is due that was just done");
            }
            prop_assert!(peers.in_flight() <= MOST_IN_FLIGHT);
            for action in actions(&mut peers) {
                if let DiscoveryAction::Dial { addrs, sae, .. } = action {
                    prop_assert!(!addrs.is_empty() && addrs.len() <= 8);
                    prop_assert_eq!(sae.as_deref(), Some("sae-b"));
                }
            }
        }
    }
}
