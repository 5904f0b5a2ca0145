//! Whom to dial, and when.

use std::time::Duration;

use rand::RngExt;

use super::{Peers, record::Record};
use crate::{discovery::Action, ids::DaemonId};

/// Most dials at once.
pub(super) const MOST_IN_FLIGHT: usize = 8;
/// The side that is to dial first gets this much of a start.
const SECOND_DIAL: Duration = Duration::from_millis(300);

impl Peers {
    pub(super) fn give_up_lost_dials(&mut self, now: Duration) {
        let lost = |record: &Record| record.dial.in_flight.is_some_and(|until| until <= now);
        let ids: Vec<DaemonId> =
            self.records.iter().filter(|(_, r)| lost(r)).map(|(id, _)| *id).collect();
        for id in ids {
            self.dial_failed(now, id);
        }
    }

    pub(super) fn in_flight(&self) -> usize {
        self.records.values().filter(|record| record.dial.in_flight.is_some()).count()
    }

    pub(super) fn schedule_dial(&mut self, now: Duration, daemon: DaemonId) {
        if !self.records.get(&daemon).is_some_and(|record| self.wants_dial(record)) {
            return;
        }
        let Some(record) = self.records.get_mut(&daemon) else { return };
        let ours = (self.local.sae.as_ref().map(|(own, _)| own), self.local.daemon);
        let first = record.listed || ours < (record.sae.as_ref(), daemon);
        record.dial.schedule(if first { now } else { now + SECOND_DIAL });
        if record.dial.due.is_some_and(|due| due <= now) {
            self.dial_due(now);
        }
    }

    pub(super) fn dial_due(&mut self, now: Duration) {
        let mut due: Vec<(Duration, DaemonId)> = self
            .records
            .iter()
            .filter(|(_, record)| self.wants_dial(record))
            .filter_map(|(id, record)| Some((record.dial.due.filter(|at| *at <= now)?, *id)))
            .collect();
        due.sort_unstable();
        let free = MOST_IN_FLIGHT.saturating_sub(self.in_flight());
        for (_, daemon) in due.into_iter().take(free) {
            let jitter = self.random.random_range(0.5..1.5);
            let Some(record) = self.records.get_mut(&daemon) else { continue };
            let addrs = self.here.candidates(&record.sources, &record.advertised, record.listed);
            record.dial.start(now);
            if addrs.is_empty() {
                record.dial.failed(now, jitter);
                continue;
            }
            let (sae, listed) = (record.sae.clone(), record.listed);
            self.act(Action::Dial { daemon, sae, addrs, listed });
        }
    }
}
