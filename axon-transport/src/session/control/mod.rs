//! The control thread of a session: sends the messages that the handles queue, handles the daemon's messages,
//! watches the processes of peers, and connects to the next daemon when the connection is lost.

mod announced;
mod graph;
pub(in crate::session) mod in_process;
mod link;
mod matches;
mod memory;
mod messages;
mod pair_log;
mod pause;
mod peers;
pub(in crate::session) mod pending_endpoints;
mod search;
mod time;

use std::{
    collections::{BTreeMap, VecDeque},
    os::fd::{AsFd, BorrowedFd},
    sync::Arc,
    time::{Duration, Instant},
};

use axon_shm::{ExternalLeader, ShmError, internal::descriptors::PassedFd};
use rustix::event::{PollFd, PollFlags, Timespec, poll};

use self::{
    announced::AnnouncedPairs,
    graph::GraphFollower,
    in_process::{InProcessDaemon, LocalRegistry},
    matches::ChangedMatches,
    memory::AnnouncedMemory,
    pause::ReconnectPause,
    peers::Peers,
    search::Search,
    time::TimedEndpoints,
};
use crate::{
    ids::Gid,
    session::{
        core::Outgoing,
        daemon::{
            connect::Connected,
            socket::{self, SocketError},
        },
        endpoint_state::{EventSource, ServeRequest, SubscriptionInner},
        error::SessionError,
        state::SessionShared,
    },
    wire::session::{Announce, EndpointRole, Gone, SessionMessage},
};

/// Packets that are received before queued ones are sent, so that neither direction starves the other.
const BATCH: usize = 64;
/// Time between attempts of a process that ran out of file descriptors.
const RETRY: Duration = Duration::from_secs(2);
/// Maximum time that an ending session waits for a daemon whose socket is full.
const FAREWELL: Duration = Duration::from_secs(1);
/// Maximum time that an ending session stays for readers that have not taken up their grants from its
/// publishers.
const STAY: Duration = Duration::from_secs(if cfg!(test) { 60 } else { 1 });
/// Maximum number of remote subscriptions that a relay announces by GID. One packet has no room for more.
const MAX_STANDS_FOR: usize = 1024;

/// The messages that wait to be sent to the daemon, with their descriptors.
type Outbox = VecDeque<(SessionMessage, Vec<PassedFd>)>;

/// The control thread of a session.
pub(in crate::session) struct ControlThread {
    shared: Arc<SessionShared>,
    link: DaemonConnection,
    reconnects: bool,
    peers: Peers,
    outbox: Outbox,
    buffer: Vec<u8>,
    graph: GraphFollower,
    /// The pairs that the daemon of this connection has reported.
    pairs: AnnouncedPairs,
    matches: ChangedMatches,
    memory: AnnouncedMemory,
    timed: TimedEndpoints,
    pause: ReconnectPause,
    /// The time to request everything again, after the process ran out of file descriptors.
    retry: Option<Instant>,
}

/// The first peer that a session communicates with.
pub(in crate::session) enum FirstPeer {
    /// A daemon. The session connects to another one if it is gone.
    Daemon(Connected),
    /// The process at the other end of a socket. The session has no other peer afterwards.
    Socket(Connected),
    /// The registry of this process, which connects the sessions of the process.
    LocalRegistry(Arc<LocalRegistry>),
    /// No peer.
    Alone,
}

enum DaemonConnection {
    Socket(PassedFd),
    Local(InProcessDaemon),
    Reconnecting(Search),
    Ended,
}

impl ControlThread {
    pub(in crate::session) fn new(
        shared: Arc<SessionShared>,
        start: FirstPeer,
    ) -> Result<Self, SessionError> {
        let reconnects = matches!(start, FirstPeer::Daemon(_));
        shared.core.segment.is_watched();
        let (segment, memory) = (shared.core.segment.clone(), shared.core.memory.clone());
        let known = shared.core.options.known_peers.clone();
        let peers =
            Peers::new(segment, memory, known).map_err(ShmError::system("watching processes"))?;
        let mut control = Self {
            graph: GraphFollower::new(Arc::clone(&shared)),
            matches: ChangedMatches::new(Arc::clone(&shared)),
            memory: AnnouncedMemory::new(Arc::clone(&shared)),
            timed: TimedEndpoints::new(Arc::clone(&shared)),
            shared,
            link: DaemonConnection::Ended,
            reconnects,
            peers,
            outbox: VecDeque::new(),
            buffer: Vec::new(),
            pairs: AnnouncedPairs::default(),
            pause: ReconnectPause::new(Instant::now()),
            retry: None,
        };
        match start {
            FirstPeer::Daemon(connected) | FirstPeer::Socket(connected) => {
                control.connected(connected)
            }
            FirstPeer::LocalRegistry(local_registry) => {
                control.link = DaemonConnection::Local(InProcessDaemon::join(
                    local_registry,
                    &control.shared.core,
                )?);
            }
            FirstPeer::Alone => {
                control.link = DaemonConnection::Local(InProcessDaemon::alone(&control.shared.core))
            }
        }
        Ok(control)
    }

    pub(in crate::session) fn run(mut self) {
        let _ = self.shared.control.set(std::thread::current().id());
        let mut farewell = None::<Instant>;
        loop {
            let others_stay = self.shared.part_leaving(false);
            if self.shared.core.stops() {
                let until = *farewell.get_or_insert_with(|| Instant::now() + STAY);
                if !others_stay || !self.is_served() || until <= Instant::now() {
                    break;
                }
            }
            self.try_reconnected();
            self.try_again();
            self.matches.report_others(&mut self.graph, &mut self.timed);
            // Match events come before the messages: an endpoint counts its matches before its peers learn of
            // their grants.
            self.report_matches();
            self.collect();
            self.send();
            self.memory.prepare();
            self.timed.handle_timeout();
            self.graph.report_changes();
            self.sleep();
            self.receive();
            self.remove_dead();
            if self.is_linked() {
                self.memory.handle_timeout();
            }
        }
        self.shared.part_leaving(true);
        // The end of the connection replaces the messages that were queued last, such as ENDPOINT_GONE. It
        // does not replace two others: the memory in which readers may find the last samples, and the samples
        // that readers lost.
        let deadline = Instant::now() + FAREWELL;
        loop {
            self.shared.core.segment.tidy();
            self.announce_memory();
            self.tell_unmet();
            self.send_rest(deadline);
            let heard = !self.leaves_notices() || self.was_heard(deadline);
            if heard || !self.find_next_daemon(deadline) {
                return;
            }
        }
    }

    /// Returns whether readers must still be sent memory or a report of lost samples.
    fn leaves_notices(&self) -> bool {
        self.shared.core.segment.has_unread() || !self.shared.state().unmet.is_empty()
    }

    /// Queues the reports about readers that never took up their grant.
    fn tell_unmet(&mut self) {
        if !self.is_linked() {
            return;
        }
        let unmet = self.shared.core.link.take_messages(|m| matches!(m, SessionMessage::Unmet(_)));
        self.outbox.extend(unmet.into_iter().map(|message| (message, Vec::new())));
    }

    /// Ends the connection. Returns false if the daemon was killed and may not have read everything, so that
    /// another daemon must be found.
    fn was_heard(&mut self, deadline: Instant) -> bool {
        match &self.link {
            DaemonConnection::Socket(socket) if socket::finish(socket, deadline) => true,
            DaemonConnection::Socket(_) => {
                self.lost(&SocketError::Closed);
                false
            }
            DaemonConnection::Reconnecting(_) => false,
            DaemonConnection::Local(_) | DaemonConnection::Ended => true,
        }
    }

    /// Waits for the next daemon, to send it the memory and the loss reports that readers still need. Returns
    /// whether one is connected.
    fn find_next_daemon(&mut self, deadline: Instant) -> bool {
        while matches!(self.link, DaemonConnection::Reconnecting(_)) && self.leaves_notices() {
            let left = deadline.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return false;
            }
            let nap = Timespec::try_from(left.min(Duration::from_millis(20))).ok();
            let _ = poll(&mut [PollFd::new(&self.shared.core.waker, PollFlags::IN)], nap.as_ref());
            self.shared.core.waker.take();
            self.try_reconnected();
        }
        if self.is_linked() {
            self.collect();
        }
        self.is_linked()
    }

    /// Sends the queued messages, and waits while the daemon's socket is full.
    fn send_rest(&mut self, deadline: Instant) {
        let mut writable = false;
        loop {
            let queued = self.outbox.len();
            self.send();
            let left = deadline.saturating_duration_since(Instant::now());
            let DaemonConnection::Socket(socket) = &self.link else { return };
            if self.outbox.is_empty() || left.is_zero() {
                return;
            }
            let nap = left.min(Duration::from_millis(20));
            // A socket with too many descriptors in flight is writable and does not signal when that ends.
            if writable && self.outbox.len() == queued {
                std::thread::sleep(nap);
            }
            let nap = Timespec::try_from(nap).ok();
            writable =
                poll(&mut [PollFd::new(socket, PollFlags::OUT)], nap.as_ref()).is_ok_and(|n| n > 0);
        }
    }

    /// Queues a message for the daemon. Segments that the message may refer to are queued first.
    fn say(&mut self, message: SessionMessage) {
        self.announce_memory();
        self.outbox.push_back((message, Vec::new()));
    }

    fn announce_memory(&mut self) {
        self.memory.announce(&mut self.outbox, &self.peers);
    }

    /// Counts the pairs that changed, and reports the changes.
    fn report_matches(&mut self) {
        self.matches.report(&mut self.graph, &mut self.timed);
    }

    fn try_again(&mut self) {
        if self.retry.is_some_and(|retry| retry <= Instant::now()) {
            self.retry = None;
            self.outbox.push_back((SessionMessage::Resync, Vec::new()));
        }
    }

    /// Takes the messages that the handles queued.
    fn collect(&mut self) {
        let shared = self.shared.clone();
        if self.is_linked() {
            self.announce_memory();
        }
        let (mut gone, mut fences) = (Vec::new(), BTreeMap::new());
        // Under this lock endpoints and their queued messages change together.
        let state = shared.state();
        let queued = shared.core.link.take();
        if matches!(self.link, DaemonConnection::Reconnecting(_) | DaemonConnection::Ended) {
            // The next daemon is sent everything, from the state at that time.
            return;
        }
        for outgoing in queued {
            match outgoing {
                Outgoing::Message(message) => {
                    if let SessionMessage::EndpointGone(Gone { gid }) = *message {
                        self.timed.handle_gone();
                        gone.push(gid);
                    }
                    self.say(*message);
                }
                Outgoing::Fence(fence) => {
                    self.announce_memory();
                    if self.memory.is_announced() {
                        self.outbox.push_back((SessionMessage::Fence(fence), Vec::new()));
                    } else {
                        fences.insert(fence.writer, Outgoing::Fence(fence));
                    }
                }
                Outgoing::Announce(gid) => {
                    if let Some(publisher) = state.endpoints.publishers.get(&gid) {
                        self.timed.handle_changed(&EventSource::Publisher(publisher.clone()));
                        let announce = Announce {
                            endpoint: publisher.endpoint.clone(),
                            role: publisher.role,
                            stands_for: Vec::new(),
                            ring: publisher.rings.shared().map(|writer| writer.location()),
                            only: None,
                        };
                        self.say(SessionMessage::Endpoint(announce));
                    } else if let Some(subscription) = state.endpoints.subscriptions.get(&gid) {
                        self.timed.handle_changed(&EventSource::Subscription(subscription.clone()));
                        let announce = Announce {
                            endpoint: subscription.endpoint.clone(),
                            role: subscription.role,
                            stands_for: stands_for(subscription).unwrap_or_default(),
                            ring: None,
                            only: subscription.only,
                        };
                        self.outbox.push_back((SessionMessage::Endpoint(announce), Vec::new()));
                        if subscription.role == EndpointRole::Relay {
                            let lanes = subscription.lock().lanes();
                            for (writer, lane) in lanes {
                                let asking = ServeRequest { lane, after: None };
                                let attach = self.attach_message(subscription, writer, asking);
                                self.say(attach);
                            }
                        }
                    } else if let Some((node, _)) = state.endpoints.nodes.get(&gid) {
                        let announce = Announce {
                            endpoint: node.clone(),
                            role: EndpointRole::Application,
                            stands_for: Vec::new(),
                            ring: None,
                            only: None,
                        };
                        self.outbox.push_back((SessionMessage::Endpoint(announce), Vec::new()));
                    }
                }
            }
        }
        // The process is short of descriptors, so the daemon does not have all segments yet.
        if !fences.is_empty() {
            shared.core.link.put_back(fences.into_values());
        }
        drop(state);
        gone.iter().for_each(|gid| self.graph.handle_own_gone(gid));
    }

    fn send(&mut self) {
        while let Some((message, descriptors)) = self.outbox.pop_front() {
            match &mut self.link {
                DaemonConnection::Local(local) => {
                    for (message, descriptors) in local.exchange(Some((message, descriptors))) {
                        self.handle(message, descriptors);
                    }
                    self.report_matches();
                }
                DaemonConnection::Socket(socket) => {
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
                            // The daemon's last messages matter: REFUSED, or memory that holds samples. A
                            // closed socket receives no further ones, so the loop ends.
                            while matches!(error, SocketError::Closed)
                                && matches!(self.link, DaemonConnection::Socket(_))
                            {
                                self.receive();
                                self.report_matches();
                            }
                            if matches!(self.link, DaemonConnection::Socket(_)) {
                                self.lost(&error);
                            }
                            return;
                        }
                    }
                }
                DaemonConnection::Reconnecting(_) | DaemonConnection::Ended => return,
            }
        }
    }

    fn sleep(&mut self) {
        let deaths = PollFd::from_borrowed_fd(self.peers.deaths(), PollFlags::IN);
        let mut fds = vec![PollFd::new(&self.shared.core.waker, PollFlags::IN), deaths];
        if let DaemonConnection::Socket(socket) = &self.link {
            let waits = if self.outbox.is_empty() { PollFlags::empty() } else { PollFlags::OUT };
            fds.push(PollFd::new(socket, PollFlags::IN | waits));
        }
        let (listening, until) = self.shared.core.listening.leader();
        if let Some(listening) = &listening {
            fds.push(PollFd::new(listening, PollFlags::IN));
            self.tell_arrived(listening);
        }
        // A full socket becomes writable later. A socket with too many descriptors in flight does not signal
        // when that ends.
        let blocked = self.is_linked() && !(self.outbox.is_empty() && self.memory.is_announced());
        let looks = blocked || !self.shared.state().endpoints.leaving.is_empty();
        let nap = looks.then_some(Duration::from_millis(20));
        let memory = self.memory.poll_timeout().filter(|_| self.is_linked());
        let again = self.look_again();
        let due = memory
            .into_iter()
            .chain(self.retry)
            .chain(self.graph.poll_timeout())
            .chain(again)
            .chain(until)
            .min();
        let due = due.map(|due| due.saturating_duration_since(Instant::now()));
        let timeout = nap.into_iter().chain(due).chain(self.timed.poll_timeout()).min();
        let timeout = timeout.and_then(|timeout| Timespec::try_from(timeout).ok());
        let _ = poll(&mut fds, timeout.as_ref());
        self.shared.core.waker.take();
    }

    /// Wakes the waiting threads if their time has come. Returns the next such time.
    fn look_again(&self) -> Option<Instant> {
        let (due, next) = self.shared.core.listening.take_due(Instant::now());
        if due {
            self.shared.core.segment.mark_all_active();
            self.shared.core.segment.notify();
        }
        next
    }

    /// Reports arrived samples to callbacks and tasks. Later samples ring, unless all tasks were woken and
    /// there is no callback: a task arms a ticket of its own before it sleeps again.
    fn tell_arrived(&self, listening: &ExternalLeader) {
        listening.clear();
        let (_, subscriptions) = self.shared.state().endpoints.all();
        // `count` wakes the tasks of all subscriptions; `any` would stop at the first with waiting tasks.
        let wake_tasks =
            || subscriptions.iter().filter(|of| of.wake_tasks(&self.shared.core)).count() > 0;
        if self.shared.core.listening.has_callbacks() || wake_tasks() {
            listening.arm(false);
            subscriptions.iter().for_each(|subscription| subscription.tell_arrived());
            wake_tasks();
        }
    }

    fn receive(&mut self) {
        if let DaemonConnection::Local(local) = &mut self.link {
            for (message, descriptors) in local.exchange(None) {
                self.handle(message, descriptors);
            }
        }
        for _ in 0..BATCH {
            let DaemonConnection::Socket(socket) = &self.link else { return };
            match socket::receive(socket, &mut self.buffer) {
                Ok(received) => self.handle(received.message, received.descriptors),
                Err(SocketError::NotReady) => return,
                Err(error @ SocketError::NoDescriptors) => {
                    // After a new connection, this session would announce all endpoints again, and others
                    // would have to match them again.
                    tracing::error!(
                        %error,
                        "lost a daemon message: out of file descriptors; requesting it again in {RETRY:?}"
                    );
                    self.retry.get_or_insert_with(|| Instant::now() + RETRY);
                }
                Err(error) => return self.lost(&error),
            }
        }
        self.shared.core.wake();
    }

    /// Removes the endpoints of processes that have died.
    fn remove_dead(&mut self) {
        if !self.peers.note_deaths() {
            return;
        }
        let (publishers, subscriptions) = self.shared.state().endpoints.all();
        for publisher in publishers {
            if publisher.drop_dead() {
                self.matches.add_writer(&publisher);
                // A server keeps the responses of a client that a daemon carried. If the client does not
                // return, the responses are freed.
                self.memory.check_later();
            }
        }
        for subscription in subscriptions {
            if subscription.lock().end_dead() {
                self.matches.add_reader(&subscription);
            }
        }
    }
}

/// Returns the remote subscriptions that a relay reads for.
fn stands_for(subscription: &SubscriptionInner) -> Option<Vec<Gid>> {
    (subscription.role == EndpointRole::Relay).then(|| {
        let mut gids = subscription.stands_for();
        gids.truncate(MAX_STANDS_FOR);
        gids
    })
}
