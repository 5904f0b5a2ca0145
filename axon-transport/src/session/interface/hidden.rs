//! Methods of an application's types for the daemon, its relays and stand-ins, and this crate. They are hidden in the
//! documentation, are no part of the interface, and change with any release.

use std::{
    collections::{BTreeMap, HashMap},
    ops::Range,
    os::fd::OwnedFd,
    sync::Arc,
    time::{Duration, SystemTime},
};

use axon_shm::{Meta, PublishError, Sample, internal::SessionSegment};

use super::Node;
use crate::{
    config::Config,
    graph::Endpoint,
    ids::{Gid, SessionId},
    qos::Durability,
    session::{
        control::FirstPeer,
        core::Outgoing,
        daemon::connect::Caller,
        endpoint_state::{Lifetime, MessageInfo, SubscriptionInner, TakeLimit},
        endpoints::{Publisher, Server, Subscription},
        error::SessionError,
        handle::Session,
        options::{EndpointSpec, SessionOptions},
    },
    wire::session::{EndpointRole, RelayGivenUp, SessionMessage, SessionRole},
};

#[doc(hidden)]
impl MessageInfo {
    /// Of a sample with this number, of no particular time.
    pub fn of(publisher: Gid, sequence: u64) -> Self {
        let [source_timestamp, received_timestamp] = [SystemTime::UNIX_EPOCH; 2];
        let (reception, lifetime) = (sequence, None);
        Self { publisher, sequence, source_timestamp, received_timestamp, reception, lifetime }
    }
}

#[doc(hidden)]
impl Lifetime {
    /// A sample of this age and lifespan.
    pub fn new(age: Duration, lifespan: Duration) -> Self {
        Self { age, lifespan }
    }
}

#[doc(hidden)]
impl Session {
    /// A session over a socket that is connected to a daemon. It ends with that connection.
    ///
    /// # Errors
    /// When the daemon refuses it.
    pub fn over(
        socket: OwnedFd,
        config: &Config,
        options: SessionOptions,
    ) -> Result<Self, SessionError> {
        Self::over_as(SessionId::random(), socket, config, options)
    }

    /// As [`over`](Self::over), under a given id: for the daemon, in whose memory the endpoints of a
    /// relayed session are.
    pub fn over_as(
        id: SessionId,
        socket: OwnedFd,
        config: &Config,
        options: SessionOptions,
    ) -> Result<Self, SessionError> {
        let segment = SessionSegment::create(id)?;
        let caller = Caller { segment: Some(&segment), ..Caller::new(config, &options, id) };
        let connected = caller.greet_over(socket)?;
        Ok(Self::of(Self::start(config, options, segment, FirstPeer::Socket(connected))?))
    }

    /// A subscription as another process of the session describes it, under its GID there. Where it
    /// keeps all, what it takes is acknowledged when it [says so](Subscription::acknowledge_of).
    pub fn adopt_subscription(&self, endpoint: Endpoint) -> Subscription {
        let mut inner = SubscriptionInner::new(endpoint, EndpointRole::Application, Vec::new());
        inner.carries = inner.keeps_all();
        self.add_reader(inner)
    }

    /// As [`adopt_subscription`](Self::adopt_subscription), a node.
    pub fn adopt_node(&self, endpoint: Endpoint) -> Node {
        let gid = endpoint.gid;
        let changed = self.create_guard_condition();
        {
            let mut state = self.shared().state();
            state.endpoints.nodes.insert(gid, (endpoint.clone(), changed.clone()));
            state.graph.show(&endpoint);
        }
        self.core().tell(Outgoing::Announce(gid));
        Node::new(endpoint, changed, self.clone())
    }

    /// A local reader that carries samples to subscriptions on another host, `stands_for`. For the
    /// gateway alone; a daemon refuses it from anybody else.
    ///
    /// # Errors
    /// When the specification is out of bounds.
    pub fn create_relay(
        &self,
        spec: EndpointSpec,
        stands_for: Vec<Gid>,
    ) -> Result<Subscription, SessionError> {
        self.add_relay(spec, None, stands_for, false)
    }

    /// The session's segment, for waiting in other ways.
    pub fn segment(&self) -> &Arc<SessionSegment> {
        &self.core().segment
    }

    /// Its endpoints that the daemon does not take, and why.
    pub fn refused(&self) -> BTreeMap<Gid, String> {
        self.shared().state().graph.refused.clone()
    }

    /// What the daemon refused since the last call of no endpoint for good, where the options say that it is kept.
    pub fn take_refusals(&self) -> Vec<String> {
        self.core().link.take_refusals()
    }
}

#[doc(hidden)]
impl SessionOptions {
    /// Another kind of session.
    #[must_use]
    pub fn role(mut self, role: SessionRole) -> Self {
        self.role = role;
        self
    }

    /// Keeps what the daemon refuses of no endpoint for good.
    #[must_use]
    pub fn keep_refusals(mut self) -> Self {
        self.keeps_refusals = true;
        self
    }

    /// How many clients its servers may have, each counted once for each of them.
    #[must_use]
    pub fn callers(mut self, most: usize) -> Self {
        self.callers = most;
        self
    }
}

#[doc(hidden)]
impl Publisher {
    /// Publishes for a remote publisher, whose number and time the sample keeps.
    ///
    /// # Errors
    /// As for [`publish`](Self::publish).
    pub fn publish_with(&self, meta: Meta, payload: &[u8]) -> Result<(), PublishError> {
        self.inner.published(self.writer.publish(meta, payload)).map(drop)
    }

    /// As [`publish_with`](Self::publish_with), but never waits for room.
    ///
    /// # Errors
    /// [`PublishError::Blocked`] at once when there is none.
    pub fn try_publish_with(&self, meta: Meta, payload: &[u8]) -> Result<(), PublishError> {
        self.inner.published(self.writer.try_publish(meta, payload)).map(drop)
    }

    /// As [`try_publish_with`](Self::try_publish_with), but readers that sleep may sleep on until
    /// [`announce`](Self::announce).
    ///
    /// # Errors
    /// As for [`try_publish_with`](Self::try_publish_with).
    pub fn try_publish_quietly(&self, meta: Meta, payload: &[u8]) -> Result<(), PublishError> {
        self.inner.published(self.writer.try_publish_quietly(meta, payload)).map(drop)
    }

    /// Wakes the readers that sleep, for samples that were published
    /// [quietly](Self::try_publish_quietly).
    pub fn announce(&self) {
        self.writer.announce();
    }
}

#[doc(hidden)]
impl Subscription {
    /// For a relay: the publishers that may still send samples. A publisher that has ended is among them while
    /// samples of it are on their way.
    pub fn attached(&self) -> Vec<Gid> {
        let mut gids = self.matched();
        if !self.session.is_forked() {
            gids.extend(self.inner.lock().slots().leaving());
        }
        gids
    }

    /// For a relay: the next sample of one publisher, and how many of that publisher's this
    /// subscription has lost by then.
    pub fn take_from(&self, writer: &Gid) -> Option<(Sample, u64)> {
        if self.session.is_forked() {
            return None;
        }
        self.inner.sample_of(writer)
    }

    /// For a relay: how many samples of this publisher newer ones replaced before they were taken.
    pub fn lost_of(&self, writer: &Gid) -> u64 {
        if self.session.is_forked() { 0 } else { self.inner.lock().lost_of(writer) }
    }

    /// For a relay: passes over all samples of this publisher but the newest `depth`, which count as
    /// [lost](Self::lost_of).
    pub fn skip_of(&self, writer: &Gid, depth: u64) {
        if !self.session.is_forked() {
            self.inner.lock().skip_of(writer, depth);
        }
    }

    /// For a relay: what was taken and not acknowledged is to be taken once more; where its publisher
    /// keeps a history, all of that.
    pub fn take_back(&self) {
        if !self.session.is_forked() {
            let history = self.inner.qos.durability == Durability::TransientLocal;
            self.inner.lock().take_back(history);
        }
    }

    /// For a relay: samples of this publisher up to this number are where they are to go. Until then
    /// nobody takes them as acknowledged.
    pub fn acknowledge_of(&self, writer: &Gid, sequence: u64) {
        if !self.session.is_forked() {
            self.inner.lock().finish_of(writer, sequence);
        }
    }

    /// For a relay: samples that are not acknowledged, those that were not taken among them, by
    /// publisher.
    pub fn unacknowledged(&self) -> HashMap<Gid, u64> {
        if self.session.is_forked() { HashMap::new() } else { self.inner.lock().slots().undone() }
    }

    /// For a relay: bytes that the samples of this publisher take that are not acknowledged.
    pub fn unacknowledged_bytes_of(&self, writer: &Gid) -> u64 {
        if self.session.is_forked() { 0 } else { self.inner.lock().slots().undone_bytes_of(writer) }
    }

    /// For a relay: how many publishes of this publisher found no room since readers were not done with its oldest sample,
    /// if this one is not.
    pub fn refused_of(&self, writer: &Gid) -> Option<u64> {
        if self.session.is_forked() { None } else { self.inner.lock().slots().refused_of(writer) }
    }

    /// For a relay: so many samples of this publisher do not get where they are to go. It is told.
    pub fn give_up(&self, writer: Gid, samples: u64) {
        if self.session.is_forked() {
            return;
        }
        // The publisher sees it before it sees that they are acknowledged. Its process is told besides: it
        // may be of an older version, and the publisher may wait for acknowledgements.
        self.inner.lock().give_up_of(&writer, samples);
        let given_up = RelayGivenUp { reader: self.gid(), writer, samples };
        self.session.core().tell(Outgoing::message(SessionMessage::GivenUp(given_up)));
    }

    /// For a relay: the next sample of one publisher, as bytes.
    pub fn take_of(&self, writer: &Gid) -> Option<(MessageInfo, Vec<u8>)> {
        self.inner.take_of(self.session.core(), writer)
    }

    /// For a relay: the next samples of one publisher, with their payloads one behind the other in `out`, which
    /// they replace. `each` is told where a sample's payload is. Returns how many samples it took.
    pub fn take_many_of(
        &self,
        writer: &Gid,
        most: TakeLimit,
        out: &mut Vec<u8>,
        each: impl FnMut(MessageInfo, Range<usize>),
    ) -> usize {
        self.inner.take_many_of(self.session.core(), writer, most, out, each)
    }

    /// The publishers of which there is something to take.
    pub fn with_data(&self) -> Vec<Gid> {
        if self.session.is_forked() {
            Vec::new()
        } else {
            self.inner.lock().slots().with_data().collect()
        }
    }

    /// Whether it reads what this publisher writes or wrote, or may do so soon.
    pub fn reads(&self, writer: &Gid) -> bool {
        !self.session.is_forked() && self.inner.lock().reads(writer)
    }

    /// Whether it is RELIABLE and KEEP_ALL.
    pub fn may_lose_nothing(&self) -> bool {
        self.inner.keeps_all()
    }

    /// Whether samples of `writer` wait that cannot be taken yet, for want of its memory or of our own.
    pub fn is_held_up(&self, writer: &Gid) -> bool {
        !self.session.is_forked() && self.inner.lock().slots().is_held_up(writer)
    }

    /// For a relay: after what time [`take_of`](Self::take_of) may have a sample of this publisher, where it had none
    /// although some wait. It had passed over samples that do not count, or there was no memory for one.
    pub fn retry_of(&self, writer: &Gid) -> Option<Duration> {
        if self.session.is_forked() { None } else { self.inner.lock().slots().retry_of(writer) }
    }

    /// Whether there is something to take of this publisher.
    pub fn has_from(&self, writer: &Gid) -> bool {
        !self.session.is_forked() && self.inner.lock().slots().has_from(writer)
    }

    /// The publishers that have a lease, and when each was last alive, by the monotonic clock.
    pub fn assertions(&self) -> Vec<(Gid, u64)> {
        if self.session.is_forked() {
            return Vec::new();
        }
        self.inner.lock().slots().assertions()
    }

    /// For a relay: the remote subscriptions that it stands for from now on.
    pub fn set_stands_for(&self, gids: Vec<Gid>) {
        if self.session.is_forked() {
            return;
        }
        self.inner.set_stands_for(gids);
        self.session.renew(self.gid());
    }
}

#[doc(hidden)]
impl Server {
    /// As [`take_request_from`](Self::take_request_from), as bytes.
    pub fn take_request_of(&self, client: &Gid) -> Option<(MessageInfo, Vec<u8>)> {
        self.requests.take_of(self.session.core(), client)
    }

    /// The clients of which there is a request to be taken.
    pub fn with_requests(&self) -> Vec<Gid> {
        if self.session.is_forked() {
            Vec::new()
        } else {
            self.requests.lock().slots().with_data().collect()
        }
    }

    /// Whether it reads what this client asks or asked, or may do so soon.
    pub fn reads(&self, client: &Gid) -> bool {
        !self.session.is_forked() && self.requests.lock().reads(client)
    }
}
