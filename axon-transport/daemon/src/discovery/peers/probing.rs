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

/// Most probes whose answer is awaited.
const MOST_ASKED: usize = 1024;
/// Most of them to one host: beacons may be forged, and it hears so many within [`ANSWER_WITHIN`].
/// Those to the [expected ports](PeerDiscovery::expects) of a known host come on top.
const MOST_ASKED_OF_A_HOST: usize = 32;
/// An address is probed at most this often, whatever daemons are said to be there.
const ASKED_AGAIN: Duration = Duration::from_millis(250);
/// So long is an answer awaited.
pub(super) const ANSWER_WITHIN: Duration = Duration::from_secs(3);

/// A probe whose answer is awaited.
#[derive(Debug)]
pub(super) struct ProbeInFlight {
    at: Duration,
    nonce: [u8; 8],
    daemon: DaemonId,
    source: DialAddress,
    /// It counts towards [`MOST_ASKED_OF_A_HOST`].
    counts: bool,
    /// Somebody answered: it is kept for [`ASKED_AGAIN`] alone.
    answered: bool,
}

/// The probes whose answers are awaited, the oldest first.
pub(super) type Probes = VecDeque<ProbeInFlight>;

impl PeerDiscovery {
    /// Asks the addresses of this standing that were not asked since their latest beacon.
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

    /// Probes an address, unless too many probes are under way or somebody answered there just now.
    /// Whether an answer is awaited from there.
    fn ask(&mut self, now: Duration, daemon: DaemonId, source: DialAddress) -> bool {
        let to = source.address;
        // The answer says which daemon is there, whichever was asked for.
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

    /// Whether a daemon of this domain usually has this port, or one is listed there with it.
    fn expects(&self, address: SocketAddr) -> bool {
        let (ip, port) = (address.ip(), address.port());
        quic_ports(self.local.domain).contains(&port) || self.listed.contains(&(ip, Some(port)))
    }

    /// The daemon said goodbye, or somebody did in its name. It is asked, and forgotten if it does not
    /// answer in time. Where too many are asked the goodbye says nothing.
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

    /// The same, where the daemon is said to be elsewhere, too: addresses of this host of which there is
    /// nothing but a beacon are asked, and forgotten if nobody answers there in time.
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

    /// An answer came: the address that was asked has a better standing, even if others were heard of
    /// since.
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
            // Another one was asked for there, and this one was heard of as well.
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
