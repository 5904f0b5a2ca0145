//! Discovery's state machine (`docs/architecture.md`): decides which daemons exist and when to dial them. Its inputs
//! are datagrams and events of links; its outputs are datagrams and dials.
//!
//! Any host can send a beacon, so a beacon is only a hint. Every collection is bounded, and every answer is
//! rate-limited. No received datagram closes a link, or prevents a link to a peer that was acceptable before.

mod absent;
mod addresses;
mod announcing;
mod candidates;
mod dialling;
mod eviction;
mod local;
mod probing;
mod receiving;
mod record;
mod relocation;
#[cfg(test)]
mod tests;

use std::{
    collections::{BTreeMap, VecDeque},
    net::{IpAddr, SocketAddr},
    time::Duration,
};

use axon_shm::ids::DaemonId;
use axon_transport::config::DiscoveryRange;
use rand::{RngExt, SeedableRng, rngs::StdRng};

#[cfg(test)]
use self::dialling::MOST_IN_FLIGHT;
pub(crate) use self::local::LocalDaemon;
use self::{
    candidates::LocalAddresses,
    eviction::EvictionCandidates,
    probing::Probes,
    record::{DaemonRecord, DialAddress, ReportedAddresses},
};
use super::{AddressConfidence, DiscoveryAction, Interface};

use crate::token_bucket::TokenBucket;

/// Most records of peers that are not linked.
const MOST_UNAUTHENTICATED: usize = 256;
/// Most addresses of listed peers.
const MOST_LISTED: usize = 128;

/// The socket at which a datagram arrived.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Arrival {
    /// The shared port, by multicast or broadcast.
    Shared,
    /// This daemon's QUIC port: the sender lists this host, answers it, or is on this host.
    Quic,
}

/// An output of [`PeerDiscovery`].
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum PeersOutput {
    /// A datagram to the group, on every interface.
    Multicast(Vec<u8>),
    /// An action of the daemon.
    Action(DiscoveryAction),
}

/// The state machine of discovery.
#[derive(Debug)]
pub(crate) struct PeerDiscovery {
    local: LocalDaemon,
    here: LocalAddresses,
    records: BTreeMap<DaemonId, DaemonRecord>,
    eviction: EvictionCandidates,
    /// Addresses of listed peers, with a port where one was given.
    listed: Vec<(IpAddr, Option<u16>)>,
    port: Option<u16>,
    graph: u64,
    /// The time of the next beacon, and the number of remaining beacons of the burst.
    next_beacon: Option<Duration>,
    burst_left: usize,
    answers: TokenBucket,
    /// Answers to addresses that this host knows.
    known_answers: TokenBucket,
    echoes: TokenBucket,
    known_echoes: TokenBucket,
    /// Beacons and goodbyes that are processed, from unknown and from known hosts.
    heard: TokenBucket,
    known_heard: TokenBucket,
    probes: TokenBucket,
    known_probes: TokenBucket,
    asked: Probes,
    /// The time at which a dial became due since the dials were last checked.
    dials_due: Option<Duration>,
    /// Hosts of earlier links, the latest last.
    met: VecDeque<IpAddr>,
    reports: TokenBucket,
    random: StdRng,
    outputs: VecDeque<PeersOutput>,
}

impl PeerDiscovery {
    /// Creates discovery without records. It is silent until its [QUIC port](Self::set_port) is known.
    pub(crate) fn new(local: LocalDaemon, seed: u64) -> Self {
        let here = LocalAddresses { bind: local.bind.clone(), interfaces: Vec::new() };
        Self {
            local,
            here,
            records: BTreeMap::new(),
            eviction: EvictionCandidates::default(),
            listed: Vec::new(),
            port: None,
            graph: 0,
            next_beacon: None,
            burst_left: 0,
            answers: TokenBucket::new(64, 64),
            known_answers: TokenBucket::new(64, 64),
            echoes: TokenBucket::new(1024, 1024),
            known_echoes: TokenBucket::new(1024, 1024),
            heard: TokenBucket::new(1024, 1024),
            known_heard: TokenBucket::new(1024, 1024),
            probes: TokenBucket::new(1024, 1024),
            known_probes: TokenBucket::new(1024, 1024),
            asked: Probes::new(),
            dials_due: None,
            met: VecDeque::new(),
            reports: TokenBucket::new(32, 1),
            random: StdRng::seed_from_u64(seed),
            outputs: VecDeque::new(),
        }
    }

    /// Returns the next output, or `None` if there is none.
    pub(crate) fn poll_output(&mut self) -> Option<PeersOutput> {
        // Dials are decided once for all datagrams that arrived together.
        if let Some(now) = self.dials_due.take() {
            self.dial_due(now);
        }
        self.outputs.pop_front()
    }

    /// Returns the latest time for the next call of [`handle_timeout`](Self::handle_timeout).
    pub(crate) fn poll_timeout(&self) -> Option<Duration> {
        let in_flight = self.dials_in_flight();
        let lifetime = self.lifetime();
        let of_records = self.records.values().flat_map(|record| {
            let dials = AddressConfidence::ALL.into_iter().flat_map(|standing| {
                let dial = &record.dials[standing as usize];
                let host = record.to_dial(standing).next().map(|source| source.address.ip());
                let may_dial =
                    self.wants_dial(record, standing) && in_flight.has_room(standing, host);
                [dial.due.filter(|_| may_dial), dial.in_flight]
            });
            let expiry = record.may_be_forgotten().then(|| record.gone_at(lifetime));
            let report = record.reported_addresses.due;
            dials.chain([expiry, report]).flatten().min()
        });
        of_records.chain(self.next_beacon).min()
    }

    /// Does the work that is due at `now`.
    pub(crate) fn handle_timeout(&mut self, now: Duration) {
        self.give_up_lost_dials(now);
        self.forget_silent(now);
        self.forget_unanswered(now);
        self.report_due_addresses(now);
        self.dial_due(now);
        if self.next_beacon.is_some_and(|at| at <= now) {
            let first = self.burst_left > 0;
            if self.announces() {
                self.send_beacon(first);
                self.schedule_beacon(now);
            } else {
                self.next_beacon = None;
            }
        }
    }

    /// Sets the port to which the QUIC socket is bound.
    pub(crate) fn set_port(&mut self, now: Duration, port: u16) {
        if self.port.replace(port) != Some(port) {
            self.start_burst(now);
        }
    }

    /// Sets this daemon's discovery range. Existing links stay: the range is checked for each pair of endpoints.
    pub(crate) fn set_range(&mut self, now: Duration, range: DiscoveryRange) {
        let before = std::mem::replace(&mut self.local.range, range);
        if range > before {
            self.start_burst(now);
        }
        if range == DiscoveryRange::Off {
            self.next_beacon = None;
        }
        if range < before {
            // Peers that still want this daemon send to its QUIC port.
            let unlinked = self.records.iter_mut().filter(|(_, record)| !record.linked);
            let far: Vec<DaemonId> = unlinked
                .filter(|(_, record)| range == DiscoveryRange::Off || !record.listed)
                .map(|(id, _)| *id)
                .collect();
            far.into_iter().for_each(|daemon| self.forget(daemon));
            self.records.values_mut().for_each(|record| record.near = record.listed);
        } else {
            self.dial_all(now);
        }
    }

    fn dial_all(&mut self, now: Duration) {
        let ids: Vec<DaemonId> = self.records.keys().copied().collect();
        ids.into_iter().for_each(|id| self.schedule_dial(now, id));
    }

    /// Sets the interfaces of this host, as the latest check found them.
    pub(crate) fn set_interfaces(&mut self, now: Duration, interfaces: Vec<Interface>) {
        if self.here.interfaces == interfaces {
            return;
        }
        self.here.interfaces = interfaces;
        let dials = self.records.values_mut().flat_map(|record| &mut record.dials);
        dials.for_each(record::DialTime::reset);
        self.dial_all(now);
        if self.port.is_some() {
            self.start_burst(now);
        }
    }

    /// Sets the addresses of listed peers, with names resolved.
    pub(crate) fn set_listed(&mut self, now: Duration, mut listed: Vec<(IpAddr, Option<u16>)>) {
        listed.truncate(MOST_LISTED);
        let new = listed.iter().any(|peer| !self.listed.contains(peer));
        self.listed = listed;
        let listed: Vec<IpAddr> = self.listed.iter().map(|(address, _)| *address).collect();
        for record in self.records.values_mut() {
            let lists = |source: &DialAddress| listed.contains(&source.address.ip());
            record.listed = record.sources.iter().any(lists);
            for source in &mut record.sources {
                let address = source.address.ip();
                source.known = listed.contains(&address) || self.met.contains(&address);
            }
            record.order();
        }
        if new && self.port.is_some() {
            self.start_burst(now);
        }
    }

    /// Sets the digest of this daemon's graph for the next beacons.
    pub(crate) fn set_graph(&mut self, digest: u64) {
        self.graph = digest;
    }

    /// Handles a new link with `daemon`, which either side dialled. `proven`: the daemon proved that the id is its own.
    /// If it did not, another host may have the id, and that host is dialled too.
    pub(crate) fn handle_link_up(
        &mut self,
        now: Duration,
        daemon: DaemonId,
        address: SocketAddr,
        proven: bool,
    ) {
        let listed = self.lists(address.ip().to_canonical());
        let address = SocketAddr::new(address.ip().to_canonical(), address.port());
        self.meet(address.ip());
        self.handle_found(daemon, address);
        let record = self.records.entry(daemon).or_default();
        record.listed |= listed;
        record.linked = true;
        record.linked_at = now;
        record.cut = false;
        record.leaving = None;
        record.last_seen = record.last_seen.max(now);
        record.from = Some(address.ip());
        record.done();
        record.proved(address);
        record.found(address, proven);
        record.reported_addresses = ReportedAddresses::default();
        self.report_addresses(now, daemon);
        self.schedule_dial(now, daemon);
        self.dial_due(now);
    }

    /// Handles the end of the link with `daemon`.
    pub(crate) fn handle_link_down(&mut self, now: Duration, daemon: DaemonId) {
        let Some(record) = self.records.get_mut(&daemon) else { return };
        (record.linked, record.cut) = (false, false);
        record.unproven = None;
        record.done();
        self.forget_taken(daemon);
        let Some(record) = self.records.get_mut(&daemon) else { return };
        let left = record.left(now);
        // A peer that dialled this host and whose beacons never arrived cannot be dialled.
        if !record.compatible {
            self.forget(daemon);
        } else if left {
            self.leaves(now, daemon);
        } else {
            record.last_seen = record.last_seen.max(now);
            self.schedule_dial(now, daemon);
        }
    }

    /// Handles a failed dial to addresses of this standing.
    pub(crate) fn handle_dial_failed(
        &mut self,
        now: Duration,
        daemon: DaemonId,
        standing: AddressConfidence,
    ) {
        let jitter = self.random.random_range(0.5..1.5);
        let record = self.records.get_mut(&daemon);
        let under_way =
            |record: &&mut DaemonRecord| record.dials[standing as usize].in_flight.is_some();
        if let Some(record) = record.filter(under_way) {
            record.failed(standing, now, jitter);
            if record.may_be_forgotten() && record.left(now) {
                self.leaves(now, daemon);
            } else {
                self.schedule_dial(now, daemon);
            }
        }
        self.dial_due(now);
    }

    /// Returns whether a dial makes sense now and the range permits this daemon to look for the peer.
    fn wants_dial(&self, record: &DaemonRecord, standing: AddressConfidence) -> bool {
        let in_range = match self.local.range {
            DiscoveryRange::Off => false,
            DiscoveryRange::Localhost => record.near || record.listed,
            DiscoveryRange::Subnet => true,
        };
        in_range && record.wants_dial(standing)
    }

    fn lists(&self, address: IpAddr) -> bool {
        self.listed.iter().any(|(listed, _)| *listed == address)
    }

    fn send(&mut self, to: SocketAddr, bytes: Vec<u8>) {
        self.act(DiscoveryAction::SendFromQuicPort { to, bytes });
    }

    fn act(&mut self, action: DiscoveryAction) {
        self.outputs.push_back(PeersOutput::Action(action));
    }
}
