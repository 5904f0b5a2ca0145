//! Decides which peers are dialled, and when.

use std::{net::IpAddr, time::Duration};

use axon_shm::ids::DaemonId;
use rand::RngExt;

use super::{PeerDiscovery, record::DaemonRecord};
use crate::discovery::{AddressConfidence, DiscoveryAction};

/// Most dials at once.
pub(super) const MOST_IN_FLIGHT: usize = 8;
/// Most dials at once to addresses of this standing and of worse ones together. The remaining dials are reserved for
/// better standings.
const MOST_DOWN_FROM: [usize; AddressConfidence::COUNT] = [MOST_IN_FLIGHT, 7, 6, 5, 3];
/// Most dials at once of one standing to one host.
const MOST_OF_A_HOST: usize = 2;
/// Head start of the side that is to dial first.
const SECOND_DIAL: Duration = Duration::from_millis(300);

/// The dials in flight.
pub(super) struct InFlight(Vec<(AddressConfidence, Option<IpAddr>)>);

impl InFlight {
    /// Returns whether one more dial of this standing to this host is within the limits.
    pub(super) fn has_room(&self, standing: AddressConfidence, host: Option<IpAddr>) -> bool {
        let down_from = |best: usize| self.0.iter().filter(|(s, _)| *s as usize >= best).count();
        let within = (0..=standing as usize).all(|best| down_from(best) < MOST_DOWN_FROM[best]);
        within && self.of_host(standing, host) < MOST_OF_A_HOST
    }

    fn of_host(&self, standing: AddressConfidence, host: Option<IpAddr>) -> usize {
        self.0.iter().filter(|other| **other == (standing, host)).count()
    }
}

impl PeerDiscovery {
    pub(super) fn give_up_lost_dials(&mut self, now: Duration) {
        let lost = self.records.iter().flat_map(|(id, record)| {
            let lost = record.in_flight().filter(|(_, d)| d.in_flight.is_some_and(|at| at <= now));
            lost.map(|(standing, _)| (*id, standing))
        });
        for (daemon, standing) in lost.collect::<Vec<_>>() {
            self.handle_dial_failed(now, daemon, standing);
        }
    }

    #[cfg(test)]
    pub(super) fn in_flight(&self) -> usize {
        self.records.values().map(|record| record.in_flight().count()).sum()
    }

    pub(super) fn dials_in_flight(&self) -> InFlight {
        let dials = self.records.values().flat_map(DaemonRecord::in_flight);
        InFlight(dials.map(|(standing, dial)| (standing, dial.first.map(|a| a.ip()))).collect())
    }

    pub(super) fn schedule_dial(&mut self, now: Duration, daemon: DaemonId) {
        let mut due = false;
        for standing in AddressConfidence::ALL {
            let Some(record) = self.records.get(&daemon) else { return };
            if !self.wants_dial(record, standing) {
                continue;
            }
            let Some(source) = record.to_dial(standing).next() else { continue };
            let ours = (self.local.sae.as_ref().map(|(own, _)| own), self.local.daemon);
            let listed = record.listed && self.lists(source.address.ip());
            let first = listed || ours < (source.sae.as_ref(), daemon);
            let at = if first { now } else { now + SECOND_DIAL };
            let Some(record) = self.records.get_mut(&daemon) else { return };
            record.schedule(standing, at);
            due |= record.dials[standing as usize].due.is_some_and(|due| due <= now);
        }
        if due {
            self.dials_due = Some(now);
        }
    }

    /// Dials the peers whose dial is due: the best standing first. Within one standing, peers whose host has the fewest
    /// dials in flight come first. A peer that has to wait is probed; an answer gives it a better standing.
    pub(super) fn dial_due(&mut self, now: Duration) {
        let mut in_flight = self.dials_in_flight();
        let mut due = Vec::new();
        for (id, record) in &self.records {
            for standing in AddressConfidence::ALL {
                let dial = &record.dials[standing as usize];
                let Some(at) = dial.due.filter(|at| *at <= now) else { continue };
                if self.wants_dial(record, standing) {
                    let host = record.to_dial(standing).next().map(|source| source.address.ip());
                    due.push((standing, in_flight.of_host(standing, host), at, *id, host));
                }
            }
        }
        due.sort_unstable();
        for (standing, _, _, daemon, host) in due {
            // A better address of the peer may be the same, and its dial may have started by now.
            let wants = self.records.get(&daemon).is_some_and(|r| self.wants_dial(r, standing));
            if !wants {
                continue;
            }
            if !in_flight.has_room(standing, host) {
                self.ask_whether_there(now, daemon, standing);
            } else if self.dial(now, daemon, standing) {
                in_flight.0.push((standing, host));
            }
        }
    }

    /// Starts a dial. Returns whether it is in flight now.
    fn dial(&mut self, now: Duration, daemon: DaemonId, standing: AddressConfidence) -> bool {
        let jitter = self.random.random_range(0.5..1.5);
        let Some(record) = self.records.get_mut(&daemon) else { return false };
        let listed = record.listed && standing <= AddressConfidence::Known;
        let Some(first) = record.to_dial(standing).next() else { return false };
        let (sae, advertised) = (first.sae.clone(), first.advertised.clone());
        let same = record.to_dial(standing).filter(|source| source.sae == sae);
        let sources: Vec<_> = same.map(|source| source.address).collect();
        let addrs = self.here.candidates(&sources, &advertised, listed);
        record.dials[standing as usize].start(now, sources.first().copied());
        if addrs.is_empty() {
            record.failed(standing, now, jitter);
            return false;
        }
        self.act(DiscoveryAction::Dial { daemon, sae, addrs, listed, standing });
        true
    }
}
