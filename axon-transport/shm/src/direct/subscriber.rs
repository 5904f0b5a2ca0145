//! Subscribing without a daemon.

use std::{
    fmt,
    os::fd::AsFd,
    sync::{Arc, Mutex, PoisonError},
    time::{Duration, Instant},
};

use rustix::net::{Shutdown, shutdown};

use crate::{
    direct::{
        connect::{AttachRequest, ConnectChannel, ConnectError, line},
        context::Context,
    },
    error::TakeError,
    ids::Gid,
    os::descriptors::PassedFd,
    qos::Qos,
    reader::{Reader, ReaderOptions, sample::Sample},
    ring::types::{Grant, Meta},
    session::peer::{PeerSession, RingPeer},
};

/// The longest sleep. A publisher may store a sample and die before it rings the doorbell; the sample is found then.
const LONGEST_SLEEP: Duration = Duration::from_secs(1);
/// Most updates that one call reads. A socket holds fewer, unless the other end fills it all the time.
const MAX_UPDATES: u32 = 64;

/// Options of a [`Subscriber`].
///
/// ```
/// use axon_shm::{SubscriberOptions, qos::Qos};
///
/// let options = SubscriberOptions::new(Qos::sensor_data()).max_len(1 << 20);
/// # let _ = options;
/// ```
#[derive(Clone, Copy, Debug)]
pub struct SubscriberOptions {
    qos: Qos,
    max_len: u64,
}

impl SubscriberOptions {
    /// Returns options of a subscriber that requests `qos` and takes samples of up to 256 MiB.
    pub fn new(qos: Qos) -> Self {
        Self { qos, max_len: 256 << 20 }
    }

    /// Sets the largest sample in bytes. Longer samples count as lost.
    #[must_use]
    pub fn max_len(self, max_len: u64) -> Self {
        Self { max_len, ..self }
    }
}

/// Takes the samples of one publisher. After the publisher's end it takes the samples that are left.
///
/// A subscriber may be moved to another thread, but only one thread at a time can take. Samples that were taken are
/// independent of it: they may be sent to any thread and outlive it.
///
/// ```
/// # use axon_shm::{Context, Publisher, Sample, Subscriber};
/// # fn may_be_shared<T: Send + Sync>() {}
/// # fn may_be_sent<T: Send>() {}
/// # may_be_shared::<Context>();
/// # may_be_shared::<Publisher>();
/// # may_be_shared::<Sample>();
/// # may_be_sent::<Subscriber>();
/// fn keep_one(mut subscriber: Subscriber) -> Option<Sample> {
///     let sample = subscriber.take().ok()?;
///     drop(subscriber);
///     sample
/// }
/// ```
///
/// ```compile_fail,E0499
/// # use axon_shm::Subscriber;
/// fn twice_at_once(subscriber: &mut Subscriber) {
///     std::thread::scope(|scope| {
///         scope.spawn(|| subscriber.take());
///         scope.spawn(|| subscriber.take());
///     });
/// }
/// ```
///
/// There are three ways to wait: [`recv`](Self::recv) blocks; [`Context::wait`] blocks on any number of subscribers;
/// [`Context::event`] returns a descriptor for an event loop, for example tokio's.
pub struct Subscriber {
    context: Context,
    reader: Reader,
    gid: Gid,
    /// The socket over which the publisher passes memory that comes into use later. `None` if the publisher is in the
    /// same context.
    line: Option<Mutex<PassedFd>>,
    /// Keeps the publisher's memory mapped, if the publisher is in another context.
    _hold: Option<Hold>,
    /// When `recv` last read the line.
    tended: Instant,
}

/// Keeps the memory of a publisher's large samples mapped.
struct Hold {
    context: Context,
    peer: Arc<PeerSession>,
    publisher: Gid,
}

impl Hold {
    fn new(context: &Context, peer: &Arc<PeerSession>, publisher: Gid) -> Self {
        peer.subscribe(publisher);
        Self { context: context.clone(), peer: Arc::clone(peer), publisher }
    }
}

impl Drop for Hold {
    fn drop(&mut self) {
        // A thread of the parent may have held the lock when a child was forked.
        if !self.context.session().is_forked() {
            self.peer.unsubscribe(self.publisher);
        }
    }
}

impl Subscriber {
    /// Sends a request to the publisher that [serves](crate::Publisher::serve) at the other end of `socket`, and waits
    /// at most `timeout` for its answer. The socket is not needed afterwards.
    ///
    /// # Errors
    /// The publisher did not answer in time, refused, or passed something unusable.
    pub fn connect(
        context: &Context,
        socket: impl AsFd,
        options: SubscriberOptions,
        timeout: Option<Duration>,
    ) -> Result<Self, ConnectError> {
        let SubscriberOptions { qos, max_len: max_message } = options;
        let start = Instant::now();
        let channel = ConnectChannel::new(socket.as_fd(), timeout);
        let lane = context.session().allocate_lane()?;
        let gid = context.next_gid();
        let asked =
            AttachRequest { session: context.id(), reader: gid, lane: lane.location(), qos };
        let asking = context.asking(gid, lane.location())?;
        let (ours, theirs) = line()?;
        channel.ask(&asked, &context.session().descriptors()?, &theirs)?;
        drop(theirs);
        let (granted, descriptors) = channel.await_granted(gid)?;
        let peer = if granted.session == context.id() {
            asking.answered(&granted)?
        } else {
            context.peer(granted.session, descriptors)?
        };
        let ring = granted.ring;
        let (mut kept, mut hold) = (None, None);
        if let RingPeer::Remote(peer) = &peer {
            hold = Some(Hold::new(context, peer, granted.writer));
            let left = timeout.map(|timeout| timeout.saturating_sub(start.elapsed()));
            let channel = ConnectChannel::new(ours.as_fd(), left);
            // The ring is not in the first segment: the publisher sends its segment over the line.
            while !peer.has_segment(ring.segment) {
                context.hear(peer, channel.take_update()?);
            }
            // The process at the other end decides what is queued in the socket, and so how long closing it takes.
            kept = Some(Mutex::new(PassedFd::received(ours)));
        }
        let reader = Reader::map(ReaderOptions {
            reader: gid,
            writer: granted.writer,
            peer,
            ring,
            lane,
            grant: Grant { generation: granted.generation, first: granted.first },
            qos,
            max_message,
        })?;
        let (context, tended) = (context.clone(), Instant::now());
        Ok(Self { context, reader, gid, line: kept, _hold: hold, tended })
    }

    /// Returns the subscriber's GID.
    #[inline]
    pub fn gid(&self) -> Gid {
        self.gid
    }

    /// Returns the publisher's GID.
    #[inline]
    pub fn publisher(&self) -> Gid {
        self.reader.writer()
    }

    /// Returns the next sample, or `None` if there is none. Never waits. A sample of more than 4 KiB stays in the
    /// publisher's memory as long as it is kept. So does a loan of more than 512 bytes if its publisher
    /// [expects](crate::PublisherOptions::expected_len) such samples.
    ///
    /// If more samples are unread than the requested depth, the oldest are [skipped](Self::skipped).
    ///
    /// # Errors
    /// See [`TakeError`]. After [`TakeError::Corrupt`] there will be no more samples.
    #[inline]
    pub fn take(&mut self) -> Result<Option<Sample>, TakeError> {
        self.take_with(Reader::take_sample)
    }

    /// Like [`take`](Self::take), but replaces the contents of `out`. It does not allocate if `out` is large enough.
    ///
    /// # Errors
    /// The errors of [`take`](Self::take).
    pub fn take_into(&mut self, out: &mut Vec<u8>) -> Result<Option<Meta>, TakeError> {
        Ok(self.take_with(|reader| reader.take(out))?.map(|taken| taken.meta))
    }

    fn take_with<T>(
        &mut self,
        mut take: impl FnMut(&mut Reader) -> Result<Option<T>, TakeError>,
    ) -> Result<Option<T>, TakeError> {
        let taken = take(&mut self.reader)?;
        if taken.is_some() || self.reader.missing().is_none() {
            return Ok(taken);
        }
        self.hear();
        take(&mut self.reader)
    }

    /// Handles the updates that the publisher sent about its memory.
    fn hear(&self) {
        let (Some(line), Some(publisher)) = (&self.line, self.reader.peer().remote()) else {
            return;
        };
        // An update that a forked child receives is lost to the parent.
        if self.context.session().is_forked() {
            return;
        }
        let line = line.lock().unwrap_or_else(PoisonError::into_inner);
        for _ in 0..MAX_UPDATES {
            match ConnectChannel::new(line.as_fd(), Some(Duration::ZERO)).take_update() {
                Ok(news) => self.context.hear(publisher, news),
                // An update that finds no room here stays in the socket until the next call.
                Err(_) => break,
            }
        }
        self.context.hear_again();
    }

    /// Unmaps memory that the publisher dropped. Call this about once a second if in-place samples are taken only now
    /// and then. [`recv`](Self::recv) does it while it waits.
    pub fn reclaim_idle(&self) {
        self.hear();
    }

    /// Like [`take`](Self::take), but waits at most `timeout` for a sample. Also returns `None` if the publisher's
    /// process has ended and no sample of it is left.
    ///
    /// # Errors
    /// The errors of [`take`](Self::take).
    pub fn recv(&mut self, timeout: Option<Duration>) -> Result<Option<Sample>, TakeError> {
        let deadline = timeout.and_then(|timeout| Instant::now().checked_add(timeout));
        loop {
            // Also checked while there are samples to take, because the subscriber may never run out of them.
            if self.line.is_some() && self.tended.elapsed() >= LONGEST_SLEEP {
                self.tended = Instant::now();
                self.reclaim_idle();
            }
            if let Some(sample) = self.take()? {
                return Ok(Some(sample));
            }
            let left = deadline.map_or(LONGEST_SLEEP, |deadline| {
                deadline.saturating_duration_since(Instant::now()).min(LONGEST_SLEEP)
            });
            // In this order: the check for samples then sees what the publisher published before it ended.
            if left.is_zero() || (self.publisher_ended() && self.reader.is_drained()) {
                return Ok(None);
            }
            if !self.context.wait(|| self.has_data(), Some(left)) {
                self.reclaim_idle();
            }
        }
    }

    /// Returns whether there is something to take. Costs two loads, and a system call only while a segment of the
    /// publisher is missing. For [`Context::wait`] and event loops.
    #[inline]
    pub fn has_data(&self) -> bool {
        if self.reader.has_data() {
            return true;
        }
        // The missing segment may be queued in the socket.
        self.reader.missing().is_some() && {
            self.hear();
            self.reader.has_data()
        }
    }

    /// Returns the number of samples taken.
    #[inline]
    pub fn received(&self) -> u64 {
        self.reader.received()
    }

    /// Returns the number of samples that were overwritten before they could be taken, within the requested depth.
    #[inline]
    pub fn lost(&self) -> u64 {
        self.reader.lost()
    }

    /// Returns the number of samples that were passed over because newer ones fill the requested depth.
    #[inline]
    pub fn skipped(&self) -> u64 {
        self.reader.skipped()
    }

    /// Returns whether the publisher's process has ended, by a system call. The samples that it left can still be
    /// taken.
    pub fn publisher_ended(&self) -> bool {
        self.reader.writer_dead()
    }
}

impl Drop for Subscriber {
    fn drop(&mut self) {
        // The publisher learns at once that nobody listens, so it hands its pending updates to another line. A forked
        // child shares its end of the line with its parent.
        if let (Some(line), false) = (&mut self.line, self.context.session().is_forked()) {
            let line = line.get_mut().unwrap_or_else(PoisonError::into_inner);
            let _ = shutdown(&*line, Shutdown::Both);
        }
    }
}

impl fmt::Debug for Subscriber {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Subscriber")
            .field("gid", &self.gid)
            .field("publisher", &self.publisher())
            .finish_non_exhaustive()
    }
}
