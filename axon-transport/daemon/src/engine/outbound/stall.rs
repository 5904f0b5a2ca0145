//! Finds routes that the peer asked for and does not read.

use std::{collections::HashMap, time::Duration};

use axon_shm::{ids::Gid, qos::History};

use super::{Outbound, OutboundEvent, Served, Source};

/// Between two looks.
const LOOK: Duration = Duration::from_secs(1);
/// After so long without any datagram of the peer the link is at fault: the link's own limits apply, and the time of
/// the routes begins again.
const SILENT: Duration = Duration::from_secs(6);

/// KEEP_ALL flows with samples that are not acknowledged.
#[derive(Debug)]
pub(super) struct Stalls {
    limit: Duration,
    flows: HashMap<(u32, Gid), Progress>,
    /// Datagrams of the peer, and when there was a new one.
    heard: (u64, Duration),
    next: Duration,
}

#[derive(Clone, Copy, Debug)]
struct Progress {
    at: (u64, u64),
    since: Duration,
}

impl Stalls {
    pub(super) fn new(limit: Duration, now: Duration) -> Self {
        Self { limit, flows: HashMap::new(), heard: (0, now), next: now + LOOK }
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
        let before = std::mem::take(&mut self.stalls.flows);
        for (number, served) in self.routes.iter_mut().filter(|(_, served)| !served.stalled) {
            for of in served.awaited() {
                let flow = served.flows.get(&of).and_then(|id| self.flows[*id].as_ref());
                let at = flow.map_or((0, 0), super::Flow::progress);
                let progress = match before.get(&(*number, of)) {
                    Some(progress) if progress.at == at && !silent => *progress,
                    _ => Progress { at, since: now },
                };
                if now.saturating_sub(progress.since) >= self.stalls.limit {
                    served.stalled = true;
                    self.events.push(OutboundEvent::Stalled(*number));
                    break;
                }
                self.stalls.flows.insert((*number, of), progress);
            }
        }
    }
}

impl Served {
    /// The publishers that a KEEP_ALL relay holds back.
    fn awaited(&self) -> Vec<Gid> {
        let keeping = self.sources.iter().filter(|source| source.qos().history == History::KeepAll);
        let mut awaited: Vec<_> =
            keeping.flat_map(|source| Source::unacknowledged(source).into_keys()).collect();
        awaited.sort_unstable();
        awaited.dedup();
        awaited
    }
}
