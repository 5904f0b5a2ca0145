//! Takes the next samples of a subscription.

use std::{ops::Range, time::SystemTime};

use axon_shm::{Meta, Sample, TakeError, internal::Reader};

use super::{
    matched_reader::TakeTurn,
    matched_readers::MatchedReaders,
    message_info::{Lifetime, MessageInfo},
};
use crate::{ids::Gid, session::clock};

/// Maximum number of samples that one take skips because they were taken before.
const REPEATS: usize = 64;

/// The limit of one take by a relay, which takes at least one sample.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TakeLimit {
    /// Maximum number of samples.
    pub samples: usize,
    /// Maximum number of bytes of several samples together.
    pub bytes: usize,
}

fn clock_now() -> SystemTime {
    clock::from_unix_nanos(clock::wall())
}

/// The properties of a subscription that a take depends on.
#[derive(Clone, Copy)]
pub(super) struct TakeRules<'a> {
    /// The topic, for log lines.
    pub(super) topic: &'a str,
    /// Maximum number of unread samples of all writers together, if they share a depth.
    pub(super) shared_depth: Option<u32>,
    /// True if the numbers of each writer rise: a sample whose number does not rise was taken before.
    pub(super) rising: bool,
    /// True if skipped samples count as lost: a relay was not asked to skip any.
    pub(super) loses_skipped: bool,
}

/// One take by a subscription.
pub(super) struct Take<'a> {
    readers: &'a mut MatchedReaders,
    of: TakeRules<'a>,
    /// The time at which its samples were received. Without it, each sample has the time at which it was taken.
    received_timestamp: Option<SystemTime>,
}

impl<'a> Take<'a> {
    /// Begins a take from these `readers`, which are `of` the subscription and whose lock the caller holds.
    pub(super) fn begin(readers: &'a mut MatchedReaders, of: TakeRules<'a>) -> Self {
        readers.slots.begin_take();
        Self { readers, of, received_timestamp: None }
    }

    /// Takes the oldest sample of all writers.
    pub(super) fn next<T>(
        mut self,
        mut take: impl FnMut(&mut Reader) -> Result<Option<(Meta, T)>, TakeError>,
    ) -> Option<(MessageInfo, T)> {
        // A writer that repeats itself without end must not keep the lock: callers come back as long as there is a
        // sample to take.
        for _ in 0..REPEATS {
            let slots = &mut self.readers.slots;
            if let Some(depth) = self.of.shared_depth.filter(|_| slots.len() > 1) {
                slots.skip_to_depth(depth.into());
            }
            self.readers.skip_missing();
            let Some(index) = self.readers.slots.oldest() else {
                // A skipped sample may have been the last of a writer that is gone.
                if self.readers.slots.iter().any(|slot| slot.over) {
                    self.readers.sweep();
                }
                return None;
            };
            if let Some(taken) = self.take_at(index, &mut take) {
                return Some(taken);
            }
        }
        None
    }

    /// Takes the next sample of one writer.
    pub(super) fn next_of<T>(
        mut self,
        writer: &Gid,
        mut take: impl FnMut(&mut Reader) -> Result<Option<(Meta, T)>, TakeError>,
    ) -> Option<(MessageInfo, T)> {
        for _ in 0..REPEATS {
            self.readers.skip_missing();
            let Some(index) = self.readers.slots.next_of(writer) else {
                self.readers.sweep();
                return None;
            };
            if let Some(taken) = self.take_at(index, &mut take) {
                return Some(taken);
            }
        }
        None
    }

    /// Takes samples of one writer, with their payloads one behind the other in `out`, which is empty. `each` receives
    /// the position of each sample's payload. Returns the number of samples taken.
    pub(super) fn many_of(
        mut self,
        writer: &Gid,
        most: TakeLimit,
        out: &mut Vec<u8>,
        mut each: impl FnMut(MessageInfo, Range<usize>),
    ) -> usize {
        self.received_timestamp = Some(clock_now());
        let (mut taken, mut passed_over) = (0, 0);
        let mut last = None;
        while taken < most.samples && passed_over < REPEATS {
            // Usually the next sample is at the same reader as the last one.
            let Some(index) = last.take().or_else(|| {
                self.readers.skip_missing();
                self.readers.slots.next_of(writer)
            }) else {
                self.readers.sweep();
                break;
            };
            let start = out.len();
            let mut take = |reader: &mut Reader| {
                let taken = reader.take_behind(out, most.bytes)?;
                Ok(taken.map(|(taken, len)| (taken.meta, len)))
            };
            match self.take_at(index, &mut take) {
                Some((info, len)) => {
                    each(info, start..start + len);
                    taken += 1;
                    let slot = self.readers.slots.get(index);
                    last = slot.filter(|s| !s.over && s.reader.writer() == *writer).map(|_| index);
                }
                None => {
                    // A sample that does not count is removed from the output.
                    out.truncate(start);
                    passed_over += 1;
                }
            }
        }
        self.readers.slots.of(writer).for_each(|slot| slot.reader.tell_taken());
        taken
    }

    /// Takes a sample from a reader. Returns `None` if there is none, or it does not count.
    fn take_at<T>(
        &mut self,
        index: usize,
        take: &mut impl FnMut(&mut Reader) -> Result<Option<(Meta, T)>, TakeError>,
    ) -> Option<(MessageInfo, T)> {
        let readers = &mut *self.readers;
        let topic = self.of.topic;
        let slot = &mut readers.slots[index];
        let writer = slot.reader.writer();
        let (meta, taken) = match take(&mut slot.reader) {
            Ok(Some(taken)) => taken,
            // Overwritten again and again during the read: the other readers have their turn first.
            Ok(None) => {
                slot.turn = TakeTurn::Overtaken;
                return None;
            }
            Err(error @ TakeError::TooLarge { .. }) => {
                tracing::error!(topic, %error, "a sample is lost");
                return None;
            }
            // The sample stays, and can be taken when there is memory again.
            Err(error @ TakeError::NoMemory { .. }) => {
                if readers.slots.note_short(index) {
                    tracing::error!(topic, %error, "cannot take a sample yet");
                }
                return None;
            }
            Err(error) => {
                self.discard(index, &error);
                return None;
            }
        };
        let over = slot.over;
        let received_timestamp = self.received_timestamp.unwrap_or_else(clock_now);
        let lifetime = slot.lifespan.map(|lifespan| Lifetime::of(&meta, lifespan));
        let expired = lifetime.is_some_and(Lifetime::is_over);
        slot.passed(meta.sequence);
        let repeated = self.of.rising && slot.last.is_some_and(|last| meta.sequence <= last);
        if !repeated {
            readers.note(writer, meta.sequence);
            if expired {
                readers.counts.expired += 1;
            } else {
                readers.counts.received += 1;
            }
        }
        if over {
            readers.sweep();
        }
        if repeated || expired {
            return None;
        }
        let info = MessageInfo {
            publisher: writer,
            sequence: meta.sequence,
            source_timestamp: clock::from_unix_nanos(meta.source_nanos),
            received_timestamp,
            reception: readers.counts.received,
            lifetime,
        };
        Some((info, taken))
    }

    /// Takes the next sample of one writer, for a relay. Returns it and the number of that writer's samples lost by
    /// then.
    pub(super) fn sample_of(mut self, writer: &Gid) -> Option<(Sample, u64)> {
        let readers = &mut *self.readers;
        let topic = self.of.topic;
        let index = readers.slots.iter().position(|slot| {
            slot.reader.writer() == *writer && (!slot.over || slot.reader.has_data())
        })?;
        let slot = &mut readers.slots[index];
        match slot.reader.take_sample() {
            Ok(sample) => {
                if let Some(sample) = &sample {
                    slot.passed(sample.meta().sequence);
                }
                let skipped = if self.of.loses_skipped { slot.reader.skipped() } else { 0 };
                let taken = sample.map(|sample| (sample, slot.lost().saturating_add(skipped)));
                readers.sweep();
                taken
            }
            Err(error @ (TakeError::TooLarge { .. } | TakeError::NoMemory { .. })) => {
                tracing::error!(topic, %error, "cannot take a sample");
                None
            }
            Err(error) => {
                self.discard(index, &error);
                None
            }
        }
    }

    /// Gives up a reader whose ring is not usable.
    fn discard(&mut self, index: usize, error: &TakeError) {
        let topic = self.of.topic;
        tracing::error!(topic, %error, "a publisher's memory is not usable");
        let slot = self.readers.slots.remove(index);
        self.readers.retire(&slot);
        if !slot.over {
            self.readers.discarded.push(slot.reader.writer());
        }
    }
}
