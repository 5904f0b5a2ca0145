//! Asking addresses whether the daemon that beacons put there answers.
//!
//! A beacon's source address can be forged, an answer from there cannot be had. A probe costs one
//! short datagram, a dial to an address where nobody is costs one of eight places for seconds.

use std::{collections::VecDeque, net::SocketAddr, time::Duration};

use rand::RngExt;

use super::{Peers, record::Source};
use crate::{
    discovery::{Standing, beacon::Datagram},
    ids::DaemonId,
};

/// Most probes whose answer is awaited.
const MOST_ASKED: usize = 1024;
/// Most of them to one host of which nothing is known but beacons, which may be forged: it hears so
/// many within [`ANSWER_WITHIN`].
const MOST_ASKED_OF_A_STRANGER: usize = 32;
/// So long is an answer awaited.
pub(super) const ANSWER_WITHIN: Duration = Duration::from_secs(3);

/// A probe whose answer is awaited.
#[derive(Debug)]
pub(super) struct Asked {
    at: Duration,
    nonce: [u8; 8],
    daemon: DaemonId,
    source: Source,
}

/// The probes whose answers are awaited, the oldest first.
pub(super) type Probes = VecDeque<Asked>;

impl Peers {
    /// Asks the addresses of this standing that were not asked since their latest beacon.
    pub(super) fn ask_whether_there(
        &mut self,
        now: Duration,
        daemon: DaemonId,
        standing: Standing,
    ) {
        let Some(record) = self.records.get_mut(&daemon) else { return };
        let may_ask = |source: &Source| !source.asked && !source.answered && !source.proven;
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

    /// Probes an address, unless too many are under way.
    fn ask(&mut self, now: Duration, daemon: DaemonId, source: Source) -> bool {
        let to = source.address;
        let of_host = || self.asked.iter().filter(|asked| asked.source.address.ip() == to.ip());
        if !source.known && of_host().count() >= MOST_ASKED_OF_A_STRANGER {
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
        self.asked.push_back(Asked { at: now, nonce, daemon, source });
        self.send(to, Datagram::Probe { daemon: self.local.daemon, nonce }.encode());
        true
    }

    /// The daemon said goodbye, or somebody did in its name. It is asked, and forgotten if it does not
    /// answer in time. Where too many are asked, one of which there was nothing but a beacon is
    /// forgotten at once.
    pub(super) fn leaves(&mut self, now: Duration, daemon: DaemonId) {
        let Some(record) = self.records.get(&daemon) else { return };
        let Some(best) = record.sources.first() else { return self.forget(daemon) };
        if record.stays(now) || record.leaving.is_some() {
            return;
        }
        let best = best.clone();
        let heard = best.standing() == Standing::Heard;
        if self.ask(now, daemon, best) {
            let record = self.records.get_mut(&daemon);
            record.into_iter().for_each(|record| record.leaving = Some(now));
        } else if heard {
            self.forget(daemon);
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
        let awaited =
            |a: &Asked| a.nonce == nonce && a.daemon == daemon && a.source.address == from;
        let Some(at) = self.asked.iter().position(awaited) else { return };
        let Some(Asked { mut source, .. }) = self.asked.remove(at) else { return };
        source.answered = true;
        let Some(record) = self.records.get_mut(&daemon).filter(|record| record.compatible) else {
            return;
        };
        record.saw(source);
        if !record.linked && record.leaving.take().is_some() {
            record.stayed = Some(now);
        }
        self.schedule_dial(now, daemon);
    }

    pub(super) fn forget_unanswered(&mut self, now: Duration) {
        while self.asked.front().is_some_and(|asked| asked.at + ANSWER_WITHIN <= now) {
            self.asked.pop_front();
        }
        if self.asked.is_empty() {
            self.asked.shrink_to_fit();
        }
    }
}
