//! Who is there and whom to dial: datagrams, events and time in, datagrams and dials out.
//!
//! Nothing here does I/O or looks at a clock. `now` is any clock that does not go back. A beacon is
//! a hint from anybody, so every collection is bounded, every answer rationed, and nothing that
//! arrives here closes a link or keeps one from being made to a peer that was acceptable before.

mod announcing;
mod bucket;
mod candidates;
mod dialling;
mod local;
mod receiving;
mod record;
#[cfg(test)]
mod simulation;
#[cfg(test)]
mod tests;

use std::{
    collections::{BTreeMap, VecDeque},
    net::{IpAddr, SocketAddr},
    time::Duration,
};

use rand::{RngExt, SeedableRng, rngs::StdRng};

pub use self::local::Local;
use self::{bucket::Bucket, candidates::Here, dialling::MOST_IN_FLIGHT, record::Record};
use super::{Action, Interface};
use crate::{config::DiscoveryRange, ids::DaemonId};

/// Most records of peers that are not linked.
const MOST_UNAUTHENTICATED: usize = 256;
/// Most addresses of listed peers.
const MOST_LISTED: usize = 128;

/// How a datagram came.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Arrival {
    /// To the shared port, by multicast or broadcast.
    Shared,
    /// To our QUIC port alone: the sender lists us, answers us, or is on this host.
    Quic,
}

/// What [`Peers`] wants done.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Output {
    /// To the group, on every interface.
    Multicast(Vec<u8>),
    /// For the daemon.
    Action(Action),
}

/// The state machine of discovery.
#[derive(Debug)]
pub struct Peers {
    local: Local,
    here: Here,
    records: BTreeMap<DaemonId, Record>,
    /// Addresses of listed peers, with a port where one was given.
    listed: Vec<(IpAddr, Option<u16>)>,
    port: Option<u16>,
    graph: u64,
    /// When the next beacon goes, and how many of the burst are still to go.
    next_beacon: Option<Duration>,
    burst_left: usize,
    answers: Bucket,
    reports: Bucket,
    random: StdRng,
    outputs: VecDeque<Output>,
}

impl Peers {
    /// A daemon that knows nobody. It is silent until its [QUIC port](Self::set_port) is known.
    pub fn new(local: Local, seed: u64) -> Self {
        let here = Here { bind: local.bind.clone(), interfaces: Vec::new() };
        Self {
            local,
            here,
            records: BTreeMap::new(),
            listed: Vec::new(),
            port: None,
            graph: 0,
            next_beacon: None,
            burst_left: 0,
            answers: Bucket::new(64, 64),
            reports: Bucket::new(32, 1),
            random: StdRng::seed_from_u64(seed),
            outputs: VecDeque::new(),
        }
    }

    /// The next thing to do; ask until it says `None`.
    pub fn poll(&mut self) -> Option<Output> {
        self.outputs.pop_front()
    }

    /// When [`advance`](Self::advance) is to be called at the latest.
    pub fn next_wakeup(&self) -> Option<Duration> {
        let may_dial = self.in_flight() < MOST_IN_FLIGHT;
        let lifetime = self.lifetime();
        let of_records = self.records.values().flat_map(|record| {
            let due = record.dial.due.filter(|_| may_dial && self.wants_dial(record));
            let expiry = record.may_be_forgotten().then(|| record.last_seen + lifetime);
            [due, record.dial.in_flight, expiry].into_iter().flatten()
        });
        of_records.chain(self.next_beacon).min()
    }

    /// Does what is due at `now`.
    pub fn advance(&mut self, now: Duration) {
        self.give_up_lost_dials(now);
        self.forget_silent(now);
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

    /// The QUIC port is bound.
    pub fn set_port(&mut self, now: Duration, port: u16) {
        if self.port.replace(port) != Some(port) {
            self.start_burst(now);
        }
    }

    /// How far this daemon looks from now on. Links that stand are left alone: what goes over them is
    /// decided for each pair.
    pub fn set_range(&mut self, now: Duration, range: DiscoveryRange) {
        let before = std::mem::replace(&mut self.local.range, range);
        if range > before {
            self.start_burst(now);
        }
        if range == DiscoveryRange::Off {
            self.next_beacon = None;
        }
        if range < before {
            // Those who still want this daemon say so to its QUIC port.
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

    /// The interfaces of this host, whenever they were looked at.
    pub fn set_interfaces(&mut self, now: Duration, interfaces: Vec<Interface>) {
        if self.here.interfaces == interfaces {
            return;
        }
        self.here.interfaces = interfaces;
        self.records.values_mut().for_each(|record| record.dial.reset());
        self.dial_all(now);
        if self.port.is_some() {
            self.start_burst(now);
        }
    }

    /// The addresses of listed peers, names resolved.
    pub fn set_listed(&mut self, now: Duration, mut listed: Vec<(IpAddr, Option<u16>)>) {
        listed.truncate(MOST_LISTED);
        let new = listed.iter().any(|peer| !self.listed.contains(peer));
        self.listed = listed;
        let listed: Vec<IpAddr> = self.listed.iter().map(|(address, _)| *address).collect();
        for record in self.records.values_mut() {
            record.listed = record.sources.iter().any(|source| listed.contains(&source.ip()));
        }
        if new && self.port.is_some() {
            self.start_burst(now);
        }
    }

    /// The digest of this daemon's graph, for the beacons to come.
    pub fn set_graph(&mut self, digest: u64) {
        self.graph = digest;
    }

    /// A link with `daemon` stands, whoever dialled it.
    pub fn link_up(&mut self, now: Duration, daemon: DaemonId, address: SocketAddr) {
        let listed = self.lists(address.ip().to_canonical());
        let record = self.records.entry(daemon).or_default();
        record.listed |= listed;
        record.linked = true;
        record.leaving = None;
        record.last_seen = record.last_seen.max(now);
        record.dial.done();
        self.dial_due(now);
    }

    /// The link with `daemon` is no more.
    pub fn link_down(&mut self, now: Duration, daemon: DaemonId) {
        let Some(record) = self.records.get_mut(&daemon) else { return };
        record.linked = false;
        record.dial.done();
        let left = record.left(now);
        // One that dialled us and whose beacons never came cannot be dialled.
        if left || !record.compatible {
            self.forget(daemon);
        } else {
            record.last_seen = record.last_seen.max(now);
            self.schedule_dial(now, daemon);
        }
    }

    /// A dial did not become a link.
    pub fn dial_failed(&mut self, now: Duration, daemon: DaemonId) {
        let jitter = self.random.random_range(0.5..1.5);
        let record = self.records.get_mut(&daemon);
        if let Some(record) = record.filter(|record| record.dial.in_flight.is_some()) {
            record.dial.failed(now, jitter);
            if record.left(now) {
                self.forget(daemon);
            }
        }
        self.dial_due(now);
    }

    /// Makes room for a record of `daemon`, if it has none.
    fn make_room(&mut self, daemon: DaemonId) {
        let unauthenticated = self.records.values().filter(|record| !record.linked).count();
        if self.records.contains_key(&daemon) || unauthenticated < MOST_UNAUTHENTICATED {
            return;
        }
        let oldest = self
            .records
            .iter()
            .filter(|(_, record)| record.may_be_forgotten())
            .min_by_key(|(_, record)| (record.listed, record.last_seen))
            .map(|(id, _)| *id);
        if let Some(oldest) = oldest {
            self.forget(oldest);
        }
    }

    fn forget(&mut self, daemon: DaemonId) {
        if self.records.remove(&daemon).is_some() {
            self.act(Action::Gone { daemon });
        }
    }

    fn forget_silent(&mut self, now: Duration) {
        let lifetime = self.lifetime();
        let silent: Vec<DaemonId> = self
            .records
            .iter()
            .filter(|(_, record)| record.may_be_forgotten() && record.last_seen + lifetime <= now)
            .map(|(id, _)| *id)
            .collect();
        for id in silent {
            self.forget(id);
        }
    }

    /// Whether a dial would make sense, and the range lets this daemon look for the peer.
    fn wants_dial(&self, record: &Record) -> bool {
        let in_range = match self.local.range {
            DiscoveryRange::Off => false,
            DiscoveryRange::Localhost => record.near || record.listed,
            DiscoveryRange::Subnet => true,
        };
        in_range && record.wants_dial()
    }

    fn lists(&self, address: IpAddr) -> bool {
        self.listed.iter().any(|(listed, _)| *listed == address)
    }

    fn send(&mut self, to: SocketAddr, bytes: Vec<u8>) {
        self.act(Action::SendFromQuicPort { to, bytes });
    }

    fn act(&mut self, action: Action) {
        self.outputs.push_back(Output::Action(action));
    }
}
