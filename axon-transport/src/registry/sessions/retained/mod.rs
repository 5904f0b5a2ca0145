//! What is kept for readers whose sessions are not connected, or do not read yet: memory, grants with their rings, and
//! the numbers of samples that the readers lost.

mod earlier_grants;
mod memory;
mod undelivered;

use self::{
    earlier_grants::EarlierGrants, memory::RetainedMemory, undelivered::UndeliveredPackets,
};
use super::{
    entry::SessionEntry,
    memory::{OwnMemory, RegisteredSegment},
    outbox::SessionPacket,
};
use crate::{
    ids::{Gid, SessionId},
    wire::session::{Granted, MAX_DESCRIPTORS, Pair, SessionMessage, Unmatch},
};

/// What sessions left for readers.
#[derive(Debug)]
pub(super) struct RetainedState<F> {
    /// The memory of sessions that ended.
    memory: RetainedMemory<F>,
    /// Packets for readers whose sessions are not connected.
    undelivered: UndeliveredPackets<F>,
    earlier_grants: EarlierGrants,
}

impl<F> Default for RetainedState<F> {
    fn default() -> Self {
        Self {
            memory: RetainedMemory::default(),
            undelivered: UndeliveredPackets::default(),
            earlier_grants: EarlierGrants::default(),
        }
    }
}

impl<F> RetainedState<F> {
    /// Keeps up to `most` segments of sessions that end from now on.
    pub(super) fn keep_memory(&mut self, most: usize) {
        self.memory = RetainedMemory::new(most);
    }

    /// Returns whether segments of sessions that end are kept.
    pub(super) fn keeps_memory(&self) -> bool {
        self.memory.is_kept()
    }

    /// Returns a segment of a session that ended.
    pub(super) fn segment(&self, of: &SessionId, number: u32) -> Option<&RegisteredSegment<F>> {
        self.memory.segment(of, number)
    }

    /// Handles a session that came or came back. Its process lives, so the session reports its grants again.
    pub(super) fn session_came(&mut self, id: &SessionId) {
        self.memory.forget(id);
        self.undelivered.take_awaiting(id);
    }

    /// Handles the end of a session: keeps its memory, and the packets that were kept for its readers.
    pub(super) fn session_ended(
        &mut self,
        id: SessionId,
        segments: OwnMemory<F>,
        kept: impl Iterator<Item = SessionPacket<F>>,
    ) {
        self.memory.keep(id, segments);
        // The session may come back.
        kept.for_each(|output| self.keep(output));
    }

    /// Keeps a packet for its reader.
    pub(super) fn keep(&mut self, output: SessionPacket<F>) {
        self.undelivered.keep(output, None);
    }

    /// Keeps a packet for its reader, which gets it only after the process of session `id` has ended.
    pub(super) fn hold_back(&mut self, output: SessionPacket<F>, id: SessionId) {
        self.undelivered.keep(output, Some(id));
    }

    /// Takes the packets that were kept for a session's readers.
    pub(super) fn take_for(&mut self, id: &SessionId) -> Vec<SessionPacket<F>> {
        self.undelivered.take(id)
    }

    /// Returns whether packets wait for the end of a session's process.
    pub(super) fn awaits_process(&self, id: &SessionId) -> bool {
        self.undelivered.awaits(id)
    }

    /// Takes the packets that waited for the end of a session's process.
    pub(super) fn take_awaiting(&mut self, id: &SessionId) -> Vec<SessionPacket<F>> {
        self.undelivered.take_awaiting(id)
    }

    /// Adds a grant that a publisher of `process` made through an earlier daemon.
    pub(super) fn add_earlier_grant(&mut self, granted: Granted, process: u32) {
        self.earlier_grants.note(granted, process);
    }

    /// Removes the earlier grant of a reader that got another one, or was told that it gets nothing.
    pub(super) fn forget_earlier_grant(&mut self, pair: &Pair) {
        self.earlier_grants.forget(|of| (of.reader, of.writer) == (pair.reader, pair.writer));
    }

    /// Removes the earlier grants of a publisher that has ended and reported its readers' losses.
    pub(super) fn forget_earlier_grants(&mut self, writer: &Gid) {
        self.earlier_grants.forget(|granted| granted.writer == *writer);
    }

    /// Takes the grants that a session's publishers made through an earlier daemon.
    pub(super) fn take_earlier_grants(&mut self, id: &SessionId) -> Vec<Granted> {
        self.earlier_grants.take(id)
    }
}

/// Returns the packets that pass the grant of a session that ends to its reader, with the ring. Through them the reader
/// gets the samples in the session's own segments, and counts the others.
pub(super) fn packets_of_grant<F: Clone>(
    entry: &SessionEntry<F>,
    granted: Granted,
) -> Vec<SessionPacket<F>> {
    // Access rules decide what another user may give to readers here, and they may have changed.
    let Some(descriptors) = entry.descriptors.clone().filter(|_| entry.user.is_none()) else {
        return Vec::new();
    };
    let mut descriptors = Vec::from(descriptors);
    let own = entry.segments.iter().filter(|of| of.segment.publisher.is_none());
    let (ring, others): (Vec<_>, Vec<_>) =
        own.partition(|of| of.segment.number == granted.ring.segment);
    let own = ring.into_iter().chain(others).take(MAX_DESCRIPTORS - descriptors.len());
    let (segments, maps): (Vec<_>, Vec<_>) =
        own.map(|of| (of.segment, of.descriptor.clone())).unzip();
    descriptors.extend(maps);
    let Granted { reader, writer, .. } = granted;
    let grant = SessionMessage::Grant(Granted { segments, ..granted });
    let end = Unmatch { reader, writer, reason: "its session ended".to_owned() };
    let grant = SessionPacket::kept(&grant, descriptors, reader, entry.pid);
    let end = SessionPacket::kept(&SessionMessage::Unmatch(end), Vec::new(), reader, entry.pid);
    grant.into_iter().chain(end).collect()
}
