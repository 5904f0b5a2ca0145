//! Remote endpoints that the graph does not show yet. An endpoint appears once its pairs with the session's own
//! endpoints are attached, so that a counted endpoint can be reached.
//!
//! This module does no I/O. An endpoint is delayed for at most [`ARRIVAL_TIMEOUT`]: a stopped process must not hide
//! endpoints from other processes.

use std::{
    collections::{BTreeSet, HashMap},
    time::{Duration, Instant},
};

use crate::{graph::GraphEntry, ids::Gid, wire::session::Pair};

/// Maximum delay of an endpoint.
pub(in crate::session) const ARRIVAL_TIMEOUT: Duration = Duration::from_secs(1);

#[derive(Default)]
pub(super) struct PendingEndpoints {
    arriving: HashMap<Gid, PendingEndpoint>,
    /// End of the delay of each endpoint that was pending when the last full graph began.
    before: HashMap<Gid, Instant>,
}

struct PendingEndpoint {
    entry: GraphEntry,
    missing: BTreeSet<Pair>,
    until: Instant,
}

impl PendingEndpoints {
    /// Delays `entry` until the pairs in `missing` are attached.
    pub(super) fn hold(&mut self, entry: GraphEntry, missing: BTreeSet<Pair>, now: Instant) {
        let gid = entry.endpoint.gid;
        let until = self.before.remove(&gid).unwrap_or(now + ARRIVAL_TIMEOUT);
        self.arriving.insert(gid, PendingEndpoint { entry, missing, until });
    }

    /// Returns the pending endpoints.
    pub(super) fn entries(&self) -> impl Iterator<Item = &GraphEntry> {
        self.arriving.values().map(|arriving| &arriving.entry)
    }

    /// Records that a pair is attached. Returns the endpoint that waited for it and for no other.
    pub(super) fn pair_up(&mut self, pair: &Pair) -> Option<GraphEntry> {
        [pair.reader, pair.writer].iter().find_map(|gid| {
            let arriving = self.arriving.get_mut(gid)?;
            arriving.missing.remove(pair);
            let whole = arriving.missing.is_empty();
            whole.then(|| self.arriving.remove(gid).map(|arriving| arriving.entry)).flatten()
        })
    }

    /// Removes an endpoint that ended while it was pending.
    pub(super) fn remove(&mut self, gid: &Gid) -> Option<GraphEntry> {
        self.arriving.remove(gid).map(|arriving| arriving.entry)
    }

    /// Removes the pairs of an own endpoint that ended. Returns the endpoints that waited for nothing else.
    pub(super) fn own_gone(&mut self, own: &Gid) -> Vec<GraphEntry> {
        self.take_where(|arriving| {
            arriving.missing.retain(|pair| pair.reader != *own && pair.writer != *own);
            arriving.missing.is_empty()
        })
    }

    /// Removes and returns the endpoints whose delay is over.
    pub(super) fn overdue(&mut self, now: Instant) -> Vec<GraphEntry> {
        if self.due().is_none_or(|due| due > now) {
            return Vec::new();
        }
        self.take_where(|arriving| arriving.until <= now)
    }

    /// Returns the time at which the next delay ends.
    pub(super) fn due(&self) -> Option<Instant> {
        self.arriving.values().map(|arriving| arriving.until).min()
    }

    /// Begins a full graph. An endpoint that the daemon does not repeat is gone.
    pub(super) fn restart(&mut self) {
        let arriving = std::mem::take(&mut self.arriving);
        self.before = arriving.into_iter().map(|(gid, arriving)| (gid, arriving.until)).collect();
    }

    fn take_where(
        &mut self,
        mut which: impl FnMut(&mut PendingEndpoint) -> bool,
    ) -> Vec<GraphEntry> {
        let taken = self.arriving.extract_if(|_, arriving| which(arriving));
        taken.map(|(_, arriving)| arriving.entry).collect()
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::graph::{Endpoint, EndpointKind};

    const fn gid(number: u8) -> Gid {
        Gid([number; 16])
    }

    fn entry(number: u8) -> GraphEntry {
        let endpoint = Endpoint::example(gid(number), EndpointKind::Publisher);
        GraphEntry { endpoint: Arc::new(endpoint), daemon: None, reach: None }
    }

    fn pair(reader: u8, writer: u8) -> Pair {
        Pair { reader: gid(reader), writer: gid(writer) }
    }

    fn shown(entries: impl IntoIterator<Item = GraphEntry>) -> Vec<Gid> {
        entries.into_iter().map(|entry| entry.endpoint.gid).collect()
    }

    #[test]
    fn an_endpoint_appears_with_the_last_of_its_pairs() {
        let (mut arrivals, now) = (PendingEndpoints::default(), Instant::now());
        arrivals.hold(entry(9), [pair(1, 9), pair(9, 2), pair(3, 9)].into(), now);
        assert!(arrivals.pair_up(&pair(1, 9)).is_none());
        assert!(arrivals.pair_up(&pair(1, 9)).is_none(), "once more");
        assert!(arrivals.pair_up(&pair(1, 8)).is_none(), "another's");
        assert!(arrivals.own_gone(&gid(2)).is_empty());
        assert_eq!(shown(arrivals.pair_up(&pair(3, 9))), [gid(9)]);
        assert!(arrivals.due().is_none());
        arrivals.hold(entry(9), [pair(1, 9)].into(), now);
        assert_eq!(shown(arrivals.own_gone(&gid(1))), [gid(9)]);
    }

    #[test]
    fn none_is_held_back_for_ever() {
        let (mut arrivals, now) = (PendingEndpoints::default(), Instant::now());
        arrivals.hold(entry(8), [pair(1, 8)].into(), now);
        arrivals.hold(entry(9), [pair(1, 9)].into(), now + ARRIVAL_TIMEOUT / 2);
        assert_eq!(arrivals.due(), Some(now + ARRIVAL_TIMEOUT));
        assert!(arrivals.overdue(now).is_empty());
        assert_eq!(shown(arrivals.overdue(now + ARRIVAL_TIMEOUT)), [gid(8)]);
        // A repeated announcement does not extend the delay.
        arrivals.restart();
        assert!(arrivals.due().is_none());
        arrivals.hold(entry(9), [pair(1, 9)].into(), now + ARRIVAL_TIMEOUT);
        assert_eq!(arrivals.due(), Some(now + ARRIVAL_TIMEOUT / 2 + ARRIVAL_TIMEOUT));
        assert_eq!(shown(arrivals.remove(&gid(9))), [gid(9)]);
        assert!(arrivals.pair_up(&pair(1, 9)).is_none());
    }
}
