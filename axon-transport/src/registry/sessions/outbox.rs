//! The packets that wait for one session, and the parts of a report that it is still to be told.

use std::{collections::VecDeque, sync::Arc};

use super::{encode, shares::makes_room};
use crate::{
    ids::{Gid, SessionId},
    registry::limits::{MAX_QUEUE, MAX_QUEUE_BYTES, STATUS_SLICE},
    wire::session::{SessionMessage, StatusPart},
};

/// Packets that stay for their readers that may wait for one session.
const MAX_WAITING_KEPT: usize = 1024;

/// A packet for a session.
#[derive(Clone, Debug)]
pub struct SessionPacket<F> {
    /// Its bytes.
    pub packet: Arc<[u8]>,
    /// What goes with it.
    pub descriptors: Vec<F>,
    /// The session's segment that it hands over and nothing else.
    segment: Option<(SessionId, u32)>,
    /// The reader of the session's that it is for, where the session would not hear of it when it is told everything anew.
    pub(in crate::registry) kept_for: Option<Gid>,
    /// The process whose publisher it is of, where it stays for its reader.
    pub(super) process: u32,
    /// Which it is of the packets that were queued for its session; 0 before it is.
    number: u64,
}

impl<F> SessionPacket<F> {
    /// A message that does not fit is left out: everything that is stored is small enough to be passed on.
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

    /// A packet of a publisher of `process` that stays for its reader whatever becomes of the session's queue.
    pub(super) fn kept(
        message: &SessionMessage,
        descriptors: Vec<F>,
        reader: Gid,
        process: u32,
    ) -> Option<Self> {
        Some(Self { kept_for: Some(reader), process, ..Self::of(message, descriptors)? })
    }

    /// A packet without descriptors.
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

/// What a session with an empty queue is told next.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in crate::registry) enum DueMessage {
    /// Everything, from the beginning.
    Everything,
    /// More of the pairs of its endpoints.
    Pairs,
}

/// What came of a packet for a session.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Pushed {
    Queued,
    /// The session is behind: it is told everything anew.
    Behind,
    /// The queue is full.
    Full,
}

/// The packets for one session, in order, within bounds of their number and bytes.
///
/// A session that does not take its packets in time falls *behind*: its queue is dropped but for what it would not hear
/// again ([`push_kept`](Self::push_kept)), nothing else is queued for it, and it is told everything anew once it reads
/// again. While it is told everything the bounds grow with what it has to hear.
#[derive(Debug)]
pub(in crate::registry) struct Outbox<F> {
    queue: VecDeque<SessionPacket<F>>,
    /// How many of them stay whatever becomes of the rest. They have a bound of their own.
    kept: usize,
    /// The number of the last packet that was queued.
    last_queued: u64,
    max_packets: usize,
    /// The sum over the queue.
    bytes: usize,
    max_bytes: usize,
    /// Whether the session is told of the graph. One that is not cannot be behind.
    hears_graph: bool,
    behind: bool,
    /// It asked to be told everything anew, and is once it has taken what waits for it.
    resync: bool,
    /// Its endpoints whose pairs it is still to be told of, while it is told everything.
    telling: Option<Vec<Gid>>,
    /// What it asked about, and the next part of it.
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

    /// Packets that wait.
    pub(super) fn len(&self) -> usize {
        self.queue.len()
    }

    /// Whether the queue was dropped, and the session has not begun to hear everything anew.
    pub(in crate::registry) fn is_behind(&self) -> bool {
        self.behind
    }

    /// Whether it is being told everything.
    pub(in crate::registry) fn is_being_told(&self) -> bool {
        self.telling.is_some()
    }

    /// Whether it is told everything from the beginning, or is about to be.
    fn is_told_anew(&self) -> bool {
        self.behind || self.resync || self.telling.is_some()
    }

    /// Queues a packet. After [`Pushed::Full`] the session has to [`fall_behind`](Self::fall_behind).
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

    /// Queues what the session would not hear of otherwise: it stays if the session falls behind. Beyond the bound the
    /// process that said most of it loses the oldest.
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

    /// Takes back what stays for its readers.
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

    /// Takes what stays for its readers, of a session that is gone.
    pub(super) fn into_kept(self) -> impl Iterator<Item = SessionPacket<F>> {
        self.queue.into_iter().filter(|output| output.kept_for.is_some())
    }

    /// What has to be queued before the next [`pop`](Self::pop).
    pub(in crate::registry) fn due(&self) -> Option<DueMessage> {
        if !self.queue.is_empty() {
            None
        } else if self.telling.is_some() {
            Some(DueMessage::Pairs)
        } else {
            (self.behind || self.resync).then_some(DueMessage::Everything)
        }
    }

    /// The next packet, or the next part of a status.
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

    /// Puts a packet back that could not be sent.
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

    /// Takes back what hands a segment over and still waits. Returns whether there was any.
    pub(in crate::registry) fn take_back(&mut self, of: &SessionId, number: u32) -> bool {
        let before = self.queue.len();
        self.queue.retain(|output| output.segment != Some((*of, number)));
        let taken = self.queue.len() < before;
        if taken {
            self.bytes = self.queue.iter().map(|output| output.packet.len()).sum();
        }
        taken
    }

    /// Drops what waits; the session is told everything anew.
    pub(super) fn fall_behind(&mut self) {
        self.behind = self.hears_graph;
        self.telling = None;
        self.queue.retain(|output| output.kept_for.is_some());
        self.bytes = self.queue.iter().map(|output| output.packet.len()).sum();
    }

    /// The session is told everything anew once it has taken what waits.
    pub(in crate::registry) fn request_resync(&mut self) {
        self.resync = true;
    }

    /// Begins to tell everything: the pairs of `endpoints` follow what is queued now. The queue has no bound until
    /// [`limit`](Self::limit).
    pub(in crate::registry) fn begin_telling(&mut self, endpoints: Vec<Gid>) {
        self.behind = false;
        self.resync = false;
        self.telling = Some(endpoints);
        self.lift_limit();
    }

    /// The next endpoint whose pairs the session is told. After the last one it is no longer being told everything.
    pub(in crate::registry) fn next_endpoint(&mut self) -> Option<Gid> {
        let next = self.telling.as_mut().and_then(Vec::pop);
        if next.is_none() {
            self.telling = None;
        }
        next
    }

    /// The queue has no bound until [`limit`](Self::limit).
    pub(in crate::registry) fn lift_limit(&mut self) {
        self.max_packets = usize::MAX;
        self.max_bytes = usize::MAX;
    }

    /// As much as usual may wait besides what waits now.
    pub(in crate::registry) fn limit(&mut self) {
        self.max_packets = self.queue.len() + MAX_QUEUE;
        self.max_bytes = self.bytes + MAX_QUEUE_BYTES;
    }

    /// Tells a status, part by part. It need not fit the queue: a large system's is of many megabytes.
    pub(super) fn tell_status(&mut self, text: Arc<[u8]>) {
        self.status = Some((text, 0));
    }

    /// Tells the same status from its beginning. Returns whether one is being told.
    pub(super) fn repeat_status(&mut self) -> bool {
        self.status.as_mut().is_some_and(|(_, next)| {
            *next = 0;
            true
        })
    }

    /// The next part of a status. A status without text has one part, too.
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

    /// The number of the packet up to which all has to be sent before a FENCE of now is answered; `None` while the
    /// session is told everything anew.
    pub(in crate::registry) fn mark(&self) -> Option<u64> {
        (!self.is_told_anew()).then_some(self.last_queued)
    }

    /// Whether all up to a [`mark`](Self::mark) was sent. If the session is told everything anew, it has to be sent all
    /// of that.
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
    /// Checks the bounds and the sum, and returns the bytes that wait.
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
        // What was told before is told anew: the mark moves to the end of that.
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
