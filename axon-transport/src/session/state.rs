//! The state of a session, which its handles and its control thread share.

use std::{
    collections::{BTreeMap, BTreeSet, HashMap, VecDeque},
    fmt,
    os::fd::OwnedFd,
    sync::{
        Arc, Condvar, Mutex, MutexGuard, OnceLock, PoisonError,
        atomic::{AtomicBool, AtomicU64, Ordering},
    },
    thread::ThreadId,
    time::{Duration, Instant},
};

use axon_shm::{
    ShmError,
    internal::{SegmentEvent, SessionSegment},
};

use super::{
    SessionOptions,
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
    wire::session::{EndpointRole, Fence, Gone, Message, StatusPart, Unmet},
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

type Listener = Arc<dyn Fn(&SessionEvent) + Send + Sync>;

pub(crate) struct SessionShared {
    pub(crate) config: Config,
    pub(crate) options: SessionOptions,
    pub(crate) id: SessionId,
    pub(super) segment: Arc<SessionSegment>,
    /// Wakes the control thread (an eventfd).
    pub(super) wake: Arc<OwnedFd>,
    pub(super) memory: Arc<MemoryNews>,
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

/// What changed in the session's own memory, and whether other sessions' is missing. Of use under any
/// lock.
pub(super) struct MemoryNews {
    wake: Arc<OwnedFd>,
    changes: Mutex<Vec<SegmentChange>>,
    /// Counts what readers have to be sent before they find samples.
    handovers: AtomicU64,
    /// Counts the times that the daemon was told, or tells, everything from the beginning.
    connections: AtomicU64,
}

/// What became of the session's own memory, or is to be asked of another's.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum SegmentChange {
    Opened(u32),
    Gone(u32),
    /// This publisher has no memory ready for its next large sample.
    Low(Gid),
    /// Readers miss memory of this other session.
    Wanted(SessionId),
}

impl MemoryNews {
    fn note(&self, event: SegmentEvent<'_>) {
        match event {
            SegmentEvent::Opened(info, _) => {
                self.push(SegmentChange::Opened(info.number));
                self.hands_over();
            }
            SegmentEvent::Gone(info) => self.push(SegmentChange::Gone(info.number)),
            SegmentEvent::Low(publisher) => self.push(SegmentChange::Low(publisher)),
        }
    }

    /// Readers have to be sent something more: memory that was opened, a grant, or all of it by another
    /// daemon.
    pub(super) fn hands_over(&self) {
        // Relaxed: this is counted before the writer's lock is taken, and the publishing thread reads it
        // under that lock or after.
        self.handovers.fetch_add(1, Ordering::Relaxed);
    }

    /// The daemon is another one, or tells everything anew: it may not answer what it was asked before.
    pub(super) fn begins_anew(&self) {
        // Relaxed: a question that is asked once more is answered once more.
        self.connections.fetch_add(1, Ordering::Relaxed);
        self.hands_over();
    }

    /// How often that was so.
    pub(super) fn connections(&self) -> u64 {
        self.connections.load(Ordering::Relaxed)
    }

    /// How often readers had to be sent something more. Read after a sample was published, it covers all that its readers need.
    pub(super) fn handovers(&self) -> u64 {
        self.handovers.load(Ordering::Relaxed)
    }

    /// Readers miss memory of another session.
    pub(super) fn want(&self, session: SessionId) {
        self.push(SegmentChange::Wanted(session));
    }

    fn push(&self, change: SegmentChange) {
        self.changes.lock().unwrap_or_else(PoisonError::into_inner).push(change);
        self.wake();
    }

    pub(super) fn take(&self) -> Vec<SegmentChange> {
        std::mem::take(&mut *self.changes.lock().unwrap_or_else(PoisonError::into_inner))
    }

    /// Has the control thread look around.
    pub(super) fn wake(&self) {
        // An eventfd whose counter is full is readable, which is all that is wanted.
        let _ = rustix::io::write(&self.wake, &1u64.to_ne_bytes());
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

/// The parts of a status that have come.
#[derive(Debug, Default)]
pub(super) struct StatusText {
    text: Vec<u8>,
    next: u32,
}

/// The longest status that is put together.
const MAX_STATUS: usize = 64 << 20;

impl StatusText {
    /// Adds the part that is due; the whole, once it was the last. The first one may come again, for
    /// a caller that asks again; any other part is of an answer that nobody waits for any more.
    pub(super) fn add(&mut self, part: &StatusPart) -> Option<Vec<u8>> {
        if part.part == 0 {
            *self = Self::default();
        }
        if part.part != self.next || self.text.len() + part.text.len() > MAX_STATUS {
            return None;
        }
        self.text.extend_from_slice(&part.text);
        self.next += 1;
        (self.next >= part.parts).then(|| std::mem::take(&mut self.text))
    }
}

#[derive(Debug, Default)]
pub(super) enum StatusAnswer {
    #[default]
    None,
    Parts(StatusText),
    Whole(Vec<u8>),
    Lost,
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
        let memory = Arc::new(MemoryNews {
            wake: wake.clone(),
            changes: Mutex::default(),
            handovers: AtomicU64::new(0),
            connections: AtomicU64::new(0),
        });
        let listener = memory.clone();
        segment.on_segment(move |event| listener.note(event));
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_status_is_put_together_of_its_own_parts_only() {
        let mut status = StatusText::default();
        let mut add =
            |part, text: &[u8]| status.add(&StatusPart { part, parts: 3, text: text.into() });
        assert_eq!(add(2, b"the end of another"), None);
        assert_eq!(add(0, b"first"), None);
        assert_eq!(add(2, b"one was lost"), None);
        assert_eq!(add(0, b"a"), None, "it begins again");
        assert_eq!(add(1, b"b"), None);
        assert_eq!(add(2, b"c"), Some(b"abc".to_vec()));
    }
}
