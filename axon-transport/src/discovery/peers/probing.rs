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
/// So long is an answer awaited.
const ANSWER_WITHIN: Duration = Duration::from_secs(3);

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
                let bucket = if source.known { &mut self.known_probes } else { &mut self.probes };
                if !bucket.take(now) {
                    break;
                }
                source.asked = true;
                asked.push(source.clone());
            }
        }
        for source in asked {
            let nonce = self.random.random();
            let to = source.address;
            if self.asked.len() >= MOST_ASKED {
                self.asked.pop_front();
            }
            self.asked.push_back(Asked { at: now, nonce, daemon, source });
            self.send(to, Datagram::Probe { daemon: self.local.daemon, nonce }.encode());
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
