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

/// No sleep is longer: what a publisher stored last and did not live to ring for is found then.
const LONGEST_SLEEP: Duration = Duration::from_secs(1);
/// Updates that one look reads at most. A socket holds fewer, unless the other end fills it all the time.
const MAX_UPDATES: u32 = 64;

/// What a [`Subscriber`] asks for.
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
    /// A subscriber that requests `qos` and takes samples of up to 256 MiB.
    pub fn new(qos: Qos) -> Self {
        Self { qos, max_len: 256 << 20 }
    }

    /// The largest sample in bytes. Longer ones count as lost.
    #[must_use]
    pub fn max_len(self, max_len: u64) -> Self {
        Self { max_len, ..self }
    }
}

/// Takes the samples of one publisher. Goes on after that one's end until nothing is left.
///
/// It may be moved to another thread, and taking is for one thread at a time; the samples that were
/// taken are no part of it, so they may go anywhere and outlive it.
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
/// Three ways to wait: [`recv`](Self::recv) blocks; [`Context::wait`] blocks on any number of
/// subscribers; [`Context::event`] has a descriptor for an event loop, such as that of tokio.
pub struct Subscriber {
    context: Context,
    reader: Reader,
    gid: Gid,
    /// Over which memory of the publisher's comes that is in use only later; absent where the
    /// publisher is in the same context.
    line: Option<Mutex<PassedFd>>,
    /// Keeps the publisher's memory, where that is in another context.
    _hold: Option<Hold>,
    /// When the line was read last.
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
    /// Asks the publisher that [serves](crate::Publisher::serve) at the other end of `socket`, and
    /// waits for its answer for at most `timeout`. The socket is not needed any more after it.
    ///
    /// # Errors
    /// It did not answer in time, refused, or handed over what cannot be used.
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
            // A ring that is not in the first segment: its own follows.
            while !peer.has_segment(ring.segment) {
                context.hear(peer, channel.take_update()?);
            }
            // The process at the other end decides what is queued in it, and so how long closing it takes.
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

    /// Its GID.
    #[inline]
    pub fn gid(&self) -> Gid {
        self.gid
    }

    /// The publisher's GID.
    #[inline]
    pub fn publisher(&self) -> Gid {
        self.reader.writer()
    }

    /// The next sample, or `None` when there is none. Never waits. One of more than 4 KiB, or a loan of
    /// more than 512 bytes if its publisher [expects](crate::PublisherOptions::expected_len) such,
    /// stays in the publisher's memory for as long as it is kept.
    ///
    /// Where more is unread than the requested depth, the oldest are [skipped](Self::skipped).
    ///
    /// # Errors
    /// See [`TakeError`]. After [`TakeError::Corrupt`] there will be no more samples.
    #[inline]
    pub fn take(&mut self) -> Result<Option<Sample>, TakeError> {
        self.take_with(Reader::take_sample)
    }

    /// As [`take`](Self::take), but into `out`, which it replaces: without an allocation where
    /// `out` is large enough.
    ///
    /// # Errors
    /// As for [`take`](Self::take).
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

    /// Takes in what the publisher said of its memory.
    fn hear(&self) {
        let (Some(line), Some(publisher)) = (&self.line, self.reader.peer().remote()) else {
            return;
        };
        // What a child takes its parent never hears.
        if self.context.session().is_forked() {
            return;
        }
        let line = line.lock().unwrap_or_else(PoisonError::into_inner);
        for _ in 0..MAX_UPDATES {
            match ConnectChannel::new(line.as_fd(), Some(Duration::ZERO)).take_update() {
                Ok(news) => self.context.hear(publisher, news),
                // What finds no room here is there the next time, too.
                Err(_) => break,
            }
        }
        self.context.hear_again();
    }

    /// Lets go of memory that the publisher gave up. To be called about once a second where samples
    /// in place are taken now and then; [`recv`](Self::recv) does it while it waits.
    pub fn reclaim_idle(&self) {
        self.hear();
    }

    /// As [`take`](Self::take), after waiting for a sample for at most `timeout`. `None` also when
    /// the publisher's process has ended and nothing of it is left.
    ///
    /// # Errors
    /// As for [`take`](Self::take).
    pub fn recv(&mut self, timeout: Option<Duration>) -> Result<Option<Sample>, TakeError> {
        let deadline = timeout.and_then(|timeout| Instant::now().checked_add(timeout));
        loop {
            // Not only once there is nothing to take, which may never be.
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
            // In this order: what it published before it ended is seen by the look.
            if left.is_zero() || (self.publisher_ended() && self.reader.is_drained()) {
                return Ok(None);
            }
            if !self.context.wait(|| self.has_data(), Some(left)) {
                self.reclaim_idle();
            }
        }
    }

    /// Whether there is something to take: two loads, and a system call only while memory of the
    /// publisher's is missing. For [`Context::wait`] and event loops.
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

    /// Samples taken.
    #[inline]
    pub fn received(&self) -> u64 {
        self.reader.received()
    }

    /// Samples overwritten before they could be taken, within the requested depth.
    #[inline]
    pub fn lost(&self) -> u64 {
        self.reader.lost()
    }

    /// Samples passed over because more recent ones fill the requested depth.
    #[inline]
    pub fn skipped(&self) -> u64 {
        self.reader.skipped()
    }

    /// Whether the publisher's process has ended: a system call. What it left can be taken still.
    pub fn publisher_ended(&self) -> bool {
        self.reader.writer_dead()
    }
}

impl Drop for Subscriber {
    fn drop(&mut self) {
        // The publisher hears at once that nobody listens, so that what it says is not lost. A
        // forked child's end of the line is its parent's, too.
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
