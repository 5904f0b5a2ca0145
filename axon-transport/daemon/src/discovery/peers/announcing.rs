//! Decides when this daemon sends beacons, to which addresses, and with which content.

use std::{
    collections::BTreeSet,
    net::{IpAddr, Ipv4Addr, SocketAddr},
    time::Duration,
};

use axon_transport::config::DiscoveryRange;
use rand::RngExt;

use super::{PeerDiscovery, PeersOutput, record::DaemonRecord};
use crate::{
    discovery::quic_ports,
    wire::beacon::{Beacon, Datagram, PROTOCOLS},
};

/// Times of the first beacons after a change of this daemon or its network.
const BURST: [Duration; 5] = [
    Duration::ZERO,
    Duration::from_millis(200),
    Duration::from_millis(500),
    Duration::from_millis(1000),
    Duration::from_millis(1900),
];
const INTERVAL_LEAST: Duration = Duration::from_secs(10);
const INTERVAL_PER_HOST: Duration = Duration::from_millis(250);
/// Most hosts known by beacons alone that count towards the beacon interval.
const MOST_HEARD_COUNT: usize = 32;

impl PeerDiscovery {
    /// Sends a goodbye, because this daemon ends: other daemons would otherwise dial it.
    pub(crate) fn say_goodbye(&mut self) {
        if self.port.is_none() || self.local.range == DiscoveryRange::Off {
            return;
        }
        let goodbye = Datagram::Goodbye { domain: self.local.domain, daemon: self.local.daemon };
        let bytes = goodbye.encode();
        self.announce(&bytes);
    }

    pub(super) fn interval(&self) -> Duration {
        // Any host can forge beacons under many ids, up to the limit of records: only a few of those count.
        let linked = self.records.values().filter(|record| record.linked).count();
        let others = || self.records.values().filter(|record| !record.linked);
        // An address that answers under many ids is one host.
        let answered = others().filter(|record| record.has_answered());
        let answered = answered.filter_map(DaemonRecord::host).collect::<BTreeSet<_>>().len();
        let heard = others().filter(|record| !record.has_answered()).count();
        let hosts = linked + answered + heard.min(MOST_HEARD_COUNT) + 1;
        let hosts = u32::try_from(hosts).unwrap_or(u32::MAX);
        INTERVAL_LEAST.max(INTERVAL_PER_HOST.saturating_mul(hosts))
    }

    /// Returns the longest silence of a live peer: five beacons, each as late as it may be.
    pub(super) fn lifetime(&self) -> Duration {
        self.interval().mul_f64(6.25)
    }

    /// Returns whether this daemon sends beacons.
    pub(super) fn announces(&self) -> bool {
        self.port.is_some()
            && match self.local.range {
                DiscoveryRange::Off => false,
                DiscoveryRange::Localhost => !self.listed.is_empty(),
                DiscoveryRange::Subnet => true,
            }
    }

    pub(super) fn start_burst(&mut self, now: Duration) {
        if !self.announces() {
            return;
        }
        self.burst_left = BURST.len();
        self.next_beacon = Some(now);
    }

    pub(super) fn schedule_beacon(&mut self, now: Duration) {
        self.burst_left = self.burst_left.saturating_sub(1);
        let wait = match self.burst_left {
            0 => self.interval().mul_f64(self.random.random_range(0.75..1.25)),
            left => {
                let next = BURST.len() - left;
                (BURST[next] - BURST[next - 1]).mul_f64(self.random.random_range(0.75..1.0))
            }
        };
        self.next_beacon = Some(now + wait);
    }

    pub(super) fn send_beacon(&mut self, answer_wanted: bool) {
        let Some(port) = self.port else { return };
        let bytes = self.own_beacon(port, answer_wanted);
        self.announce(&bytes);
    }

    /// Sends to every address where a daemon may listen: the QUIC ports of listed peers, and in SUBNET the group and
    /// the QUIC ports of this host, where the group may not be reached.
    fn announce(&mut self, bytes: &[u8]) {
        let mut targets = Vec::new();
        if self.local.range == DiscoveryRange::Subnet {
            self.outputs.push_back(PeersOutput::Multicast(bytes.to_vec()));
            targets.push((IpAddr::from(Ipv4Addr::LOCALHOST), None));
        }
        targets.extend(&self.listed);
        for (address, port) in targets {
            if !self.here.can_reach(address) {
                continue;
            }
            let ports = match port {
                Some(port) => port..=port,
                None => quic_ports(self.local.domain),
            };
            for port in ports {
                let own = Some(port) == self.port && self.is_own(address);
                if !own {
                    self.send(SocketAddr::new(address, port), bytes.to_vec());
                }
            }
        }
    }

    /// Returns whether this daemon's QUIC socket listens at `address`.
    fn is_own(&self, address: IpAddr) -> bool {
        if self.here.bind.is_empty() {
            self.here.is_local(address)
        } else {
            self.here.bind.contains(&address)
        }
    }

    pub(super) fn own_beacon(&self, port: u16, answer_wanted: bool) -> Vec<u8> {
        let addresses = match self.local.advertise.is_empty() {
            true => self.here.advertised(),
            false => self.local.advertise.clone(),
        };
        Datagram::Beacon(Beacon {
            protocols: (*PROTOCOLS.start(), *PROTOCOLS.end()),
            domain: self.local.domain,
            daemon: self.local.daemon,
            terms: self.local.terms,
            sae: self.local.sae.as_ref().map(|(own, _)| own.clone()),
            port,
            addresses,
            graph: self.graph,
            answer_wanted,
            localhost: self.local.range == DiscoveryRange::Localhost,
        })
        .encode()
    }
}
