//! What is still queued when a publisher or a link ends: it is sent as long as there is progress, then
//! counted as lost.

use std::{
    collections::HashMap,
    sync::Arc,
    time::{Duration, Instant},
};

use axon_envelope::Kind;
use axon_shm::{ids::Gid, qos::Reliability};

use super::{Active, Owner, Shared};
use crate::gateway::hub::Event;

/// What a publisher left is given up after so long without progress.
const PATIENCE: Duration = Duration::from_secs(10);

/// Publishers that ended and whose samples are not all acknowledged.
pub(super) struct Endings {
    owner: Owner,
    endings: HashMap<Gid, Ending>,
}

struct Ending {
    /// What it had come to when it was looked at last, and since when that is so.
    progress: (u64, u64),
    since: Instant,
}

impl Endings {
    pub(super) fn new(owner: Owner) -> Self {
        Self { owner, endings: HashMap::new() }
    }

    /// Whose they are.
    pub(super) fn owner(&self) -> &Owner {
        &self.owner
    }

    /// This publisher ended.
    pub(super) fn add(&mut self, of: Gid) {
        let ending = Ending { progress: (0, 0), since: Instant::now() };
        self.endings.entry(of).or_insert(ending);
    }

    /// Tells the hub of those of which nothing is left, or whose rest is given up. When to look again.
    pub(super) fn look(
        &mut self,
        routes: &mut HashMap<u32, Active>,
        shared: &Arc<Shared>,
    ) -> Option<Instant> {
        if self.endings.is_empty() {
            return None;
        }
        let now = Instant::now();
        let mut over = Vec::new();
        for (of, ending) in &mut self.endings {
            let active = routes.values_mut().find_map(|active| {
                let left = active.unacknowledged().get(of).copied();
                left.map(|left| (active, left))
            });
            let Some((active, left)) = active else {
                over.push((*of, None));
                continue;
            };
            let progress = active.feeds.get(of).map_or((0, 0), super::Feed::progress);
            if progress != ending.progress {
                *ending = Ending { progress, since: now };
            }
            if now.duration_since(ending.since) >= PATIENCE {
                shared.counters.dropped("publisher_ended", left);
                tracing::warn!(
                    topic = &*active.flow.topic,
                    publisher = %of,
                    samples = left,
                    "a publisher ended, and the peer did not take what it left: samples are lost"
                );
                active.forget(of);
                over.push((*of, Some((Arc::clone(&active.flow.topic), left))));
            }
        }
        for (of, lost) in over {
            self.endings.remove(&of);
            let events = self.owner.events.clone();
            let drained = Event::Drained(self.owner.daemon, of);
            tokio::spawn(async move {
                if let Some((topic, samples)) = lost {
                    let lost = Event::Lost { topic, cause: "publisher_ended", samples };
                    let _ = events.send(lost).await;
                }
                // An error: the hub is gone.
                let _ = events.send(drained).await;
            });
        }
        self.endings.values().map(|ending| ending.since + PATIENCE).min()
    }

    /// The link is over: what was not sent, or not acknowledged where it was to be, is given up.
    pub(super) async fn link_over(&self, routes: &mut HashMap<u32, Active>, shared: &Shared) {
        for active in routes.values_mut() {
            let unsent = active.end().await;
            let topic = &active.flow.topic;
            let samples = match active.flow.route.kind {
                Kind::Topic => {
                    shared.counters.lost(topic, "no_link", unsent);
                    active.give_up()
                }
                Kind::Request | Kind::Response => unsent,
            };
            if samples > 0 {
                let peer = &self.owner.daemon;
                tracing::warn!(topic = &**topic, %peer, samples,
                    "the link ended before the peer acknowledged them: samples may be lost");
                shared.counters.lost(topic, "link_ended", samples);
            }
        }
    }
}

impl Active {
    /// Nothing more is sent of this publisher.
    fn forget(&mut self, of: &Gid) {
        self.feeds.remove(of);
        for source in self.sources.iter().filter(|source| source.reads(of)) {
            while source.take_of(of).is_some() {}
            source.acknowledge_of(of, u64::MAX);
        }
    }

    /// Ends all streams. Returns how many samples, requests and responses were taken and not written. A
    /// RELIABLE sample counts until it is acknowledged.
    async fn end(&mut self) -> u64 {
        let mut unsent = 0;
        for (of, feed) in &mut self.feeds {
            let left = feed.end().await;
            // As the first asks that reads it.
            let source = self.sources.iter().find(|source| source.reads(of));
            let reliable = source.is_some_and(|s| s.qos().reliability == Reliability::Reliable);
            if self.flow.route.kind != Kind::Topic || !reliable {
                unsent += left;
            }
        }
        unsent
    }

    /// Tells the publishers what does not get to the peer; how many samples that are.
    pub(super) fn give_up(&self) -> u64 {
        let mut all = 0;
        for (of, samples) in self.unacknowledged() {
            all += samples;
            let source = self.sources.iter().find(|source| source.has_unacknowledged(&of));
            if let Some(source) = source {
                source.give_up(of, samples);
            }
        }
        all
    }
}
