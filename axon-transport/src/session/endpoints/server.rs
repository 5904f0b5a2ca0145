//! A server of a service: the application's handle.

use std::{
    fmt,
    sync::Arc,
    time::{Duration, SystemTime},
};

use axon_shm::{Meta, PublishError, Sample};

use super::service::{attached, await_both, both, set_callback, take_from_one};
use crate::{
    graph::Endpoint,
    ids::Gid,
    session::{
        clock,
        endpoint_state::{
            MessageInfo, NewDataCallback, PublisherInner, RingsByClient, SubscriptionInner,
        },
        error::{RecvError, SessionError},
        handle::Session,
    },
};

/// Maximum time that a response waits for a client whose request came before the client could be answered.
const CLIENT_MATCH_TIMEOUT: Duration = Duration::from_millis(100);

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
    pub(in crate::session) requests: Arc<SubscriptionInner>,
    pub(in crate::session) session: Session,
}

impl Server {
    pub(in crate::session) fn new(
        responses: Arc<PublisherInner>,
        requests: Arc<SubscriptionInner>,
        rings: Arc<RingsByClient>,
        session: Session,
    ) -> Self {
        Self { responses, rings, requests, session }
    }

    /// Returns the server's GID.
    pub fn gid(&self) -> Gid {
        self.responses.endpoint.gid
    }

    /// Returns the endpoint that describes the server in the graph.
    pub fn endpoint(&self) -> &Endpoint {
        &self.responses.endpoint
    }

    /// Takes the next request into `out`, whose content it replaces. Returns `None` if there is none. The returned
    /// information names the client, and the number that the response must carry.
    pub fn take_request(&self, out: &mut Vec<u8>) -> Option<MessageInfo> {
        self.requests.take_bytes(self.session.core(), out)
    }

    /// Like [`take_request`](Self::take_request), in place, as
    /// [`Subscription::take_sample`](crate::Subscription::take_sample) does.
    pub fn take_request_sample(&self) -> Option<(MessageInfo, Sample)> {
        self.requests.take_sample(self.session.core())
    }

    /// Like [`take_request`](Self::take_request), after waiting for at most `timeout`.
    ///
    /// # Errors
    /// [`RecvError::TimedOut`], and [`RecvError::Forked`] in a forked child.
    pub fn recv_request(
        &self,
        out: &mut Vec<u8>,
        timeout: Option<Duration>,
    ) -> Result<MessageInfo, RecvError> {
        self.requests.recv(self.session.core(), timeout, || self.take_request(out))
    }

    /// Sends the response to request `sequence` of `client`. A client that is gone is no error.
    ///
    /// # Errors
    /// [`PublishError::Blocked`] after 100 ms if the client does not take its responses and there is no space for more.
    /// The other variants tell why the response was not sent.
    pub fn send_response(
        &self,
        client: Gid,
        sequence: u64,
        payload: &[u8],
    ) -> Result<(), PublishError> {
        self.respond(client, sequence, None, payload)
    }

    /// Like [`send_response`](Self::send_response), with the caller's source timestamp. A response carries it in
    /// nanoseconds, which reach from the year 1677 to 2262.
    ///
    /// # Errors
    /// As for [`send_response`](Self::send_response).
    pub fn send_response_at(
        &self,
        client: Gid,
        sequence: u64,
        source_timestamp: SystemTime,
        payload: &[u8],
    ) -> Result<(), PublishError> {
        self.respond(client, sequence, Some(clock::unix_nanos(source_timestamp)), payload)
    }

    fn respond(
        &self,
        client: Gid,
        sequence: u64,
        source_timestamp: Option<i64>,
        payload: &[u8],
    ) -> Result<(), PublishError> {
        if self.session.is_forked() {
            return Err(PublishError::Forked);
        }
        let ring = || self.rings.ring(&client);
        // A request may come before its client can be answered.
        let settled = || ring().is_some() || !self.requests.lock().writers().contains(&client);
        if !settled() {
            self.session.wait_changed(CLIENT_MATCH_TIMEOUT, settled);
        }
        let Some(ring) = ring() else { return Ok(()) };
        let meta = Meta::at_nanos(sequence, source_timestamp.unwrap_or_else(clock::wall));
        ring.publish(meta, payload).map(drop)
    }

    /// Sends a response to `client` for a remote server, without waiting for space. Returns false if there is no such
    /// client any more.
    pub(crate) fn try_respond(
        &self,
        client: &Gid,
        meta: Meta,
        payload: &[u8],
    ) -> Result<bool, PublishError> {
        let Some(ring) = self.rings.ring(client) else { return Ok(false) };
        ring.try_publish(meta, payload).map(|_| true)
    }

    /// Returns, for a relay, the number of responses to this client that are in its ring and not delivered.
    pub(crate) fn undelivered(&self, client: &Gid) -> u64 {
        self.rings.ring(client).map_or(0, |ring| ring.under_way())
    }

    /// Takes the next request of one client, for a relay.
    pub(crate) fn take_request_from(&self, client: &Gid) -> Option<Sample> {
        take_from_one(&self.requests, &self.session, client)
    }

    /// Confirms, for a relay, the delivery of the requests of this client up to this number.
    pub(crate) fn finish_requests(&self, client: &Gid, number: u64) {
        if !self.session.is_forked() {
            self.requests.lock().finish_of(client, number);
        }
    }

    /// Returns, for a relay, the number of unconfirmed requests of this client, including untaken ones.
    pub(crate) fn unread_of(&self, client: &Gid) -> u64 {
        if self.session.is_forked() { 0 } else { self.requests.lock().slots().undone_of(client) }
    }

    /// Returns, for a relay, how many requests of this client found no space, if an unconfirmed request may be the
    /// reason.
    pub(crate) fn refused_of(&self, client: &Gid) -> Option<u64> {
        if self.session.is_forked() {
            return None;
        }
        self.requests.lock().slots().refused_of(client)
    }

    /// Returns whether there is a request of this client to take.
    pub(crate) fn has_request_from(&self, client: &Gid) -> bool {
        !self.session.is_forked() && self.requests.lock().slots().has_from(client)
    }

    pub(in crate::session) fn await_clients(&self) {
        await_both(&self.responses, &self.requests, &self.session);
    }

    /// Returns the clients that reach it and that it reaches.
    pub fn clients(&self) -> Vec<Gid> {
        both(&self.responses, &self.requests, &self.session)
    }

    /// Returns the clients that a relay serves: [`clients`](Self::clients), and ended clients whose requests are still
    /// to come.
    pub(crate) fn attached(&self) -> Vec<Gid> {
        attached(&self.responses, &self.requests, &self.session)
    }

    /// Returns whether there is a request to take.
    pub fn has_request(&self) -> bool {
        !self.session.is_forked() && self.requests.has_data()
    }

    /// Like [`Subscription::set_on_new_sample`](crate::Subscription::set_on_new_sample), for requests.
    ///
    /// # Errors
    /// As there.
    pub fn set_on_new_request(
        &self,
        callback: Option<NewDataCallback>,
    ) -> Result<(), SessionError> {
        set_callback(&self.requests, callback, &self.session)
    }

    /// Like [`Subscription::tell_no_more`](crate::Subscription::tell_no_more).
    pub(crate) fn tell_no_more(&self) {
        if !self.session.is_forked() {
            self.requests.tell_no_more(self.session.core());
        }
    }
}

impl fmt::Debug for Server {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("Server").field(self.endpoint()).finish()
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        self.tell_no_more();
        self.session.forget_endpoint(&self.gid());
    }
}
