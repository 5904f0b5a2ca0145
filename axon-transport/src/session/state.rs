//! The state of a session, which its handles and its control thread share.

use std::{
    collections::{BTreeMap, BTreeSet, HashMap, VecDeque},
    fmt,
    os::fd::OwnedFd,
    sync::{
        Arc, Condvar, Mutex, MutexGuard, OnceLock, PoisonError,
        atomic::{AtomicBool, Ordering},
    },
    thread::ThreadId,
    time::{Duration, Instant},
};

use axon_shm::{ShmError, internal::SessionSegment};

use super::{
    SessionOptions,
    daemon::{memory_changes::MemoryChanges, status_text::StatusAnswer},
    events::{Changes, EventSource},
    guard::GuardCondition,
    pair_waits::PairWaits,
    publisher::PublisherInner,
    rings::ClientLimit,
    subscription::SubscriptionInner,
    tasks::Listening,
    unmet::UnmetPairs,
};
use crate::{
    config::Config,
    graph::{Endpoint, GraphEntry, GraphView},
    ids::{DaemonId, Gid, SessionId},
    wire::session::{EndpointRole, Fence, Gone, Message, Unmet},
};

/// Something that a session's owner may want to hear of.
///
/// ```
/// use axon_transport::SessionEvent;
///
/// fn log(event: &SessionEvent) {
///     match event {
///         SessionEvent::DaemonLost => println!("the daemon is gone"),
///         SessionEvent::DaemonFound(daemon) => println!("connected to daemon {daemon:?}"),
///         other => println!("{other:?}"),
///     }
/// }
/// # log(&SessionEvent::DaemonLost);
/// ```
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum SessionEvent {
    /// The graph changed.
    Graph,
    /// The readers of this publisher, or the publishers of this subscription, changed.
    Matched(Gid),
    /// The daemon is gone. Rings that are attached flow on.
    DaemonLost,
    /// A daemon, perhaps another one than before, knows the session's endpoints.
    DaemonFound(DaemonId),
    /// The daemon does not take this endpoint: no other session hears of it, and the graph does not
    /// show it.
    Refused(Gid),
}

/// Refusals that are kept for a process that is relayed, until it takes them. It is not told of those beyond.
const REFUSALS: usize = 256;

type Listener = Arc<dyn Fn(&SessionEvent) + Send + Sync>;

pub(crate) struct SessionShared {
    pub(crate) config: Config,
    pub(crate) options: SessionOptions,
    pub(crate) id: SessionId,
    pub(super) segment: Arc<SessionSegment>,
    /// Wakes the control thread (an eventfd).
    pub(super) wake: Arc<OwnedFd>,
    pub(super) memory: Arc<MemoryChanges>,
    pub(crate) stopping: AtomicBool,
    /// The control thread, once it runs.
    pub(super) control: OnceLock<ThreadId>,
    /// The callbacks and tasks for which the control thread listens for samples.
    pub(super) listening: Listening,
    pub(super) listener: Mutex<Option<Listener>>,
    /// One status request at a time.
    pub(super) asking: Mutex<()>,
    pair_waits: Mutex<PairWaits>,
    /// Held while pairs of the session's own endpoints come or go.
    pub(super) own_pairs: Mutex<()>,
    /// For the clients of its servers.
    pub(super) room: Arc<ClientLimit>,
    state: Mutex<SessionState>,
    changed: Condvar,
}

#[derive(Default)]
pub(super) struct SessionState {
    pub(super) next_entity: u32,
    /// With what tells of changes of the graph.
    pub(super) nodes: HashMap<Gid, (Endpoint, GuardCondition)>,
    pub(super) publishers: HashMap<Gid, Arc<PublisherInner>>,
    pub(super) subscriptions: HashMap<Gid, Arc<SubscriptionInner>>,
    /// Publishers that the application has dropped, and until when they stay at most.
    pub(super) leaving: BTreeMap<Gid, Instant>,
    /// Readers that never took up what publishers granted that have ended.
    pub(super) unmet: UnmetPairs,
    /// Applications' endpoints of both kinds by topic or service.
    pub(super) topics: HashMap<String, BTreeSet<Gid>>,
    pub(super) outgoing: VecDeque<Outgoing>,
    /// Ended endpoints, until a daemon has announced their end.
    pub(super) tombstones: BTreeSet<Gid>,
    pub(super) graph: Arc<GraphView>,
    /// Own endpoints that the daemon refused, and why. No other session learns of them.
    pub(super) refused: BTreeMap<Gid, String>,
    /// What else it refused, for the process that the session relays.
    pub(super) refusals: Vec<String>,
    pub(super) daemon: Option<DaemonId>,
    pub(super) status: StatusAnswer,
    /// Deadline at which waiters check again without an event.
    pub(super) again: Option<Instant>,
    /// Pairs that other threads matched or unmatched, for the control thread to report.
    pub(super) rematched: Vec<(Changes, EventSource)>,
    /// Whether the graph changed since the control thread last reported it.
    pub(super) regraphed: bool,
    /// Counts changes that may end a wait.
    pub(super) changes: u64,
}

impl SessionState {
    /// The nodes and endpoints of the session's application.
    pub(super) fn own(&self) -> impl Iterator<Item = &Endpoint> {
        let application = |role| role == EndpointRole::Application;
        let nodes = self.nodes.values().map(|(node, _)| node);
        let publishers = self
            .publishers
            .values()
            .filter(move |p| application(p.role) && !self.leaving.contains_key(&p.endpoint.gid));
        let subscriptions = self.subscriptions.values().filter(move |s| application(s.role));
        nodes
            .chain(publishers.map(|publisher| &publisher.endpoint))
            .chain(subscriptions.map(|subscription| &subscription.endpoint))
    }

    /// Those of them that the graph shows.
    pub(super) fn shown(&self) -> impl Iterator<Item = &Endpoint> {
        self.own().filter(|own| !self.refused.contains_key(&own.gid))
    }

    /// Shows what the session has made, whatever the daemon does meanwhile: the caller that
    /// made it finds it in the graph, unless the daemon has refused it.
    pub(super) fn show(&mut self, own: &Endpoint) {
        if self.refused.contains_key(&own.gid) {
            return;
        }
        let entry = || GraphEntry { endpoint: Arc::new(own.clone()), daemon: None, reach: None };
        Arc::make_mut(&mut self.graph).endpoints.entry(own.gid).or_insert_with(entry);
        self.regraphed = true;
    }

    /// The daemon does not take one of its own: it is in nobody's graph, and so not in this one.
    pub(super) fn refuse(&mut self, gid: Gid, why: String) {
        // It may have ended meanwhile.
        if self.own().any(|own| own.gid == gid) {
            self.refused.insert(gid, why);
            self.hide(&gid);
        }
    }

    /// Another daemon may take those that the last one refused.
    pub(super) fn forget_refusals(&mut self) {
        let refused = std::mem::take(&mut self.refused);
        let own: Vec<_> = self.own().filter(|e| refused.contains_key(&e.gid)).cloned().collect();
        own.iter().for_each(|own| self.show(own));
    }

    pub(super) fn hide(&mut self, gid: &Gid) {
        if self.graph.endpoints.contains_key(gid) {
            Arc::make_mut(&mut self.graph).endpoints.remove(gid);
            self.regraphed = true;
        }
    }

    pub(super) fn index(&mut self, endpoint: &Endpoint) {
        self.topics.entry(endpoint.topic.clone()).or_default().insert(endpoint.gid);
    }

    /// One of its own is gone: nobody here counts it any more, whatever the daemon has heard.
    pub(super) fn remove_dead(&mut self, gid: &Gid) {
        self.tombstones.insert(*gid);
        self.refused.remove(gid);
        self.hide(gid);
        self.tell_gone(gid);
    }

    pub(super) fn tell_gone(&mut self, gid: &Gid) {
        let gone = Message::EndpointGone(Gone { gid: *gid });
        self.outgoing.push_back(Outgoing::Message(Box::new(gone)));
    }

    /// A publisher ends. Has to be called before the daemon is told so.
    pub(super) fn leave_unmet(&mut self, publisher: &PublisherInner) {
        let writer = publisher.endpoint.gid;
        for (reader, samples) in publisher.unmet() {
            let unmet = Unmet { reader, writer, samples };
            self.unmet.remember(unmet);
            self.tell_unmet(unmet);
        }
    }

    pub(super) fn tell_unmet(&mut self, unmet: Unmet) {
        self.outgoing.push_back(Outgoing::Message(Box::new(Message::Unmet(unmet))));
    }

    pub(super) fn unindex(&mut self, endpoint: &Endpoint) {
        if let Some(gids) = self.topics.get_mut(&endpoint.topic) {
            gids.remove(&endpoint.gid);
            if gids.is_empty() {
                self.topics.remove(&endpoint.topic);
            }
        }
    }
}

/// Something for the daemon to be told.
#[derive(Debug)]
pub(super) enum Outgoing {
    /// This endpoint of ours, as it is when the message is sent.
    Announce(Gid),
    /// A message without descriptors.
    Message(Box<Message>),
    /// A question behind all that readers have to be sent.
    Fence(Fence),
}

impl SessionShared {
    pub(super) fn new(
        config: Config,
        options: SessionOptions,
        segment: Arc<SessionSegment>,
        wake: OwnedFd,
    ) -> Self {
        let wake = Arc::new(wake);
        let room = Arc::new(ClientLimit::new(options.callers));
        let memory = MemoryChanges::follow(&segment, wake.clone());
        Self {
            config,
            options,
            id: segment.id(),
            segment,
            wake,
            memory,
            stopping: AtomicBool::new(false),
            control: OnceLock::new(),
            listening: Listening::default(),
            listener: Mutex::new(None),
            asking: Mutex::new(()),
            pair_waits: Mutex::default(),
            own_pairs: Mutex::default(),
            room,
            state: Mutex::default(),
            changed: Condvar::new(),
        }
    }

    /// For a relay: there is a daemon now, or none any more.
    pub(crate) fn set_daemon(&self, daemon: Option<DaemonId>) {
        {
            let mut state = self.state();
            state.daemon = daemon;
            if daemon.is_some() {
                state.forget_refusals();
            }
        }
        self.notify(Some(&daemon.map_or(SessionEvent::DaemonLost, SessionEvent::DaemonFound)));
    }

    /// The daemon does not take an endpoint of the session's own.
    pub(crate) fn refuse(&self, gid: Gid, why: String) {
        self.state().refuse(gid, why);
        self.notify(Some(&SessionEvent::Refused(gid)));
        self.wake();
    }

    /// The daemon refuses something that it may allow later. A session that relays a process keeps the reason for it.
    pub(crate) fn keep_refusal(&self, why: String) {
        if !self.options.keeps_refusals {
            return;
        }
        let mut state = self.state();
        let is_first = state.refusals.is_empty();
        if state.refusals.len() < REFUSALS {
            state.refusals.push(why);
        }
        drop(state);
        // The relay was woken for the first refusal. It takes all at once.
        if is_first {
            self.notify(Some(&SessionEvent::Graph));
        }
    }

    /// For a relay: so many samples of `writer` were lost on their way to the session's
    /// subscriptions, before the `first` that comes through this daemon or later.
    pub(crate) fn lost(&self, writer: &Gid, samples: u64, first: bool) {
        let subscriptions: Vec<_> = self.state().subscriptions.values().cloned().collect();
        subscriptions.iter().for_each(|s| s.lock().lost_elsewhere(writer, samples, first));
    }

    pub(super) fn state(&self) -> MutexGuard<'_, SessionState> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// How new endpoints wait for those of other hosts.
    pub(super) fn pair_waits(&self) -> MutexGuard<'_, PairWaits> {
        self.pair_waits.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Has the control thread listen for samples on behalf of one subscription more.
    pub(super) fn listen(&self) -> Result<(), ShmError> {
        if self.listening.begin_callback(&self.segment)? {
            self.wake();
        }
        Ok(())
    }

    /// One subscription has nobody any more who would hear.
    pub(super) fn listen_no_more(&self) {
        if self.listening.end_callback() {
            self.wake();
        }
    }

    /// Has those who wait look again then.
    pub(super) fn look_again(&self, at: Instant) {
        let mut state = self.state();
        let sooner = state.again.is_none_or(|before| at < before);
        if sooner {
            state.again = Some(at);
        }
        drop(state);
        // The control thread itself asks for the same time again and again, and must not wake itself each time.
        if sooner {
            self.wake();
        }
    }

    /// Queues something for the daemon.
    pub(super) fn tell(&self, outgoing: Outgoing) {
        self.state().outgoing.push_back(outgoing);
        self.wake();
    }

    pub(super) fn wake(&self) {
        self.memory.wake();
    }

    pub(super) fn stop(&self) {
        // Pairs with the acquire load of the control thread's loop.
        self.stopping.store(true, Ordering::Release);
        self.wake();
    }

    /// Waits for changes of the state until `reached`, which runs without the state's lock.
    pub(super) fn wait_changed(
        &self,
        timeout: Duration,
        mut reached: impl FnMut() -> bool,
    ) -> bool {
        let deadline = Instant::now().checked_add(timeout);
        loop {
            // Read before `reached` looks, so that a change after it is not missed.
            let seen = self.state().changes;
            if reached() {
                return true;
            }
            let mut state = self.state();
            while state.changes == seen {
                let left =
                    deadline.map_or(Duration::MAX, |d| d.saturating_duration_since(Instant::now()));
                if left.is_zero() {
                    return false;
                }
                let nap = left.min(Duration::from_secs(3600));
                let woken = self.changed.wait_timeout(state, nap);
                state = woken.unwrap_or_else(PoisonError::into_inner).0;
            }
        }
    }

    /// Tells those who wait, and the listener.
    pub(super) fn notify(&self, event: Option<&SessionEvent>) {
        let guards: Vec<GuardCondition> = {
            let mut state = self.state();
            state.changes += 1;
            let graph = matches!(event, Some(SessionEvent::Graph));
            let guards = state.nodes.values().filter(|_| graph);
            guards.map(|(_, guard)| guard.clone()).collect()
        };
        self.changed.notify_all();
        guards.iter().for_each(GuardCondition::trigger);
        let Some(event) = event else { return };
        // Who waits for the control thread's end may hold what a listener waits for. Relaxed: it is no more than that.
        if self.stopping.load(Ordering::Relaxed) {
            return;
        }
        if matches!(event, SessionEvent::Matched(_)) {
            // A writer that died between its last sample and the doorbell leaves that sample to be
            // found by who sleeps for samples.
            self.segment.notify();
        }
        let listener = self.listener.lock().unwrap_or_else(PoisonError::into_inner).clone();
        if let Some(listener) = listener {
            listener(event);
        }
    }
}

impl fmt::Debug for SessionShared {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("SessionShared").field("id", &self.id).finish_non_exhaustive()
    }
}
