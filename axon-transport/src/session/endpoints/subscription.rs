//! A subscription, as its application holds it.

use std::{fmt, sync::Arc, time::Duration};

use axon_shm::{Sample, ShmError};

use super::event::Event;
use crate::{
    events::EventKind,
    graph::Endpoint,
    ids::Gid,
    session::{
        endpoint_state::{EventSource, MessageInfo, NewDataCallback, SubscriptionInner},
        error::{RecvError, SessionError},
        handle::Session,
    },
};

/// Receives the samples of a topic. Thread-safe.
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
/// let publisher = session.create_publisher(spec())?;
/// let subscription = session.create_subscription(spec())?;
/// assert!(publisher.wait_matched(1, Duration::from_secs(10)));
/// publisher.publish(b"1.5 m/s")?;
///
/// let mut payload = Vec::new();
/// subscription.recv(&mut payload, Some(Duration::from_secs(10)))?;
/// assert_eq!(payload, b"1.5 m/s");
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub struct Subscription {
    pub(in crate::session) inner: Arc<SubscriptionInner>,
    pub(in crate::session) session: Session,
}

impl Subscription {
    /// Its GID.
    pub fn gid(&self) -> Gid {
        self.inner.endpoint.gid
    }

    /// Itself, as others see it.
    pub fn endpoint(&self) -> &Endpoint {
        &self.inner.endpoint
    }

    /// The oldest sample by source timestamp among all publishers, into `out`, which it replaces.
    /// `None` when there is none.
    ///
    /// A publisher whose sample is in memory that this process has not been told of yet, such as its
    /// first one of more than 4 KiB, holds up none of the others: newer samples of theirs come first.
    /// Clocks are taken at their word. Where KEEP_LAST's depth passes samples over, they are those
    /// with the oldest timestamps: a publisher whose clock is ahead has the others' passed over.
    pub fn take(&self, out: &mut Vec<u8>) -> Option<MessageInfo> {
        self.inner.take_bytes(self.session.core(), out)
    }

    /// As [`take`](Self::take), but a sample of more than 4 KiB, or a loan of more than 512 bytes whose
    /// publisher [expects](crate::EndpointSpec::expected_len) so many, stays in the publisher's memory
    /// for as long as it is kept, unless `AXON_SHM_COPY` asks for copies.
    pub fn take_sample(&self) -> Option<(MessageInfo, Sample)> {
        self.inner.take_sample(self.session.core())
    }

    /// As [`take`](Self::take), after waiting for a sample for at most `timeout`; without end where it is
    /// `None`.
    ///
    /// # Errors
    /// [`RecvError::TimedOut`], and [`RecvError::Forked`] in a forked child.
    pub fn recv(
        &self,
        out: &mut Vec<u8>,
        timeout: Option<Duration>,
    ) -> Result<MessageInfo, RecvError> {
        self.inner.recv(self.session.core(), timeout, || self.take(out))
    }

    /// Whether there is something to take.
    pub fn has_data(&self) -> bool {
        !self.session.is_forked() && self.inner.has_data()
    }

    /// The publishers it receives from.
    pub fn matched(&self) -> Vec<Gid> {
        if self.session.is_forked() {
            return Vec::new();
        }
        self.inner.matched()
    }

    /// Waits until it receives from at least `count` publishers; whether it does.
    pub fn wait_matched(&self, count: usize, timeout: Duration) -> bool {
        self.session.wait_changed(timeout, || self.matched().len() >= count)
    }

    /// Samples that were lost: overwritten before they were taken, missing in memory that is gone, or published for this
    /// subscription by a publisher that ended before this process was told of it.
    pub fn lost(&self) -> u64 {
        if self.session.is_forked() {
            return 0;
        }
        self.inner.lost()
    }

    /// Samples that were older than their publisher's lifespan when they would have been taken.
    pub fn expired(&self) -> u64 {
        if self.session.is_forked() { 0 } else { self.inner.expired() }
    }

    /// Has `callback` told of new samples from now on, in place of the one before, which is not
    /// called any more once this returns. Those that are there to be taken, and that nobody was told of, it is
    /// told at once, on this thread; others as they come, on the control thread. It must neither block nor
    /// panic, nor hold the session.
    ///
    /// # Errors
    /// In a forked child, or when an event loop of the program's listens already
    /// (an [`ExternalLeader`](axon_shm::ExternalLeader)).
    pub fn set_on_new_sample(&self, callback: Option<NewDataCallback>) -> Result<(), SessionError> {
        if self.session.is_forked() {
            return Err(ShmError::Forked.into());
        }
        Ok(self.inner.set_on_new_sample(callback, self.session.core())?)
    }

    /// The callback has returned and is not called any more once this returns, whatever is set from now
    /// on: for one that other threads may still use though it has ended.
    pub(crate) fn tell_no_more(&self) {
        if !self.session.is_forked() {
            self.inner.tell_no_more(self.session.core());
        }
    }

    /// One of its events; `None` where `kind` is a publisher's.
    pub fn event(&self, kind: EventKind) -> Option<Event> {
        Event::new(EventSource::Subscription(self.inner.clone()), kind, self.session.clone())
    }

    /// Samples taken.
    pub fn received(&self) -> u64 {
        if self.session.is_forked() { 0 } else { self.inner.received() }
    }
}

impl fmt::Debug for Subscription {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("Subscription").field(self.endpoint()).finish()
    }
}

impl Drop for Subscription {
    fn drop(&mut self) {
        self.tell_no_more();
        self.session.forget_endpoint(&self.gid());
    }
}
