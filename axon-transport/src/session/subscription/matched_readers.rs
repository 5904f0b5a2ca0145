//! The readers of a subscription, one for each publisher: their attachment and removal.

use std::{
    collections::{BTreeSet, HashMap},
    time::{Duration, Instant},
};

use axon_shm::internal::{Grant, Lane, Location, MAX_GAP, Reader};

use super::remembered::Remembered;
use crate::{ids::Gid, session::clock};

/// Rings that a KEEP_ALL subscription, a client or a server reads of what a writer left, each by way of another daemon.
const LEFT: usize = 8;
/// How long nobody is woken for a sample that there was no memory to take.
const SHORT: Duration = Duration::from_secs(1);

#[derive(Default)]
pub(in crate::session) struct MatchedReaders {
    pub(super) matched_readers: Vec<MatchedReader>,
    /// Lanes given to writers that have not granted yet, and the number behind which each is to go on.
    pub(super) pending: HashMap<Gid, (Lane, Option<u64>)>,
    /// The last sequence number taken of each writer that is gone.
    last: Remembered,
    pub(super) received: u64,
    pub(super) expired: u64,
    pub(super) lost: u64,
    /// Losses that were reported.
    pub(super) lost_before: u64,
    /// Samples that came from writers that are gone, and all that somebody was told of.
    pub(super) arrived: u64,
    pub(super) arrived_before: u64,
    /// When there was no memory to take a sample last.
    pub(super) short: Option<Instant>,
    /// Whether the subscription wants every sample.
    pub(super) keeps_all: bool,
    /// Whether it is of a client or server. What of its calls was not taken comes again with the next daemon.
    of_service: bool,
    /// Writers whose memory was not usable, of which the others have to be told.
    pub(super) discarded: Vec<Gid>,
}

/// What a writer's numbers tell of losses that the ring's positions do not.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in crate::session) enum Numbers {
    None,
    /// It stands in for one elsewhere: what was lost on the way to its ring.
    All,
    /// What was lost since it was here before.
    Since,
    /// What was lost between the last sample that it brought before and its first. Later losses are said
    /// aloud.
    Between,
}

/// How a writer is asked to serve.
pub(in crate::session) struct Asking {
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

pub(super) struct MatchedReader {
    pub(super) reader: Reader,
    /// When it was mapped: what was published before is no news. By the monotonic clock.
    pub(super) since: u64,
    /// The age at which its samples are not delivered any more.
    pub(super) lifespan: Option<Duration>,
    /// Within what the writer says that it is alive.
    pub(super) lease: Option<u64>,
    /// The writer is gone: take what it left, then unmap.
    pub(super) over: bool,
    /// It is gone, too, but what it left is still to come.
    pub(super) leaving: bool,
    /// Found nothing in the take that is under way, since the writer was faster.
    pub(super) overtaken: bool,
    /// There was no memory for its next sample in the take that is under way. Later samples of its writer wait as well.
    pub(super) short: bool,
    /// The last sequence number taken of its writer, by way of whatever slot; of one that was attached
    /// before and has taken nothing, the one in front of its first.
    pub(super) last: Option<u64>,
    /// The number in front of the first that this slot was granted.
    after: Option<u64>,
    /// The gaps in its numbers, where they tell of losses.
    pub(super) gaps: Option<Gaps>,
    numbers: Numbers,
    /// A number of its writer was known when it was granted.
    pub(super) resumed: bool,
    /// What was missing while they were looked at.
    missed: u64,
}

/// Samples of a publisher on another host that never came to the ring that stands in for it here:
/// numbers that no position of the ring has.
#[derive(Default)]
pub(super) struct Gaps {
    /// Sequence number of the newest sample, and the position after that of the last one.
    before: Option<(u64, u64)>,
    lost: u64,
}

impl Gaps {
    /// A sample of this number was at this position.
    fn pass(&mut self, sequence: u64, position: u64) {
        let newest = self.before.map_or(sequence, |(newest, next)| {
            // What was overwritten on this side is counted there, by its positions.
            let missing = sequence.saturating_sub(newest).saturating_sub(1);
            let lost = missing.saturating_sub(position.saturating_sub(next));
            // The writer's process may say any number. A loss that cannot be is not counted.
            if missing <= MAX_GAP {
                self.lost = self.lost.saturating_add(lost);
            }
            newest.max(sequence)
        });
        self.before = Some((newest, position.saturating_add(1)));
    }
}

impl MatchedReader {
    /// Whether the writer is one of those that the subscription is matched with.
    pub(super) fn counts(&self) -> bool {
        !self.over && !self.leaving
    }

    /// A sample was taken.
    pub(super) fn passed(&mut self, sequence: u64) {
        let Some(gaps) = &mut self.gaps else { return };
        let position = self.reader.position().saturating_sub(1);
        if let (None, Some(last)) = (gaps.before, self.last) {
            gaps.before = Some((last, self.reader.grant().first));
        }
        gaps.pass(sequence, position);
        if self.numbers == Numbers::Between {
            self.missed = gaps.lost;
            self.gaps = None;
        }
    }

    /// The number up to which nothing is to come any more.
    fn reached(&self) -> Option<u64> {
        self.last.or(self.after)
    }

    /// Its samples that were lost, here and before they came here.
    pub(super) fn lost(&self) -> u64 {
        let before = self.gaps.as_ref().map_or(0, |gaps| gaps.lost);
        self.reader.lost().saturating_add(before).saturating_add(self.missed)
    }
}

impl MatchedReaders {
    /// Those of a subscription that wants every sample, or does not.
    pub(super) fn new(keeps_all: bool) -> Self {
        Self { keeps_all, ..Self::default() }
    }

    /// Those of a client or server.
    pub(super) fn of_service() -> Self {
        Self { of_service: true, ..Self::default() }
    }

    pub(super) fn has_data(&self) -> bool {
        !self.is_short() && self.matched_readers.iter().any(|slot| slot.reader.has_data())
    }

    pub(super) fn is_short(&self) -> bool {
        self.short_until().is_some()
    }

    /// Until when there is nothing to take, as there is no memory to take it.
    pub(super) fn short_until(&self) -> Option<Instant> {
        self.short.map(|since| since + SHORT).filter(|until| *until > Instant::now())
    }

    /// When to look again though nobody rings: for memory to take a sample, or for memory of a writer.
    pub(in crate::session) fn look_again(&self) -> Option<Instant> {
        let missing = self.matched_readers.iter().filter_map(|slot| slot.reader.look_again());
        missing.chain(self.short_until()).min()
    }

    /// Whether the lease of one of the writers may run out.
    pub(in crate::session) fn offers_lease(&self) -> bool {
        self.matched_readers.iter().any(|slot| slot.counts() && slot.lease.is_some())
    }

    pub(super) fn losses(&self) -> u64 {
        self.matched_readers.iter().map(MatchedReader::lost).fold(self.lost, u64::saturating_add)
    }

    /// Samples that came since this was last asked.
    pub(super) fn new_arrivals(&mut self) -> u64 {
        let present = self.matched_readers.iter().map(|slot| slot.reader.arrived()).sum::<u64>();
        let arrived = self.arrived + present;
        // A writer whose memory is corrupt takes its numbers with it.
        arrived.saturating_sub(std::mem::replace(&mut self.arrived_before, arrived))
    }

    /// Samples to be taken: of all writers together at most `depth`, if they share one.
    pub(super) fn unread(&self, depth: Option<u32>) -> u64 {
        let unread = self.matched_readers.iter().map(|slot| slot.reader.unread()).sum::<u64>();
        depth.map_or(unread, |depth| unread.min(depth.into()))
    }

    /// Losses since this was last asked.
    pub(super) fn new_losses(&mut self) -> u64 {
        let losses = self.losses();
        losses.saturating_sub(std::mem::replace(&mut self.lost_before, losses))
    }

    /// The lane that is, or from now on will be, the one for `writer`.
    pub(in crate::session) fn lane_for<E>(
        &mut self,
        writer: Gid,
        allocate: impl FnOnce() -> Result<Lane, E>,
    ) -> Result<Asking, E> {
        if let Some(slot) =
            self.matched_readers.iter().find(|s| s.reader.writer() == writer && !s.over)
        {
            return Ok(Asking { lane: slot.reader.lane(), after: None });
        }
        if let Some((lane, after)) = self.pending.get(&writer) {
            return Ok(Asking { lane: lane.location(), after: *after });
        }
        let earlier = self.matched_readers.iter().find(|slot| slot.reader.writer() == writer);
        let after = earlier.map_or_else(|| self.last.get(&writer), MatchedReader::reached);
        let lane = allocate()?;
        let location = lane.location();
        self.pending.insert(writer, (lane, after));
        Ok(Asking { lane: location, after })
    }

    /// The lanes of all that are attached, or asked to be: what is repeated when `stands_for`
    /// changes.
    pub(in crate::session) fn lanes(&self) -> Vec<(Gid, Location)> {
        let attached = self.matched_readers.iter().filter(|s| !s.over);
        let attached = attached.map(|s| (s.reader.writer(), s.reader.lane()));
        attached
            .chain(self.pending.iter().map(|(gid, (lane, _))| (*gid, lane.location())))
            .collect()
    }

    /// What a grant of `writer` calls for.
    pub(in crate::session) fn accept(&mut self, writer: Gid, grant: Grant) -> Accept {
        if let Some(slot) =
            self.matched_readers.iter_mut().find(|s| !s.over && s.reader.writer() == writer)
        {
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
    pub(in crate::session) fn add(&mut self, reader: Reader, after: Option<u64>, numbers: Numbers) {
        let writer = reader.writer();
        // One that speaks for another has no number before it has a sample.
        let after = after.filter(|number| *number > 0);
        let since = clock::monotonic();
        let times = reader.times();
        let lifespan = times.lifespan.map(Duration::from_nanos);
        let lease = times.lease;
        let (over, leaving, overtaken, short) = (false, false, false, false);
        let earlier = self
            .matched_readers
            .iter()
            .find(|s| s.reader.writer() == writer)
            .map(MatchedReader::reached);
        let last = earlier.unwrap_or_else(|| self.last.remove(&writer));
        let resumed = earlier.is_some() || last.is_some();
        let told = match numbers {
            Numbers::None => false,
            Numbers::All => true,
            Numbers::Since | Numbers::Between => resumed,
        };
        let gaps = told.then(Gaps::default);
        let missed = 0;
        self.matched_readers.push(MatchedReader {
            reader,
            since,
            lifespan,
            lease,
            over,
            leaving,
            overtaken,
            short,
            last,
            after,
            gaps,
            numbers,
            resumed,
            missed,
        });
        if let Some(slot) = self.matched_readers.last() {
            // It could not be taken from before it was here.
            slot.reader.mark_active();
        }
        self.forget_older(writer);
    }

    /// The daemon said that the writer will not write any more: it has handed over all that there is.
    /// Whether that is news.
    pub(in crate::session) fn end(&mut self, writer: &Gid) -> bool {
        self.pending.remove(writer);
        for slot in self.matched_readers.iter_mut().filter(|slot| slot.reader.writer() == *writer) {
            slot.reader.end();
            slot.reader.mark_active();
        }
        self.end_where(|reader| reader.writer() == *writer)
    }

    /// The writer is gone though more comes of it, or is not after all. Whether that is news.
    pub(in crate::session) fn leave(&mut self, writer: &Gid, leaving: bool) -> bool {
        let mut news = false;
        for slot in self.matched_readers.iter_mut().filter(|slot| slot.reader.writer() == *writer) {
            news |= slot.leaving != leaving;
            slot.leaving = leaving;
        }
        news
    }

    /// Those who are, though more comes of them.
    pub(in crate::session) fn leaving(&self) -> Vec<Gid> {
        let leaving = self.matched_readers.iter().filter(|slot| slot.leaving && !slot.over);
        leaving.map(|slot| slot.reader.writer()).collect()
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
        let there = self.matched_readers.iter().map(|slot| slot.reader.writer());
        there.chain(self.pending.keys().copied()).collect()
    }

    fn end_where(&mut self, which: impl Fn(&Reader) -> bool) -> bool {
        let mut news = false;
        for slot in self.matched_readers.iter_mut().filter(|s| !s.over && which(&s.reader)) {
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
            let of = self.slots_of(writer);
            let over = of.iter().filter(|index| self.matched_readers[**index].over).count();
            let [older, newer, ..] = of[..] else { return };
            let same =
                self.matched_readers[newer].reader.is_of_ring(&self.matched_readers[older].reader);
            let keeps = self.keeps_all || self.of_service;
            if over <= if keeps && !same { LEFT } else { 1 } {
                return;
            }
            let mut slot = self.matched_readers.remove(older);
            self.count_left(&mut slot);
            self.retire(&slot);
        }
    }

    /// Counts what a slot that is given up has not taken and no later one of its writer will.
    fn count_left(&mut self, slot: &mut MatchedReader) {
        let writer = slot.reader.writer();
        let Some(newer) = self.matched_readers.iter().find(|s| s.reader.writer() == writer) else {
            return;
        };
        if newer.reader.is_of_ring(&slot.reader) {
            let later = newer.reader.grant().first;
            self.lost = self.lost.saturating_add(slot.reader.unread_below(later));
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
            self.lost = self.lost.saturating_add(1);
        }
        if let Some(last) = slot.last {
            self.note(writer, last);
        }
    }

    /// Keeps what a slot that is given up leaves to be known.
    pub(super) fn retire(&mut self, slot: &MatchedReader) {
        self.lost = self.lost.saturating_add(slot.lost());
        self.arrived += slot.reader.arrived();
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
        for slot in self.matched_readers.iter_mut().filter(|s| s.reader.writer() == writer) {
            slot.last = Some(sequence);
        }
    }

    /// Where this writer's are, in the order in which it granted them.
    fn slots_of(&self, writer: Gid) -> Vec<usize> {
        let of = |index: &usize| self.matched_readers[*index].reader.writer() == writer;
        (0..self.matched_readers.len()).filter(of).collect()
    }

    /// Whether anything of this writer's is read, or may be soon.
    pub(in crate::session) fn reads(&self, writer: &Gid) -> bool {
        self.pending.contains_key(writer)
            || self.matched_readers.iter().any(|s| s.reader.writer() == *writer)
    }

    /// Gives up what a writer left in memory that never came, where it has come back in another process and
    /// sends once more what was not confirmed. Samples missing then show as gaps in its numbers.
    pub(super) fn skip_missing(&mut self) {
        // To others nothing is sent again.
        if !self.keeps_all {
            return;
        }
        let mut forgone = false;
        for index in 0..self.matched_readers.len().saturating_sub(1) {
            let (earlier, later) = self.matched_readers.split_at_mut(index + 1);
            let slot = &mut earlier[index];
            let sends_again = |other: &MatchedReader| {
                other.reader.writer() == slot.reader.writer()
                    && other.resumed
                    && other.numbers != Numbers::None
                    && !other.reader.is_of_ring(&slot.reader)
            };
            let returned = slot.over
                && slot.reader.missing().is_some()
                && slot.reader.writer_dead()
                && later.iter().any(sends_again);
            forgone |= returned && slot.reader.skip_missing();
        }
        if forgone {
            self.sweep();
        }
    }

    /// Unmaps writers that are gone and drained, and of which nothing is under way.
    pub(super) fn sweep(&mut self) {
        let over = |slot: &mut MatchedReader| {
            slot.over && slot.reader.is_drained() && !slot.reader.is_under_way()
        };
        let gone: Vec<MatchedReader> = self.matched_readers.extract_if(.., over).collect();
        gone.iter().for_each(|slot| self.retire(slot));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_number_without_a_position_was_lost_on_the_way() {
        let mut gaps = Gaps::default();
        for (sequence, position) in [(5, 0), (6, 1), (9, 2)] {
            gaps.pass(sequence, position);
        }
        assert_eq!(gaps.lost, 2, "7 and 8");
        // Overwritten here: numbers and positions are missing alike.
        gaps.pass(19, 12);
        assert_eq!(gaps.lost, 2);
        gaps.pass(30, 20);
        assert_eq!(gaps.lost, 5, "three of ten were lost on the way");
        // What comes again has a position, and makes up for no number.
        gaps.pass(29, 21);
        gaps.pass(30, 22);
        gaps.pass(32, 23);
        assert_eq!(gaps.lost, 6);
    }

    #[test]
    fn a_number_that_no_publisher_can_have_reached_is_no_loss() {
        let mut gaps = Gaps::default();
        gaps.pass(1, 0);
        gaps.pass(2 + MAX_GAP, 1);
        assert_eq!(gaps.lost, MAX_GAP);
        gaps.pass(u64::MAX, 2);
        assert_eq!(gaps.lost, MAX_GAP, "nobody lost 2^64 samples");
        gaps.pass(u64::MAX, 3);
        assert_eq!(gaps.lost, MAX_GAP);
    }
}
