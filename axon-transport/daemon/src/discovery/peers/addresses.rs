//! Tells the gateway the addresses of linked peers: the candidates for a second path.

use std::{net::SocketAddr, time::Duration};

use axon_shm::ids::DaemonId;

use super::{
    PeerDiscovery,
    record::{DaemonRecord, ReportedAddresses},
};
use crate::discovery::DiscoveryAction;

/// Minimum time between two reports of one peer: forged beacons may change its addresses as often as they come.
const REPORT_SPACING: Duration = Duration::from_secs(1);

/// Time after which they are reported again: the gateway may have missed a report.
const REPEAT: Duration = Duration::from_secs(30);

impl PeerDiscovery {
    /// Reports the addresses of a linked peer if they changed and links may have two paths.
    pub(super) fn report_addresses(&mut self, now: Duration, daemon: DaemonId) {
        let Some(record) = self.records.get(&daemon) else { return };
        let wanted = self.local.has_two_paths && record.linked && record.compatible;
        if !wanted {
            return;
        }
        let addresses = self.all_addresses(record);
        let Some(record) = self.records.get_mut(&daemon) else { return };
        let reported = &mut record.reported_addresses;
        // Beacons of two interfaces in turn change the order alone.
        let known = &reported.addresses;
        let changed =
            known.len() != addresses.len() || !addresses.iter().all(|a| known.contains(a));
        let passed = |time| reported.at.is_none_or(|at| at + time <= now);
        if !changed && !passed(REPEAT) {
            reported.due = None;
        } else if !passed(REPORT_SPACING) {
            reported.due = reported.at.map(|at| at + REPORT_SPACING);
        } else {
            *reported =
                ReportedAddresses { addresses: addresses.clone(), at: Some(now), due: None };
            self.act(DiscoveryAction::Addresses { daemon, addresses });
        }
    }

    /// Reports the addresses that changed too soon after a report.
    pub(super) fn report_due_addresses(&mut self, now: Duration) {
        let due = self
            .records
            .iter()
            .filter(|(_, record)| record.reported_addresses.due.is_some_and(|due| due <= now));
        for daemon in due.map(|(daemon, _)| *daemon).collect::<Vec<_>>() {
            if let Some(record) = self.records.get_mut(&daemon) {
                record.reported_addresses.due = None;
            }
            self.report_addresses(now, daemon);
        }
    }

    /// Returns the sources of a peer's beacons, and the addresses that it advertises from there.
    fn all_addresses(&self, record: &DaemonRecord) -> Vec<SocketAddr> {
        let sources: Vec<_> = record.sources.iter().map(|source| source.address).collect();
        let advertised = record.sources.iter().flat_map(|source| &source.advertised);
        let advertised: Vec<_> = advertised.copied().collect();
        self.here.candidates(&sources, &advertised, record.listed)
    }
}

#[cfg(test)]
mod tests {
    use super::{
        super::{
            Arrival, PeersOutput,
            tests::{HIGHER, beacon, from, hear, local, secs, settled},
        },
        *,
    };
    use crate::{discovery::LocalDaemon, wire::beacon::Datagram};

    const FIRST: &str = "10.0.0.2:61301";
    const SECOND: &str = "10.0.0.7:61301";

    /// Returns the reported addresses since the last call.
    fn reports(peers: &mut PeerDiscovery) -> Vec<Vec<String>> {
        let outputs = std::iter::from_fn(|| peers.poll_output());
        let reports = outputs.filter_map(|output| match output {
            PeersOutput::Action(DiscoveryAction::Addresses { daemon, addresses }) => {
                assert_eq!(daemon, HIGHER);
                Some(addresses.iter().map(ToString::to_string).collect())
            }
            _ => None,
        });
        reports.collect()
    }

    fn hear_from(peers: &mut PeerDiscovery, now: f64, address: &str) {
        let bytes = Datagram::Beacon(beacon(HIGHER)).encode();
        peers.handle_datagram(secs(now), from(address), Arrival::Shared, &bytes);
    }

    fn linked(has_two_paths: bool) -> PeerDiscovery {
        let mut peers = settled(LocalDaemon { has_two_paths, ..local() });
        hear(&mut peers, 3.0, beacon(HIGHER));
        assert_eq!(reports(&mut peers), Vec::<Vec<String>>::new(), "it is not linked");
        peers.handle_link_up(secs(4.0), HIGHER, from(FIRST), true);
        peers
    }

    #[test]
    fn addresses_of_a_linked_peer_are_reported_when_they_change() {
        let mut peers = linked(true);
        assert_eq!(reports(&mut peers), [[FIRST]]);
        hear_from(&mut peers, 6.0, FIRST);
        assert!(reports(&mut peers).is_empty());
        hear_from(&mut peers, 35.0, FIRST);
        assert_eq!(reports(&mut peers), [[FIRST]], "the report may have been lost");
        hear_from(&mut peers, 35.2, SECOND);
        assert!(reports(&mut peers).is_empty(), "too soon");
        let due = secs(36.0);
        assert!(peers.poll_timeout().is_some_and(|timeout| timeout <= due));
        peers.handle_timeout(due);
        assert_eq!(reports(&mut peers).len(), 1);
        peers.handle_link_down(secs(38.0), HIGHER);
        peers.handle_link_up(secs(38.5), HIGHER, from(SECOND), true);
        assert_eq!(reports(&mut peers).len(), 1, "the gateway forgot them");
    }

    #[test]
    fn flood_of_beacons_from_made_up_addresses_is_reported_once_a_second() {
        let mut peers = linked(true);
        reports(&mut peers);
        for number in 0..5000u32 {
            let [_, _, high, low] = number.to_be_bytes();
            hear_from(
                &mut peers,
                6.0 + f64::from(number) / 1000.0,
                &format!("10.0.{high}.{low}:61301"),
            );
        }
        let reports = reports(&mut peers);
        assert!((1..=6).contains(&reports.len()), "{}", reports.len());
        assert!(reports.iter().all(|addresses| addresses.contains(&FIRST.to_owned())));
    }

    #[test]
    fn nothing_is_reported_where_links_have_one_path() {
        let mut peers = linked(false);
        hear_from(&mut peers, 7.0, SECOND);
        assert!(reports(&mut peers).is_empty());
    }
}
