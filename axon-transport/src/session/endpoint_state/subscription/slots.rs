//! The readers of all publishers of a subscription, and the order in which it takes their samples.

use std::{
    collections::HashMap,
    ops::{Index, IndexMut},
    time::{Duration, Instant},
};

use super::matched_reader::{MatchedReader, TakeTurn};
use crate::ids::Gid;

/// Time for which a sample that could not be taken for want of memory wakes no thread.
const NO_MEMORY_PAUSE: Duration = Duration::from_secs(1);

/// Readers in the order in which their publishers granted them. A publisher that granted anew has several.
#[derive(Default)]
pub(in crate::session) struct Slots {
    slots: Vec<MatchedReader>,
    /// Time of the last shortage of memory for a sample.
    short: Option<Instant>,
}

impl Slots {
    pub(super) fn push(&mut self, slot: MatchedReader) {
        self.slots.push(slot);
    }

    pub(super) fn remove(&mut self, index: usize) -> MatchedReader {
        self.slots.remove(index)
    }

    pub(super) fn len(&self) -> usize {
        self.slots.len()
    }

    pub(super) fn get(&self, index: usize) -> Option<&MatchedReader> {
        self.slots.get(index)
    }

    pub(super) fn iter(&self) -> impl Iterator<Item = &MatchedReader> {
        self.slots.iter()
    }

    pub(super) fn iter_mut(&mut self) -> impl Iterator<Item = &mut MatchedReader> {
        self.slots.iter_mut()
    }

    /// Returns the readers of one writer.
    pub(super) fn of(&self, writer: &Gid) -> impl Iterator<Item = &MatchedReader> {
        self.slots.iter().filter(move |slot| slot.reader.writer() == *writer)
    }

    pub(super) fn of_mut(&mut self, writer: &Gid) -> impl Iterator<Item = &mut MatchedReader> {
        self.slots.iter_mut().filter(move |slot| slot.reader.writer() == *writer)
    }

    /// Returns the reader of this writer, if the writer is not gone.
    pub(super) fn attached(&self, writer: &Gid) -> Option<&MatchedReader> {
        self.of(writer).find(|slot| !slot.over)
    }

    pub(super) fn attached_mut(&mut self, writer: &Gid) -> Option<&mut MatchedReader> {
        self.of_mut(writer).find(|slot| !slot.over)
    }

    /// Returns the indices of the readers of this writer.
    pub(super) fn indices_of(&self, writer: &Gid) -> Vec<usize> {
        let of = |index: &usize| self.slots[*index].reader.writer() == *writer;
        (0..self.slots.len()).filter(of).collect()
    }

    /// Removes and returns the readers of writers that are gone, if their rings are drained and none of their samples
    /// is in flight.
    pub(super) fn remove_drained(&mut self) -> Vec<MatchedReader> {
        let over = |slot: &mut MatchedReader| {
            slot.over && slot.reader.is_drained() && !slot.reader.is_under_way()
        };
        self.slots.extract_if(.., over).collect()
    }

    /// Gives up a writer's samples in memory that never came, if the writer has come back in another process and sends
    /// the unconfirmed samples once more. Missing samples then show as gaps in its numbers. Returns whether it gave up
    /// anything.
    pub(super) fn skip_missing(&mut self) -> bool {
        let mut forgone = false;
        for index in 0..self.slots.len().saturating_sub(1) {
            let (earlier, later) = self.slots.split_at_mut(index + 1);
            let slot = &mut earlier[index];
            let returned = slot.over
                && slot.reader.missing().is_some()
                && slot.reader.writer_dead()
                && later.iter().any(|other| other.sends_again(slot));
            forgone |= returned && slot.reader.skip_missing();
        }
        forgone
    }

    /// Begins a take: each reader may have a sample.
    pub(super) fn begin_take(&mut self) {
        self.slots.iter_mut().for_each(|slot| slot.turn = TakeTurn::Open);
    }

    /// Records that there was no memory for the next sample of a reader. Returns false while an earlier shortage still
    /// counts.
    pub(super) fn note_short(&mut self, index: usize) -> bool {
        self.slots[index].turn = TakeTurn::Short;
        let news = self.short_until().is_none();
        self.short = Some(Instant::now());
        news
    }

    /// Returns the end of the current shortage of memory, before which nothing can be taken.
    pub(super) fn short_until(&self) -> Option<Instant> {
        self.short.map(|since| since + NO_MEMORY_PAUSE).filter(|until| *until > Instant::now())
    }

    /// Returns whether there is a sample to take.
    pub(super) fn has_data(&self) -> bool {
        self.short_until().is_none() && self.slots.iter().any(|slot| slot.reader.has_data())
    }

    /// Returns when to look again without a doorbell: for memory to take a sample, or for memory of a writer.
    pub(in crate::session) fn look_again(&self) -> Option<Instant> {
        let missing = self.slots.iter().filter_map(|slot| slot.reader.look_again());
        missing.chain(self.short_until()).min()
    }

    /// Returns the index of the reader that has the next sample of a writer.
    pub(super) fn next_of(&self, writer: &Gid) -> Option<usize> {
        let next = self.slots.iter().position(|slot| {
            slot.reader.writer() == *writer
                && match slot.turn {
                    TakeTurn::Open => slot.reader.has_data(),
                    TakeTurn::Overtaken => false,
                    TakeTurn::Short => true,
                }
        });
        next.filter(|index| self.slots[*index].turn != TakeTurn::Short)
    }

    /// Returns the reader with the oldest next sample, except readers whose writer is faster than the take. Samples
    /// that a writer wrote before it granted anew come before its later samples, even if their timestamps are later. In
    /// the other order, they would count as repeated.
    pub(super) fn oldest(&mut self) -> Option<usize> {
        loop {
            let index = self.oldest_by_time()?;
            let writer = self.slots[index].reader.writer();
            let earlier = self.slots[..index].iter().position(|slot| {
                slot.reader.writer() == writer
                    && match slot.turn {
                        TakeTurn::Open => slot.over && slot.reader.has_data(),
                        TakeTurn::Overtaken => false,
                        TakeTurn::Short => true,
                    }
            });
            match earlier {
                Some(earlier) if self.slots[earlier].turn == TakeTurn::Short => {
                    self.slots[index].turn = TakeTurn::Overtaken;
                }
                earlier => return Some(earlier.unwrap_or(index)),
            }
        }
    }

    fn oldest_by_time(&mut self) -> Option<usize> {
        if let [slot] = self.slots.as_slice() {
            // The take itself finds out whether there is a sample; usually there is.
            return (slot.turn == TakeTurn::Open).then_some(0);
        }
        let mut oldest = None;
        let open =
            self.slots.iter_mut().enumerate().filter(|(_, slot)| slot.turn == TakeTurn::Open);
        for (index, slot) in open {
            // A writer whose memory is corrupt is chosen, so that taking finds out.
            let stamp = match slot.reader.peek() {
                Ok(Some(meta)) => meta.source_nanos,
                Ok(None) => continue,
                Err(_) => i64::MIN,
            };
            if oldest.is_none_or(|(least, _)| stamp < least) {
                oldest = Some((stamp, index));
            }
        }
        oldest.map(|(_, index)| index)
    }

    /// Skips the oldest samples beyond `depth`: a subscription's KEEP_LAST(depth) counts over all publishers together.
    pub(super) fn skip_to_depth(&mut self, depth: u64) {
        let mut unread = self.unread();
        while unread > depth {
            let Some(index) = self.oldest() else { return };
            if !self.slots[index].reader.skip() {
                return;
            }
            unread -= 1;
        }
    }

    /// Returns the number of samples to be taken.
    pub(super) fn unread(&self) -> u64 {
        self.slots.iter().map(|slot| slot.reader.unread()).sum()
    }

    /// Returns the number of samples that were lost.
    pub(super) fn lost(&self) -> u64 {
        self.slots.iter().map(MatchedReader::lost).fold(0, u64::saturating_add)
    }

    /// Returns the number of samples that came.
    pub(super) fn arrived(&self) -> u64 {
        self.slots.iter().map(|slot| slot.reader.arrived()).sum()
    }

    /// Returns the writers that are leaving, with samples still to come.
    pub(in crate::session) fn leaving(&self) -> Vec<Gid> {
        let leaving = self.slots.iter().filter(|slot| slot.leaving && !slot.over);
        leaving.map(|slot| slot.reader.writer()).collect()
    }

    /// Returns whether the lease of a writer may run out.
    pub(in crate::session) fn offers_lease(&self) -> bool {
        self.slots.iter().any(|slot| slot.counts() && slot.lease.is_some())
    }

    /// Returns the publishers that have a lease, and when each was last alive, by the monotonic clock.
    pub(in crate::session) fn assertions(&self) -> Vec<(Gid, u64)> {
        let there = self.slots.iter().filter(|slot| !slot.over);
        let times = there.map(|slot| (slot.reader.writer(), slot.reader.times()));
        let leased = times.filter(|(_, times)| times.lease.is_some());
        leased.filter_map(|(gid, times)| Some((gid, times.asserted?))).collect()
    }

    /// Returns the writers that have a sample to take.
    pub(in crate::session) fn with_data(&self) -> impl Iterator<Item = Gid> {
        let some = self.slots.iter().filter(|slot| slot.reader.has_data());
        some.map(|slot| slot.reader.writer())
    }

    /// Returns whether there is a sample of `writer` to take.
    pub(in crate::session) fn has_from(&self, writer: &Gid) -> bool {
        self.of(writer).any(|slot| slot.reader.has_data())
    }

    /// Returns the time after which a sample of `writer` may be taken, if any waits.
    pub(in crate::session) fn retry_of(&self, writer: &Gid) -> Option<Duration> {
        let wait = |until: Instant| until.saturating_duration_since(Instant::now());
        self.has_from(writer).then(|| self.short_until().map_or(Duration::ZERO, wait))
    }

    /// Returns whether samples of `writer` wait that cannot be taken yet, for want of its memory or of this process's
    /// own.
    pub(in crate::session) fn is_held_up(&self, writer: &Gid) -> bool {
        let mut slots = self.of(writer);
        slots.any(|slot| slot.reader.missing().is_some())
            || self.short_until().is_some() && self.has_from(writer)
    }

    /// Returns how many publishes of `writer` found no space, if a reader has not confirmed its oldest sample.
    pub(in crate::session) fn refused_of(&self, writer: &Gid) -> Option<u64> {
        self.of(writer).filter_map(|slot| slot.reader.refused()).max()
    }

    /// Returns the number of unconfirmed samples by writer.
    pub(in crate::session) fn undone(&self) -> HashMap<Gid, u64> {
        let mut undone = HashMap::new();
        for slot in &self.slots {
            let samples = slot.reader.undone();
            if samples > 0 {
                *undone.entry(slot.reader.writer()).or_default() += samples;
            }
        }
        undone
    }

    /// Returns the number of unconfirmed samples of `writer`.
    pub(in crate::session) fn undone_of(&self, writer: &Gid) -> u64 {
        self.of(writer).map(|slot| slot.reader.undone()).fold(0, u64::saturating_add)
    }

    /// Returns the bytes of the unconfirmed samples of `writer`.
    pub(in crate::session) fn undone_bytes_of(&self, writer: &Gid) -> u64 {
        self.of(writer).map(|slot| slot.reader.undone_bytes()).fold(0, u64::saturating_add)
    }
}

impl Index<usize> for Slots {
    type Output = MatchedReader;

    fn index(&self, index: usize) -> &MatchedReader {
        &self.slots[index]
    }
}

impl IndexMut<usize> for Slots {
    fn index_mut(&mut self, index: usize) -> &mut MatchedReader {
        &mut self.slots[index]
    }
}

#[cfg(test)]
mod tests {
    use axon_shm::{
        Meta,
        internal::{SessionSegment, Writer},
    };

    use super::*;
    use crate::{
        ids::SessionId,
        session::endpoint_state::subscription::{matched_reader::NumberKind, tests::reading},
    };

    /// Creates readers of the rings of these writers in turn, each with samples of these times.
    fn slots(rings: &[(u32, &[i64])]) -> (Slots, Vec<Writer>) {
        let session = SessionSegment::create(SessionId::random()).unwrap();
        let mut slots = Slots::default();
        let writers = rings.iter().map(|(number, stamps)| {
            let gid = |number| Gid::new(session.id(), number);
            let (writer, reader) = reading(&session, gid(*number), gid(0));
            for (sequence, stamp) in (1..).zip(*stamps) {
                writer.publish(Meta::at_nanos(sequence, *stamp), b"sample").unwrap();
            }
            slots.push(MatchedReader::new(reader, None, None, false, NumberKind::None));
            writer
        });
        let writers = writers.collect();
        (slots, writers)
    }

    #[test]
    fn the_oldest_sample_is_next_and_no_reader_of_a_writer_overtakes_an_earlier_one() {
        let (mut slots, _writers) = slots(&[(1, &[30]), (2, &[20]), (1, &[10])]);
        assert_eq!(slots.oldest(), Some(2));
        slots[0].over = true;
        assert_eq!(slots.oldest(), Some(0), "the writer granted anew");
        slots[0].turn = TakeTurn::Overtaken;
        assert_eq!(slots.oldest(), Some(2));
        assert!(slots.note_short(0) && !slots.note_short(0));
        assert_eq!(slots.oldest(), Some(1), "what the first reader has comes before the third's");
        let writer = slots[0].reader.writer();
        assert_eq!((slots.next_of(&writer), slots.has_data()), (None, false));
        slots.begin_take();
        assert_eq!(slots.next_of(&writer), Some(0));
    }

    #[test]
    fn a_shared_depth_counts_over_all_writers_and_skips_the_oldest_samples() {
        let (mut slots, _writers) = slots(&[(1, &[1, 4, 5]), (2, &[2, 3, 6])]);
        slots.skip_to_depth(3);
        assert_eq!(
            (slots.unread(), slots[0].reader.skipped(), slots[1].reader.skipped()),
            (3, 1, 2)
        );
        let next = slots.oldest().unwrap();
        assert_eq!(slots[next].reader.peek().unwrap().unwrap().source_nanos, 4);
    }
}
