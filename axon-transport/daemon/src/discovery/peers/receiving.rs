//! Handles received datagrams: beacons, probes and goodbyes.

use std::{net::SocketAddr, time::Duration};

use axon_shm::ids::DaemonId;
use axon_transport::config::DiscoveryRange;
use rand::RngExt;
use tracing::{debug, info};

use super::{Arrival, PeerDiscovery, record::DialAddress};
use crate::{
    discovery::{DiscoveryAction, PeerMismatch},
    wire::{
        Difference,
        beacon::{Beacon, Datagram, Foreign, PROTOCOLS},
    },
};

/// Minimum time between two answers to a peer.
const ANSWER_SPACING: Duration = Duration::from_secs(1);

impl PeerDiscovery {
    /// Handles a received datagram.
    pub(crate) fn handle_datagram(
        &mut self,
        now: Duration,
        from: SocketAddr,
        arrival: Arrival,
        bytes: &[u8],
    ) {
        if self.local.range == DiscoveryRange::Off {
            return;
        }
        let from = SocketAddr::new(from.ip().to_canonical(), from.port());
        let known = self.knows(from.ip());
        let datagram = Datagram::decode(bytes);
        let told = matches!(
            datagram,
            Ok(Datagram::Beacon(_) | Datagram::Foreign(_) | Datagram::Goodbye { .. })
        );
        let heard = if known { &mut self.known_heard } else { &mut self.heard };
        if told && !heard.take(now) {
            return;
        }
        match datagram {
            Err(error) => debug!(%from, %error, "discovery datagram dropped"),
            Ok(Datagram::Beacon(beacon)) => self.beacon(now, from, arrival, beacon),
            Ok(Datagram::Foreign(foreign)) => self.foreign(now, from, arrival, foreign),
            Ok(Datagram::Goodbye { domain, daemon }) => {
                if domain == self.local.domain {
                    self.goodbye_from(now, from, daemon);
                }
            }
            Ok(Datagram::Probe { daemon, nonce }) => {
                let ours = daemon == self.local.daemon;
                let echoes = if known { &mut self.known_echoes } else { &mut self.echoes };
                if arrival == Arrival::Quic && !ours && echoes.take(now) {
                    let echo = Datagram::Echo { daemon: self.local.daemon, nonce };
                    self.send(from, echo.encode());
                }
            }
            Ok(Datagram::Echo { daemon, nonce }) => {
                if arrival == Arrival::Quic {
                    self.answered(now, from, daemon, nonce);
                }
            }
        }
    }

    fn beacon(&mut self, now: Duration, from: SocketAddr, arrival: Arrival, beacon: Beacon) {
        let daemon = beacon.daemon;
        let listed = self.lists(from.ip());
        if daemon == self.local.daemon || !self.in_range(from, arrival, beacon.localhost, listed) {
            return;
        }
        let near = arrival == Arrival::Quic || self.here.is_local(from.ip());
        self.make_room(daemon, from.ip());
        let difference = self.judge(&beacon);
        let observed = match arrival {
            Arrival::Shared => SocketAddr::new(from.ip(), beacon.port),
            // A NAT's port, if a NAT is between.
            Arrival::Quic => from,
        };
        let known = self.knows(from.ip());
        let record = self.records.entry(daemon).or_default();
        record.last_seen = now;
        record.listed |= listed;
        record.near |= near;
        if !record.linked {
            record.from = Some(from.ip());
        }
        match difference {
            None => {
                record.compatible = true;
                record.leaving = None;
                let port = beacon.port;
                let advertised = beacon.addresses.iter().map(|a| SocketAddr::new(*a, port));
                record.saw(DialAddress {
                    address: observed,
                    sae: beacon.sae,
                    advertised: advertised.collect(),
                    proven: false,
                    known,
                    answered: false,
                    asked: false,
                    leaving: None,
                });
                self.report_addresses(now, daemon);
                self.schedule_dial(now, daemon);
                self.ask_if_contested(now, daemon, observed);
            }
            Some(difference) => self.differs(now, daemon, from, difference),
        }
        if beacon.answer_wanted {
            self.answer(now, daemon, observed, known);
        }
    }

    fn foreign(&mut self, now: Duration, from: SocketAddr, arrival: Arrival, foreign: Foreign) {
        let (daemon, listed) = (foreign.daemon, self.lists(from.ip()));
        let ours = daemon == self.local.daemon || foreign.domain != self.local.domain;
        if ours || !self.in_range(from, arrival, false, listed) {
            return;
        }
        self.make_room(daemon, from.ip());
        let range = |low: u8, high: u8| format!("{low} to {high}");
        let difference = Difference {
            setting: "protocol version",
            ours: range(*PROTOCOLS.start(), *PROTOCOLS.end()),
            theirs: range(foreign.protocols.0, foreign.protocols.1),
        };
        let record = self.records.entry(daemon).or_default();
        record.last_seen = now;
        if !record.linked {
            record.from = Some(from.ip());
        }
        self.differs(now, daemon, from, difference);
    }

    /// Returns the setting that prevents a link with the beacon's sender, if any.
    fn judge(&self, beacon: &Beacon) -> Option<Difference> {
        if beacon.domain != self.local.domain {
            return Some(Difference {
                setting: "ROS_DOMAIN_ID",
                ours: self.local.domain.to_string(),
                theirs: beacon.domain.to_string(),
            });
        }
        if let Some(difference) = self.local.terms.first_difference(&beacon.terms) {
            return Some(difference);
        }
        let ((own, peers), theirs) = (self.local.sae.as_ref()?, beacon.sae.as_ref()?);
        let setting = match theirs {
            same if same == own => "AXON_SAE_ID",
            other if !peers.allows(other) => "AXON_QKD_PEERS",
            _ => return None,
        };
        let ours = if setting == "AXON_SAE_ID" { own.clone() } else { peers.to_string() };
        Some(Difference { setting, ours, theirs: theirs.clone() })
    }

    fn differs(&mut self, now: Duration, daemon: DaemonId, from: SocketAddr, what: Difference) {
        let Some(record) = self.records.get_mut(&daemon) else { return };
        if record.compatible || record.linked {
            if !std::mem::replace(&mut record.contradicted, true) {
                let Difference { setting, theirs, .. } = what;
                info!(peer = %daemon, %from, setting, theirs, "a beacon contradicts the known settings of its daemon");
            }
            return;
        }
        if record.reported || !self.reports.take(now) {
            return;
        }
        record.reported = true;
        let Difference { setting, ours, theirs } = what;
        let mismatch = PeerMismatch { peer: daemon, address: from, setting, ours, theirs };
        self.act(DiscoveryAction::Mismatch(mismatch));
    }

    fn in_range(&self, from: SocketAddr, arrival: Arrival, theirs: bool, listed: bool) -> bool {
        let ours = self.local.range == DiscoveryRange::Localhost;
        // Only a daemon that lists this host, answers it or is on it sends to this host's QUIC port.
        let near = arrival == Arrival::Quic || listed || self.here.is_local(from.ip());
        near || !(ours || theirs)
    }

    fn goodbye_from(&mut self, now: Duration, from: SocketAddr, daemon: DaemonId) {
        let Some(record) = self.records.get_mut(&daemon) else { return };
        let from = from.ip();
        if record.stays(now) || !record.sources.iter().any(|source| source.address.ip() == from) {
            return;
        }
        // If several addresses claim the id, a goodbye concerns its own address alone.
        let others = record.sources.iter().any(|source| source.address.ip() != from);
        let best = record.sources.first().is_some_and(|source| source.address.ip() == from);
        if record.linked {
            // While its path is cut, the peer is looked for, and no goodbye in its name counts.
            if !record.cut && (best || !others) {
                record.leaving = Some(now);
            }
        } else if others {
            self.leaves_host(now, daemon, from);
        } else {
            self.leaves(now, daemon);
        }
    }

    /// Probes the daemon if beacons under its id came from other addresses too.
    fn ask_if_contested(&mut self, now: Duration, daemon: DaemonId, address: SocketAddr) {
        let Some(record) = self.records.get(&daemon) else { return };
        let Some(source) = record.sources.iter().find(|source| source.address == address) else {
            return;
        };
        let contested = match record.linked {
            false => record.sources.len() > 1,
            true => record.may_be_at(source),
        };
        if contested {
            let standing = source.standing();
            self.ask_whether_there(now, daemon, standing);
        }
    }

    fn answer(&mut self, now: Duration, daemon: DaemonId, to: SocketAddr, known: bool) {
        let (Some(port), Some(record)) = (self.port, self.records.get_mut(&daemon)) else { return };
        if record.last_answered.is_some_and(|at| at + ANSWER_SPACING > now) {
            return;
        }
        let answers = if known { &mut self.known_answers } else { &mut self.answers };
        if !answers.take(now) {
            // Many daemons ask at once: one beacon to all of them instead.
            let soon = now + Duration::from_secs(1).mul_f64(self.random.random_range(0.5..1.0));
            self.next_beacon = self.next_beacon.map(|at| at.min(soon));
            return;
        }
        record.last_answered = Some(now);
        let bytes = self.own_beacon(port, false);
        self.send(to, bytes);
    }
}
