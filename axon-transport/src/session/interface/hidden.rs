//! Methods of an application's types for the daemon, its relays and stand-ins, and this crate. They are hidden in the
//! documentation, are no part of the interface, and may change with any release.

use std::{
    collections::{BTreeMap, HashMap},
    ops::Range,
    os::fd::OwnedFd,
    sync::Arc,
    time::{Duration, SystemTime},
};

use axon_shm::{
    Meta, PublishError, Sample,
    internal::{KnownPeers, SessionSegment},
};

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
        endpoints::{EndpointFactory, Publisher, Server, Subscription},
        error::SessionError,
        handle::Session,
        options::{EndpointSpec, SessionOptions},
    },
    wire::session::{EndpointRole, RelayGivenUp, SessionMessage, SessionRole},
};

#[doc(hidden)]
impl MessageInfo {
    /// Creates the information of a sample with this number and no particular time.
    pub fn of(publisher: Gid, sequence: u64) -> Self {
        let [source_timestamp, received_timestamp] = [SystemTime::UNIX_EPOCH; 2];
        let (reception, lifetime) = (sequence, None);
        Self { publisher, sequence, source_timestamp, received_timestamp, reception, lifetime }
    }
}

#[doc(hidden)]
impl Lifetime {
    /// Creates the lifetime of a sample with this age and lifespan.
    pub fn new(age: Duration, lifespan: Duration) -> Self {
        Self { age, lifespan }
    }
}

#[doc(hidden)]
impl Session {
    /// Opens a session over a socket that is connected to a daemon. It ends with that connection.
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

    /// Like [`over`](Self::over), under a given id: for the daemon, whose memory holds the endpoints of a relayed
    /// session.
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

    /// Creates a subscription as another process of the session describes it, under its GID there. If it is RELIABLE
    /// and KEEP_ALL, samples that it takes are acknowledged only by [`acknowledge_of`](Subscription::acknowledge_of).
    pub fn adopt_subscription(&self, endpoint: Endpoint) -> Subscription {
        let mut inner = SubscriptionInner::new(endpoint, EndpointRole::Application, Vec::new());
        inner.carries = inner.keeps_all();
        EndpointFactory(self).add_reader(inner)
    }

    /// Like [`adopt_subscription`](Self::adopt_subscription), for a node.
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

    /// Creates a local reader that carries samples to the subscriptions `stands_for` on another host. Only the gateway
    /// may call this; a daemon refuses it from any other session.
    ///
    /// # Errors
    /// When the specification is out of bounds.
    pub fn create_relay(
        &self,
        spec: EndpointSpec,
        stands_for: Vec<Gid>,
    ) -> Result<Subscription, SessionError> {
        EndpointFactory(self).create_relay(spec, None, stands_for, false)
    }

    /// Returns the session's segment, for waiting in other ways.
    pub fn segment(&self) -> &Arc<SessionSegment> {
        &self.core().segment
    }

    /// Returns the endpoints that the daemon has refused, each with the reason.
    pub fn refused(&self) -> BTreeMap<Gid, String> {
        self.shared().state().graph.refused.clone()
    }

    /// Takes the refusals since the last call that concern no endpoint permanently, if the options keep them.
    pub fn take_refusals(&self) -> Vec<String> {
        self.core().link.take_refusals()
    }
}

#[doc(hidden)]
impl SessionOptions {
    /// Sets the kind of the session.
    #[must_use]
    pub fn role(mut self, role: SessionRole) -> Self {
        self.role = role;
        self
    }

    /// Keeps the daemon's refusals that concern no endpoint permanently.
    #[must_use]
    pub fn keep_refusals(mut self) -> Self {
        self.keeps_refusals = true;
        self
    }

    /// Sets the descriptors of other sessions that this process holds already. The session uses them in place of
    /// copies that it receives.
    #[must_use]
    pub fn known_peers(mut self, known: Arc<KnownPeers>) -> Self {
        self.known_peers = Some(known);
        self
    }

    /// Sets the maximum number of clients of its servers. A client counts once for each server.
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

    /// Like [`publish_with`](Self::publish_with), but never waits for space.
    ///
    /// # Errors
    /// [`PublishError::Blocked`] at once if there is no space.
    pub fn try_publish_with(&self, meta: Meta, payload: &[u8]) -> Result<(), PublishError> {
        self.inner.published(self.writer.try_publish(meta, payload)).map(drop)
    }

    /// Like [`try_publish_with`](Self::try_publish_with), but sleeping readers may sleep on until
    /// [`announce`](Self::announce).
    ///
    /// # Errors
    /// As for [`try_publish_with`](Self::try_publish_with).
    pub fn try_publish_quietly(&self, meta: Meta, payload: &[u8]) -> Result<(), PublishError> {
        self.inner.published(self.writer.try_publish_quietly(meta, payload)).map(drop)
    }

    /// Wakes sleeping readers, for samples that were published [quietly](Self::try_publish_quietly).
    pub fn announce(&self) {
        self.writer.announce();
    }
}

#[doc(hidden)]
impl Subscription {
    /// Returns, for a relay, the publishers that may still send samples. A publisher that has ended is included while
    /// its samples are in flight.
    pub fn attached(&self) -> Vec<Gid> {
        let mut gids = self.matched();
        if !self.session.is_forked() {
            gids.extend(self.inner.lock().slots().leaving());
        }
        gids
    }

    /// Takes, for a relay, the next sample of one publisher. Returns it and the number of that publisher's samples that
    /// this subscription has lost by then.
    pub fn take_from(&self, writer: &Gid) -> Option<(Sample, u64)> {
        if self.session.is_forked() {
            return None;
        }
        self.inner.sample_of(writer)
    }

    /// Returns, for a relay, how many samples of this publisher newer samples replaced before they were taken.
    pub fn lost_of(&self, writer: &Gid) -> u64 {
        if self.session.is_forked() { 0 } else { self.inner.lock().lost_of(writer) }
    }

    /// Skips, for a relay, all samples of this publisher but the newest `depth`. The skipped samples count as
    /// [lost](Self::lost_of).
    pub fn skip_of(&self, writer: &Gid, depth: u64) {
        if !self.session.is_forked() {
            self.inner.lock().skip_of(writer, depth);
        }
    }

    /// Makes samples available again, for a relay, that were taken and not acknowledged. If the subscription is
    /// TRANSIENT_LOCAL, this covers the whole history that the publisher keeps.
    pub fn take_back(&self) {
        if !self.session.is_forked() {
            let history = self.inner.qos.durability == Durability::TransientLocal;
            self.inner.lock().take_back(history);
        }
    }

    /// Acknowledges, for a relay, the samples of this publisher up to this number. Until then, they do not count as
    /// acknowledged.
    pub fn acknowledge_of(&self, writer: &Gid, sequence: u64) {
        if !self.session.is_forked() {
            self.inner.lock().finish_of(writer, sequence);
        }
    }

    /// Returns, for a relay, the number of samples that are not acknowledged, including untaken ones, by publisher.
    pub fn unacknowledged(&self) -> HashMap<Gid, u64> {
        if self.session.is_forked() { HashMap::new() } else { self.inner.lock().slots().undone() }
    }

    /// Returns, for a relay, the bytes of the samples of this publisher that are not acknowledged.
    pub fn unacknowledged_bytes_of(&self, writer: &Gid) -> u64 {
        if self.session.is_forked() { 0 } else { self.inner.lock().slots().undone_bytes_of(writer) }
    }

    /// Returns, for a relay, how many publishes of this publisher found no space because readers had not acknowledged
    /// its oldest sample, if this subscription has not acknowledged it.
    pub fn refused_of(&self, writer: &Gid) -> Option<u64> {
        if self.session.is_forked() { None } else { self.inner.lock().slots().refused_of(writer) }
    }

    /// Gives up, for a relay, `samples` samples of this publisher that do not reach their destination. Tells the
    /// publisher.
    pub fn give_up(&self, writer: Gid, samples: u64) {
        if self.session.is_forked() {
            return;
        }
        // The publisher sees the count before it sees that the samples are acknowledged. Its process also receives a
        // message: it may be of an older version, and the publisher may wait for acknowledgements.
        self.inner.lock().give_up_of(&writer, samples);
        let given_up = RelayGivenUp { reader: self.gid(), writer, samples };
        self.session.core().tell(Outgoing::message(SessionMessage::GivenUp(given_up)));
    }

    /// Takes, for a relay, the next sample of one publisher, as bytes.
    pub fn take_of(&self, writer: &Gid) -> Option<(MessageInfo, Vec<u8>)> {
        self.inner.take_of(self.session.core(), writer)
    }

    /// Takes, for a relay, the next samples of one publisher, with their payloads one behind the other in `out`, whose
    /// content they replace. `each` receives the position of each sample's payload. Returns the number of samples
    /// taken.
    pub fn take_many_of(
        &self,
        writer: &Gid,
        most: TakeLimit,
        out: &mut Vec<u8>,
        each: impl FnMut(MessageInfo, Range<usize>),
    ) -> usize {
        self.inner.take_many_of(self.session.core(), writer, most, out, each)
    }

    /// Returns the publishers that have a sample to take.
    pub fn with_data(&self) -> Vec<Gid> {
        if self.session.is_forked() {
            Vec::new()
        } else {
            self.inner.lock().slots().with_data().collect()
        }
    }

    /// Returns whether it reads this publisher, including samples of an earlier attachment, or may do so soon.
    pub fn reads(&self, writer: &Gid) -> bool {
        !self.session.is_forked() && self.inner.lock().reads(writer)
    }

    /// Returns whether it is RELIABLE and KEEP_ALL.
    pub fn may_lose_nothing(&self) -> bool {
        self.inner.keeps_all()
    }

    /// Returns whether samples of `writer` wait that cannot be taken yet, for want of its memory or of this process's
    /// own.
    pub fn is_held_up(&self, writer: &Gid) -> bool {
        !self.session.is_forked() && self.inner.lock().slots().is_held_up(writer)
    }

    /// Returns, for a relay, the time after which [`take_of`](Self::take_of) may return a sample of this publisher, if
    /// it returned none although some wait: it had skipped samples that do not count, or there was no memory for one.
    pub fn retry_of(&self, writer: &Gid) -> Option<Duration> {
        if self.session.is_forked() { None } else { self.inner.lock().slots().retry_of(writer) }
    }

    /// Returns whether there is a sample of this publisher to take.
    pub fn has_from(&self, writer: &Gid) -> bool {
        !self.session.is_forked() && self.inner.lock().slots().has_from(writer)
    }

    /// Returns the publishers that have a lease, and when each was last alive, by the monotonic clock.
    pub fn assertions(&self) -> Vec<(Gid, u64)> {
        if self.session.is_forked() {
            return Vec::new();
        }
        self.inner.lock().slots().assertions()
    }

    /// Sets, for a relay, the remote subscriptions that it stands for from now on.
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
    /// Like [`take_request_from`](Self::take_request_from), as bytes.
    pub fn take_request_of(&self, client: &Gid) -> Option<(MessageInfo, Vec<u8>)> {
        self.requests.take_of(self.session.core(), client)
    }

    /// Returns the clients that have a request to take.
    pub fn with_requests(&self) -> Vec<Gid> {
        if self.session.is_forked() {
            Vec::new()
        } else {
            self.requests.lock().slots().with_data().collect()
        }
    }

    /// Returns whether it reads this client's requests, including requests of an earlier attachment, or may do so soon.
    pub fn reads(&self, client: &Gid) -> bool {
        !self.session.is_forked() && self.requests.lock().reads(client)
    }
}
