//! The daemon's own discovery on a simulated host. It hears the beacons that a scenario makes up.

use std::{
    net::{IpAddr, SocketAddr},
    time::Duration,
};

use axon_shm::ids::DaemonId;
use axon_transport::config::{Config, DiscoveryRange};

use super::host::PORT;
use crate::{
    bridge::ToGateway,
    discovery::{
        AddressConfidence, Arrival, DiscoveryAction, Interface, LocalDaemon, PeerDiscovery,
        PeersOutput,
    },
    wire::{
        SecurityTerms,
        beacon::{Beacon, Datagram, PROTOCOLS},
    },
};

/// Maximum number of dials under way: eight of discovery, and those of successors.
pub(super) const MOST_BEACON_DIALS: usize = 32;

/// Discovery of one daemon.
pub(super) struct BeaconDiscovery {
    pub(super) peers: PeerDiscovery,
    terms: SecurityTerms,
    /// The dials that were ordered.
    pub(super) dials: u64,
}

impl BeaconDiscovery {
    /// Creates discovery for a daemon at this address.
    pub(super) fn new(config: &Config, daemon: DaemonId, address: IpAddr, now: Duration) -> Self {
        let mut peers = PeerDiscovery::new(LocalDaemon::of(config, daemon), 1);
        let interface = Interface {
            name: "wlan0".into(),
            index: 1,
            address,
            prefix: 16,
            broadcast: None,
            loopback: false,
        };
        peers.set_range(now, DiscoveryRange::Subnet);
        peers.set_interfaces(now, vec![interface]);
        peers.set_port(now, PORT);
        Self { peers, terms: SecurityTerms::of(config), dials: 0 }
    }

    /// Handles the beacon of a daemon at this address.
    pub(super) fn hear(
        &mut self,
        now: Duration,
        daemon: DaemonId,
        address: SocketAddr,
        sae: Option<String>,
    ) {
        let beacon = Datagram::Beacon(Beacon {
            protocols: (*PROTOCOLS.start(), *PROTOCOLS.end()),
            domain: 0,
            daemon,
            terms: self.terms,
            sae,
            port: address.port(),
            addresses: Vec::new(),
            graph: 0,
            answer_wanted: false,
            localhost: false,
        });
        self.peers.handle_datagram(now, address, Arrival::Shared, &beacon.encode());
    }

    /// Handles a failed dial.
    pub(super) fn handle_dial_failed(
        &mut self,
        now: Duration,
        daemon: DaemonId,
        standing: AddressConfidence,
        absent_at: Option<SocketAddr>,
    ) {
        if let Some(address) = absent_at {
            self.peers.handle_absent(daemon, address);
        }
        self.peers.handle_dial_failed(now, daemon, standing);
    }

    /// Does the work that is due. Returns the orders for the gateway. No beacon is sent.
    pub(super) fn take_orders(&mut self, now: Duration) -> Vec<ToGateway> {
        self.peers.handle_timeout(now);
        let mut orders = Vec::new();
        while let Some(output) = self.peers.poll_output() {
            match output {
                PeersOutput::Action(DiscoveryAction::Dial {
                    daemon,
                    sae,
                    addrs: addresses,
                    listed,
                    standing,
                }) => {
                    self.dials += 1;
                    orders.push(ToGateway::Dial { daemon, sae, addresses, listed, standing });
                }
                PeersOutput::Action(DiscoveryAction::SendFromQuicPort { to, bytes })
                    if !matches!(Datagram::decode(&bytes), Ok(Datagram::Beacon(_))) =>
                {
                    orders.push(ToGateway::SendDatagram { to, bytes });
                }
                _ => {}
            }
        }
        orders
    }
}
