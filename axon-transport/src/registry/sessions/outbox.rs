//! The packets that wait for one session, and the remaining parts of a status that it is sent.

use std::{collections::VecDeque, sync::Arc};

use super::{encode, shares::makes_room};
use crate::{
    ids::{Gid, SessionId},
    registry::limits::{MAX_QUEUE, MAX_QUEUE_BYTES, STATUS_SLICE},
    wire::session::{SessionMessage, StatusPart},
};

/// Most kept packets (for readers) that may wait for one session.
const MAX_WAITING_KEPT: usize = 1024;

/// A packet for a session.
#[derive(Clone, Debug)]
pub struct SessionPacket<F> {
    /// The encoded message.
    pub packet: Arc<[u8]>,
    /// The descriptors that go with it.
    pub descriptors: Vec<F>,
    /// The segment that it passes on, if that is all it does.
    segment: Option<(SessionId, u32)>,
    /// Set if the packet is kept for this reader of the session, because the complete state does not contain it.
    pub(in crate::registry) kept_for: Option<Gid>,
    /// For a kept packet: the process of the publisher.
    pub(super) process: u32,
    /// The number of the packet among those queued for its session; 0 before it is queued.
    number: u64,
}

impl<F> SessionPacket<F> {
    /// Encodes a message. Returns `None` if it is too large; everything that the registry stores is small enough.
    pub(super) fn of(message: &SessionMessage, descriptors: Vec<F>) -> Option<Self> {
        let segment = match message {
            SessionMessage::Segment(opened) => Some((opened.session, opened.segment.number)),
            _ => None,
        };
        Some(Self {
            packet: encode(message)?,
            descriptors,
            segment,
            kept_for: None,
            process: 0,
            number: 0,
        })
    }

    /// Creates a packet about a publisher of `process`, which is kept for its reader whatever happens to the session's
    /// queue.
    pub(super) fn kept(
        message: &SessionMessage,
        descriptors: Vec<F>,
        reader: Gid,
        process: u32,
    ) -> Option<Self> {
        Some(Self { kept_for: Some(reader), process, ..Self::of(message, descriptors)? })
    }

    /// Creates a packet without descriptors.
    pub(super) fn plain(packet: Arc<[u8]>) -> Self {
        Self {
            packet,
            descriptors: Vec::new(),
            segment: None,
            kept_for: None,
            process: 0,
            number: 0,
        }
    }
}

/// What a session with an empty queue is sent next.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in crate::registry) enum DueMessage {
    /// The complete state, from its beginning.
    Everything,
    /// Further pairs of its endpoints.
    Pairs,
}

/// The result of queueing a packet.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Pushed {
    Queued,
    /// The session is behind and will be sent the complete state.
    Behind,
    /// The queue is full.
    Full,
}

/// The packets for one session, in order, with limits on their number and bytes.
///
/// A session that does not take its packets in time falls *behind*. Its queue is then dropped, except for kept packets
/// ([`push_kept`](Self::push_kept)), which it would not be sent again. Nothing else is queued for it until it reads
/// again, and then it is sent the complete state. Meanwhile the limits grow with the complete state.
#[derive(Debug)]
pub(in crate::registry) struct Outbox<F> {
    queue: VecDeque<SessionPacket<F>>,
    /// The number of kept packets in the queue. They have their own limit.
    kept: usize,
    /// The number of the last packet that was queued.
    last_queued: u64,
    max_packets: usize,
    /// The bytes of all packets in the queue.
    bytes: usize,
    max_bytes: usize,
    /// True if the session gets the graph. Otherwise it cannot be behind.
    hears_graph: bool,
    behind: bool,
    /// True if it asked for the complete state. It is sent that after the packets that wait.
    resync: bool,
    /// While the complete state is sent: the endpoints whose pairs it has yet to be sent.
    telling: Option<Vec<Gid>>,
    /// The status that it asked for, and the number of the next part.
    status: Option<(Arc<[u8]>, u32)>,
}

impl<F> Outbox<F> {
    pub(super) fn new(hears_graph: bool) -> Self {
        Self {
            queue: VecDeque::new(),
            kept: 0,
            last_queued: 0,
            max_packets: MAX_QUEUE,
            bytes: 0,
            max_bytes: MAX_QUEUE_BYTES,
            hears_graph,
            behind: false,
            resync: false,
            telling: None,
            status: None,
        }
    }

    /// Returns the number of packets that wait.
    pub(super) fn len(&self) -> usize {
        self.queue.len()
    }

    /// Returns whether the queue was dropped and the complete state has not been started.
    pub(in crate::registry) fn is_behind(&self) -> bool {
        self.behind
    }

    /// Returns whether the complete state is being sent.
    pub(in crate::registry) fn is_being_told(&self) -> bool {
        self.telling.is_some()
    }

    /// Returns whether the complete state is being sent or about to be.
    fn is_told_anew(&self) -> bool {
        self.behind || self.resync || self.telling.is_some()
    }

    /// Queues a packet. After [`Pushed::Full`], the caller must call [`fall_behind`](Self::fall_behind).
    pub(super) fn push(&mut self, output: SessionPacket<F>) -> Pushed {
        if self.behind {
            return Pushed::Behind;
        }
        if self.queue.len() - self.kept >= self.max_packets || self.bytes >= self.max_bytes {
            return Pushed::Full;
        }
        self.bytes += output.packet.len();
        self.last_queued += 1;
        self.queue.push_back(SessionPacket { number: self.last_queued, ..output });
        Pushed::Queued
    }

    /// Queues a packet that the session would not be sent otherwise; it is kept if the session falls behind. Beyond the
    /// limit, the process with the most kept packets loses its oldest one.
    pub(super) fn push_kept(&mut self, output: SessionPacket<F>) {
        if self.kept == MAX_WAITING_KEPT {
            self.make_room(output.process);
        }
        self.kept += 1;
        self.bytes += output.packet.len();
        self.last_queued += 1;
        self.queue.push_back(SessionPacket { number: self.last_queued, ..output });
    }

    fn make_room(&mut self, newcomer: u32) {
        let kept: Vec<usize> =
            (0..self.queue.len()).filter(|at| self.queue[*at].kept_for.is_some()).collect();
        let processes = kept.iter().map(|at| self.queue[*at].process);
        let Some(oldest) = makes_room(processes, newcomer) else { return };
        let Some(gone) = self.queue.remove(kept[oldest]) else { return };
        self.kept -= 1;
        self.bytes -= gone.packet.len();
        tracing::warn!(
            reader = ?gone.kept_for, process = gone.process,
            "a reader does not count what it lost: its process has yet to hear of {MAX_WAITING_KEPT} \
             publishers that ended"
        );
    }

    /// Removes and returns the kept packets.
    pub(super) fn take_kept(&mut self) -> Vec<SessionPacket<F>> {
        let is_kept = |output: &SessionPacket<F>| output.kept_for.is_some();
        let (taken, rest): (VecDeque<_>, _) =
            std::mem::take(&mut self.queue).into_iter().partition(is_kept);
        self.queue = rest;
        let taken = Vec::<SessionPacket<F>>::from(taken);
        self.kept -= taken.len();
        self.bytes -= taken.iter().map(|output| output.packet.len()).sum::<usize>();
        taken
    }

    /// Returns the kept packets of a session that is gone.
    pub(super) fn into_kept(self) -> impl Iterator<Item = SessionPacket<F>> {
        self.queue.into_iter().filter(|output| output.kept_for.is_some())
    }

    /// Returns what has to be queued before the next [`pop`](Self::pop).
    pub(in crate::registry) fn due(&self) -> Option<DueMessage> {
        if !self.queue.is_empty() {
            None
        } else if self.telling.is_some() {
            Some(DueMessage::Pairs)
        } else {
            (self.behind || self.resync).then_some(DueMessage::Everything)
        }
    }

    /// Takes the next packet, or the next part of a status.
    pub(super) fn pop(&mut self) -> Option<SessionPacket<F>> {
        let output = self.queue.pop_front();
        self.bytes -= output.as_ref().map_or(0, |output| output.packet.len());
        self.kept -= usize::from(output.as_ref().is_some_and(|output| output.kept_for.is_some()));
        if self.queue.is_empty() && self.telling.is_none() {
            self.max_packets = MAX_QUEUE;
            self.max_bytes = MAX_QUEUE_BYTES;
        }
        output.or_else(|| self.next_part())
    }

    /// Puts back a packet that could not be sent.
    pub(super) fn put_back(&mut self, output: SessionPacket<F>) {
        if SessionMessage::is_status(&output.packet) {
            if let Some((_, next)) = &mut self.status {
                *next = next.saturating_sub(1);
            }
        } else {
            self.bytes += output.packet.len();
            self.kept += usize::from(output.kept_for.is_some());
            self.queue.push_front(output);
        }
    }

    /// Removes waiting packets that pass a segment on. Returns whether there were any.
    pub(in crate::registry) fn take_back(&mut self, of: &SessionId, number: u32) -> bool {
        let before = self.queue.len();
        self.queue.retain(|output| output.segment != Some((*of, number)));
        let taken = self.queue.len() < before;
        if taken {
            self.bytes = self.queue.iter().map(|output| output.packet.len()).sum();
        }
        taken
    }

    /// Drops the waiting packets except for kept ones. The session is sent the complete state instead.
    pub(super) fn fall_behind(&mut self) {
        self.behind = self.hears_graph;
        self.telling = None;
        self.queue.retain(|output| output.kept_for.is_some());
        self.bytes = self.queue.iter().map(|output| output.packet.len()).sum();
    }

    /// Sends the session the complete state after the packets that wait.
    pub(in crate::registry) fn request_resync(&mut self) {
        self.resync = true;
    }

    /// Begins to send the complete state: the pairs of `endpoints` follow the packets queued now. The queue has no
    /// limit until [`limit`](Self::limit).
    pub(in crate::registry) fn begin_telling(&mut self, endpoints: Vec<Gid>) {
        self.behind = false;
        self.resync = false;
        self.telling = Some(endpoints);
        self.lift_limit();
    }

    /// Takes the next endpoint whose pairs the session is sent. Returns `None` after the last one, which ends the
    /// complete state.
    pub(in crate::registry) fn next_endpoint(&mut self) -> Option<Gid> {
        let next = self.telling.as_mut().and_then(Vec::pop);
        if next.is_none() {
            self.telling = None;
        }
        next
    }

    /// Removes the limits of the queue until [`limit`](Self::limit).
    pub(in crate::registry) fn lift_limit(&mut self) {
        self.max_packets = usize::MAX;
        self.max_bytes = usize::MAX;
    }

    /// Permits the usual number of packets and bytes in addition to those that wait now.
    pub(in crate::registry) fn limit(&mut self) {
        self.max_packets = self.queue.len() + MAX_QUEUE;
        self.max_bytes = self.bytes + MAX_QUEUE_BYTES;
    }

    /// Sends a status in parts. It need not fit in the queue: the status of a large system has many megabytes.
    pub(super) fn tell_status(&mut self, text: Arc<[u8]>) {
        self.status = Some((text, 0));
    }

    /// Sends the same status again from its beginning. Returns whether one is being sent.
    pub(super) fn repeat_status(&mut self) -> bool {
        self.status.as_mut().is_some_and(|(_, next)| {
            *next = 0;
            true
        })
    }

    /// Returns the next part of a status. An empty status has one part, too.
    fn next_part(&mut self) -> Option<SessionPacket<F>> {
        let (text, next) = self.status.as_mut()?;
        let parts = u32::try_from(text.len().div_ceil(STATUS_SLICE).max(1)).ok()?;
        if *next == parts {
            self.status = None;
            return None;
        }
        let from = *next as usize * STATUS_SLICE;
        let slice = &text[from..text.len().min(from + STATUS_SLICE)];
        let part = SessionMessage::Status(StatusPart { part: *next, parts, text: slice.to_vec() });
        *next += 1;
        SessionPacket::of(&part, Vec::new())
    }

    /// Returns the number of the packet up to which everything has to be sent before a FENCE that comes now is
    /// answered; `None` while the session is sent the complete state.
    pub(in crate::registry) fn mark(&self) -> Option<u64> {
        (!self.is_told_anew()).then_some(self.last_queued)
    }

    /// Returns whether everything up to a [`mark`](Self::mark) was sent. If the session is sent the complete state, the
    /// mark moves to the end of that.
    pub(in crate::registry) fn was_sent(&self, mark: &mut Option<u64>) -> bool {
        if self.is_told_anew() {
            *mark = None;
            return false;
        }
        let last = *mark.get_or_insert(self.last_queued);
        self.queue.front().is_none_or(|next| next.number > last)
    }
}

#[cfg(test)]
impl<F> Outbox<F> {
    /// Checks the limits and the sum, and returns the bytes that wait.
    pub(in crate::registry) fn check(&self) -> usize {
        let kept = self.queue.iter().filter(|output| output.kept_for.is_some());
        assert_eq!(self.kept, kept.count());
        assert!(self.queue.len() - self.kept <= self.max_packets);
        assert_eq!(self.bytes, self.queue.iter().map(|output| output.packet.len()).sum::<usize>());
        let mut numbers = self.queue.iter().map(|output| output.number);
        assert!(numbers.clone().is_sorted() && numbers.all(|number| number <= self.last_queued));
        self.bytes
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::wire::session::{Segment, SegmentOpened};

    const OTHER: SessionId = SessionId([2; 16]);

    fn packet(bytes: usize) -> SessionPacket<&'static str> {
        SessionPacket::plain(vec![0xa0; bytes].into())
    }

    fn segment(number: u32) -> SessionPacket<&'static str> {
        let segment = Segment { number, publisher: None };
        let opened = SessionMessage::Segment(SegmentOpened { session: OTHER, segment });
        SessionPacket::of(&opened, vec!["map"]).unwrap()
    }

    #[test]
    fn a_full_queue_is_dropped_and_nothing_is_queued_behind() {
        let mut outbox = Outbox::new(true);
        for _ in 0..MAX_QUEUE {
            assert_eq!(outbox.push(packet(1)), Pushed::Queued);
        }
        assert_eq!(outbox.push(packet(1)), Pushed::Full);
        outbox.fall_behind();
        assert_eq!(outbox.check(), 0);
        assert!(outbox.is_behind());
        assert_eq!(outbox.due(), Some(DueMessage::Everything));
        assert_eq!(outbox.push(packet(1)), Pushed::Behind);

        let mut tool = Outbox::<()>::new(false);
        tool.fall_behind();
        assert!(!tool.is_behind(), "a tool hears nothing of the graph");
        assert_eq!(tool.due(), None);
    }

    #[test]
    fn one_large_packet_passes_and_fills_the_queue() {
        let mut outbox = Outbox::new(true);
        assert_eq!(outbox.push(packet(MAX_QUEUE_BYTES + 1)), Pushed::Queued);
        assert_eq!(outbox.push(packet(1)), Pushed::Full);
        let large = outbox.pop().unwrap();
        assert_eq!(outbox.push(packet(1)), Pushed::Queued);
        outbox.put_back(large);
        assert_eq!(outbox.check(), MAX_QUEUE_BYTES + 2);
        assert_eq!(outbox.pop().unwrap().packet.len(), MAX_QUEUE_BYTES + 1, "the first again");
    }

    #[test]
    fn the_whole_is_told_without_a_bound_and_the_bound_returns_after_it() {
        let mut outbox = Outbox::new(true);
        outbox.fall_behind();
        let endpoint = Gid::new(OTHER, 1);
        outbox.begin_telling(vec![endpoint]);
        for _ in 0..2 * MAX_QUEUE {
            assert_eq!(outbox.push(packet(1)), Pushed::Queued);
        }
        outbox.limit();
        for _ in 0..MAX_QUEUE {
            assert_eq!(outbox.push(packet(1)), Pushed::Queued);
        }
        assert_eq!(outbox.push(packet(1)), Pushed::Full);
        while outbox.due().is_none() {
            outbox.pop().unwrap();
        }
        assert_eq!(outbox.due(), Some(DueMessage::Pairs));
        assert_eq!(outbox.next_endpoint(), Some(endpoint));
        assert!(outbox.is_being_told());
        assert_eq!(outbox.next_endpoint(), None);
        assert!(!outbox.is_being_told());
        assert!(outbox.pop().is_none());
        for _ in 0..MAX_QUEUE {
            assert_eq!(outbox.push(packet(1)), Pushed::Queued);
        }
        assert_eq!(outbox.push(packet(1)), Pushed::Full);
    }

    #[test]
    fn memory_that_waits_is_taken_back_with_its_bytes() {
        let mut outbox = Outbox::new(true);
        outbox.push(packet(3));
        outbox.push(segment(1));
        outbox.push(segment(2));
        assert!(outbox.take_back(&OTHER, 1));
        assert!(!outbox.take_back(&OTHER, 1));
        assert!(!outbox.take_back(&SessionId([3; 16]), 2));
        outbox.check();
        assert_eq!(outbox.len(), 2);
    }

    #[test]
    fn a_mark_is_reached_when_all_before_it_was_sent() {
        let mut outbox = Outbox::new(true);
        outbox.push(packet(1));
        let mut mark = outbox.mark();
        outbox.push(packet(2));
        assert!(!outbox.was_sent(&mut mark));
        let first = outbox.pop().unwrap();
        assert!(outbox.was_sent(&mut mark), "the later packet does not count");
        outbox.put_back(first);
        assert!(!outbox.was_sent(&mut mark), "it could not be sent");
        // The complete state replaces the packets, so the mark moves to its end.
        outbox.fall_behind();
        assert!(!outbox.was_sent(&mut mark));
        assert_eq!(mark, None);
        outbox.begin_telling(Vec::new());
        outbox.push(packet(1));
        assert_eq!(outbox.next_endpoint(), None);
        assert!(!outbox.was_sent(&mut mark));
        outbox.pop().unwrap();
        assert!(outbox.was_sent(&mut mark));
    }

    #[test]
    fn a_status_follows_the_queue_and_a_returned_part_comes_again() {
        let mut outbox = Outbox::new(false);
        outbox.tell_status(vec![7; STATUS_SLICE + 1].into());
        outbox.push(packet(1));
        assert_eq!(outbox.pop().unwrap().packet.len(), 1);
        let first = outbox.pop().unwrap();
        let bytes = first.packet.clone();
        outbox.put_back(first);
        assert_eq!(outbox.pop().unwrap().packet, bytes);
        assert!(outbox.repeat_status());
        assert_eq!(outbox.pop().unwrap().packet, bytes);
        assert!(outbox.pop().is_some() && outbox.pop().is_none());
        assert!(!outbox.repeat_status(), "it has been told");
    }
}
