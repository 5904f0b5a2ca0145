//! Services: requests that clients send to all servers, and responses that each server sends only to the client that
//! asked.
//!
//! A client has one ring, which its servers read; a server has a ring for each of its clients. A KEEP_ALL reader
//! skips no untaken message. A KEEP_LAST reader keeps the newest untaken messages of each client or server, up to
//! its depth, and skips older ones. No message within the depth is dropped to make room while its reader lives.

use std::{fmt, sync::Arc, time::Duration};

use axon_shm::{Meta, PublishError, Sample, ShmError, internal::Writer};

use super::{
    MessageInfo, OnNew, RecvError, Session, SessionError, clock,
    publisher::PublisherInner,
    rings::RingsByClient,
    subscription::{SubscriptionInner, recv_from, sample_of, take_bytes_from, take_sample_from},
};
use crate::{graph::Endpoint, ids::Gid};

/// How long a response waits for a client whose request came before it could be answered.
const PATIENCE: Duration = Duration::from_millis(100);

/// Answers requests. Thread-safe.
///
/// ```
/// # use std::time::Duration;
/// # use axon_transport::{
/// #     EndpointSpec, Session, SessionOptions,
/// #     config::{Config, DaemonPolicy},
/// #     qos::Qos,
/// # };
/// # let config = Config::builder().daemon(DaemonPolicy::Off).build()?;
/// # let session = Session::open(&config, SessionOptions::new("robot"))?;
/// # let spec = || EndpointSpec::new("/speed", "example/Speed", Qos::default());
/// let server = session.create_server(spec())?;
/// let client = session.create_client(spec())?;
/// assert!(client.wait_available(Duration::from_secs(10)));
/// client.send_request(b"how fast?")?;
///
/// let mut payload = Vec::new();
/// let request = server.recv_request(&mut payload, Some(Duration::from_secs(10)))?;
/// server.send_response(request.publisher, request.sequence, b"1.5 m/s")?;
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub struct Server {
    responses: Arc<PublisherInner>,
    rings: Arc<RingsByClient>,
    pub(super) requests: Arc<SubscriptionInner>,
    pub(super) session: Session,
}

/// Sends requests. Thread-safe.
///
/// ```
/// use std::time::Duration;
///
/// use axon_transport::{
///     EndpointSpec, Session, SessionOptions,
///     config::{Config, DaemonPolicy},
///     qos::Qos,
/// };
///
/// let config = Config::builder().daemon(DaemonPolicy::Off).build()?;
/// let session = Session::open(&config, SessionOptions::new("robot"))?;
/// let spec = || EndpointSpec::new("/add", "AddTwoInts", Qos::default());
/// let server = session.create_server(spec())?;
/// let client = session.create_client(spec())?;
/// assert!(client.wait_available(Duration::from_secs(10)));
///
/// let number = client.send_request(b"1 + 2")?;
/// let mut bytes = Vec::new();
/// let request = server.recv_request(&mut bytes, None)?;
/// server.send_response(request.publisher, request.sequence, b"3")?;
/// let response = client.recv_response(&mut bytes, None)?;
/// assert_eq!((response.sequence, &bytes[..]), (number, &b"3"[..]));
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub struct Client {
    requests: Arc<PublisherInner>,
    pub(super) ring: Arc<Writer>,
    pub(super) responses: Arc<SubscriptionInner>,
    pub(super) session: Session,
}

impl Server {
    pub(super) fn new(
        responses: Arc<PublisherInner>,
        requests: Arc<SubscriptionInner>,
        rings: Arc<RingsByClient>,
        session: Session,
    ) -> Self {
        Self { responses, rings, requests, session }
    }

    /// Its GID.
    pub fn gid(&self) -> Gid {
        self.responses.endpoint.gid
    }

    /// Itself, as others see it.
    pub fn endpoint(&self) -> &Endpoint {
        &self.responses.endpoint
    }

    /// The next request, into `out`, which it replaces. `None` when there is none. What is known of
    /// it names the client, and the number that the response must carry.
    pub fn take_request(&self, out: &mut Vec<u8>) -> Option<MessageInfo> {
        take_bytes_from(&self.requests, self.session.shared(), out)
    }

    /// As [`take_request`](Self::take_request), in place, as
    /// [`Subscription::take_sample`](super::Subscription::take_sample).
    pub fn take_request_sample(&self) -> Option<(MessageInfo, Sample)> {
        take_sample_from(&self.requests, self.session.shared())
    }

    /// As [`take_request`](Self::take_request), after waiting for at most `timeout`.
    ///
    /// # Errors
    /// [`RecvError::TimedOut`], and [`RecvError::Forked`] in a forked child.
    pub fn recv_request(
        &self,
        out: &mut Vec<u8>,
        timeout: Option<Duration>,
    ) -> Result<MessageInfo, RecvError> {
        recv_from(&self.requests, &self.session, timeout, || self.take_request(out))
    }

    /// Answers request `sequence` of `client`. A client that is gone is no error.
    ///
    /// # Errors
    /// [`PublishError::Blocked`] after 100 ms when the client does not take its responses and there
    /// is no room for more; the others say what does not fit.
    pub fn send_response(
        &self,
        client: Gid,
        sequence: u64,
        payload: &[u8],
    ) -> Result<(), PublishError> {
        if self.session.is_forked() {
            return Err(PublishError::Forked);
        }
        let ring = || self.rings.ring(&client);
        // Its request may have come before it could be answered.
        let settled = || ring().is_some() || !self.requests.lock().writers().contains(&client);
        if !settled() {
            self.session.wait_changed(PATIENCE, settled);
        }
        let Some(ring) = ring() else { return Ok(()) };
        let meta = Meta::at_nanos(sequence, clock::wall());
        ring.publish(meta, payload).map(drop)
    }

    /// For who speaks for it: gives `client` a response without waiting for room. `false` when there is no
    /// such client any more.
    pub(crate) fn try_respond(
        &self,
        client: &Gid,
        meta: Meta,
        payload: &[u8],
    ) -> Result<bool, PublishError> {
        let Some(ring) = self.rings.ring(client) else { return Ok(false) };
        ring.try_publish(meta, payload).map(|_| true)
    }

    /// For a relay: how many responses to this client are in its ring and are not where they are to go.
    pub(crate) fn undelivered(&self, client: &Gid) -> u64 {
        self.rings.ring(client).map_or(0, |ring| ring.under_way())
    }

    /// For a relay: the next request of one client.
    pub(crate) fn take_request_from(&self, client: &Gid) -> Option<Sample> {
        take_from_one(&self.requests, &self.session, client)
    }

    /// For a relay: requests of this client up to this number are where they are to go.
    pub(crate) fn finish_requests(&self, client: &Gid, number: u64) {
        if !self.session.is_forked() {
            self.requests.lock().finish_of(client, number);
        }
    }

    /// For a relay: how many requests of this client it has not taken.
    pub(crate) fn unread_of(&self, client: &Gid) -> u64 {
        if self.session.is_forked() { 0 } else { self.requests.lock().slots().undone_of(client) }
    }

    /// For a relay: how many requests of this client found no room, if one that it has not taken is why the next one may
    /// not.
    pub(crate) fn refused_of(&self, client: &Gid) -> Option<u64> {
        if self.session.is_forked() {
            return None;
        }
        self.requests.lock().slots().refused_of(client)
    }

    /// Whether there is a request of this client to be taken.
    pub(crate) fn has_request_from(&self, client: &Gid) -> bool {
        !self.session.is_forked() && self.requests.lock().slots().has_from(client)
    }

    pub(super) fn await_clients(&self) {
        await_both(&self.responses, &self.requests, &self.session);
    }

    /// The clients that reach it and that it reaches.
    pub fn clients(&self) -> Vec<Gid> {
        both(&self.responses, &self.requests, &self.session)
    }

    /// For a relay: as [`clients`](Self::clients), with those of whom there is more to come.
    pub(crate) fn attached(&self) -> Vec<Gid> {
        attached(&self.responses, &self.requests, &self.session)
    }

    /// Whether there is a request to be taken.
    pub fn has_request(&self) -> bool {
        !self.session.is_forked() && self.requests.has_data()
    }

    /// As [`Subscription::set_on_new_sample`](super::Subscription::set_on_new_sample), of requests.
    ///
    /// # Errors
    /// As there.
    pub fn set_on_new_request(&self, callback: Option<OnNew>) -> Result<(), SessionError> {
        set_callback(&self.requests, callback, &self.session)
    }

    /// As [`Subscription::tell_no_more`](super::Subscription::tell_no_more).
    pub(crate) fn tell_no_more(&self) {
        if !self.session.is_forked() {
            self.requests.tell_no_more(self.session.shared());
        }
    }
}

impl Client {
    pub(super) fn new(
        requests: Arc<PublisherInner>,
        responses: Arc<SubscriptionInner>,
        ring: Arc<Writer>,
        session: Session,
    ) -> Self {
        Self { requests, ring, responses, session }
    }

    /// Its GID.
    pub fn gid(&self) -> Gid {
        self.requests.endpoint.gid
    }

    /// Itself, as others see it.
    pub fn endpoint(&self) -> &Endpoint {
        &self.requests.endpoint
    }

    /// Sends a request to every server that is there, and returns its number. Where there is none,
    /// nobody will answer: see [`is_available`](Self::is_available).
    ///
    /// # Errors
    /// [`PublishError::Blocked`] after 100 ms when a server does not take its requests and there is
    /// no room for more; the others say what does not fit.
    pub fn send_request(&self, payload: &[u8]) -> Result<u64, PublishError> {
        self.ring.publish_next(clock::wall(), payload)
    }

    /// For who speaks for it: a request under the number that it has there, without waiting for room.
    pub(crate) fn try_forward(&self, meta: Meta, payload: &[u8]) -> Result<(), PublishError> {
        self.ring.try_publish(meta, payload).map(drop)
    }

    /// For a relay: the next response of one server.
    pub(crate) fn take_response_from(&self, server: &Gid) -> Option<Sample> {
        take_from_one(&self.responses, &self.session, server)
    }

    /// For a relay: the response of this number, and all that it took of this server before, are where they are to go.
    pub(crate) fn finish_through(&self, server: &Gid, number: u64) {
        if !self.session.is_forked() {
            self.responses.lock().finish_through(server, number);
        }
    }

    /// For a relay: responses that it took and that are not where they are to go are to be taken once more.
    pub(crate) fn take_back(&self) {
        if !self.session.is_forked() {
            self.responses.lock().take_back(false);
        }
    }

    /// For a relay: how many responses of all servers it has not taken.
    pub(crate) fn unread(&self) -> u64 {
        if self.session.is_forked() {
            return 0;
        }
        self.responses.lock().slots().undone().into_values().fold(0, u64::saturating_add)
    }

    /// For a relay: how many responses of all servers found no room, if those that it has not taken are why the next ones
    /// may not.
    pub(crate) fn refused(&self) -> Option<u64> {
        if self.session.is_forked() {
            return None;
        }
        let responses = self.responses.lock();
        let servers = responses.slots().undone().into_keys();
        let refused = servers.filter_map(|server| responses.slots().refused_of(&server));
        refused.reduce(u64::saturating_add)
    }

    /// Whether there is a response of this server to be taken.
    pub(crate) fn has_response_from(&self, server: &Gid) -> bool {
        !self.session.is_forked() && self.responses.lock().slots().has_from(server)
    }

    pub(super) fn await_servers(&self) {
        await_both(&self.requests, &self.responses, &self.session);
    }

    /// The next response, into `out`, which it replaces. `None` when there is none. What is known of
    /// it names the server, and the number of the request that it answers.
    pub fn take_response(&self, out: &mut Vec<u8>) -> Option<MessageInfo> {
        take_bytes_from(&self.responses, self.session.shared(), out)
    }

    /// As [`take_response`](Self::take_response), in place, as
    /// [`Subscription::take_sample`](super::Subscription::take_sample).
    pub fn take_response_sample(&self) -> Option<(MessageInfo, Sample)> {
        take_sample_from(&self.responses, self.session.shared())
    }

    /// As [`take_response`](Self::take_response), after waiting for at most `timeout`.
    ///
    /// # Errors
    /// [`RecvError::TimedOut`], and [`RecvError::Forked`] in a forked child.
    pub fn recv_response(
        &self,
        out: &mut Vec<u8>,
        timeout: Option<Duration>,
    ) -> Result<MessageInfo, RecvError> {
        recv_from(&self.responses, &self.session, timeout, || self.take_response(out))
    }

    /// Whether there is a server that a request sent now reaches, and whose response reaches this
    /// client.
    pub fn is_available(&self) -> bool {
        !self.servers().is_empty()
    }

    /// Waits until a server [is available](Self::is_available); whether one is.
    pub fn wait_available(&self, timeout: Duration) -> bool {
        self.session.wait_changed(timeout, || self.is_available())
    }

    /// The servers that it reaches and that reach it.
    pub fn servers(&self) -> Vec<Gid> {
        both(&self.requests, &self.responses, &self.session)
    }

    /// For a relay: as [`servers`](Self::servers), with those of whom there is more to come.
    pub(crate) fn attached(&self) -> Vec<Gid> {
        attached(&self.requests, &self.responses, &self.session)
    }

    /// Whether there is a response to be taken.
    pub fn has_response(&self) -> bool {
        !self.session.is_forked() && self.responses.has_data()
    }

    /// As [`Subscription::set_on_new_sample`](super::Subscription::set_on_new_sample), of responses.
    ///
    /// # Errors
    /// As there.
    pub fn set_on_new_response(&self, callback: Option<OnNew>) -> Result<(), SessionError> {
        set_callback(&self.responses, callback, &self.session)
    }

    /// As [`Subscription::tell_no_more`](super::Subscription::tell_no_more).
    pub(crate) fn tell_no_more(&self) {
        if !self.session.is_forked() {
            self.responses.tell_no_more(self.session.shared());
        }
    }
}

fn take_from_one(inner: &SubscriptionInner, session: &Session, writer: &Gid) -> Option<Sample> {
    if session.is_forked() {
        return None;
    }
    sample_of(inner, writer).map(|(sample, _)| sample)
}

fn await_both(writes: &PublisherInner, reads: &SubscriptionInner, session: &Session) {
    session.await_pairs(&writes.endpoint, |other| {
        writes.events.is_matched(other) && reads.events.is_matched(other)
    });
}

/// Endpoints that are attached in both directions.
fn both(writes: &PublisherInner, reads: &SubscriptionInner, session: &Session) -> Vec<Gid> {
    if session.is_forked() {
        return Vec::new();
    }
    let mut gids = reads.events.matched_now();
    gids.retain(|gid| writes.events.is_matched(gid));
    gids
}

/// Attached endpoints, including ended ones with pending data.
fn attached(writes: &PublisherInner, reads: &SubscriptionInner, session: &Session) -> Vec<Gid> {
    let mut gids = both(writes, reads, session);
    if !session.is_forked() {
        let leaving = reads.lock().slots().leaving();
        gids.extend(leaving.into_iter().filter(|gid| writes.events.is_matched(gid)));
    }
    gids
}

fn set_callback(
    inner: &SubscriptionInner,
    callback: Option<OnNew>,
    session: &Session,
) -> Result<(), SessionError> {
    if session.is_forked() {
        return Err(ShmError::Forked.into());
    }
    Ok(inner.set_on_new_sample(callback, session.shared())?)
}

impl fmt::Debug for Server {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("Server").field(self.endpoint()).finish()
    }
}

impl fmt::Debug for Client {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("Client").field(self.endpoint()).finish()
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        self.tell_no_more();
        self.session.forget_endpoint(&self.gid());
    }
}

impl Drop for Client {
    fn drop(&mut self) {
        self.tell_no_more();
        self.session.forget_endpoint(&self.gid());
    }
}
