//! Finds routes that the peer does not read while their publishers wait, so that the hub can end them.

use std::{
    collections::HashMap,
    sync::Arc,
    time::{Duration, Instant},
};

use axon_shm::{ids::Gid, qos::History};

use super::{Active, Owner, Shared};
use crate::gateway::hub::Event;

/// How often progress is looked for.
const LOOK: Duration = Duration::from_secs(1);
/// A link over which nothing came for so long, though quinn keeps it alive, is silent: that its peer does
/// not acknowledge samples says nothing of its readers.
const SILENT: Duration = Duration::from_secs(6);

/// The flows that publishers wait for, and since when they have not got on.
pub(super) struct Stalling {
    limit: Duration,
    flows: HashMap<(u32, Gid), Flow>,
    /// Packets that came over the link, and when one came last.
    heard: (u64, Instant),
    next: Instant,
}

struct Flow {
    progress: (u64, u64),
    since: Instant,
}

impl Stalling {
    pub(super) fn new(limit: Duration) -> Self {
        let now = Instant::now();
        Self { limit, flows: HashMap::new(), heard: (0, now), next: now + LOOK }
    }

    /// Tells the hub of routes on which nothing moves, once each. When to look again, if there may be
    /// something to be looked at.
    pub(super) fn look(
        &mut self,
        routes: &mut HashMap<u32, Active>,
        shared: &Arc<Shared>,
        owner: &Owner,
    ) -> Option<Instant> {
        let now = Instant::now();
        if now < self.next {
            // Something may have been queued since the last look.
            return (!routes.is_empty()).then_some(self.next);
        }
        self.next = now + LOOK;
        let heard = shared.carrier.borrow().connection.stats().udp_rx.datagrams;
        if heard != self.heard.0 {
            self.heard = (heard, now);
        }
        let silent = now.duration_since(self.heard.1) >= SILENT;
        let mut before = std::mem::take(&mut self.flows);
        for (number, active) in routes.iter_mut().filter(|(_, active)| !active.stalled) {
            for of in active.awaited() {
                let progress = active.feeds.get(&of).map_or((0, 0), super::Feed::progress);
                let new = Flow { progress, since: now };
                let flow = match before.remove(&(*number, of)) {
                    Some(flow) if flow.progress == progress && !silent => flow,
                    _ => new,
                };
                if now.duration_since(flow.since) >= self.limit {
                    active.stalled = true;
                    let (daemon, number) = (owner.daemon, *number);
                    let stalled = Event::Stalled { daemon, route: number };
                    let events = owner.events.clone();
                    // An error: the hub is gone.
                    tokio::spawn(async move { drop(events.send(stalled).await) });
                    break;
                }
                self.flows.insert((*number, of), flow);
            }
        }
        (!self.flows.is_empty()).then_some(self.next)
    }
}

impl Active {
    /// Publishers of which something is not acknowledged that they keep until it is.
    fn awaited(&self) -> Vec<Gid> {
        let keeping = self.sources.iter().filter(|source| source.qos().history == History::KeepAll);
        let mut awaited: Vec<_> =
            keeping.flat_map(|source| source.unacknowledged().into_keys()).collect();
        awaited.sort_unstable();
        awaited.dedup();
        awaited
    }
}
