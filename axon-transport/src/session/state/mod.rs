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

/// A session: its [core](SessionCore), and the endpoints and the graph that the core knows nothing of.
pub(in crate::session) struct SessionShared {
    pub(in crate::session) core: Arc<SessionCore>,
    /// The control thread, once it runs.
    pub(in crate::session) control: OnceLock<ThreadId>,
    /// One status request at a time.
    pub(in crate::session) asking: Mutex<()>,
    pair_waits: Mutex<PairWaits>,
    /// Held while pairs of the session's own endpoints come or go.
    own_pairs: Mutex<()>,
    /// For the clients of its servers.
    pub(in crate::session) room: Arc<ClientLimit>,
    state: Mutex<SessionState>,
}

#[derive(Default)]
pub(in crate::session) struct SessionState {
    pub(in crate::session) endpoints: OwnEndpoints,
    pub(in crate::session) graph: ShownGraph,
    /// Readers that never took up what publishers granted that have ended.
    pub(in crate::session) unmet: UnmetPairs,
    /// Pairs that other threads matched or unmatched, for the control thread to report.
    pub(in crate::session) rematched: Vec<(Changes, EventSource)>,
}

impl SessionState {
    /// The application's nodes and endpoints that the graph shows.
    pub(in crate::session) fn shown(&self) -> impl Iterator<Item = &Endpoint> {
        self.endpoints.own().filter(|own| !self.graph.refused.contains_key(&own.gid))
    }

    /// The daemon does not take one of its own: it is in nobody's graph, and so not in this one.
    fn refuse(&mut self, gid: Gid, why: String) {
        // It may have ended meanwhile.
        if self.endpoints.own().any(|own| own.gid == gid) {
            self.graph.refused.insert(gid, why);
            self.graph.hide(&gid);
        }
    }

    /// Another daemon may take those that the last one refused.
    pub(in crate::session) fn forget_refusals(&mut self) {
        let refused = std::mem::take(&mut self.graph.refused);
        let own = self.endpoints.own().filter(|own| refused.contains_key(&own.gid));
        own.for_each(|own| self.graph.show(own));
    }

    /// One of its own is gone. The daemon hears of it, too.
    fn remove_dead(&mut self, gid: &Gid, link: &DaemonLink) {
        self.graph.remove_dead(gid);
        link.queue(Outgoing::gone(*gid));
    }

    /// A publisher ends. Has to be called before the daemon is told so.
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
    /// The state of a new session, which has no endpoint yet.
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

    /// For a relay: there is a daemon now, or none any more.
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

    /// The daemon does not take an endpoint of the session's own.
    pub(in crate::session) fn refuse(&self, gid: Gid, why: String) {
        self.state().refuse(gid, why);
        self.notify(Some(&SessionEvent::Refused(gid)));
        self.core.wake();
    }

    /// The daemon refuses something that it may allow later. A session that relays a process keeps the reason for it.
    pub(in crate::session) fn keep_refusal(&self, why: String) {
        // The relay is woken for the first refusal. It takes all at once.
        if self.core.options.keeps_refusals && self.core.link.keep_refusal(why) {
            self.notify(Some(&SessionEvent::Graph));
        }
    }

    /// For a relay: so many samples of `writer` were lost on their way to the session's
    /// subscriptions, before the `first` that comes through this daemon or later.
    pub(in crate::session) fn lost(&self, writer: &Gid, samples: u64, first: bool) {
        let subscriptions: Vec<_> =
            self.state().endpoints.subscriptions.values().cloned().collect();
        subscriptions.iter().for_each(|s| s.lock().lost_elsewhere(writer, samples, first));
    }

    pub(in crate::session) fn state(&self) -> MutexGuard<'_, SessionState> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// How new endpoints wait for those of other hosts.
    fn pair_waits(&self) -> MutexGuard<'_, PairWaits> {
        self.pair_waits.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Waits for changes of the session until `reached`, which runs without a lock.
    pub(in crate::session) fn wait_changed(
        &self,
        timeout: Duration,
        reached: impl FnMut() -> bool,
    ) -> bool {
        self.core.changes.wait(timeout, reached)
    }

    /// Tells those who wait, the nodes' conditions for a change of the graph, and the listener.
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
