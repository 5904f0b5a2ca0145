//! A client of a service: the application's handle.

use std::{fmt, sync::Arc, time::Duration};

use axon_shm::{Meta, PublishError, Sample, internal::Writer};

use super::service::{attached, await_both, both, set_callback, take_from_one};
use crate::{
    graph::Endpoint,
    ids::Gid,
    session::{
        clock,
        endpoint_state::{MessageInfo, NewDataCallback, PublisherInner, SubscriptionInner},
        error::{RecvError, SessionError},
        handle::Session,
    },
};

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
    pub(in crate::session) ring: Arc<Writer>,
    pub(in crate::session) responses: Arc<SubscriptionInner>,
    pub(in crate::session) session: Session,
}

impl Client {
    pub(in crate::session) fn new(
        requests: Arc<PublisherInner>,
        responses: Arc<SubscriptionInner>,
        ring: Arc<Writer>,
        session: Session,
    ) -> Self {
        Self { requests, ring, responses, session }
    }

    /// Returns the client's GID.
    pub fn gid(&self) -> Gid {
        self.requests.endpoint.gid
    }

    /// Returns the endpoint that describes the client in the graph.
    pub fn endpoint(&self) -> &Endpoint {
        &self.requests.endpoint
    }

    /// Sends a request to every available server, and returns its number. If there is no server, there will be no
    /// response: see [`is_available`](Self::is_available).
    ///
    /// # Errors
    /// [`PublishError::Blocked`] after 100 ms if a server does not take its requests and there is no space for more.
    /// The other variants tell why the request was not sent.
    pub fn send_request(&self, payload: &[u8]) -> Result<u64, PublishError> {
        self.ring.publish_next(clock::wall(), payload)
    }

    /// Sends a request for a remote client, under the number that it has there, without waiting for space.
    pub(crate) fn try_forward(&self, meta: Meta, payload: &[u8]) -> Result<(), PublishError> {
        self.ring.try_publish(meta, payload).map(drop)
    }

    /// Takes the next response of one server, for a relay.
    pub(crate) fn take_response_from(&self, server: &Gid) -> Option<Sample> {
        take_from_one(&self.responses, &self.session, server)
    }

    /// Confirms, for a relay, the delivery of the response of this number, and of all responses that the relay took
    /// from this server before.
    pub(crate) fn finish_through(&self, server: &Gid, number: u64) {
        if !self.session.is_forked() {
            self.responses.lock().finish_through(server, number);
        }
    }

    /// Makes responses available again, for a relay, that it took and whose delivery is not confirmed.
    pub(crate) fn take_back(&self) {
        if !self.session.is_forked() {
            self.responses.lock().take_back(false);
        }
    }

    /// Returns, for a relay, the number of unconfirmed responses of all servers, including untaken ones.
    pub(crate) fn unread(&self) -> u64 {
        if self.session.is_forked() {
            return 0;
        }
        self.responses.lock().slots().undone().into_values().fold(0, u64::saturating_add)
    }

    /// Returns, for a relay, how many responses of all servers found no space, if its unconfirmed responses may be the
    /// reason.
    pub(crate) fn refused(&self) -> Option<u64> {
        if self.session.is_forked() {
            return None;
        }
        let responses = self.responses.lock();
        let servers = responses.slots().undone().into_keys();
        let refused = servers.filter_map(|server| responses.slots().refused_of(&server));
        refused.reduce(u64::saturating_add)
    }

    /// Returns whether there is a response of this server to be taken.
    pub(crate) fn has_response_from(&self, server: &Gid) -> bool {
        !self.session.is_forked() && self.responses.lock().slots().has_from(server)
    }

    pub(in crate::session) fn await_servers(&self) {
        await_both(&self.requests, &self.responses, &self.session);
    }

    /// Takes the next response into `out`, whose content it replaces. Returns `None` if there is none. The returned
    /// information names the server, and the number of the request that it answers.
    pub fn take_response(&self, out: &mut Vec<u8>) -> Option<MessageInfo> {
        self.responses.take_bytes(self.session.core(), out)
    }

    /// Like [`take_response`](Self::take_response), in place, as
    /// [`Subscription::take_sample`](crate::Subscription::take_sample) does.
    pub fn take_response_sample(&self) -> Option<(MessageInfo, Sample)> {
        self.responses.take_sample(self.session.core())
    }

    /// Like [`take_response`](Self::take_response), after waiting for at most `timeout`.
    ///
    /// # Errors
    /// [`RecvError::TimedOut`], and [`RecvError::Forked`] in a forked child.
    pub fn recv_response(
        &self,
        out: &mut Vec<u8>,
        timeout: Option<Duration>,
    ) -> Result<MessageInfo, RecvError> {
        self.responses.recv(self.session.core(), timeout, || self.take_response(out))
    }

    /// Returns whether there is a server that a request sent now reaches, and whose response reaches this client.
    pub fn is_available(&self) -> bool {
        !self.servers().is_empty()
    }

    /// Waits until a server [is available](Self::is_available). Returns whether one is.
    pub fn wait_available(&self, timeout: Duration) -> bool {
        self.session.wait_changed(timeout, || self.is_available())
    }

    /// Returns the servers that it reaches and that reach it.
    pub fn servers(&self) -> Vec<Gid> {
        both(&self.requests, &self.responses, &self.session)
    }

    /// Returns the servers that a relay serves: [`servers`](Self::servers), and ended servers whose responses are still
    /// to come.
    pub(crate) fn attached(&self) -> Vec<Gid> {
        attached(&self.requests, &self.responses, &self.session)
    }

    /// Returns whether there is a response to take.
    pub fn has_response(&self) -> bool {
        !self.session.is_forked() && self.responses.has_data()
    }

    /// Like [`Subscription::set_on_new_sample`](crate::Subscription::set_on_new_sample), for responses.
    ///
    /// # Errors
    /// As there.
    pub fn set_on_new_response(
        &self,
        callback: Option<NewDataCallback>,
    ) -> Result<(), SessionError> {
        set_callback(&self.responses, callback, &self.session)
    }

    /// Like [`Subscription::tell_no_more`](crate::Subscription::tell_no_more).
    pub(crate) fn tell_no_more(&self) {
        if !self.session.is_forked() {
            self.responses.tell_no_more(self.session.core());
        }
    }
}

impl fmt::Debug for Client {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("Client").field(self.endpoint()).finish()
    }
}

impl Drop for Client {
    fn drop(&mut self) {
        self.tell_no_more();
        self.session.forget_endpoint(&self.gid());
    }
}
