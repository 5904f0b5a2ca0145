//! A writer of a topic.

use std::{
    collections::BTreeSet,
    fmt, io,
    ops::{Deref, DerefMut},
    sync::{Arc, Mutex, MutexGuard, PoisonError},
    time::{Duration, SystemTime},
};

use axon_shm::{
    PublishError, ShmError,
    internal::{Grant, Location, ReaderInfo, Terms, Writer, holds, nanoseconds},
};

use super::{
    Session, clock,
    events::{Changes, EndpointEvents, Event, EventSource},
    rings::Rings,
    state::Outgoing,
};
use crate::{
    events::EventKind,
    graph::{Endpoint, EndpointKind},
    ids::{Gid, SessionId},
    qos::{Liveliness, Qos},
    wire::session::{EndpointRole, Fence, Granted},
};

/// Sends the samples of a topic. Thread-safe. When it is dropped, readers still take what it left.
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
    pub(super) inner: Arc<PublisherInner>,
    pub(super) writer: Arc<Writer>,
    pub(super) session: Session,
}

impl Publisher {
    /// Its GID.
    pub fn gid(&self) -> Gid {
        self.inner.endpoint.gid
    }

    /// Itself, as others see it.
    pub fn endpoint(&self) -> &Endpoint {
        &self.inner.endpoint
    }

    /// Publishes a sample, stamped with the current time, and returns its sequence number.
    ///
    /// # Errors
    /// [`PublishError::Blocked`] after 100 ms when a KEEP_ALL reader makes no room; the others say
    /// what does not fit. A sample that was refused has no sequence number: nobody counts it lost.
    pub fn publish(&self, payload: &[u8]) -> Result<u64, PublishError> {
        self.inner.published(self.writer.publish_next(clock::wall(), payload))
    }

    /// As [`publish`](Self::publish), with a source timestamp of the caller's: of 1677 to 2262, in
    /// nanoseconds.
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

    /// If a sample would be read by nobody, now or later, uses up the next sequence number and
    /// returns it; `None` when somebody would. Where nobody reads, publishing does the same, but
    /// a caller that has to serialize first can save the work.
    ///
    /// # Errors
    /// [`PublishError::Forked`].
    pub fn skip_unread(&self) -> Result<Option<u64>, PublishError> {
        let skipped = self.writer.skip_unread()?;
        if skipped.is_some() { self.inner.published(Ok(skipped)) } else { Ok(None) }
    }

    /// Says that it is alive. Where its liveliness is MANUAL_BY_TOPIC, so does every publication;
    /// where it is AUTOMATIC, its session says so.
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

    /// Waits until every sample published so far is acknowledged; whether it is.
    ///
    /// Between processes of this host that share memory a sample is acknowledged at once, whether or not it
    /// has been taken. What it says of another host depends on the QoS of the publisher and of each
    /// subscription there that it matches:
    ///
    /// - Both RELIABLE and KEEP_ALL: the host has the sample in the ring from which its subscriptions take.
    /// - Both RELIABLE, one of them KEEP_LAST: that ring has the newest samples that were published, as many
    ///   as the depth (the smaller one, where both are KEEP_LAST), or newer ones. Older samples are
    ///   acknowledged, too, though newer ones may have replaced them on the way.
    /// - One of them BEST_EFFORT: nothing. The sample was sent or dropped.
    ///
    /// A host that has no such subscription any more waits for nothing. A peer that runs a version of AXON
    /// which sends no acknowledgements counts as having a sample when it was handed to the link.
    ///
    /// Returns false, once and at once, when samples were [given up](Self::given_up) since the last call:
    /// their link broke, the peer stopped reading, a limit dropped them, or this host's daemon was killed.
    ///
    /// Where one of two processes of this host shares no memory (`AXON_SHM`), a sample of a RELIABLE and
    /// KEEP_ALL publisher for a subscription like it is acknowledged when the other process has it. Until
    /// then it is kept, and goes to the next daemon if this one ends. For other subscriptions it is when
    /// this host's daemon has taken it over. One that ends waits for that no longer than a second.
    pub fn wait_acknowledged(&self, timeout: Duration) -> bool {
        self.session.is_forked() || self.writer.wait_handed_over(timeout)
    }

    /// Samples for other hosts that are not [acknowledged](Self::wait_acknowledged) yet.
    pub fn unacknowledged(&self) -> u64 {
        self.writer.under_way()
    }

    /// Samples that were never acknowledged, and will not be: for other hosts, or lost in the daemon where
    /// it carries this session's samples. Some of them may have arrived. Samples that newer ones replaced,
    /// for a KEEP_LAST or BEST_EFFORT subscription, are not among them.
    pub fn given_up(&self) -> u64 {
        self.writer.given_up()
    }

    /// One of its events; `None` where `kind` is a subscription's.
    pub fn event(&self, kind: EventKind) -> Option<Event> {
        Event::new(EventSource::Publisher(self.inner.clone()), kind, self.session.clone())
    }

    /// Room for a sample of exactly `len` bytes, to serialize into: in shared memory where it is
    /// more than 4 KiB, or more than 512 bytes if so many are
    /// [expected](super::EndpointSpec::expected_len).
    ///
    /// # Errors
    /// As for [`publish`](Self::publish).
    pub fn loan(&self, len: usize) -> Result<Loan<'_>, PublishError> {
        Ok(Loan { loan: self.writer.loan(len)?, publisher: &self.inner })
    }

    /// The readers that receive from it; a relay shows as the remote ones it stands for.
    pub fn matched(&self) -> Vec<Gid> {
        self.writer.readers()
    }

    /// Waits until at least `count` readers receive from it; whether they do.
    pub fn wait_matched(&self, count: usize, timeout: Duration) -> bool {
        self.session.wait_changed(timeout, || self.matched().len() >= count)
    }
}

impl Publisher {
    /// The number up to which its samples are with those who carry them to other processes and hosts, and
    /// can be read by all others whatever becomes of this process: these were sent the memory that they
    /// are in. The session's memory wakes the thread that waits for that.
    pub(crate) fn delivered_up_to(&self) -> u64 {
        let memory = &self.session.shared().memory;
        let (began, number) = (memory.connections(), self.writer.delivered_up_to());
        // In this order: it counts what the readers of those samples have to be sent.
        let handovers = memory.handovers();
        let mut sending = self.inner.sending();
        if sending.sent == Some(handovers) {
            sending.number = sending.number.max(number);
        } else if sending.asked.is_none_or(|asked| asked.connection != began) {
            // One at a time: where there is always something more to be sent, each is answered.
            sending.asked = Some(PendingFence { connection: began, handovers, number });
            let fence = Fence { writer: self.gid(), number: handovers };
            self.session.shared().tell(Outgoing::Fence(fence));
        }
        number.min(sending.number)
    }

    /// As [`loan`](Self::loan), of `len` bytes at most, for who cannot borrow the publisher. What is
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

/// A sample that the application writes in place, from the front or as a slice. Dropping the loan without
/// calling [`publish`](Self::publish) discards the sample.
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
/// let mut loan = publisher.loan(100_000)?;
/// loan.fill(7);
/// loan.publish()?;
///
/// let (_info, sample) = subscription.take_sample().expect("it is there");
/// assert_eq!(sample.len(), 100_000);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub struct Loan<'a> {
    loan: axon_shm::Loan<'a>,
    publisher: &'a PublisherInner,
}

impl Loan<'_> {
    /// Publishes it, stamped with the current time, and returns its sequence number.
    ///
    /// # Errors
    /// When fewer bytes were written than were asked for, and as for [`Publisher::publish`].
    pub fn publish(self) -> Result<u64, PublishError> {
        self.publisher.published(self.loan.publish_next(clock::wall()))
    }
}

impl Deref for Loan<'_> {
    type Target = [u8];

    fn deref(&self) -> &[u8] {
        &self.loan
    }
}

impl DerefMut for Loan<'_> {
    fn deref_mut(&mut self) -> &mut [u8] {
        &mut self.loan
    }
}

impl fmt::Debug for Loan<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("Loan").field(&self.publisher.endpoint.topic).finish()
    }
}

impl io::Write for Loan<'_> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.loan.write(bytes)
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// A sample that is being written, of which nothing but its start may be published.
pub(crate) struct OwnedLoan {
    loan: axon_shm::Loan<'static>,
    publisher: Arc<PublisherInner>,
}

impl OwnedLoan {
    /// Where it is written. It stays there.
    pub(crate) fn as_mut_ptr(&mut self) -> *mut u8 {
        self.loan.as_mut_ptr()
    }

    /// Publishes the first `len` bytes, with a time of the caller's or the current one, and returns
    /// the sequence number.
    pub(crate) fn publish(
        self,
        len: usize,
        source_timestamp: Option<i64>,
    ) -> Result<u64, PublishError> {
        let time = source_timestamp.unwrap_or_else(clock::wall);
        self.publisher.published(self.loan.publish_front(len, time))
    }
}

/// The writing side of a publisher, client or server, which the session's control thread shares with
/// the handle.
pub(super) struct PublisherInner {
    pub(super) endpoint: Endpoint,
    pub(super) role: EndpointRole,
    pub(super) rings: Rings,
    pub(super) events: EndpointEvents,
    /// A publication says that the publisher is alive, and nothing else but the program does.
    asserts: bool,
    /// Its samples come from a process of this host that shares no memory.
    pub(super) relayed: bool,
    /// Readers that were granted; a relay as itself.
    attached: Mutex<BTreeSet<Gid>>,
    sending: Mutex<Sending>,
}

/// How far readers were sent what they need to find a publisher's samples, by the session's count of
/// [handovers](super::daemon::memory_changes::MemoryChanges::handovers).
#[derive(Default)]
struct Sending {
    /// What the daemon was asked, and has not answered.
    asked: Option<PendingFence>,
    /// What it said was sent.
    sent: Option<u64>,
    /// The number of the last sample that can be found by that.
    number: u64,
}

/// A question to the daemon.
#[derive(Clone, Copy)]
struct PendingFence {
    /// Which connection to a daemon it was said on: another one does not answer it.
    connection: u64,
    handovers: u64,
    /// The last sample that had been handed over as it was asked.
    number: u64,
}

impl PublisherInner {
    pub(super) fn new(endpoint: Endpoint, role: EndpointRole, rings: Rings) -> Self {
        let Qos { liveliness, lease, .. } = endpoint.qos;
        let asserts = liveliness == Liveliness::ManualByTopic && lease.is_some();
        let events = EndpointEvents::of_publisher(&endpoint.qos, clock::monotonic());
        let (relayed, attached, sending) = (false, Mutex::default(), Mutex::default());
        Self { endpoint, role, rings, events, asserts, relayed, attached, sending }
    }

    /// Liveliness is asserted explicitly: the publisher runs in another process.
    pub(super) fn asserted(mut self) -> Self {
        self.asserts = self.endpoint.qos.lease.is_some();
        self.relayed = self.role == EndpointRole::Application;
        self
    }

    /// Serves a reader on its terms: what it is granted, the number in front of that, and in which ring.
    pub(super) fn attach(
        &self,
        reader: ReaderInfo,
        terms: Terms,
    ) -> Result<(Grant, u64, Location), ShmError> {
        let gid = reader.gid;
        let granted = self.rings.attach(reader, terms)?;
        self.attached().insert(gid);
        Ok(granted)
    }

    /// Whether it has samples for a reader that has not taken up its grant and must not lose one: a daemon that was
    /// killed may not have passed the grant on.
    pub(super) fn expects_readers(&self) -> bool {
        let Rings::Shared(writer) = &self.rings else { return false };
        self.endpoint.kind == EndpointKind::Publisher
            && self.role == EndpointRole::Application
            && holds(&self.endpoint.qos)
            && writer.expects_readers()
    }

    /// The readers of other sessions that have not taken up their grant, and how many samples there are for each.
    pub(super) fn unmet(&self) -> Vec<(Gid, u64)> {
        let Rings::Shared(writer) = &self.rings else { return Vec::new() };
        let counted =
            self.endpoint.kind == EndpointKind::Publisher && self.role == EndpointRole::Application;
        if counted { writer.unmet() } else { Vec::new() }
    }

    /// What it granted to readers of other sessions that have not taken it up, said once more.
    pub(super) fn pledged(&self, session: SessionId) -> Vec<Granted> {
        let counted = self.endpoint.kind == EndpointKind::Publisher
            && self.role == EndpointRole::Application
            && !self.relayed;
        let Some(writer) = self.rings.shared().filter(|_| counted) else { return Vec::new() };
        let ring = writer.location();
        let granted = |(reader, Grant { generation, first }, after)| Granted {
            reader,
            writer: self.endpoint.gid,
            generation,
            first,
            session,
            ring,
            segments: Vec::new(),
            after: Some(after),
            relayed: None,
        };
        writer.pledged().into_iter().map(granted).collect()
    }

    /// Whether it was attached.
    pub(super) fn detach(&self, reader: Gid) -> bool {
        self.attached().remove(&reader);
        self.rings.detach(reader)
    }

    /// Whether any reader's process was dead.
    pub(super) fn drop_dead(&self) -> bool {
        let dead = self.rings.drop_dead();
        let mut attached = self.attached();
        dead.iter().for_each(|gid| {
            attached.remove(gid);
        });
        !dead.is_empty()
    }

    /// The daemon says that readers were sent what they needed as this count was reached.
    pub(super) fn was_sent(&self, handovers: u64) {
        let mut sending = self.sending();
        if let Some(asked) = sending.asked.take_if(|asked| asked.handovers == handovers) {
            sending.sent = Some(handovers);
            sending.number = sending.number.max(asked.number);
        }
    }

    fn sending(&self) -> MutexGuard<'_, Sending> {
        self.sending.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The readers that were granted.
    pub(super) fn granted(&self) -> Vec<Gid> {
        self.attached().iter().copied().collect()
    }

    fn attached(&self) -> MutexGuard<'_, BTreeSet<Gid>> {
        self.attached.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// What became of its matches since it was asked last.
    pub(super) fn rematch(&self) -> Changes {
        self.events.readers(|| self.rings.readers())
    }

    /// Counts the deadlines that passed, and asserts or watches the lease. When to look again, and
    /// whether something happened.
    pub(super) fn look_at_time(&self, now: u64) -> (Option<u64>, bool) {
        let qos = &self.endpoint.qos;
        let Rings::Shared(writer) = &self.rings else { return (None, false) };
        let times = writer.times();
        let (due, news) = self.events.offered(qos, &times, now);
        let Some(lease) = qos.lease.filter(|_| !self.asserts) else {
            return (due, news);
        };
        let third = nanoseconds(lease / 3).max(1_000_000);
        let mut next = times.asserted.map_or(now, |asserted| asserted.saturating_add(third));
        if next <= now {
            writer.assert(now);
            next = now.saturating_add(third);
        }
        (Some(due.map_or(next, |due| due.min(next))), news)
    }

    /// Notes what was published, where somebody watches the time.
    pub(super) fn published<T>(&self, result: Result<T, PublishError>) -> Result<T, PublishError> {
        let deadline = self.endpoint.qos.deadline.is_some();
        if result.is_ok()
            && (deadline || self.asserts)
            && let Rings::Shared(writer) = &self.rings
        {
            let now = clock::monotonic();
            if deadline {
                writer.note_sample(now);
            }
            if self.asserts {
                writer.assert(now);
            }
        }
        result
    }
}
