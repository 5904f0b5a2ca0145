//! The control thread: sends what the handles queue, handles what the daemon says, watches peers
//! for their death, and finds another daemon when the old one is gone.

mod graph;
mod handle;
mod time;

use std::{
    collections::{BTreeSet, HashSet, VecDeque},
    os::fd::{AsFd, BorrowedFd},
    sync::{
        Arc,
        atomic::Ordering,
        mpsc::{Receiver, TryRecvError, sync_channel},
    },
    time::{Duration, Instant},
};

use rustix::event::{PollFd, PollFlags, Timespec, poll};

use super::{
    arrivals::Arrivals,
    connect::{Caller, Connected},
    error::SessionError,
    events::Source,
    local::{House, Local},
    message::{Announce, EndpointRole, Gone, Message, Pair, SegmentName, SegmentOpened},
    peers::Peers,
    socket::{self, SocketError},
    state::{Outgoing, SegmentChange, SessionEvent, Shared, StatusAnswer},
};
use crate::{graph::GraphView, ids::Gid, passed::PassedFd, wait::ExternalLeader};

/// Packets handled before queued ones are sent: neither direction starves the other.
const BATCH: usize = 64;
/// Between attempts to find a daemon.
const MIN_PAUSE: Duration = Duration::from_millis(100);
const MAX_PAUSE: Duration = Duration::from_secs(2);
/// A connection that lasted less was as good as refused.
const BRIEF: Duration = Duration::from_secs(1);
/// Until a process that had no descriptors left tries again.
const RETRY: Duration = Duration::from_secs(2);
/// How often the memory of large samples is looked after.
const TEND: Duration = Duration::from_secs(1);
/// A relay stands for at most this many remote subscriptions by name; one packet holds no more.
const MAX_STANDS_FOR: usize = 1024;

pub(super) struct Control {
    shared: Arc<Shared>,
    link: Link,
    reconnects: bool,
    peers: Peers,
    outbox: VecDeque<(Message, Vec<PassedFd>)>,
    buffer: Vec<u8>,
    /// A whole graph of which parts are still to come.
    building: Option<GraphView>,
    /// Pairs that the daemon repeated since it began to tell everything anew.
    repeated: Option<HashSet<Pair>>,
    /// Whether this connection has brought a whole graph already.
    told: bool,
    /// When to look after the memory of large samples, while there is any.
    tend: Option<Instant>,
    /// The segments of our memory that this connection was told of.
    segments: BTreeSet<u32>,
    /// Those that it could not be told of, for want of descriptors.
    untold: BTreeSet<u32>,
    /// Publishers that have no memory ready for their next large sample.
    low: BTreeSet<Gid>,
    /// When this connection was made, and how long the search for the next one waits first: one
    /// that does not last is not to be had at once again, at the cost of everybody else.
    since: Instant,
    pause: Duration,
    /// This process had no descriptors left: when it asks to be told everything anew.
    retry: Option<Instant>,
    arrivals: Arrivals,
    /// The graph is another one than was last told.
    graph_changed: bool,
    /// Endpoints of whom somebody watches the time, unless they are to be looked for anew.
    timed: Option<Vec<Source>>,
    /// When to look at them, by the monotonic clock.
    alarm: Option<u64>,
}

/// With whom a session speaks first.
pub(super) enum Start {
    /// A daemon; another one when it is gone.
    Daemon(Connected),
    /// Whoever is at the other end of a socket, and nobody after it.
    Socket(Connected),
    /// The registry of its own process.
    House(Arc<House>),
}

enum Link {
    Socket(PassedFd),
    Local(Local),
    Reconnecting(Receiver<Connected>),
    Ended,
}

impl Control {
    pub(super) fn new(shared: Arc<Shared>, start: Start) -> Result<Self, SessionError> {
        let reconnects = matches!(start, Start::Daemon(_));
        let peers = Peers::new(shared.segment.clone(), shared.memory.clone());
        let mut control = Self {
            shared,
            link: Link::Ended,
            reconnects,
            peers,
            outbox: VecDeque::new(),
            buffer: Vec::new(),
            building: None,
            repeated: None,
            told: false,
            tend: None,
            segments: BTreeSet::new(),
            untold: BTreeSet::new(),
            low: BTreeSet::new(),
            since: Instant::now(),
            pause: Duration::ZERO,
            retry: None,
            arrivals: Arrivals::default(),
            graph_changed: false,
            timed: None,
            alarm: None,
        };
        match start {
            Start::Daemon(connected) | Start::Socket(connected) => control.connected(connected),
            Start::House(house) => {
                control.link = Link::Local(Local::new(house, &control.shared)?);
            }
        }
        Ok(control)
    }

    pub(super) fn run(mut self) {
        let _ = self.shared.control.set(std::thread::current().id());
        // Pairs with the release store in `Shared::stop`.
        while !self.shared.stopping.load(Ordering::Acquire) {
            self.try_reconnected();
            self.try_again();
            self.collect();
            self.send();
            self.prepare();
            self.look_at_time();
            self.tell_graph();
            self.sleep();
            self.receive();
            self.bury();
            self.tend();
        }
        // What was queued last, such as ENDPOINT_GONE, is said by the end of the connection. Only
        // of memory, in which readers may find the last samples, nobody else could tell.
        self.tell_segments();
        self.send();
    }

    fn connected(&mut self, connected: Connected) {
        self.outbox.clear();
        self.building = None;
        self.repeated = None;
        self.told = false;
        self.segments.clear();
        self.untold.clear();
        self.since = Instant::now();
        self.retry = None;
        let daemon = connected.welcome.daemon;
        {
            let mut state = self.shared.state();
            state.daemon = Some(daemon);
            state.outgoing.clear();
            let endpoints = state.publishers.keys().chain(state.subscriptions.keys());
            let gids: BTreeSet<Gid> = state.nodes.keys().chain(endpoints).copied().collect();
            let gone: Vec<Gid> = state.tombstones.iter().copied().collect();
            state.outgoing.extend(gids.into_iter().map(Outgoing::Announce));
            let gone = gone.into_iter().map(|gid| Message::EndpointGone(Gone { gid }));
            state.outgoing.extend(gone.map(|m| Outgoing::Message(Box::new(m))));
        }
        self.link = Link::Socket(PassedFd::connection(connected.socket).trusted());
        for info in self.shared.segment.segments() {
            self.tell_segment(SegmentChange::Opened(info.number));
        }
        self.shared.notify(Some(&SessionEvent::DaemonFound(daemon)));
    }

    fn lost(&mut self, why: &dyn std::fmt::Display) {
        tracing::warn!(%why, "the connection to the daemon is lost");
        self.outbox.clear();
        {
            let mut state = self.shared.state();
            state.daemon = None;
            if matches!(state.status, StatusAnswer::Parts(_)) {
                state.status = StatusAnswer::Lost;
            }
        }
        self.pause = if self.since.elapsed() < BRIEF {
            (self.pause * 2).clamp(MIN_PAUSE, MAX_PAUSE)
        } else {
            Duration::ZERO
        };
        self.link = if self.reconnects { self.reconnect() } else { Link::Ended };
        self.shared.notify(Some(&SessionEvent::DaemonLost));
    }

    /// Looks for a daemon on a thread of its own: meanwhile peers may die.
    fn reconnect(&self) -> Link {
        let shared = self.shared.clone();
        let (found, receiver) = sync_channel(1);
        let first = self.pause;
        let search = move || {
            std::thread::sleep(first);
            let mut pause = MIN_PAUSE;
            // Pairs with the release store in `Shared::stop`.
            while !shared.stopping.load(Ordering::Acquire) {
                let caller = Caller {
                    config: &shared.config,
                    options: &shared.options,
                    id: shared.id,
                    segment: Some(&shared.segment),
                    relay: None,
                    cancel: Some(&shared.stopping),
                };
                match caller.connect() {
                    Ok(connected) => {
                        let _ = found.send(connected);
                        shared.wake();
                        return;
                    }
                    Err(SessionError::NoDaemon { .. }) => {}
                    Err(error) => tracing::error!(%error, "no daemon took this session"),
                }
                std::thread::sleep(pause);
                pause = (pause * 2).min(MAX_PAUSE);
            }
        };
        match std::thread::Builder::new().name("axon-connect".into()).spawn(search) {
            Ok(_) => Link::Reconnecting(receiver),
            Err(error) => {
                tracing::error!(%error, "no thread to look for a daemon with");
                Link::Ended
            }
        }
    }

    fn try_reconnected(&mut self) {
        let Link::Reconnecting(receiver) = &self.link else { return };
        match receiver.try_recv() {
            Ok(connected) => self.connected(connected),
            Err(TryRecvError::Empty) => {}
            Err(TryRecvError::Disconnected) => self.link = Link::Ended,
        }
    }

    fn is_linked(&self) -> bool {
        matches!(self.link, Link::Socket(_) | Link::Local(_))
    }

    /// Queues a message for the daemon, behind what it must know of memory that the message may
    /// speak of.
    fn say(&mut self, message: Message) {
        self.tell_segments();
        self.outbox.push_back((message, Vec::new()));
    }

    /// Takes what changed in the session's memory, and what its readers lack of others'.
    fn tell_segments(&mut self) {
        for number in self.untold.clone() {
            self.tell_segment(SegmentChange::Opened(number));
        }
        for change in self.shared.memory.take() {
            self.tell_segment(change);
        }
        for session in self.peers.sessions() {
            for number in session.take_wanted() {
                let need = SegmentName { session: session.id(), number };
                self.outbox.push_back((Message::Need(need), Vec::new()));
            }
        }
    }

    fn tell_segment(&mut self, change: SegmentChange) {
        let session = self.shared.id;
        match change {
            // Found here and noted there.
            SegmentChange::Opened(number) if self.segments.contains(&number) => {}
            SegmentChange::Opened(number) => match self.shared.segment.segment(number) {
                Ok(Some((info, descriptor))) => {
                    self.segments.insert(number);
                    self.untold.remove(&number);
                    let opened = SegmentOpened { session, segment: info.into() };
                    self.outbox.push_back((Message::Segment(opened), vec![descriptor.into()]));
                }
                // It is gone again.
                Ok(None) => {
                    self.untold.remove(&number);
                }
                Err(error) => {
                    if self.untold.insert(number) {
                        tracing::error!(%error, "samples stay unseen by others until there is one");
                    }
                }
            },
            SegmentChange::Gone(number) => {
                self.segments.remove(&number);
                self.untold.remove(&number);
                let gone = SegmentName { session, number };
                self.outbox.push_back((Message::SegmentGone(gone), Vec::new()));
            }
            SegmentChange::Low(gid) => {
                self.low.insert(gid);
            }
        }
    }

    /// Has memory ready for those that publish large samples.
    fn prepare(&mut self) {
        for gid in std::mem::take(&mut self.low) {
            let publisher = self.shared.state().publishers.get(&gid).cloned();
            if let Some(publisher) = publisher {
                // What lacks then, its next publish says.
                publisher.rings.prepare();
                self.look_after_memory();
            }
        }
    }

    fn try_again(&mut self) {
        if self.retry.is_some_and(|retry| retry <= Instant::now()) {
            self.retry = None;
            self.outbox.push_back((Message::Resync, Vec::new()));
        }
    }

    /// Takes what the handles queued.
    fn collect(&mut self) {
        let shared = self.shared.clone();
        if self.is_linked() {
            self.tell_segments();
        }
        let mut gone = Vec::new();
        let mut state = shared.state();
        if !state.outgoing.is_empty() {
            self.timed = None;
        }
        if matches!(self.link, Link::Reconnecting(_) | Link::Ended) {
            // All of it is said to the next daemon from what stands then.
            state.outgoing.clear();
            return;
        }
        while let Some(outgoing) = state.outgoing.pop_front() {
            match outgoing {
                Outgoing::Message(message) => {
                    if let Message::EndpointGone(Gone { gid }) = *message {
                        gone.push(gid);
                    }
                    self.say(*message);
                }
                Outgoing::Announce(gid) => {
                    if let Some(publisher) = state.publishers.get(&gid) {
                        let announce = Announce {
                            endpoint: publisher.endpoint.clone(),
                            role: publisher.role,
                            stands_for: Vec::new(),
                            ring: publisher.rings.shared().map(|writer| writer.location()),
                        };
                        self.say(Message::Endpoint(announce));
                    } else if let Some(subscription) = state.subscriptions.get(&gid) {
                        let announce = Announce {
                            endpoint: subscription.endpoint.clone(),
                            role: subscription.role,
                            stands_for: stands_for(subscription),
                            ring: None,
                        };
                        self.outbox.push_back((Message::Endpoint(announce), Vec::new()));
                        if subscription.role == EndpointRole::Relay {
                            let lanes = subscription.lock().lanes();
                            for (writer, lane) in lanes {
                                let attach = self.attach_message(subscription, writer, lane);
                                self.say(attach);
                            }
                        }
                    } else if let Some((node, _)) = state.nodes.get(&gid) {
                        let announce = Announce {
                            endpoint: node.clone(),
                            role: EndpointRole::Application,
                            stands_for: Vec::new(),
                            ring: None,
                        };
                        self.outbox.push_back((Message::Endpoint(announce), Vec::new()));
                    }
                }
            }
        }
        drop(state);
        gone.iter().for_each(|gid| self.own_gone(gid));
    }

    fn send(&mut self) {
        while let Some((message, descriptors)) = self.outbox.pop_front() {
            match &mut self.link {
                Link::Local(local) => {
                    for (message, descriptors) in local.exchange(Some((message, descriptors))) {
                        self.handle(message, descriptors);
                    }
                }
                Link::Socket(socket) => {
                    let packet = match message.encode() {
                        Ok(packet) => packet,
                        Err(error) => {
                            tracing::error!(%error, "a control message was dropped");
                            continue;
                        }
                    };
                    let fds: Vec<BorrowedFd<'_>> = descriptors.iter().map(AsFd::as_fd).collect();
                    match socket::send(&*socket, &packet, &fds) {
                        Ok(()) => {}
                        Err(SocketError::NotReady) => {
                            self.outbox.push_front((message, descriptors));
                            return;
                        }
                        Err(error) => {
                            // What the daemon said last, such as REFUSED, is worth hearing.
                            self.receive();
                            if matches!(self.link, Link::Socket(_)) {
                                self.lost(&error);
                            }
                            return;
                        }
                    }
                }
                Link::Reconnecting(_) | Link::Ended => return,
            }
        }
    }

    fn sleep(&mut self) {
        let sessions: Vec<_> = self.peers.sessions().cloned().collect();
        let mut fds = vec![PollFd::new(&self.shared.wake, PollFlags::IN)];
        if let Link::Socket(socket) = &self.link {
            let waits = if self.outbox.is_empty() { PollFlags::empty() } else { PollFlags::OUT };
            fds.push(PollFd::new(socket, PollFlags::IN | waits));
        }
        fds.extend(sessions.iter().map(|s| PollFd::from_borrowed_fd(s.pidfd(), PollFlags::IN)));
        let listening = self.shared.listening();
        if let Some(listening) = &listening {
            fds.push(PollFd::new(listening, PollFlags::IN));
            self.tell_arrived(listening);
        }
        // A socket without room becomes writable, but one that is short of descriptors in flight
        // does not say when that passes.
        let blocked = self.is_linked() && !(self.outbox.is_empty() && self.untold.is_empty());
        let nap = blocked.then_some(Duration::from_millis(20));
        let tend = self.tend.filter(|_| self.is_linked());
        let due = tend.into_iter().chain(self.retry).chain(self.arrivals.due()).min();
        let due = due.map(|due| due.saturating_duration_since(Instant::now()));
        let timeout = nap.into_iter().chain(due).chain(self.until_alarm()).min();
        let timeout = timeout.and_then(|timeout| Timespec::try_from(timeout).ok());
        let _ = poll(&mut fds, timeout.as_ref());
        let mut count = [0; 8];
        let _ = rustix::io::read(&self.shared.wake, &mut count);
    }

    /// Tells those who want to hear of samples as they come. What comes later rings.
    fn tell_arrived(&self, listening: &ExternalLeader) {
        listening.clear();
        listening.arm(false);
        let (_, subscriptions) = self.endpoints();
        subscriptions.iter().for_each(|subscription| subscription.tell_arrived());
    }

    fn receive(&mut self) {
        if let Link::Local(local) = &mut self.link {
            for (message, descriptors) in local.exchange(None) {
                self.handle(message, descriptors);
            }
        }
        for _ in 0..BATCH {
            let Link::Socket(socket) = &self.link else { return };
            match socket::receive(socket, &mut self.buffer) {
                Ok(received) => self.handle(received.message, received.descriptors),
                Err(SocketError::NotReady) => return,
                Err(error @ SocketError::NoDescriptors) => {
                    // Others would have to match anew what a new connection has it announce.
                    tracing::error!(%error, "what the daemon said is asked for again");
                    self.retry.get_or_insert_with(|| Instant::now() + RETRY);
                }
                Err(error) => return self.lost(&error),
            }
        }
        self.shared.wake();
    }

    /// There is memory that may have to be given back.
    pub(super) fn look_after_memory(&mut self) {
        self.tend.get_or_insert_with(|| Instant::now() + TEND);
    }

    /// Looks after the memory of large samples and of publishers that are gone. Memory that is given up may have to be opened anew,
    /// and only a daemon can say so to the readers: so not while there is none.
    fn tend(&mut self) {
        let now = Instant::now();
        if !self.is_linked() || self.tend.is_none_or(|due| now < due) {
            return;
        }
        let publishers: Vec<_> = self.shared.state().publishers.values().cloned().collect();
        let more = publishers.iter().filter(|publisher| publisher.rings.tend(now)).count();
        let more = self.shared.segment.tidy() || more > 0;
        self.tend = more.then(|| now + TEND);
    }

    /// Looks for peers that died.
    fn bury(&mut self) {
        if self.peers.take_dead().is_empty() {
            return;
        }
        let (publishers, subscriptions) = self.endpoints();
        for publisher in publishers {
            if publisher.drop_dead() {
                self.writer_changed(&publisher);
            }
        }
        for subscription in subscriptions {
            if subscription.lock().end_dead() {
                self.reader_changed(&subscription);
            }
        }
    }
}

fn stands_for(subscription: &super::subscription::SubscriptionInner) -> Vec<Gid> {
    let mut gids = subscription.stands_for();
    gids.truncate(MAX_STANDS_FOR);
    gids
}
