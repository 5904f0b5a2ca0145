//! A reader of all matched publishers of a topic, merged into one stream.

mod counts;
mod inner;
mod matched_reader;
mod matched_readers;
mod message_info;
mod remembered;
mod slots;
mod taking;
#[cfg(test)]
mod tests;
mod trusted;

use std::{
    fmt,
    ops::Range,
    sync::Arc,
    time::{Duration, Instant},
};

use axon_shm::{
    Meta, Sample, ShmError, TakeError,
    internal::{Reader, WakeCheck},
};

use self::taking::Take;
pub(super) use self::{
    inner::SubscriptionInner,
    matched_reader::Numbers,
    matched_readers::{Accept, Asking},
};
pub use self::{
    message_info::{Lifetime, MessageInfo},
    taking::TakeLimit,
    trusted::TrustedSubscription,
};
use super::{
    OnNew, RecvError, Session, SessionError,
    events::{Event, EventSource},
    state::{Outgoing, SessionShared},
};
use crate::{
    events::EventKind,
    graph::Endpoint,
    ids::Gid,
    wire::session::{Message, Pair},
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
    pub(super) inner: Arc<SubscriptionInner>,
    pub(super) session: Session,
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
        take_bytes_from(&self.inner, self.session.shared(), out)
    }

    /// As [`take`](Self::take), but a sample of more than 4 KiB, or a loan of more than 512 bytes whose
    /// publisher [expects](super::EndpointSpec::expected_len) so many, stays in the publisher's memory
    /// for as long as it is kept, unless `AXON_SHM_COPY` asks for copies.
    pub fn take_sample(&self) -> Option<(MessageInfo, Sample)> {
        take_sample_from(&self.inner, self.session.shared())
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
        recv_from(&self.inner, &self.session, timeout, || self.take(out))
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
        let matched_readers = self.inner.lock();
        let matched = matched_readers.slots.iter().filter(|slot| slot.counts());
        matched.map(|slot| slot.reader.writer()).collect()
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
        self.inner.lock().losses()
    }

    /// Samples that were older than their publisher's lifespan when they would have been taken.
    pub fn expired(&self) -> u64 {
        if self.session.is_forked() { 0 } else { self.inner.lock().counts.expired }
    }

    /// Has `callback` told of new samples from now on, in place of the one before, which is not
    /// called any more once this returns. Those that are there to be taken, and that nobody was told of, it is
    /// told at once, on this thread; others as they come, on the control thread. It must neither block nor
    /// panic, nor hold the session.
    ///
    /// # Errors
    /// In a forked child, or when an event loop of the program's listens already
    /// (an [`ExternalLeader`](axon_shm::ExternalLeader)).
    pub fn set_on_new_sample(&self, callback: Option<OnNew>) -> Result<(), SessionError> {
        if self.session.is_forked() {
            return Err(ShmError::Forked.into());
        }
        Ok(self.inner.set_on_new_sample(callback, self.session.shared())?)
    }

    /// The callback has returned and is not called any more once this returns, whatever is set from now
    /// on: for one that other threads may still use though it has ended.
    pub(crate) fn tell_no_more(&self) {
        if !self.session.is_forked() {
            self.inner.tell_no_more(self.session.shared());
        }
    }

    /// One of its events; `None` where `kind` is a publisher's.
    pub fn event(&self, kind: EventKind) -> Option<Event> {
        Event::new(EventSource::Subscription(self.inner.clone()), kind, self.session.clone())
    }

    /// Samples taken.
    pub fn received(&self) -> u64 {
        if self.session.is_forked() { 0 } else { self.inner.lock().counts.received }
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

/// The oldest of what one may take, in place.
pub(super) fn take_sample_from(
    inner: &SubscriptionInner,
    shared: &SessionShared,
) -> Option<(MessageInfo, Sample)> {
    let copy = shared.config.shm_copy;
    take_from(inner, shared, |reader| {
        let sample = if copy { reader.take_copy() } else { reader.take_sample() };
        Ok(sample?.map(|sample| (sample.meta(), sample)))
    })
}

/// The oldest of what one may take.
pub(super) fn take_from<T>(
    inner: &SubscriptionInner,
    shared: &SessionShared,
    take: impl FnMut(&mut Reader) -> Result<Option<(Meta, T)>, TakeError>,
) -> Option<(MessageInfo, T)> {
    take_with(inner, shared, |begun| begun.next(take))
}

/// The same as bytes, into `out`, which it replaces.
pub(super) fn take_bytes_from(
    inner: &SubscriptionInner,
    shared: &SessionShared,
    out: &mut Vec<u8>,
) -> Option<MessageInfo> {
    let take = |reader: &mut Reader| Ok(reader.take(out)?.map(|taken| (taken.meta, ())));
    take_from(inner, shared, take).map(|(info, ())| info)
}

/// The next of one writer, as bytes.
pub(super) fn take_of(
    inner: &SubscriptionInner,
    session: &Session,
    writer: &Gid,
) -> Option<(MessageInfo, Vec<u8>)> {
    let mut out = Vec::new();
    let take = |reader: &mut Reader| Ok(reader.take(&mut out)?.map(|taken| (taken.meta, ())));
    let shared = session.shared();
    let (info, ()) = take_with(inner, shared, |begun| begun.next_of(writer, take))?;
    Some((info, out))
}

/// Samples of one writer, into `out`, which it replaces. `each` is told where a sample's payload is. Returns how many.
pub(super) fn take_many_of(
    inner: &SubscriptionInner,
    session: &Session,
    writer: &Gid,
    most: TakeLimit,
    out: &mut Vec<u8>,
    each: impl FnMut(MessageInfo, Range<usize>),
) -> usize {
    out.clear();
    let taken = take_with(inner, session.shared(), |begun| {
        Some(begun.many_of(writer, most, out, each)).filter(|taken| *taken > 0)
    });
    taken.unwrap_or(0)
}

/// The next sample of one writer, for a relay, and how many of that writer's were lost by then. The process has not forked.
pub(super) fn sample_of(inner: &SubscriptionInner, writer: &Gid) -> Option<(Sample, u64)> {
    Take::begin(&mut inner.lock(), inner.take_rules()).sample_of(writer)
}

/// What `take` takes; `None` when there is nothing.
fn take_with<T>(
    inner: &SubscriptionInner,
    shared: &SessionShared,
    take: impl FnOnce(Take<'_>) -> Option<T>,
) -> Option<T> {
    // A thread of the parent may have held the lock when this process was forked.
    if shared.segment.is_forked() {
        tracing::error!("an endpoint of the parent process is used after fork");
        return None;
    }
    let mut matched_readers = inner.lock();
    let taken = take(Take::begin(&mut matched_readers, inner.take_rules()));
    let gone = std::mem::take(&mut matched_readers.discarded);
    let lost = matched_readers.new_losses();
    let again = if taken.is_none() { matched_readers.slots.look_again() } else { None };
    drop(matched_readers);
    if let Some(again) = again {
        shared.look_again(again);
    }
    inner.events.lost(lost);
    for writer in gone {
        let detach = Message::Detach(Pair { reader: inner.endpoint.gid, writer });
        shared.tell(Outgoing::Message(Box::new(detach)));
    }
    taken
}

/// What `take` finds, after waiting for at most `timeout`.
pub(super) fn recv_from<T>(
    inner: &Arc<SubscriptionInner>,
    session: &Session,
    timeout: Option<Duration>,
    mut take: impl FnMut() -> Option<T>,
) -> Result<T, RecvError> {
    let mut begun = None;
    loop {
        // Nothing comes to a forked child, however long it waits.
        if session.is_forked() {
            return Err(RecvError::Forked);
        }
        if let Some(taken) = take() {
            return Ok(taken);
        }
        // What is there already is taken without a look at the clock.
        let now = Instant::now();
        let waited = now.duration_since(*begun.get_or_insert(now));
        let left = timeout.map(|timeout| timeout.saturating_sub(waited));
        let look = || -> Arc<dyn WakeCheck> { inner.clone() };
        let over = left.is_some_and(|left| left.is_zero());
        if over || !session.segment().wait_for(|| inner.has_data(), &look, left) {
            return Err(RecvError::TimedOut);
        }
    }
}
