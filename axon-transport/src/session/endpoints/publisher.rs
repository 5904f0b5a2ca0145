//! A publisher: the application's handle.

use std::{
    fmt,
    sync::Arc,
    time::{Duration, SystemTime},
};

use axon_shm::{PublishError, internal::Writer};

use super::{
    event::Event,
    loan::{Loan, OwnedLoan},
};
use crate::{
    events::EventKind,
    graph::Endpoint,
    ids::Gid,
    session::{
        clock,
        endpoint_state::{EventSource, PublisherInner},
        handle::Session,
    },
};

/// Sends the samples of a topic. Thread-safe. After it is dropped, readers still take its remaining samples.
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
/// let sequence = publisher.publish(b"1.5 m/s")?;
/// assert_eq!(sequence, 1);
/// # drop(subscription);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub struct Publisher {
    pub(in crate::session) inner: Arc<PublisherInner>,
    pub(in crate::session) writer: Arc<Writer>,
    pub(in crate::session) session: Session,
}

impl Publisher {
    /// Returns the publisher's GID.
    pub fn gid(&self) -> Gid {
        self.inner.endpoint.gid
    }

    /// Returns the endpoint that describes the publisher in the graph.
    pub fn endpoint(&self) -> &Endpoint {
        &self.inner.endpoint
    }

    /// Publishes a sample, stamped with the current time, and returns its sequence number.
    ///
    /// # Errors
    /// [`PublishError::Blocked`] after 100 ms if a KEEP_ALL reader frees no space. The other variants tell why the
    /// sample was not published. A refused sample has no sequence number and does not count as lost.
    pub fn publish(&self, payload: &[u8]) -> Result<u64, PublishError> {
        self.inner.published(self.writer.publish_next(clock::wall(), payload))
    }

    /// Like [`publish`](Self::publish), with the caller's source timestamp. A sample carries it in nanoseconds, which
    /// reach from the year 1677 to 2262.
    ///
    /// # Errors
    /// As for [`publish`](Self::publish).
    pub fn publish_at(
        &self,
        source_timestamp: SystemTime,
        payload: &[u8],
    ) -> Result<u64, PublishError> {
        let source_timestamp = clock::unix_nanos(source_timestamp);
        self.inner.published(self.writer.publish_next(source_timestamp, payload))
    }

    /// If no reader would read a sample, now or later, uses up the next sequence number and returns it; otherwise
    /// returns `None`. Without readers, publishing does the same, but a caller that has to serialize first can save the
    /// work.
    ///
    /// # Errors
    /// [`PublishError::Forked`].
    pub fn skip_unread(&self) -> Result<Option<u64>, PublishError> {
        let skipped = self.writer.skip_unread()?;
        if skipped.is_some() { self.inner.published(Ok(skipped)) } else { Ok(None) }
    }

    /// Asserts the liveliness of the publisher. With MANUAL_BY_TOPIC, every publication does this, too; with AUTOMATIC,
    /// the session does it.
    ///
    /// # Errors
    /// [`PublishError::Forked`].
    pub fn assert_liveliness(&self) -> Result<(), PublishError> {
        if self.session.is_forked() {
            return Err(PublishError::Forked);
        }
        if self.inner.asserts {
            self.writer.assert(clock::monotonic());
        }
        Ok(())
    }

    /// Waits until every sample published so far is acknowledged. Returns whether it is.
    ///
    /// Between processes of this host that share memory, a sample is acknowledged at once, whether or not it has been
    /// taken. For another host, the meaning depends on the QoS of the publisher and of each subscription there that it
    /// matches:
    ///
    /// - Both RELIABLE and KEEP_ALL: the host has the sample in the ring from which its subscriptions take.
    /// - Both RELIABLE, one of them KEEP_LAST: that ring has the newest samples that were published, as many
    ///   as the depth (the smaller one, where both are KEEP_LAST), or newer ones. Older samples are
    ///   acknowledged, too, though newer ones may have replaced them on the way.
    /// - One of them BEST_EFFORT: nothing. The sample was sent or dropped.
    ///
    /// A host that has no such subscription any more is not waited for. A peer with a version of AXON that sends no
    /// acknowledgements counts as having a sample when the sample was handed to the link.
    ///
    /// Returns false, once and at once, when samples were [given up](Self::given_up) since the last call:
    /// their link broke, the peer stopped reading, a limit dropped them, or this host's daemon was killed.
    ///
    /// If one of two processes of this host shares no memory (`AXON_SHM`), a sample of a RELIABLE and KEEP_ALL
    /// publisher for a RELIABLE and KEEP_ALL subscription is acknowledged when the other process has it. Until then it
    /// is kept, and goes to the next daemon if this one ends. For other subscriptions, it is acknowledged when this
    /// host's daemon has taken it over. A process that ends waits for that for at most a second.
    pub fn wait_acknowledged(&self, timeout: Duration) -> bool {
        self.session.is_forked() || self.writer.wait_handed_over(timeout)
    }

    /// Returns the number of samples for other hosts that are not [acknowledged](Self::wait_acknowledged) yet.
    pub fn unacknowledged(&self) -> u64 {
        self.writer.under_way()
    }

    /// Returns the number of samples that were never acknowledged, and will not be: for other hosts, or lost in the
    /// daemon if it carries this session's samples. Some of them may have arrived. Samples that newer ones replaced,
    /// for a KEEP_LAST or BEST_EFFORT subscription, do not count.
    pub fn given_up(&self) -> u64 {
        self.writer.given_up()
    }

    /// Returns one of its events; `None` if `kind` belongs to subscriptions.
    pub fn event(&self, kind: EventKind) -> Option<Event> {
        Event::new(EventSource::Publisher(self.inner.clone()), kind, self.session.clone())
    }

    /// Reserves space for a sample of exactly `len` bytes, to serialize into: in shared memory if it is more than 4
    /// KiB, or more than 512 bytes if so many are [expected](crate::EndpointSpec::expected_len).
    ///
    /// # Errors
    /// As for [`publish`](Self::publish).
    pub fn loan(&self, len: usize) -> Result<Loan<'_>, PublishError> {
        Ok(Loan { loan: self.writer.loan(len)?, publisher: &self.inner })
    }

    /// Returns the readers that receive from it; a relay counts as the remote readers that it stands for.
    pub fn matched(&self) -> Vec<Gid> {
        self.writer.readers()
    }

    /// Counts the readers that [`matched`](Self::matched) lists. Allocates nothing.
    pub fn matched_count(&self) -> usize {
        self.writer.reader_count()
    }

    /// Waits until at least `count` readers receive from it. Returns whether they do.
    pub fn wait_matched(&self, count: usize, timeout: Duration) -> bool {
        self.session.wait_changed(timeout, || self.matched_count() >= count)
    }
}

impl Publisher {
    /// Returns the number up to which the samples survive the end of this process. The carriers to other processes and
    /// hosts have these samples. All other readers can read them, since they have received the samples' memory. A
    /// thread that waits for this sleeps on the session's segment, which wakes it.
    pub(crate) fn delivered_up_to(&self) -> u64 {
        self.inner.delivered_up_to(self.session.core())
    }

    /// Like [`loan`](Self::loan), of at most `len` bytes, for a caller that cannot borrow the publisher. The part
    /// behind the first `header` bytes is aligned to 16.
    pub(crate) fn loan_owned(&self, header: usize, len: usize) -> Result<OwnedLoan, PublishError> {
        Ok(OwnedLoan { loan: self.writer.loan_owned(header, len)?, publisher: self.inner.clone() })
    }
}

impl fmt::Debug for Publisher {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("Publisher").field(self.endpoint()).finish()
    }
}

impl Drop for Publisher {
    fn drop(&mut self) {
        self.session.forget_endpoint(&self.gid());
    }
}
