//! A subscription: the application's handle.

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
    /// Returns the subscription's GID.
    pub fn gid(&self) -> Gid {
        self.inner.endpoint.gid
    }

    /// Returns the endpoint that describes the subscription in the graph.
    pub fn endpoint(&self) -> &Endpoint {
        &self.inner.endpoint
    }

    /// Takes the oldest sample by source timestamp among all publishers into `out`, whose content it replaces. Returns
    /// `None` if there is none.
    ///
    /// A sample may be in memory that this process has not received yet, such as a publisher's first sample of more
    /// than 4 KiB. Its publisher holds up no other publisher: their newer samples come first. The timestamps are not
    /// checked. If KEEP_LAST's depth skips samples, it skips the samples with the oldest timestamps: a publisher whose
    /// clock is ahead makes the samples of the others be skipped.
    pub fn take(&self, out: &mut Vec<u8>) -> Option<MessageInfo> {
        self.inner.take_bytes(self.session.core(), out)
    }

    /// Like [`take`](Self::take), but a sample of more than 4 KiB, or a loan of more than 512 bytes whose publisher
    /// [expects](crate::EndpointSpec::expected_len) so many, stays in the publisher's memory for as long as it is kept,
    /// unless `AXON_SHM_COPY` requests copies.
    pub fn take_sample(&self) -> Option<(MessageInfo, Sample)> {
        self.inner.take_sample(self.session.core())
    }

    /// Like [`take`](Self::take), after waiting for a sample for at most `timeout`, or without limit if it is `None`.
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

    /// Returns whether there is a sample to take.
    pub fn has_data(&self) -> bool {
        !self.session.is_forked() && self.inner.has_data()
    }

    /// Returns the publishers that it receives from.
    pub fn matched(&self) -> Vec<Gid> {
        if self.session.is_forked() {
            return Vec::new();
        }
        self.inner.matched()
    }

    /// Counts the publishers that [`matched`](Self::matched) lists. Allocates nothing.
    pub fn matched_count(&self) -> usize {
        if self.session.is_forked() { 0 } else { self.inner.matched_count() }
    }

    /// Waits until it receives from at least `count` publishers. Returns whether it does.
    pub fn wait_matched(&self, count: usize, timeout: Duration) -> bool {
        self.session.wait_changed(timeout, || self.matched_count() >= count)
    }

    /// Returns the number of lost samples: overwritten before they were taken, missing in memory that is gone, or
    /// published for this subscription by a publisher that ended before this process learned of it.
    pub fn lost(&self) -> u64 {
        if self.session.is_forked() {
            return 0;
        }
        self.inner.lost()
    }

    /// Returns the number of samples that were older than their publisher's lifespan when their turn came.
    pub fn expired(&self) -> u64 {
        if self.session.is_forked() { 0 } else { self.inner.expired() }
    }

    /// Sets the callback for new samples. The previous callback is not called any more once this returns. The new
    /// callback receives at once, on this thread, the number of untaken samples that no callback has received. Later
    /// samples are reported on the control thread as they come. The callback must neither block nor panic, nor hold the
    /// session.
    ///
    /// # Errors
    /// In a forked child, or if an event loop of the program listens already (an
    /// [`ExternalLeader`](axon_shm::ExternalLeader)).
    pub fn set_on_new_sample(&self, callback: Option<NewDataCallback>) -> Result<(), SessionError> {
        if self.session.is_forked() {
            return Err(ShmError::Forked.into());
        }
        Ok(self.inner.set_on_new_sample(callback, self.session.core())?)
    }

    /// Ends the callback for good. Once this returns, the callback has returned and is not called any more, whatever is
    /// set later: for a handle that other threads may still use although it has ended.
    pub(crate) fn tell_no_more(&self) {
        if !self.session.is_forked() {
            self.inner.tell_no_more(self.session.core());
        }
    }

    /// Returns one of its events; `None` if `kind` belongs to publishers.
    pub fn event(&self, kind: EventKind) -> Option<Event> {
        Event::new(EventSource::Subscription(self.inner.clone()), kind, self.session.clone())
    }

    /// Returns the number of samples taken.
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
