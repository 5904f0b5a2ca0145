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

/// What a [`Publisher`] is made for.
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
    /// A publisher that offers `qos`, keeps at most 64 MiB and publishes samples of up to 256 MiB.
    /// Memory is taken as samples need it.
    pub fn new(qos: Qos) -> Self {
        Self { qos, budget: 64 << 20, max_len: 256 << 20, expected_len: 0 }
    }

    /// Bytes of samples to keep before the oldest go. One sample is always kept. Each counts
    /// as a multiple of 128 bytes.
    #[must_use]
    pub fn budget(self, budget: u64) -> Self {
        Self { budget, ..self }
    }

    /// The largest sample in bytes.
    #[must_use]
    pub fn max_len(self, max_len: u64) -> Self {
        Self { max_len, ..self }
    }

    /// The length of most samples in bytes. Where it is more than 512, the publisher has memory of
    /// its own for samples from the start: subscribers get it when they connect, and [loans](Publisher::loan)
    /// of more than 512 bytes are in place there, like all samples of more than 4 KiB. Otherwise only
    /// the latter are, in memory that comes with the first of them.
    #[must_use]
    pub fn expected_len(self, expected_len: u64) -> Self {
        Self { expected_len, ..self }
    }
}

/// Publishes samples to the subscribers that it [serves](Self::serve). All methods may be called
/// from any thread, at the same time too. When it is dropped, subscribers still take what it left;
/// the memory of that comes back as other publishers of the context [reclaim](Self::reclaim_idle) theirs, or
/// with the context.
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
    /// A publisher without subscribers.
    ///
    /// # Errors
    /// The options exceed what a ring may take, or memory or descriptors are short.
    pub fn new(context: &Context, options: PublisherOptions) -> Result<Self, ShmError> {
        let PublisherOptions { qos, budget, max_len: max_message, expected_len: expected } =
            options;
        let gid = context.next_gid();
        let ring = RingOptions { gid, qos, budget, max_message, expected };
        let writer = Writer::create(context.session().clone(), ring)?;
        Ok(Self { context: context.clone(), qos, writer })
    }

    /// Its GID.
    #[inline]
    pub fn gid(&self) -> Gid {
        self.writer.gid()
    }

    /// Admits the one subscriber that [connects](crate::Subscriber::connect) at the other end of
    /// `socket`, a connected unix socket that keeps packets apart (`SOCK_SEQPACKET` or
    /// `SOCK_DGRAM`), and returns its GID. Waits for it for at most `timeout`.
    ///
    /// The process at the other end is trusted to be the one that it claims to be. Memory that it
    /// shares is not trusted. The socket is not needed any more afterwards.
    ///
    /// # Errors
    /// It did not ask in time, asked for what this publisher does not offer, or handed over what
    /// cannot be used; it is told.
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

    /// Answers, and hands over the memory that is in use and, from then on, what comes into use.
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
            // It finds all of it here, and would take none of it from the line.
            RingPeer::Local(_) => Ok(()),
            RingPeer::Remote(_) => self.context.lines().add(session, peer, granted, line),
        }
    }

    /// Hands over what could not be handed over when it came into use.
    #[inline]
    fn keep_up(&self) {
        self.context.lines().keep_up(self.context.session());
    }

    /// Publishes a sample, stamped with the current time, and returns its sequence number, which
    /// counts from 1. Waits up to 100 ms where this publisher and a subscriber of another context
    /// are both RELIABLE and KEEP_ALL and that one lags; never otherwise.
    ///
    /// # Errors
    /// The sample was not published; what to do is in the error.
    #[inline]
    pub fn publish(&self, payload: &[u8]) -> Result<u64, PublishError> {
        let published = self.writer.publish_next(wall(), payload);
        self.keep_up();
        published
    }

    /// As [`publish`](Self::publish), but never waits: [`PublishError::Blocked`] at once.
    ///
    /// # Errors
    /// As for [`publish`](Self::publish).
    #[inline]
    pub fn try_publish(&self, payload: &[u8]) -> Result<u64, PublishError> {
        let published = self.writer.try_publish_next(wall(), payload);
        self.keep_up();
        published
    }

    /// As [`publish`](Self::publish), with a number and a time of the caller's. Numbers must rise.
    ///
    /// # Errors
    /// As for [`publish`](Self::publish).
    #[inline]
    pub fn publish_with(&self, meta: Meta, payload: &[u8]) -> Result<(), PublishError> {
        let published = self.writer.publish(meta, payload);
        self.keep_up();
        published.map(drop)
    }

    /// If a sample would be read by nobody, now or later, uses up the next sequence number and
    /// returns it; `None` when somebody would. Where nobody reads, publishing does the same, but
    /// a caller that has to serialize first can save the work.
    ///
    /// # Errors
    /// [`PublishError::Forked`].
    pub fn skip_unread(&self) -> Result<Option<u64>, PublishError> {
        self.writer.skip_unread()
    }

    /// Memory for a sample of `len` bytes, to be filled and then published: shared memory where it
    /// is more than 4 KiB, or more than 512 bytes if [so many are
    /// expected](PublisherOptions::expected_len), so that nothing is copied. It is aligned to 16.
    ///
    /// # Errors
    /// As for [`publish`](Self::publish).
    #[inline]
    pub fn loan(&self, len: usize) -> Result<Loan<'_>, PublishError> {
        self.loan_behind(0, len)
    }

    /// As [`loan`](Self::loan), but the byte behind the first `header` bytes is aligned to 16, not the
    /// first byte. It is so for a reader that takes the sample in place, too. An example is a structure
    /// that follows a header of four bytes.
    ///
    /// # Errors
    /// As for [`publish`](Self::publish).
    #[inline]
    pub fn loan_behind(&self, header: usize, len: usize) -> Result<Loan<'_>, PublishError> {
        let loan = self.writer.loan_behind(header, len);
        self.keep_up();
        loan
    }

    /// Has memory ready for one more sample as long as the last that was in place, so that
    /// publishing it waits for none. For a thread that has time between samples.
    ///
    /// # Errors
    /// There is no memory, or the process forked.
    pub fn prepare(&self) -> Result<(), ShmError> {
        let prepared = self.writer.prepare();
        self.keep_up();
        prepared
    }

    /// Gives memory back that samples in place took and that is not needed any more: all
    /// of it ten seconds after the last that anybody wants, else the part above four times what
    /// was needed for as long. And hands over what a subscriber had no room for when it came into use,
    /// which the last sample before a pause may be in. To be called about once a second for as long as
    /// it returns true, and after the last sample before a pause.
    pub fn reclaim_idle(&self) -> bool {
        let more = self.writer.reclaim_idle(Instant::now());
        let more = self.context.session().tidy() || more;
        self.context.lines().keep_up_now(self.context.session());
        more
    }

    /// The subscribers that it serves, among them such as have left since; see
    /// [`reap`](Self::reap).
    pub fn subscribers(&self) -> Vec<Gid> {
        self.writer.readers()
    }

    /// Forgets a subscriber; false when it was not served. Samples that it keeps it may keep.
    pub fn dismiss(&self, subscriber: Gid) -> bool {
        let served = self.writer.detach(subscriber);
        if !self.context.session().is_forked() {
            self.context.lines().end(subscriber);
        }
        served
    }

    /// Forgets the subscribers that have left or whose process has ended, and names them. Their
    /// memory comes back with the next samples.
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
