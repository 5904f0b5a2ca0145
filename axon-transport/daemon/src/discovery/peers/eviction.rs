//! Chooses which peer records are dropped when there are too many.

use std::{cmp::Reverse, collections::BTreeMap, net::IpAddr, time::Duration};

use axon_shm::ids::DaemonId;

use super::{MOST_UNAUTHENTICATED, PeerDiscovery, record::DaemonRecord};
use crate::discovery::{AddressConfidence, DiscoveryAction};

/// Most records of daemons that are known by a beacon alone. The remaining records are for other daemons.
const MOST_HEARD: usize = 192;
/// Records reserved for daemons that are known by a beacon alone.
const LEAST_HEARD: usize = 64;
/// Most hosts that are remembered for an earlier link.
const MOST_MET: usize = 128;

/// Records that are chosen for eviction at a time.
const CHOSEN: usize = 16;

/// Records to evict for new ones. The choice looks at all records, so several are chosen at a time.
#[derive(Debug, Default)]
pub(super) struct EvictionCandidates {
    /// The chosen records, the last one is evicted first. Each with the time when its daemon was last heard.
    chosen: Vec<(DaemonId, Duration)>,
    /// True if the chosen daemons are known by beacons alone.
    heard: bool,
    /// The number of records at the time of the choice.
    records: usize,
}

/// The records of one host.
#[derive(Default)]
struct HostRecords {
    records: usize,
    /// The records that may be evicted, the oldest last.
    candidates: Vec<(Reverse<Duration>, DaemonId)>,
}

/// Returns whether a daemon is known by beacons alone.
fn is_heard(record: &DaemonRecord) -> bool {
    record.standing() == AddressConfidence::Heard
}

impl PeerDiscovery {
    /// Makes room for a record of `daemon`, if it has none. If there are too many, the oldest record of the host with
    /// most records is dropped.
    pub(super) fn make_room(&mut self, daemon: DaemonId, from: IpAddr) {
        if self.records.contains_key(&daemon) {
            return;
        }
        // Below this number there is room for each record.
        if self.records.len() < MOST_HEARD {
            return;
        }
        // In a flood the records are as full as when records were chosen for eviction.
        let known = self.knows(from);
        if !known
            && self.records.len() >= self.eviction.records
            && let Some(victim) = self.chosen_for_eviction()
        {
            return self.forget(victim);
        }
        let unlinked = || self.records.values().filter(|record| !record.linked);
        let (all, heard) = unlinked()
            .fold((0, 0), |(all, heard), record| (all + 1, heard + usize::from(is_heard(record))));
        let full = all >= MOST_UNAUTHENTICATED;
        let crowded = heard >= MOST_HEARD && !known;
        if !full && !crowded {
            return;
        }
        let heard_goes = crowded || heard > LEAST_HEARD;
        if let Some(victim) = self.next_to_evict(heard_goes) {
            self.forget(victim);
        }
    }

    /// Returns the next record to evict.
    fn next_to_evict(&mut self, heard_goes: bool) -> Option<DaemonId> {
        self.choose_to_evict(heard_goes);
        if let Some(victim) = self.chosen_for_eviction() {
            return Some(victim);
        }
        // A daemon that answered a probe is evicted last, whatever was forged under its address.
        let answered = self.records.iter().filter(|(_, record)| {
            record.may_be_forgotten() && is_heard(record) == heard_goes && record.has_answered()
        });
        answered.min_by_key(|(_, record)| record.last_seen).map(|(id, _)| *id)
    }

    /// Returns the next record that was chosen for eviction, unless its daemon was heard since.
    fn chosen_for_eviction(&mut self) -> Option<DaemonId> {
        while let Some((victim, seen)) = self.eviction.chosen.pop() {
            let still = |record: &DaemonRecord| {
                record.last_seen == seen
                    && record.may_be_forgotten()
                    && !record.has_answered()
                    && is_heard(record) == self.eviction.heard
            };
            if self.records.get(&victim).is_some_and(still) {
                return Some(victim);
            }
        }
        None
    }

    fn choose_to_evict(&mut self, heard_goes: bool) {
        let mut hosts: BTreeMap<Option<IpAddr>, HostRecords> = BTreeMap::new();
        for (id, record) in &self.records {
            let host = hosts.entry(record.host()).or_default();
            host.records += 1;
            if record.may_be_forgotten() && is_heard(record) == heard_goes && !record.has_answered()
            {
                host.candidates.push((Reverse(record.last_seen), *id));
            }
        }
        hosts.values_mut().for_each(|host| host.candidates.sort_unstable());
        let mut chosen = Vec::with_capacity(CHOSEN);
        while chosen.len() < CHOSEN {
            let most = |host: &&mut HostRecords| (host.records, host.candidates.last().copied());
            let hosts = hosts.values_mut().filter(|host| !host.candidates.is_empty());
            let Some(host) = hosts.max_by_key(most) else { break };
            host.records -= 1;
            let oldest = host.candidates.pop();
            chosen.extend(oldest.map(|(seen, id)| (id, seen.0)));
        }
        chosen.reverse();
        self.eviction =
            EvictionCandidates { chosen, heard: heard_goes, records: self.records.len() };
    }

    /// Returns whether a peer at this address is listed, or was linked there before.
    pub(super) fn knows(&self, address: IpAddr) -> bool {
        self.lists(address) || self.met.contains(&address)
    }

    /// Records that a link with a peer at this address is up.
    pub(super) fn meet(&mut self, address: IpAddr) {
        self.met.retain(|met| *met != address);
        self.met.push_back(address);
        if self.met.len() > MOST_MET {
            self.met.pop_front();
        }
    }

    pub(super) fn forget(&mut self, daemon: DaemonId) {
        if self.records.remove(&daemon).is_some() {
            self.act(DiscoveryAction::Gone { daemon });
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
