//! Publishing without a daemon.

use std::{
    fmt,
    os::fd::AsFd,
    time::{Duration, Instant},
};

use crate::{
    direct::{
        connect::{AttachRequest, ConnectChannel, ConnectError, PublisherAnswer},
        context::Context,
    },
    error::{PublishError, ShmError},
    ids::Gid,
    os::{clock::wall, descriptors::PassedFd},
    qos::{Qos, compatible},
    ring::types::{Grant, Meta, RingOptions},
    session::{
        peer::{PeerDescriptors, RingPeer},
        reader_info::ReaderInfo,
    },
    writer::{Writer, loan::Loan},
};

/// Options of a [`Publisher`].
///
/// ```
/// use axon_shm::{PublisherOptions, qos::Qos};
///
/// // Images of a fixed size: their memory is there before the first one.
/// let images = PublisherOptions::new(Qos::sensor_data()).max_len(1 << 20).expected_len(1 << 20);
/// # let _ = images;
/// ```
#[derive(Clone, Copy, Debug)]
pub struct PublisherOptions {
    qos: Qos,
    budget: u64,
    max_len: u64,
    expected_len: u64,
}

impl PublisherOptions {
    /// Returns options of a publisher that offers `qos`, keeps at most 64 MiB and publishes samples of up to 256 MiB.
    /// Memory is allocated as samples need it.
    pub fn new(qos: Qos) -> Self {
        Self { qos, budget: 64 << 20, max_len: 256 << 20, expected_len: 0 }
    }

    /// Sets the bytes of samples to keep before the oldest are dropped. One sample is always kept. Each sample counts
    /// as a multiple of 128 bytes.
    #[must_use]
    pub fn budget(self, budget: u64) -> Self {
        Self { budget, ..self }
    }

    /// Sets the largest sample in bytes.
    #[must_use]
    pub fn max_len(self, max_len: u64) -> Self {
        Self { max_len, ..self }
    }

    /// Sets the length of most samples in bytes. If it is more than 512, the publisher has its own memory for samples
    /// from the start, and subscribers get it when they connect. [Loans](Publisher::loan) of more than 512 bytes are
    /// then in place there, like all samples of more than 4 KiB. Otherwise only samples of more than 4 KiB are, in
    /// memory that is allocated with the first of them.
    #[must_use]
    pub fn expected_len(self, expected_len: u64) -> Self {
        Self { expected_len, ..self }
    }
}

/// Publishes samples to the subscribers that it [serves](Self::serve). All methods may be called from any thread, also
/// concurrently. After it is dropped, subscribers can still take the samples that are left. The memory of those samples
/// is freed when other publishers of the context [reclaim](Self::reclaim_idle) theirs, or with the context.
///
/// ```
/// # use std::{os::unix::net::UnixDatagram, thread, time::Duration};
/// # use axon_shm::{Context, Publisher, PublisherOptions, Subscriber, SubscriberOptions, qos::Qos};
/// # let context = Context::new()?;
/// # let publisher = Publisher::new(&context, PublisherOptions::new(Qos::default()))?;
/// # let (ours, theirs) = UnixDatagram::pair()?;
/// # let options = SubscriberOptions::new(Qos::default());
/// # let ten = Some(Duration::from_secs(10));
/// # let mut subscriber = thread::scope(|scope| {
/// #     let subscriber = scope.spawn(|| Subscriber::connect(&context, &theirs, options, ten));
/// #     publisher.serve(&ours, ten).map(|_| ())?;
/// #     subscriber.join().unwrap()
/// # })?;
/// publisher.publish(b"hello")?;
/// let sample = subscriber.recv(ten)?.expect("a sample");
/// assert_eq!(sample.len(), 5);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub struct Publisher {
    context: Context,
    qos: Qos,
    writer: Writer,
}

impl Publisher {
    /// Creates a publisher without subscribers.
    ///
    /// # Errors
    /// The options exceed the limits of a ring, or memory or descriptors are short.
    pub fn new(context: &Context, options: PublisherOptions) -> Result<Self, ShmError> {
        let PublisherOptions { qos, budget, max_len: max_message, expected_len: expected } =
            options;
        let gid = context.next_gid();
        let ring = RingOptions { gid, qos, budget, max_message, expected };
        let writer = Writer::create(context.session().clone(), ring)?;
        Ok(Self { context: context.clone(), qos, writer })
    }

    /// Returns the publisher's GID.
    #[inline]
    pub fn gid(&self) -> Gid {
        self.writer.gid()
    }

    /// Admits the one subscriber that [connects](crate::Subscriber::connect) at the other end of `socket`, and returns
    /// its GID. `socket` is a connected unix socket that preserves packet boundaries (`SOCK_SEQPACKET` or
    /// `SOCK_DGRAM`). Waits at most `timeout` for the subscriber.
    ///
    /// The process at the other end is trusted to have the identity that it claims. The memory that it shares is not
    /// trusted. The socket is not needed afterwards.
    ///
    /// # Errors
    /// The subscriber did not ask in time, requested a QoS that this publisher does not offer, or passed something
    /// unusable. If it asked, it is told the reason.
    pub fn serve(&self, socket: impl AsFd, timeout: Option<Duration>) -> Result<Gid, ConnectError> {
        let channel = ConnectChannel::new(socket.as_fd(), timeout);
        let (asked, descriptors, line) = channel.await_asked()?;
        let gid = asked.reader;
        let admitted = self.admit(asked, descriptors).and_then(|(granted, peer)| {
            self.answer(&channel, &granted, peer, line).inspect_err(|_| {
                self.writer.detach(gid);
            })
        });
        match admitted {
            Ok(()) => Ok(gid),
            Err(error) => {
                channel.refuse(gid, &error);
                Err(error)
            }
        }
    }

    fn admit(
        &self,
        asked: AttachRequest,
        descriptors: PeerDescriptors,
    ) -> Result<(PublisherAnswer, RingPeer), ConnectError> {
        let AttachRequest { session, reader: gid, lane, qos } = asked;
        compatible(&self.qos, &qos).map_err(ConnectError::Incompatible)?;
        let peer = if session == self.context.id() {
            self.context.asked_itself(gid, lane)?
        } else {
            self.context.peer(session, descriptors)?
        };
        let info = ReaderInfo { gid, lane, qos, peer: peer.clone(), stands_for: None };
        let Grant { generation, first } = self.writer.attach(info)?;
        let (session, writer) = (self.context.id(), self.gid());
        let ring = self.writer.location();
        let granted = PublisherAnswer { reader: gid, session, writer, generation, first, ring };
        if let RingPeer::Local(_) = peer {
            self.context.granted_itself(&granted)?;
        }
        Ok((granted, peer))
    }

    /// Answers the subscriber, and passes it the memory in use now and any memory that comes into use later.
    fn answer(
        &self,
        channel: &ConnectChannel<'_>,
        granted: &PublisherAnswer,
        peer: RingPeer,
        line: PassedFd,
    ) -> Result<(), ConnectError> {
        let session = self.context.session();
        channel.grant(granted, &session.descriptors()?)?;
        match peer {
            // A subscriber of this context has all the memory already and would never read the line.
            RingPeer::Local(_) => Ok(()),
            RingPeer::Remote(_) => self.context.lines().add(session, peer, granted, line),
        }
    }

    /// Passes on segments that could not be passed on when they came into use.
    #[inline]
    fn keep_up(&self) {
        self.context.lines().keep_up(self.context.session());
    }

    /// Publishes a sample, stamped with the current time, and returns its sequence number, which counts from 1. Waits
    /// up to 100 ms if this publisher and a subscriber of another context are both RELIABLE and KEEP_ALL and that
    /// subscriber lags. Never waits otherwise.
    ///
    /// # Errors
    /// The sample was not published. The error says what to do.
    #[inline]
    pub fn publish(&self, payload: &[u8]) -> Result<u64, PublishError> {
        let published = self.writer.publish_next(wall(), payload);
        self.keep_up();
        published
    }

    /// Like [`publish`](Self::publish), but never waits: returns [`PublishError::Blocked`] at once.
    ///
    /// # Errors
    /// The errors of [`publish`](Self::publish).
    #[inline]
    pub fn try_publish(&self, payload: &[u8]) -> Result<u64, PublishError> {
        let published = self.writer.try_publish_next(wall(), payload);
        self.keep_up();
        published
    }

    /// Like [`publish`](Self::publish), with the caller's number and time. Numbers must increase.
    ///
    /// # Errors
    /// The errors of [`publish`](Self::publish).
    #[inline]
    pub fn publish_with(&self, meta: Meta, payload: &[u8]) -> Result<(), PublishError> {
        let published = self.writer.publish(meta, payload);
        self.keep_up();
        published.map(drop)
    }

    /// If no subscriber would read a sample, now or later, uses up the next sequence number and returns it. Returns
    /// `None` if one would. Publishing does the same when nobody reads, but a caller that has to serialize first can
    /// save that work.
    ///
    /// # Errors
    /// [`PublishError::Forked`].
    pub fn skip_unread(&self) -> Result<Option<u64>, PublishError> {
        self.writer.skip_unread()
    }

    /// Lends memory for a sample of `len` bytes, which the caller fills and then publishes. It is shared memory, so
    /// nothing is copied, if `len` is more than 4 KiB, or more than 512 bytes if the publisher [expects so
    /// many](PublisherOptions::expected_len). It is aligned to 16 bytes.
    ///
    /// # Errors
    /// The errors of [`publish`](Self::publish).
    #[inline]
    pub fn loan(&self, len: usize) -> Result<Loan<'_>, PublishError> {
        self.loan_behind(0, len)
    }

    /// Like [`loan`](Self::loan), but the byte after the first `header` bytes is aligned to 16 bytes, not the first
    /// byte. The alignment also holds for a reader that takes the sample in place. An example is a structure that
    /// follows a header of four bytes.
    ///
    /// # Errors
    /// The errors of [`publish`](Self::publish).
    #[inline]
    pub fn loan_behind(&self, header: usize, len: usize) -> Result<Loan<'_>, PublishError> {
        let loan = self.writer.loan_behind(header, len);
        self.keep_up();
        loan
    }

    /// Allocates memory for one more sample of the length of the last in-place sample, so that publishing it does not
    /// wait for memory. For a thread that has time between samples.
    ///
    /// # Errors
    /// Memory is short, or the process forked.
    pub fn prepare(&self) -> Result<(), ShmError> {
        let prepared = self.writer.prepare();
        self.keep_up();
        prepared
    }

    /// Frees memory of in-place samples that is no longer needed. All of it is freed if no sample is kept there and
    /// none came for ten seconds. Otherwise it is freed once it is more than four times what was needed in those ten
    /// seconds, and samples move to new memory. Also passes on segments that could not be passed on when they came into
    /// use; the last sample before a pause may be in one of them. Call this about once a second as long as it returns
    /// true, and after the last sample before a pause.
    pub fn reclaim_idle(&self) -> bool {
        let more = self.writer.reclaim_idle(Instant::now());
        let more = self.context.session().tidy() || more;
        self.context.lines().keep_up_now(self.context.session());
        more
    }

    /// Returns the subscribers that it serves. They may include subscribers that have left since; see
    /// [`reap`](Self::reap).
    pub fn subscribers(&self) -> Vec<Gid> {
        self.writer.readers()
    }

    /// Forgets a subscriber. Returns false if it was not served. The subscriber may keep the samples that it has.
    pub fn dismiss(&self, subscriber: Gid) -> bool {
        let served = self.writer.detach(subscriber);
        if !self.context.session().is_forked() {
            self.context.lines().end(subscriber);
        }
        served
    }

    /// Forgets the subscribers that have left or whose process has ended, and returns their GIDs. Their memory is
    /// reused for the next samples.
    pub fn reap(&self) -> Vec<Gid> {
        let gone = self.writer.drop_gone();
        gone.iter().for_each(|gid| self.context.lines().forget(*gid));
        self.keep_up();
        gone
    }
}

impl Drop for Publisher {
    fn drop(&mut self) {
        if !self.context.session().is_forked() {
            self.context.lines().end(self.gid());
        }
    }
}

impl fmt::Debug for Publisher {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("Publisher").field(&self.gid()).finish()
    }
}
