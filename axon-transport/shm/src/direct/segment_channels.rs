//! Announces a context's segments to subscribers, without a daemon. Each subscriber has a socket of its own (a
//! line), over which it receives news of opened and closed segments.

use std::{
    os::fd::{AsFd, BorrowedFd},
    sync::{
        Mutex, MutexGuard, PoisonError, TryLockError,
        atomic::{AtomicBool, Ordering},
    },
    time::{Duration, Instant},
};

use rustix::net::sockopt;

use crate::{
    alloc::segments::{SegmentEvent, SegmentInfo},
    direct::connect::{ConnectChannel, ConnectError, PublisherAnswer},
    ids::{Gid, SessionId},
    os::descriptors::PassedFd,
    ring::layout::SegmentKind,
    session::{peer::RingPeer, segment::SessionSegment},
    wake::Purpose,
};

/// Send buffer of a line in bytes: about twenty packets. Each segment in a packet keeps its memory, although its
/// publisher may have dropped it since.
const QUEUE_BYTES: usize = 8 << 10;
/// Minimum time between two retries on lines that are behind.
const RETRY_INTERVAL: Duration = Duration::from_millis(10);

/// All lines of a context.
pub(crate) struct SegmentChannels {
    session: SessionId,
    state: Mutex<ChannelsState>,
    /// True if a line has not been told everything. A hint; the state itself is protected by the locks.
    behind: AtomicBool,
}

#[derive(Default)]
struct ChannelsState {
    lines: Vec<SegmentChannel>,
    /// The last attempt to send to channels that are behind.
    tried: Option<Instant>,
}

/// The channel over which one subscriber is told about segments.
struct SegmentChannel {
    reader: Gid,
    writer: Gid,
    peer: RingPeer,
    socket: PassedFd,
    /// The segments that this line has announced and still has to withdraw when they are dropped.
    told: Vec<SegmentInfo>,
    /// True if no new samples reach the subscriber over this channel.
    ended: bool,
}

impl SegmentChannel {
    /// Returns whether the subscriber may need the segment.
    fn reads(&self, kind: SegmentKind) -> bool {
        match kind {
            SegmentKind::Session => false,
            SegmentKind::Heap => true,
            SegmentKind::Samples(gid) => gid == self.writer,
        }
    }

    fn open(
        &mut self,
        session: SessionId,
        info: SegmentInfo,
        fd: BorrowedFd<'_>,
    ) -> Result<(), ConnectError> {
        if self.ended || !self.reads(info.kind) || self.told.contains(&info) {
            return Ok(());
        }
        self.channel().hand(session, info, fd)?;
        self.told.push(info);
        Ok(())
    }

    fn close(&mut self, session: SessionId, info: SegmentInfo) -> Result<(), ConnectError> {
        if let Some(index) = self.told.iter().position(|told| *told == info) {
            self.channel().withdraw(session, info.number)?;
            self.told.swap_remove(index);
        }
        Ok(())
    }

    /// Announces new segments and withdraws dropped ones.
    fn catch_up(&mut self, session: &SessionSegment, first: u32) -> Result<(), ConnectError> {
        let mut segments = session.further();
        segments.sort_by_key(|segment| (segment.number() != first, segment.number()));
        let gone = |told: &&SegmentInfo| segments.iter().all(|segment| segment.info != **told);
        for info in self.told.iter().filter(gone).copied().collect::<Vec<_>>() {
            self.close(session.id(), info)?;
        }
        for segment in segments {
            self.open(session.id(), segment.info, segment.memory.fd())?;
        }
        Ok(())
    }

    /// Sample segments, which are withdrawn when the publisher drops them. Other segments stay as long as the context.
    fn samples(&self) -> impl Iterator<Item = &SegmentInfo> {
        self.told.iter().filter(|told| matches!(told.kind, SegmentKind::Samples(_)))
    }

    /// Returns the channel; its sends do not block.
    fn channel(&self) -> ConnectChannel<'_> {
        ConnectChannel::new(self.socket.as_fd(), Some(Duration::ZERO))
    }
}

impl ChannelsState {
    /// Calls `tell` for each channel. Removes channels that are closed, and ended ones with nothing left to send.
    /// Returns whether all were told.
    fn each(
        &mut self,
        mut tell: impl FnMut(&mut SegmentChannel) -> Result<(), ConnectError>,
    ) -> bool {
        let mut all = true;
        let parted = self.lines.extract_if(.., |line| match tell(line) {
            Ok(()) => line.ended && line.samples().next().is_none(),
            Err(ConnectError::Closed) => true,
            // The queue is full or descriptors are short. That is temporary.
            Err(_) => {
                all = false;
                false
            }
        });
        for parted in parted.collect::<Vec<_>>() {
            // The context at the other end may live on with these segments mapped, so another line to it has to
            // withdraw them.
            let same = |line: &&mut SegmentChannel| line.peer.id() == parted.peer.id();
            let Some(heir) = self.lines.iter_mut().find(same) else { continue };
            for info in parted
                .samples()
                .filter(|info| !heir.told.contains(info))
                .copied()
                .collect::<Vec<_>>()
            {
                heir.told.push(info);
                all = false;
            }
        }
        all
    }
}

impl SegmentChannels {
    pub(crate) fn new(session: SessionId) -> Self {
        Self { session, state: Mutex::default(), behind: AtomicBool::new(false) }
    }

    /// Adds a line: a subscriber of session `peer` is told over `socket` about the existing segments and about new
    /// ones. The segment with its ring comes first.
    pub(crate) fn add(
        &self,
        session: &SessionSegment,
        peer: RingPeer,
        granted: &PublisherAnswer,
        socket: PassedFd,
    ) -> Result<(), ConnectError> {
        let PublisherAnswer { reader, writer, ring, .. } = *granted;
        // If the size cannot be set, the socket buffers more. That costs only memory.
        let _ = sockopt::set_socket_send_buffer_size(&socket, QUEUE_BYTES);
        let mut line =
            SegmentChannel { reader, writer, peer, socket, told: Vec::new(), ended: false };
        let mut state = self.lock();
        let told = line.catch_up(session, ring.segment);
        let has_ring =
            ring.segment == 0 || line.told.iter().any(|told| told.number == ring.segment);
        match told {
            Err(error) if !has_ring || matches!(error, ConnectError::Closed) => return Err(error),
            told => self.note(told.is_ok()),
        }
        // If the same pair connects again, only its new line is told.
        state.lines.retain(|line| (line.reader, line.writer) != (reader, writer));
        state.lines.push(line);
        Ok(())
    }

    /// Handles an event about a segment. The caller holds the lock of the segments' table, so this does not block.
    pub(crate) fn tell(&self, event: SegmentEvent<'_>) {
        let mut state = match self.state.try_lock() {
            Ok(state) => state,
            Err(TryLockError::Poisoned(poisoned)) => poisoned.into_inner(),
            Err(TryLockError::WouldBlock) => {
                // The thread that holds the lock may have visited all segments already.
                self.behind.store(true, Ordering::Relaxed);
                return;
            }
        };
        self.note(state.each(|line| match event {
            SegmentEvent::Opened(info, fd) => line.open(self.session, info, fd),
            SegmentEvent::Gone(info) => line.close(self.session, info),
            // Only their owner prepares the publishers here.
            SegmentEvent::Low(_) => Ok(()),
        }));
    }

    fn note(&self, all_told: bool) {
        if !all_told {
            self.behind.store(true, Ordering::Relaxed);
        }
    }

    /// Tells the lines that are behind what they miss, at most once per [`RETRY_INTERVAL`]. Does not wait for another
    /// thread that is doing so; the next call does the rest then.
    #[inline]
    pub(crate) fn keep_up(&self, session: &SessionSegment) {
        if self.behind.load(Ordering::Relaxed) && !session.is_forked() {
            match self.state.try_lock() {
                Ok(state) => self.retry(state, session),
                Err(TryLockError::Poisoned(state)) => self.retry(state.into_inner(), session),
                Err(TryLockError::WouldBlock) => {}
            }
        }
    }

    /// Like [`keep_up`](Self::keep_up), but always at once and waiting for the lock: the caller's next call may never
    /// come.
    pub(crate) fn keep_up_now(&self, session: &SessionSegment) {
        if self.behind.load(Ordering::Relaxed) && !session.is_forked() {
            self.catch_up(self.lock(), session);
        }
    }

    #[cold]
    fn retry(&self, state: MutexGuard<'_, ChannelsState>, session: &SessionSegment) {
        if state.tried.is_none_or(|tried| tried.elapsed() >= RETRY_INTERVAL) {
            self.catch_up(state, session);
        }
    }

    fn catch_up(&self, mut state: MutexGuard<'_, ChannelsState>, session: &SessionSegment) {
        state.tried = Some(Instant::now());
        // Stored before the tables are read. A segment that comes after a read finds the lock taken and stores `true`;
        // the lock of the segments' table orders that store after this one.
        self.behind.store(false, Ordering::Relaxed);
        self.note(state.each(|line| {
            let told = line.catch_up(session, 0);
            // The subscriber may be asleep, waiting for the segment that it misses.
            line.peer.ring_if(Purpose::Samples);
            told
        }));
    }

    /// Removes the channel of a subscriber that is gone.
    pub(crate) fn forget(&self, reader: Gid) {
        let gone = |line: &mut SegmentChannel| line.reader == reader;
        let told =
            self.lock().each(|line| if gone(line) { Err(ConnectError::Closed) } else { Ok(()) });
        self.note(told);
    }

    /// Marks the channels of a subscriber, or of a publisher, as ended: they announce no new segments. Published
    /// samples stay readable.
    pub(crate) fn end(&self, gid: Gid) {
        let told = self.lock().each(|line| {
            line.ended |= line.reader == gid || line.writer == gid;
            Ok(())
        });
        self.note(told);
    }

    fn lock(&self) -> MutexGuard<'_, ChannelsState> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_publish_does_not_wait_for_a_thread_that_tells() {
        let session = SessionSegment::create(SessionId::random()).unwrap();
        let lines = SegmentChannels::new(session.id());
        lines.note(false);
        let telling = lines.lock();
        lines.keep_up(&session);
        assert!(lines.behind.load(Ordering::Relaxed), "it is left for the next call");
        drop(telling);
        lines.keep_up(&session);
        assert!(!lines.behind.load(Ordering::Relaxed));
    }
}
