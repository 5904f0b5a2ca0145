//! Publishers that ended: the samples that they left are sent as long as there is progress, then counted as lost.

use std::{collections::HashMap, sync::Arc, time::Duration};

use axon_shm::ids::Gid;

use super::{Outbound, OutboundEvent, Served, Source};

/// The samples of a publisher that ended are given up after this time without progress.
const PATIENCE: Duration = Duration::from_secs(10);
/// Between two looks.
const LOOK: Duration = Duration::from_millis(250);

/// Publishers that ended and whose samples are not all acknowledged.
#[derive(Debug, Default)]
pub(super) struct Endings {
    publishers: HashMap<Gid, Ending>,
    next: Option<Duration>,
}

#[derive(Debug)]
struct Ending {
    /// Its route, until the peer asks for that anew.
    route: u32,
    /// The flow's progress at the last look, and since when it has been the same.
    progress: (u64, u64),
    since: Duration,
}

impl Endings {
    /// A publisher ended.
    pub(super) fn add(&mut self, route: u32, publisher: Gid, now: Duration) {
        let ending = Ending { route, progress: (0, 0), since: now };
        self.publishers.entry(publisher).or_insert(ending);
        self.next = Some(now);
    }

    /// When to look again.
    pub(super) fn poll_timeout(&self) -> Option<Duration> {
        self.next.filter(|_| !self.publishers.is_empty())
    }
}

impl Outbound {
    /// Reports the publishers of which nothing is left, and gives up the samples of those that make no progress.
    pub(super) fn look_at_endings(&mut self, now: Duration) {
        if self.endings.poll_timeout().is_none_or(|due| due > now) {
            return;
        }
        self.endings.next = Some(now + LOOK);
        let starves = self.stalls.starves(now);
        let mut over = Vec::new();
        for (of, ending) in &mut self.endings.publishers {
            if !self.routes.contains_key(&ending.route) {
                let reads = |served: &Served| served.sources.iter().any(|source| source.reads(of));
                let found = self.routes.iter().find(|(_, served)| reads(served));
                ending.route = found.map_or(ending.route, |(number, _)| *number);
            }
            let number = ending.route;
            let served = self.routes.get(&number);
            let Some(left) = served.and_then(|s| s.unacknowledged().get(of).copied()) else {
                over.push((*of, None));
                continue;
            };
            let id = self.routes.get(&number).and_then(|served| served.flows.get(of));
            let flow = id.and_then(|id| self.flows[*id].as_ref());
            let progress = flow.map_or((0, 0), super::Flow::progress);
            let waits = !starves && flow.is_some_and(super::Flow::waits_for_others);
            if progress != ending.progress || waits {
                *ending = Ending { progress, since: now, ..*ending };
            }
            if now.saturating_sub(ending.since) >= PATIENCE {
                over.push((*of, Some((number, left))));
            }
        }
        for (of, given_up) in over {
            self.endings.publishers.remove(&of);
            if let Some((number, samples)) = given_up {
                self.give_up_ended(number, of, samples);
            }
            self.events.push(OutboundEvent::Drained(of));
        }
    }

    fn give_up_ended(&mut self, number: u32, of: Gid, samples: u64) {
        let Some(served) = self.routes.get(&number) else { return };
        let topic = Arc::clone(&served.shared.topic);
        tracing::warn!(
            topic = &*topic,
            publisher = %of,
            samples,
            "a publisher ended, and the peer did not take its last samples: they are lost"
        );
        let sources = served.sources.iter().filter(|source| source.reads(&of));
        for source in sources {
            // Nothing more is sent of it.
            while source.take_of(&of, Duration::ZERO).is_some() {}
            Source::acknowledge_of(source, &of, u64::MAX);
        }
        self.remove_flow(number, &of);
        self.counters.dropped("publisher_ended", samples);
        self.events.push(OutboundEvent::Lost { topic, cause: "publisher_ended", samples });
    }
}
