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

/// Rings that a KEEP_ALL subscription, a client or a server reads of what a writer left, each by way of another daemon.
const MAX_EARLIER_RINGS: usize = 8;

#[derive(Default)]
pub(in crate::session) struct MatchedReaders {
    pub(super) slots: Slots,
    pub(super) counts: Counts,
    /// Lanes given to writers that have not granted yet, and the number behind which each is to go on.
    pending: HashMap<Gid, (Lane, Option<u64>)>,
    /// The last sequence number taken of each writer that is gone.
    last: DepartedWriters,
    /// Whether the subscription wants every sample.
    keeps_all: bool,
    /// Whether it is of a client or server. What of its calls was not taken comes again with the next daemon.
    of_service: bool,
    /// Writers whose memory was not usable, of which the others have to be told.
    pub(super) discarded: Vec<Gid>,
}

/// How a writer is asked to serve.
pub(in crate::session) struct ServeRequest {
    pub(in crate::session) lane: Location,
    /// The last number that the reader has of it, where it was attached before.
    pub(in crate::session) after: Option<u64>,
}

/// What a grant calls for.
pub(in crate::session) enum Accept {
    /// Nothing: it repeats the one that stands, or nobody asked.
    Stands,
    /// Map the ring with this lane.
    Map(Lane),
    /// Ask again, with a fresh lane.
    AskAgain,
}

impl MatchedReaders {
    /// Those of a subscription that wants every sample, or does not.
    pub(super) fn new(keeps_all: bool) -> Self {
        Self { keeps_all, ..Self::default() }
    }

    /// The readers of a client or server.
    pub(super) fn of_service() -> Self {
        Self { of_service: true, ..Self::default() }
    }

    /// The readers, for questions that change nothing.
    pub(in crate::session) fn slots(&self) -> &Slots {
        &self.slots
    }

    pub(super) fn losses(&self) -> u64 {
        self.counts.losses(self.slots.lost())
    }

    /// Samples that came since this was last asked.
    pub(super) fn new_arrivals(&mut self) -> u64 {
        self.counts.new_arrivals(self.slots.arrived())
    }

    /// Losses since this was last asked.
    pub(super) fn new_losses(&mut self) -> u64 {
        self.counts.new_losses(self.slots.lost())
    }

    /// The lane that is, or from now on will be, the one for `writer`.
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

    /// The lanes of all that are attached, or asked to be: what is repeated when `stands_for`
    /// changes.
    pub(in crate::session) fn lanes(&self) -> Vec<(Gid, Location)> {
        let attached = self.slots.iter().filter(|s| !s.over);
        let attached = attached.map(|s| (s.reader.writer(), s.reader.lane()));
        attached
            .chain(self.pending.iter().map(|(gid, (lane, _))| (*gid, lane.location())))
            .collect()
    }

    /// What a grant of `writer` calls for.
    pub(in crate::session) fn accept(&mut self, writer: Gid, grant: Grant) -> Accept {
        if let Some(slot) = self.slots.attached_mut(&writer) {
            if slot.reader.grant() == grant {
                return Accept::Stands;
            }
            // The writer forgot us and granted anew, on a lane whose words we still use for what
            // it wrote before.
            slot.over = true;
            self.sweep();
            self.forget_older(writer);
            return Accept::AskAgain;
        }
        self.pending.remove(&writer).map_or(Accept::Stands, |(lane, _)| Accept::Map(lane))
    }

    /// A writer granted what comes `after` a number.
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
        // It could not be taken from before it was here.
        slot.reader.mark_active();
        self.slots.push(slot);
        self.forget_older(writer);
    }

    /// The daemon said that the writer will not write any more, and that it has handed over everything. Returns whether a
    /// reader of the writer stood as open until now.
    pub(in crate::session) fn end(&mut self, writer: &Gid) -> bool {
        self.pending.remove(writer);
        for slot in self.slots.of_mut(writer) {
            slot.reader.end();
            slot.reader.mark_active();
        }
        self.end_where(|reader| reader.writer() == *writer)
    }

    /// The writer leaves, with samples still to come, or takes that back. Returns whether this changes a reader.
    pub(in crate::session) fn leave(&mut self, writer: &Gid, leaving: bool) -> bool {
        let mut news = false;
        for slot in self.slots.of_mut(writer) {
            news |= slot.leaving != leaving;
            slot.leaving = leaving;
        }
        news
    }

    /// Writers whose process is dead will not write any more. Memory of theirs may still be on its way.
    /// Whether there are any.
    pub(in crate::session) fn end_dead(&mut self) -> bool {
        self.end_where(Reader::writer_dead)
    }

    /// The writers that are attached, or asked to be.
    pub(in crate::session) fn writers(&self) -> Vec<Gid> {
        self.lanes().into_iter().map(|(gid, _)| gid).collect()
    }

    /// The writers of which anything is read, or may be soon, those that have ended among them.
    pub(in crate::session) fn all_writers(&self) -> BTreeSet<Gid> {
        let there = self.slots.iter().map(|slot| slot.reader.writer());
        there.chain(self.pending.keys().copied()).collect()
    }

    fn end_where(&mut self, which: impl Fn(&Reader) -> bool) -> bool {
        let mut news = false;
        for slot in self.slots.iter_mut().filter(|s| !s.over && which(&s.reader)) {
            slot.over = true;
            news = true;
            // A writer that died may have left samples without a word.
            slot.reader.mark_active();
        }
        self.sweep();
        news
    }

    /// Gives up all but the last of what a writer left, or the last few where nothing is to be lost: one
    /// that begins anew and anew would otherwise take all lanes.
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

    /// Counts what a slot that is given up has not taken and no later one of its writer will.
    fn count_left(&mut self, slot: &mut MatchedReader) {
        let writer = slot.reader.writer();
        let Some(newer) = self.slots.of(&writer).next() else { return };
        if newer.reader.is_of_ring(&slot.reader) {
            let later = newer.reader.grant().first;
            self.counts.add_lost(slot.reader.unread_below(later));
            return;
        }
        // They come again, and none of them counts as taken.
        if self.of_service {
            return;
        }
        // One after the other: samples missing among them were counted, or are by their numbers.
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

    /// Keeps what a slot that is given up leaves to be known.
    pub(super) fn retire(&mut self, slot: &MatchedReader) {
        self.counts.retire(slot.lost(), slot.reader.arrived());
        if let Some(last) = slot.reached() {
            self.remember(slot.reader.writer(), last);
        }
    }

    /// A writer is gone.
    pub(super) fn remember(&mut self, writer: Gid, last: u64) {
        self.last.add(writer, last);
    }

    /// This sample of `writer` was taken.
    pub(super) fn note(&mut self, writer: Gid, sequence: u64) {
        self.slots.of_mut(&writer).for_each(|slot| slot.last = Some(sequence));
    }

    /// Whether anything of this writer's is read, or may be soon.
    pub(in crate::session) fn reads(&self, writer: &Gid) -> bool {
        self.pending.contains_key(writer) || self.slots.of(writer).next().is_some()
    }

    /// Gives up what a writer left in memory that never came, if it sends that once more.
    pub(super) fn skip_missing(&mut self) {
        // To others nothing is sent again.
        if self.keeps_all && self.slots.skip_missing() {
            self.sweep();
        }
    }

    /// Unmaps writers that are gone and drained, and of which nothing is under way.
    pub(super) fn sweep(&mut self) {
        let gone = self.slots.remove_drained();
        gone.iter().for_each(|slot| self.retire(slot));
    }

    /// Samples of `writer` up to this number are done with.
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

    /// As [`finish_of`](Self::finish_of), of a writer whose numbers do not rise: the message of this number, and all
    /// that were taken before it.
    pub(in crate::session) fn finish_through(&mut self, writer: &Gid, sequence: u64) {
        self.slots.of_mut(writer).for_each(|slot| slot.reader.finish_through(sequence));
        self.sweep();
    }

    /// So many samples of `writer` do not get where they are to go.
    pub(in crate::session) fn give_up_of(&mut self, writer: &Gid, samples: u64) {
        if let Some(slot) = self.slots.of_mut(writer).next() {
            slot.reader.give_up(samples);
        }
    }

    /// What was taken and is not done with is to be taken once more; and all of the `history` that
    /// stands, if so.
    pub(in crate::session) fn take_back(&mut self, history: bool) {
        for MatchedReader { reader, last, .. } in self.slots.iter_mut() {
            if history {
                reader.rewind()
            } else {
                reader.take_back()
            }
            // They are no repeats of those that were taken before.
            *last = None;
        }
    }

    /// Samples of `writer` that newer ones replaced before they were taken, in its ring or within the depth.
    pub(in crate::session) fn lost_of(&mut self, writer: &Gid) -> u64 {
        let lost = self.slots.of_mut(writer).map(|slot| {
            // Finds what a take would find lost. The take says what is wrong with the memory.
            let _ = slot.reader.peek();
            slot.reader.lost().saturating_add(slot.reader.skipped())
        });
        lost.sum()
    }

    /// Passes over all samples of `writer` but the newest `depth`. They count as those beyond the subscription's depth.
    pub(in crate::session) fn skip_of(&mut self, writer: &Gid, depth: u64) {
        self.slots.of_mut(writer).for_each(|slot| slot.reader.skip_to_depth(depth));
    }

    /// Samples of `writer` that were lost before they came to its ring here. Samples missing before
    /// the `first` in that ring are seen by its number, where the subscription knows an earlier one.
    pub(in crate::session) fn lost_elsewhere(&mut self, writer: &Gid, samples: u64, first: bool) {
        if self.slots.of(writer).any(|slot| !(slot.over || first && slot.resumed)) {
            self.counts.add_lost(samples);
        }
    }

    /// `writer` has ended before this subscription learned of its grant, and there were `samples` for us. Returns whether
    /// they are counted as lost: only if it was asked and its answer never came. Otherwise its ring is, or was, read, and
    /// tells what was lost.
    pub(in crate::session) fn count_unmet(&mut self, writer: &Gid, samples: u64) -> bool {
        let asked = self.pending.remove(writer).is_some();
        // The writer's process may say any number. A loss that cannot be is not counted.
        let counts = asked && self.slots.of(writer).next().is_none() && samples <= MAX_GAP;
        if counts {
            self.counts.add_lost(samples);
        }
        counts
    }
}
