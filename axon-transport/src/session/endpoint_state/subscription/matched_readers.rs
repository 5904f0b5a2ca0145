//! The readers of a subscription, one for each publisher: their attachment and removal, and the end of their samples.

use std::collections::{BTreeSet, HashMap};

use axon_shm::internal::{Grant, Lane, Location, MAX_GAP, Reader};

use super::{
    counts::Counts,
    departed_writers::DepartedWriters,
    matched_reader::{MatchedReader, NumberKind},
    slots::Slots,
};
use crate::ids::Gid;

/// Maximum number of ended rings of one writer, each by way of another daemon, that a KEEP_ALL subscription, a client
/// or a server still reads.
const MAX_EARLIER_RINGS: usize = 8;

#[derive(Default)]
pub(in crate::session) struct MatchedReaders {
    pub(super) slots: Slots,
    pub(super) counts: Counts,
    /// Lanes given to writers that have not granted yet, and the number behind which each writer is to continue.
    pending: HashMap<Gid, (Lane, Option<u64>)>,
    /// The last sequence number taken of each writer that is gone.
    last: DepartedWriters,
    /// True if the subscription wants every sample.
    keeps_all: bool,
    /// True if it belongs to a client or server. The next daemon sends their untaken requests and responses again.
    of_service: bool,
    /// Writers whose memory was not usable. They still have to be detached.
    pub(super) discarded: Vec<Gid>,
}

/// A request to a writer to serve a reader.
pub(in crate::session) struct ServeRequest {
    pub(in crate::session) lane: Location,
    /// The last number that the reader has of the writer, if it was attached before.
    pub(in crate::session) after: Option<u64>,
}

/// The reaction to a grant.
pub(in crate::session) enum Accept {
    /// No change: the grant repeats the current one, or it was not requested.
    Stands,
    /// Map the ring with this lane.
    Map(Lane),
    /// Ask again, with a fresh lane.
    AskAgain,
}

impl MatchedReaders {
    /// Creates the readers of a subscription; `keeps_all` if it wants every sample.
    pub(super) fn new(keeps_all: bool) -> Self {
        Self { keeps_all, ..Self::default() }
    }

    /// Creates the readers of a client or server.
    pub(super) fn of_service() -> Self {
        Self { of_service: true, ..Self::default() }
    }

    /// Returns the readers, for queries that change nothing.
    pub(in crate::session) fn slots(&self) -> &Slots {
        &self.slots
    }

    pub(super) fn losses(&self) -> u64 {
        self.counts.losses(self.slots.lost())
    }

    /// Returns the samples that came since the last call.
    pub(super) fn new_arrivals(&mut self) -> u64 {
        self.counts.new_arrivals(self.slots.arrived())
    }

    /// Returns the losses since the last call.
    pub(super) fn new_losses(&mut self) -> u64 {
        self.counts.new_losses(self.slots.lost())
    }

    /// Returns the lane for `writer`, and allocates one if there is none.
    pub(in crate::session) fn lane_for<E>(
        &mut self,
        writer: Gid,
        allocate: impl FnOnce() -> Result<Lane, E>,
    ) -> Result<ServeRequest, E> {
        if let Some(slot) = self.slots.attached(&writer) {
            return Ok(ServeRequest { lane: slot.reader.lane(), after: None });
        }
        if let Some((lane, after)) = self.pending.get(&writer) {
            return Ok(ServeRequest { lane: lane.location(), after: *after });
        }
        let earlier = self.slots.of(&writer).next();
        let after = earlier.map_or_else(|| self.last.get(&writer), MatchedReader::reached);
        let lane = allocate()?;
        let location = lane.location();
        self.pending.insert(writer, (lane, after));
        Ok(ServeRequest { lane: location, after })
    }

    /// Returns the lanes of all attached and requested writers. They are sent again when `stands_for` changes.
    pub(in crate::session) fn lanes(&self) -> Vec<(Gid, Location)> {
        let attached = self.slots.iter().filter(|s| !s.over);
        let attached = attached.map(|s| (s.reader.writer(), s.reader.lane()));
        attached
            .chain(self.pending.iter().map(|(gid, (lane, _))| (*gid, lane.location())))
            .collect()
    }

    /// Returns the reaction to a grant of `writer`.
    pub(in crate::session) fn accept(&mut self, writer: Gid, grant: Grant) -> Accept {
        if let Some(slot) = self.slots.attached_mut(&writer) {
            if slot.reader.grant() == grant {
                return Accept::Stands;
            }
            // The writer forgot this reader and granted anew, on a lane whose words are still in use for the samples
            // that it wrote before.
            slot.over = true;
            self.sweep();
            self.forget_older(writer);
            return Accept::AskAgain;
        }
        self.pending.remove(&writer).map_or(Accept::Stands, |(lane, _)| Accept::Map(lane))
    }

    /// Adds a reader for which the writer granted the samples `after` a number.
    pub(in crate::session) fn add(
        &mut self,
        reader: Reader,
        after: Option<u64>,
        numbers: NumberKind,
    ) {
        let writer = reader.writer();
        let earlier = self.slots.of(&writer).next().map(MatchedReader::reached);
        let last = earlier.unwrap_or_else(|| self.last.remove(&writer));
        let resumed = earlier.is_some() || last.is_some();
        let slot = MatchedReader::new(reader, after, last, resumed, numbers);
        // Samples may have come before the reader was added.
        slot.reader.mark_active();
        self.slots.push(slot);
        self.forget_older(writer);
    }

    /// Ends a writer: the daemon reported that it does not write any more, and has handed over all its messages.
    /// Returns whether a reader of the writer was open until now.
    pub(in crate::session) fn end(&mut self, writer: &Gid) -> bool {
        self.pending.remove(writer);
        for slot in self.slots.of_mut(writer) {
            slot.reader.end();
            slot.reader.mark_active();
        }
        self.end_where(|reader| reader.writer() == *writer)
    }

    /// Records that the writer is leaving, with samples still to come, or that it is not leaving any more. Returns
    /// whether this changes a reader.
    pub(in crate::session) fn leave(&mut self, writer: &Gid, leaving: bool) -> bool {
        let mut news = false;
        for slot in self.slots.of_mut(writer) {
            news |= slot.leaving != leaving;
            slot.leaving = leaving;
        }
        news
    }

    /// Ends the writers whose process is dead. Their memory may still be in flight. Returns whether there were any.
    pub(in crate::session) fn end_dead(&mut self) -> bool {
        self.end_where(Reader::writer_dead)
    }

    /// Returns the attached and the requested writers.
    pub(in crate::session) fn writers(&self) -> Vec<Gid> {
        self.lanes().into_iter().map(|(gid, _)| gid).collect()
    }

    /// Returns the writers that are read or may be read soon, including ended ones.
    pub(in crate::session) fn all_writers(&self) -> BTreeSet<Gid> {
        let there = self.slots.iter().map(|slot| slot.reader.writer());
        there.chain(self.pending.keys().copied()).collect()
    }

    fn end_where(&mut self, which: impl Fn(&Reader) -> bool) -> bool {
        let mut news = false;
        for slot in self.slots.iter_mut().filter(|s| !s.over && which(&s.reader)) {
            slot.over = true;
            news = true;
            // A writer that died may have left samples without ringing.
            slot.reader.mark_active();
        }
        self.sweep();
        news
    }

    /// Gives up all ended rings of a writer but the last, or all but the last few if no sample may be lost: a writer
    /// that begins anew again and again would otherwise take all lanes.
    fn forget_older(&mut self, writer: Gid) {
        loop {
            let of = self.slots.indices_of(&writer);
            let over = of.iter().filter(|index| self.slots[**index].over).count();
            let [older, newer, ..] = of[..] else { return };
            let same = self.slots[newer].reader.is_of_ring(&self.slots[older].reader);
            let keeps = self.keeps_all || self.of_service;
            if over <= if keeps && !same { MAX_EARLIER_RINGS } else { 1 } {
                return;
            }
            let mut slot = self.slots.remove(older);
            self.count_left(&mut slot);
            self.retire(&slot);
        }
    }

    /// Counts the samples that a slot which is given up has not taken, and that no later slot of its writer will take.
    fn count_left(&mut self, slot: &mut MatchedReader) {
        let writer = slot.reader.writer();
        let Some(newer) = self.slots.of(&writer).next() else { return };
        if newer.reader.is_of_ring(&slot.reader) {
            let later = newer.reader.grant().first;
            self.counts.add_lost(slot.reader.unread_below(later));
            return;
        }
        // The samples come again, and none of them counts as taken.
        if self.of_service {
            return;
        }
        // One by one: a sample missing among them is already counted, or is found by its number.
        for _ in 0..slot.reader.unread() {
            let Ok(Some(next)) = slot.reader.peek() else { break };
            if !slot.reader.skip() {
                break;
            }
            slot.passed(next.sequence);
            slot.last = slot.last.max(Some(next.sequence));
            self.counts.add_lost(1);
        }
        if let Some(last) = slot.last {
            self.note(writer, last);
        }
    }

    /// Keeps the counts and the last number of a slot that is given up.
    pub(super) fn retire(&mut self, slot: &MatchedReader) {
        self.counts.retire(slot.lost(), slot.reader.arrived());
        if let Some(last) = slot.reached() {
            self.remember(slot.reader.writer(), last);
        }
    }

    /// Remembers the last number of a writer that is gone.
    pub(super) fn remember(&mut self, writer: Gid, last: u64) {
        self.last.add(writer, last);
    }

    /// Records that this sample of `writer` was taken.
    pub(super) fn note(&mut self, writer: Gid, sequence: u64) {
        self.slots.of_mut(&writer).for_each(|slot| slot.last = Some(sequence));
    }

    /// Returns whether this writer is read, or may be read soon.
    pub(in crate::session) fn reads(&self, writer: &Gid) -> bool {
        self.pending.contains_key(writer) || self.slots.of(writer).next().is_some()
    }

    /// Gives up samples in memory that never came, if their writer sends them once more.
    pub(super) fn skip_missing(&mut self) {
        // For other subscriptions, nothing is sent again.
        if self.keeps_all && self.slots.skip_missing() {
            self.sweep();
        }
    }

    /// Unmaps the rings of writers that are gone, if the rings are drained and none of their samples is in flight.
    pub(super) fn sweep(&mut self) {
        let gone = self.slots.remove_drained();
        gone.iter().for_each(|slot| self.retire(slot));
    }

    /// Confirms the samples of `writer` up to this number.
    pub(in crate::session) fn finish_of(&mut self, writer: &Gid, sequence: u64) {
        let mut over = false;
        for slot in self.slots.of_mut(writer) {
            slot.reader.finish(sequence);
            over |= slot.over;
        }
        if over {
            self.sweep();
        }
    }

    /// Like [`finish_of`](Self::finish_of), for a writer whose numbers do not rise: confirms the message of this number
    /// and all messages taken before it.
    pub(in crate::session) fn finish_through(&mut self, writer: &Gid, sequence: u64) {
        self.slots.of_mut(writer).for_each(|slot| slot.reader.finish_through(sequence));
        self.sweep();
    }

    /// Gives up `samples` samples of `writer` that do not reach their destination.
    pub(in crate::session) fn give_up_of(&mut self, writer: &Gid, samples: u64) {
        if let Some(slot) = self.slots.of_mut(writer).next() {
            slot.reader.give_up(samples);
        }
    }

    /// Makes the samples that were taken and are not confirmed available again; with `history`, the whole history in
    /// the rings.
    pub(in crate::session) fn take_back(&mut self, history: bool) {
        for MatchedReader { reader, last, .. } in self.slots.iter_mut() {
            if history {
                reader.rewind()
            } else {
                reader.take_back()
            }
            // The samples that are taken again do not count as repeats.
            *last = None;
        }
    }

    /// Returns how many samples of `writer` newer samples replaced before they were taken, in its ring or within the
    /// depth.
    pub(in crate::session) fn lost_of(&mut self, writer: &Gid) -> u64 {
        let lost = self.slots.of_mut(writer).map(|slot| {
            // Finds the losses that a take would find. The take reports an error of the memory.
            let _ = slot.reader.peek();
            slot.reader.lost().saturating_add(slot.reader.skipped())
        });
        lost.sum()
    }

    /// Skips all samples of `writer` but the newest `depth`. They count as samples beyond the subscription's depth.
    pub(in crate::session) fn skip_of(&mut self, writer: &Gid, depth: u64) {
        self.slots.of_mut(writer).for_each(|slot| slot.reader.skip_to_depth(depth));
    }

    /// Counts samples of `writer` that were lost before they came to its ring here. With `first`, the samples were
    /// missing before the first in that ring: their loss shows in the numbers if the subscription knows an earlier
    /// number.
    pub(in crate::session) fn lost_elsewhere(&mut self, writer: &Gid, samples: u64, first: bool) {
        if self.slots.of(writer).any(|slot| !(slot.over || first && slot.resumed)) {
            self.counts.add_lost(samples);
        }
    }

    /// Handles a `writer` that ended before this subscription learned of its grant, with `samples` for this
    /// subscription. Returns whether they count as lost: only if the writer was requested and its answer never came.
    /// Otherwise its ring is, or was, read, and shows the losses.
    pub(in crate::session) fn count_unmet(&mut self, writer: &Gid, samples: u64) -> bool {
        let asked = self.pending.remove(writer).is_some();
        // The writer's process may send any number. A loss that is not possible is not counted.
        let counts = asked && self.slots.of(writer).next().is_none() && samples <= MAX_GAP;
        if counts {
            self.counts.add_lost(samples);
        }
        counts
    }
}
