//! Chooses which peer records are dropped when there are too many.

use std::{collections::BTreeMap, net::IpAddr, time::Duration};

use axon_shm::ids::DaemonId;

use super::{MOST_UNAUTHENTICATED, Peers, record::Record};
use crate::discovery::{Action, AddressConfidence};

/// Most records of daemons that are known by a beacon alone. The remaining records are for other daemons.
const MOST_HEARD: usize = 192;
/// Records reserved for daemons that are known by a beacon alone.
const LEAST_HEARD: usize = 64;
/// Most hosts that are remembered for an earlier link.
const MOST_MET: usize = 128;

impl Peers {
    /// Makes room for a record of `daemon`, if it has none. If there are too many, the oldest record of the host with
    /// most records is dropped.
    pub(super) fn make_room(&mut self, daemon: DaemonId, from: IpAddr) {
        if self.records.contains_key(&daemon) {
            return;
        }
        let unlinked = || self.records.values().filter(|record| !record.linked);
        let of_heard = |record: &Record| record.standing() == AddressConfidence::Heard;
        let (all, heard) = (unlinked().count(), unlinked().filter(|r| of_heard(r)).count());
        let full = all >= MOST_UNAUTHENTICATED;
        let crowded = heard >= MOST_HEARD && !self.knows(from);
        if !full && !crowded {
            return;
        }
        let heard_goes = crowded || heard > LEAST_HEARD;
        let mut of_host: BTreeMap<Option<IpAddr>, usize> = BTreeMap::new();
        for record in self.records.values() {
            *of_host.entry(record.host()).or_default() += 1;
        }
        let candidates = self.records.iter().filter(|(_, record)| record.may_be_forgotten());
        let candidates = candidates.filter(|(_, record)| of_heard(record) == heard_goes);
        let victim = candidates.min_by_key(|(_, record)| {
            let records = of_host.get(&record.host()).copied().unwrap_or_default();
            // One whose peer was heard from goes last, whatever was forged under its address.
            (record.has_answered(), std::cmp::Reverse(records), record.last_seen)
        });
        if let Some(victim) = victim.map(|(id, _)| *id) {
            self.forget(victim);
        }
    }

    /// Whether a peer at this address is listed, or one stood linked there.
    pub(super) fn knows(&self, address: IpAddr) -> bool {
        self.lists(address) || self.met.contains(&address)
    }

    /// A link stands with somebody there.
    pub(super) fn meet(&mut self, address: IpAddr) {
        self.met.retain(|met| *met != address);
        self.met.push_back(address);
        if self.met.len() > MOST_MET {
            self.met.pop_front();
        }
    }

    pub(super) fn forget(&mut self, daemon: DaemonId) {
        if self.records.remove(&daemon).is_some() {
            self.act(Action::Gone { daemon });
        }
    }

    pub(super) fn forget_silent(&mut self, now: Duration) {
        let lifetime = self.lifetime();
        let silent: Vec<DaemonId> = self
            .records
            .iter()
            .filter(|(_, record)| record.may_be_forgotten() && record.gone_at(lifetime) <= now)
            .map(|(id, _)| *id)
            .collect();
        for id in silent {
            self.forget(id);
        }
    }
}
