//! The state of a session, which its handles and its control thread share.

mod awaited_pairs;
mod endpoints;
mod graph;
mod own_pairs;
mod pair_waits;
#[cfg(feature = "sros2")]
mod permit;
mod unmet;

use std::{
    fmt, io,
    sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError},
    thread::ThreadId,
    time::Duration,
};

use axon_shm::internal::SessionSegment;

pub(in crate::session) use self::graph::IndexedView;
#[cfg(feature = "sros2")]
pub(in crate::session) use self::permit::check_domain;
use self::{endpoints::OwnEndpoints, graph::ShownGraph, pair_waits::PairWaits, unmet::UnmetPairs};
use super::{
    core::{DaemonLink, GuardCondition, Outgoing, SessionCore, SessionEvent},
    endpoint_state::{Changes, ClientLimit, EventSource, PublisherInner},
    options::SessionOptions,
};
use crate::{
    config::Config,
    graph::Endpoint,
    ids::{DaemonId, Gid},
    wire::session::{SessionMessage, Unmet},
};

/// A session: its [core](SessionCore), and the endpoints and the graph that the core does not know.
pub(in crate::session) struct SessionShared {
    pub(in crate::session) core: Arc<SessionCore>,
    /// The id of the control thread, once it runs.
    pub(in crate::session) control: OnceLock<ThreadId>,
    /// The lock that allows one status request at a time.
    pub(in crate::session) asking: Mutex<()>,
    pair_waits: Mutex<PairWaits>,
    /// The lock that is held while pairs of the session's own endpoints come or go.
    own_pairs: Mutex<()>,
    /// The limit for the clients of its servers.
    pub(in crate::session) room: Arc<ClientLimit>,
    state: Mutex<SessionState>,
}

#[derive(Default)]
pub(in crate::session) struct SessionState {
    pub(in crate::session) endpoints: OwnEndpoints,
    pub(in crate::session) graph: ShownGraph,
    /// Readers that never took up the grants of publishers that have ended.
    pub(in crate::session) unmet: UnmetPairs,
    /// Pairs that other threads matched or unmatched, for the control thread to report.
    pub(in crate::session) rematched: Vec<(Changes, EventSource)>,
}

impl SessionState {
    /// Returns the application's nodes and endpoints that the graph shows.
    pub(in crate::session) fn shown(&self) -> impl Iterator<Item = &Endpoint> {
        self.endpoints.own().filter(|own| !self.graph.refused.contains_key(&own.gid))
    }

    /// Records that the daemon refused an own endpoint: it is in no session's graph, and so not in this one.
    fn refuse(&mut self, gid: Gid, why: String) {
        // It may have ended meanwhile.
        if self.endpoints.own().any(|own| own.gid == gid) {
            self.graph.refused.insert(gid, why);
            self.graph.hide(&gid);
        }
    }

    /// Forgets the refusals of the last daemon: another daemon may accept the endpoints.
    pub(in crate::session) fn forget_refusals(&mut self) {
        let refused = std::mem::take(&mut self.graph.refused);
        let own = self.endpoints.own().filter(|own| refused.contains_key(&own.gid));
        own.for_each(|own| self.graph.show(own));
    }

    /// Removes an own endpoint that is gone, and queues the message for the daemon.
    fn remove_dead(&mut self, gid: &Gid, link: &DaemonLink) {
        self.graph.remove_dead(gid);
        link.queue(Outgoing::gone(*gid));
    }

    /// Reports the readers of an ending publisher that have not taken up their grant. It must be called before the end
    /// of the publisher is queued for the daemon.
    fn leave_unmet(&mut self, publisher: &PublisherInner, link: &DaemonLink) {
        let writer = publisher.endpoint.gid;
        for (reader, samples) in publisher.unmet() {
            let unmet = Unmet { reader, writer, samples };
            self.unmet.remember(unmet);
            link.queue(Outgoing::message(SessionMessage::Unmet(unmet)));
        }
    }
}

impl SessionShared {
    /// Creates the state of a new session, which has no endpoint yet.
    ///
    /// # Errors
    /// The process has no descriptors left.
    pub(in crate::session) fn new(
        config: Config,
        options: SessionOptions,
        segment: Arc<SessionSegment>,
    ) -> io::Result<Self> {
        let room = Arc::new(ClientLimit::new(options.callers));
        Ok(Self {
            core: Arc::new(SessionCore::new(config, options, segment)?),
            control: OnceLock::new(),
            asking: Mutex::new(()),
            pair_waits: Mutex::default(),
            own_pairs: Mutex::default(),
            room,
            state: Mutex::default(),
        })
    }

    /// Sets, for a relay, the daemon, or that there is none.
    pub(in crate::session) fn set_daemon(&self, daemon: Option<DaemonId>) {
        {
            let mut state = self.state();
            self.core.link.set_daemon(daemon);
            if daemon.is_some() {
                state.forget_refusals();
            }
        }
        self.notify(Some(&daemon.map_or(SessionEvent::DaemonLost, SessionEvent::DaemonFound)));
    }

    /// Records that the daemon refused an endpoint of the session.
    pub(in crate::session) fn refuse(&self, gid: Gid, why: String) {
        self.state().refuse(gid, why);
        self.notify(Some(&SessionEvent::Refused(gid)));
        self.core.wake();
    }

    /// Records a refusal that may be lifted later. A session that relays a process keeps the reason for it.
    pub(in crate::session) fn keep_refusal(&self, why: String) {
        // The relay is woken for the first refusal. It takes all at once.
        if self.core.options.keeps_refusals && self.core.link.keep_refusal(why) {
            self.notify(Some(&SessionEvent::Graph));
        }
    }

    /// Counts, for a relay, `samples` samples of `writer` that were lost on their way to the session's subscriptions.
    /// With `first`, they were lost before the first sample that comes through this daemon or later.
    pub(in crate::session) fn lost(&self, writer: &Gid, samples: u64, first: bool) {
        let subscriptions: Vec<_> =
            self.state().endpoints.subscriptions.values().cloned().collect();
        subscriptions.iter().for_each(|s| s.lock().lost_elsewhere(writer, samples, first));
    }

    pub(in crate::session) fn state(&self) -> MutexGuard<'_, SessionState> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Returns the state of the waits for endpoints of other hosts.
    fn pair_waits(&self) -> MutexGuard<'_, PairWaits> {
        self.pair_waits.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Waits for changes of the session until `reached` returns true; it runs without a lock. Returns false if the time
    /// is over.
    pub(in crate::session) fn wait_changed(
        &self,
        timeout: Duration,
        reached: impl FnMut() -> bool,
    ) -> bool {
        self.core.changes.wait(timeout, reached)
    }

    /// Wakes the waiting threads, triggers the nodes' conditions if the graph changed, and calls the listener.
    pub(in crate::session) fn notify(&self, event: Option<&SessionEvent>) {
        if matches!(event, Some(SessionEvent::Graph)) {
            let guards: Vec<GuardCondition> = {
                let state = self.state();
                state.endpoints.nodes.values().map(|(_, guard)| guard.clone()).collect()
            };
            guards.iter().for_each(GuardCondition::trigger);
        }
        self.core.notify(event);
    }
}

impl fmt::Debug for SessionShared {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("SessionShared").field("id", &self.core.id).finish_non_exhaustive()
    }
}
