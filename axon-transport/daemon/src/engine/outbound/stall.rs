//! Finds routes that the peer asked for and does not read. A flow that waits for the credit of others is excused, as long
//! as credit comes back. If none does, those who use it are judged, KEEP_ALL or not.

use std::{collections::HashMap, time::Duration};

use axon_shm::{ids::Gid, qos::History};

use super::{FlowId, Outbound, OutboundEvent, Served, Source};

/// Between two looks.
const LOOK: Duration = Duration::from_secs(1);
/// After so long without anything of the peer the link is at fault: the link's own limits apply, and the time of
/// the routes begins again.
const SILENT: Duration = Duration::from_secs(6);

/// KEEP_ALL flows with samples that are not acknowledged.
#[derive(Debug)]
pub(super) struct Stalls {
    limit: Duration,
    flows: HashMap<FlowId, Progress>,
    /// Frames of the peer, and when there was a new one.
    heard: (u64, Duration),
    /// How often credit came back, and when it did last or nobody waited for any.
    returned: (u64, Duration),
    next: Duration,
}

#[derive(Clone, Copy, Debug)]
struct Progress {
    at: (u64, u64),
    since: Duration,
}

impl Stalls {
    pub(super) fn new(limit: Duration, now: Duration) -> Self {
        Self { limit, flows: HashMap::new(), heard: (0, now), returned: (0, now), next: now + LOOK }
    }

    /// A flow is gone. Its number is another's next.
    pub(super) fn forget(&mut self, flow: FlowId) {
        self.flows.remove(&flow);
    }

    /// Whether flows have waited for credit for the limit, and none came back. Then no flow that waits is excused any
    /// more, and those that use credit are judged, too.
    pub(super) fn starves(&self, now: Duration) -> bool {
        now.saturating_sub(self.returned.1) >= self.limit
    }

    /// When to look again.
    pub(super) fn poll_timeout(&self) -> Option<Duration> {
        Some(self.next)
    }
}

impl Outbound {
    /// Reports the routes that made no progress for the limit.
    pub(super) fn look_at_stalls(&mut self, heard: u64, now: Duration) {
        if now < self.stalls.next {
            return;
        }
        self.stalls.next = now + LOOK;
        if heard != self.stalls.heard.0 {
            self.stalls.heard = (heard, now);
        }
        let silent = now.saturating_sub(self.stalls.heard.1) >= SILENT;
        let returned = self.credit.returned();
        if silent || returned != self.stalls.returned.0 || self.for_credit.is_empty() {
            self.stalls.returned = (returned, now);
        }
        let starves = self.stalls.starves(now);
        let before = std::mem::take(&mut self.stalls.flows);
        let mut quiet = Vec::new();
        for id in &self.busy {
            let Some(flow) = &self.flows[*id] else { continue };
            let Some(served) = self.routes.get_mut(&flow.route_number) else { continue };
            let is_judged = served.holds(&flow.of) || starves && flow.uses_credit();
            if !is_judged {
                quiet.extend(flow.is_quiet().then_some(*id));
                continue;
            }
            if served.stalled {
                continue;
            }
            let at = flow.progress();
            let progress = match before.get(id) {
                Some(progress)
                    if progress.at == at && !silent && (starves || !flow.waits_for_others()) =>
                {
                    *progress
                }
                _ => Progress { at, since: now },
            };
            if now.saturating_sub(progress.since) >= self.stalls.limit {
                served.stalled = true;
                self.events.push(OutboundEvent::Stalled(flow.route_number));
                continue;
            }
            self.stalls.flows.insert(*id, progress);
        }
        for id in quiet {
            self.busy.remove(&id);
        }
    }

    /// Samples of a flow wait.
    pub(super) fn note_busy(&mut self, id: FlowId, now: Duration) {
        if self.busy.is_empty() {
            // Nobody looked while there was nothing.
            self.stalls.next = self.stalls.next.max(now + LOOK);
        }
        self.busy.insert(id);
    }
}

impl Served {
    /// Whether a KEEP_ALL relay holds a publisher back.
    fn holds(&self, of: &Gid) -> bool {
        let keeping = |source: &Source| source.qos().history == History::KeepAll;
        self.sources.iter().any(|source| keeping(source) && source.has_unacknowledged(of))
    }
}
