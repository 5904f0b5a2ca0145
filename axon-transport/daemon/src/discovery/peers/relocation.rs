//! Looks for a linked peer at other addresses while the path of its link does not work. Both hosts may have moved, so
//! that neither knows the other's address.

use std::time::Duration;

use axon_shm::ids::DaemonId;

use super::PeerDiscovery;
use crate::discovery::AddressConfidence;

impl PeerDiscovery {
    /// Handles a change of the path to `daemon`. If the path does not work, looks for the daemon at other addresses.
    pub(crate) fn handle_path(&mut self, now: Duration, daemon: DaemonId, works: bool) {
        let Some(record) = self.records.get_mut(&daemon).filter(|record| record.linked) else {
            return;
        };
        let was_cut = std::mem::replace(&mut record.cut, !works);
        // The report is repeated in case it was lost.
        if works || was_cut {
            return;
        }
        record.ask_anew();
        for standing in [AddressConfidence::Known, AddressConfidence::Heard] {
            self.ask_whether_there(now, daemon, standing);
        }
        self.schedule_dial(now, daemon);
        self.dial_due(now);
    }
}

#[cfg(test)]
mod tests {
    use super::{
        super::{
            Arrival,
            tests::{HIGHER, actions, beacon, dials, from, hear, local, secs, settled},
        },
        *,
    };
    use crate::{discovery::DiscoveryAction, wire::beacon::Datagram};

    const OLD: &str = "10.0.0.2:61301";
    const NEW: &str = "10.0.0.7:61301";

    /// Returns discovery that is linked with a peer at the old address.
    fn linked() -> PeerDiscovery {
        let mut peers = settled(local());
        hear(&mut peers, 3.0, beacon(HIGHER));
        assert_eq!(dials(&mut peers), [HIGHER]);
        peers.handle_link_up(secs(4.0), HIGHER, from(OLD), true);
        peers
    }

    /// Delivers a beacon from the new address. Returns the probe of that address, if one is sent.
    fn hear_new(peers: &mut PeerDiscovery, now: f64) -> Option<[u8; 8]> {
        let bytes = Datagram::Beacon(beacon(HIGHER)).encode();
        peers.handle_datagram(secs(now), from(NEW), Arrival::Shared, &bytes);
        probe(peers)
    }

    /// Returns the probe of the new address, and checks that there are no other actions.
    fn probe(peers: &mut PeerDiscovery) -> Option<[u8; 8]> {
        let sent = actions(peers).into_iter().map(|action| match action {
            DiscoveryAction::SendFromQuicPort { to, bytes } if to == from(NEW) => {
                match Datagram::decode(&bytes) {
                    Ok(Datagram::Probe { nonce, .. }) => nonce,
                    other => panic!("{other:?}"),
                }
            }
            other => panic!("{other:?}"),
        });
        sent.collect::<Vec<_>>().last().copied()
    }

    fn answer(peers: &mut PeerDiscovery, now: f64, nonce: [u8; 8]) {
        let echo = Datagram::Echo { daemon: HIGHER, nonce }.encode();
        peers.handle_datagram(secs(now), from(NEW), Arrival::Quic, &echo);
    }

    #[test]
    fn a_peer_whose_path_is_cut_is_dialled_where_it_answers_whichever_comes_first() {
        for beacon_first in [true, false] {
            let mut peers = linked();
            if beacon_first {
                assert_eq!(hear_new(&mut peers, 5.0), None, "the link stands");
            }
            peers.handle_path(secs(6.0), HIGHER, false);
            let nonce = match beacon_first {
                true => probe(&mut peers),
                false => hear_new(&mut peers, 7.0),
            };
            answer(&mut peers, 8.0, nonce.unwrap());
            let dial = actions(&mut peers);
            let [DiscoveryAction::Dial { daemon: HIGHER, addrs, .. }] = &dial[..] else {
                panic!("{dial:?}")
            };
            assert_eq!(addrs[..], [from(NEW)]);
            peers.handle_link_up(secs(9.0), HIGHER, from(NEW), true);
            // Beacons from the old address have no effect either while the new path works.
            hear(&mut peers, 10.0, beacon(HIGHER));
            peers.handle_timeout(secs(60.0));
            assert_eq!(dials(&mut peers), []);
        }
    }

    #[test]
    fn the_address_of_a_forged_beacon_is_not_dialled_without_its_echo() {
        let mut peers = linked();
        peers.handle_path(secs(5.0), HIGHER, false);
        let nonce = hear_new(&mut peers, 6.0).unwrap();
        // An echo without the nonce, or from elsewhere, is ignored.
        answer(&mut peers, 6.1, [0; 8]);
        let echo = Datagram::Echo { daemon: HIGHER, nonce }.encode();
        peers.handle_datagram(secs(6.2), from("10.0.0.8:61301"), Arrival::Quic, &echo);
        peers.handle_timeout(secs(60.0));
        assert_eq!(dials(&mut peers), []);
    }

    #[test]
    fn nothing_is_dialled_once_the_path_works_again() {
        let mut peers = linked();
        peers.handle_path(secs(5.0), HIGHER, false);
        let nonce = hear_new(&mut peers, 6.0).unwrap();
        peers.handle_path(secs(6.1), HIGHER, true);
        answer(&mut peers, 6.2, nonce);
        peers.handle_timeout(secs(60.0));
        assert_eq!(dials(&mut peers), []);
    }

    #[test]
    fn dials_of_a_peer_that_moved_back_off() {
        let mut peers = linked();
        peers.handle_path(secs(5.0), HIGHER, false);
        let nonce = hear_new(&mut peers, 6.0).unwrap();
        answer(&mut peers, 6.1, nonce);
        let mut at = Vec::new();
        let mut now = secs(6.1);
        while now < secs(66.1) {
            peers.handle_timeout(now);
            for action in actions(&mut peers) {
                if let DiscoveryAction::Dial { standing, .. } = action {
                    at.push(now);
                    peers.handle_dial_failed(now, HIGHER, standing);
                }
            }
            now += Duration::from_millis(100);
        }
        assert!((8..=16).contains(&at.len()), "{at:?}");
    }

    #[test]
    fn the_path_of_a_peer_without_a_link_says_nothing() {
        let mut peers = settled(local());
        peers.handle_path(secs(3.0), HIGHER, false);
        assert_eq!(actions(&mut peers), []);
        assert_eq!(peers.records.len(), 0);
    }
}
