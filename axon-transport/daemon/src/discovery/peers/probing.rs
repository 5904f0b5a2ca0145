//! Probes an address to verify that the daemon named in a beacon is there.
//!
//! A beacon's source address can be forged. An answer from a forged address cannot be obtained. A probe costs one
//! short datagram; a dial to an address without a daemon occupies one of eight dials for seconds.

use std::{
    collections::VecDeque,
    net::{IpAddr, SocketAddr},
    time::Duration,
};

use axon_shm::ids::DaemonId;
use rand::RngExt;

use super::{PeerDiscovery, record::DialAddress};
use crate::{
    discovery::{AddressConfidence, quic_ports},
    wire::beacon::Datagram,
};

/// Most probes in flight.
const MOST_ASKED: usize = 1024;
/// Most probes in flight to one host: beacons may be forged, and this is the most that one host receives within
/// [`ANSWER_WITHIN`]. Probes to the [expected ports](PeerDiscovery::expects) of a known host are not counted.
const MOST_ASKED_OF_A_HOST: usize = 32;
/// Minimum time between probes of one address, whatever daemons beacons claim there.
const ASKED_AGAIN: Duration = Duration::from_millis(250);
/// Timeout of a probe.
pub(super) const ANSWER_WITHIN: Duration = Duration::from_secs(3);

/// A probe in flight.
#[derive(Debug)]
pub(super) struct ProbeInFlight {
    at: Duration,
    nonce: [u8; 8],
    daemon: DaemonId,
    source: DialAddress,
    /// True if it counts towards [`MOST_ASKED_OF_A_HOST`].
    counts: bool,
    /// The peer answered. The entry only enforces [`ASKED_AGAIN`].
    answered: bool,
}

/// The probes in flight, the oldest first.
pub(super) type Probes = VecDeque<ProbeInFlight>;

impl PeerDiscovery {
    /// Probes the addresses of this standing that were not probed since their latest beacon.
    pub(super) fn ask_whether_there(
        &mut self,
        now: Duration,
        daemon: DaemonId,
        standing: AddressConfidence,
    ) {
        let Some(record) = self.records.get_mut(&daemon) else { return };
        let may_ask = |source: &DialAddress| !source.asked && !source.answered && !source.proven;
        let mut asked = Vec::new();
        for source in &mut record.sources {
            if source.standing() == standing && may_ask(source) {
                source.asked = true;
                asked.push(source.clone());
            }
        }
        for source in asked {
            let address = source.address;
            if !self.ask(now, daemon, source) {
                let sources = self.records.get_mut(&daemon).map(|record| &mut record.sources);
                let unasked = sources.into_iter().flatten().find(|s| s.address == address);
                unasked.into_iter().for_each(|source| source.asked = false);
            }
        }
    }

    /// Probes an address, unless too many probes are in flight or a peer answered there just now. Returns whether an
    /// answer from there is pending.
    fn ask(&mut self, now: Duration, daemon: DaemonId, source: DialAddress) -> bool {
        let to = source.address;
        // The answer names the daemon at the address, whichever daemon was asked for.
        let mut recent = self.asked.iter().rev().take_while(|asked| asked.at + ASKED_AGAIN > now);
        if let Some(recent) = recent.find(|asked| asked.source.address == to) {
            return !recent.answered;
        }
        let counts = !(source.known && self.expects(to));
        let of_host = |asked: &&ProbeInFlight| {
            asked.counts && !asked.answered && asked.source.address.ip() == to.ip()
        };
        if counts && self.asked.iter().filter(of_host).count() >= MOST_ASKED_OF_A_HOST {
            return false;
        }
        let bucket = if source.known { &mut self.known_probes } else { &mut self.probes };
        if !bucket.take(now) {
            return false;
        }
        let nonce = self.random.random();
        if self.asked.len() >= MOST_ASKED {
            self.asked.pop_front();
        }
        self.asked.push_back(ProbeInFlight {
            at: now,
            nonce,
            daemon,
            source,
            counts,
            answered: false,
        });
        self.send(to, Datagram::Probe { daemon: self.local.daemon, nonce }.encode());
        true
    }

    /// Returns whether daemons of this domain usually have this port, or a peer is listed there with it.
    fn expects(&self, address: SocketAddr) -> bool {
        let (ip, port) = (address.ip(), address.port());
        quic_ports(self.local.domain).contains(&port) || self.listed.contains(&(ip, Some(port)))
    }

    /// Handles a goodbye in the daemon's name, which another host may have sent. Probes the daemon, which is forgotten
    /// if it does not answer in time. If the probe is not sent, the goodbye is ignored and a dial is scheduled.
    pub(super) fn leaves(&mut self, now: Duration, daemon: DaemonId) {
        let Some(record) = self.records.get(&daemon) else { return };
        let Some(best) = record.sources.first() else { return self.forget(daemon) };
        if record.stays(now) || record.leaving.is_some() {
            return;
        }
        let best = best.clone();
        if self.ask(now, daemon, best) {
            let record = self.records.get_mut(&daemon);
            record.into_iter().for_each(|record| record.leaving = Some(now));
        } else {
            self.schedule_dial(now, daemon);
        }
    }

    /// Like [`leaves`](Self::leaves), for a goodbye from `host` under an id that other addresses claim too. Probes the
    /// addresses of `host` that are known by beacons alone. An address is forgotten if no daemon answers there in time.
    pub(super) fn leaves_host(&mut self, now: Duration, daemon: DaemonId, host: IpAddr) {
        let Some(record) = self.records.get(&daemon) else { return };
        let heard =
            record.of(AddressConfidence::Heard).filter(|source| source.address.ip() == host);
        for source in heard.cloned().collect::<Vec<_>>() {
            let address = source.address;
            if source.leaving.is_none() && self.ask(now, daemon, source) {
                let sources = self.records.get_mut(&daemon).map(|record| &mut record.sources);
                let asked = sources.into_iter().flatten().find(|s| s.address == address);
                asked.into_iter().for_each(|source| source.leaving = Some(now));
            }
        }
    }

    /// Handles an answer: the probed address gets a better standing, even if the peer was heard at others since.
    pub(super) fn answered(
        &mut self,
        now: Duration,
        from: SocketAddr,
        daemon: DaemonId,
        nonce: [u8; 8],
    ) {
        let awaited = |asked: &&mut ProbeInFlight| {
            !asked.answered && asked.nonce == nonce && asked.source.address == from
        };
        let Some(asked) = self.asked.iter_mut().find(awaited) else { return };
        asked.answered = true;
        let Some(record) = self.records.get_mut(&daemon).filter(|record| record.compatible) else {
            return;
        };
        let source = match asked.daemon == daemon {
            true => Some(asked.source.clone()),
            // The probe asked for another daemon, and beacons named this one there as well.
            false => record.sources.iter().find(|source| source.address == from).cloned(),
        };
        let Some(source) = source else { return };
        record.saw(DialAddress { answered: true, leaving: None, ..source });
        if !record.linked && record.leaving.take().is_some() {
            record.stayed = Some(now);
        }
        self.schedule_dial(now, daemon);
    }

    pub(super) fn forget_unanswered(&mut self, now: Duration) {
        while self.asked.front().is_some_and(|asked| asked.at + ANSWER_WITHIN <= now) {
            self.asked.pop_front();
        }
        for record in self.records.values_mut() {
            record.forget_unanswered(now);
        }
        if self.asked.is_empty() {
            self.asked.shrink_to_fit();
        }
    }
}
