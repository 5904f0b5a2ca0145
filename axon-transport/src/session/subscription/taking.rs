//! Chooses the publisher from which a subscription takes the next sample.

use std::{
    collections::HashMap,
    ops::Range,
    time::{Duration, Instant, SystemTime},
};

use axon_shm::{Meta, Sample, TakeError, internal::Reader};

use super::{
    Lifetime, MessageInfo,
    inner::SubscriptionInner,
    matched_readers::{MatchedReader, MatchedReaders},
};
use crate::{graph::Endpoint, ids::Gid, session::clock, wire::session::EndpointRole};

/// Samples that one take passes over because they were taken before.
const REPEATS: usize = 64;

/// How much a relay takes in one go: one sample in any case.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TakeLimit {
    /// Samples.
    pub samples: usize,
    /// Bytes of several samples together.
    pub bytes: usize,
}

fn clock_now() -> SystemTime {
    clock::from_unix_nanos(clock::wall())
}

impl MatchedReaders {
    pub(super) fn take<T>(
        &mut self,
        mut take: impl FnMut(&mut Reader) -> Result<Option<(Meta, T)>, TakeError>,
        of: &SubscriptionInner,
    ) -> Option<(MessageInfo, T)> {
        self.matched_readers.iter_mut().for_each(|slot| slot.overtaken = false);
        // A writer that repeats itself without end must not keep the lock: callers come back as
        // long as there is something to take.
        for _ in 0..REPEATS {
            if let Some(depth) = of.shared_depth.filter(|_| self.matched_readers.len() > 1) {
                self.skip_to_depth(depth.into());
            }
            self.skip_missing();
            let Some(index) = self.oldest() else {
                // What was skipped may have been the last of a writer that is gone.
                if self.matched_readers.iter().any(|slot| slot.over) {
                    self.sweep();
                }
                return None;
            };
            if let Some(taken) = self.take_at(index, &mut take, of, None) {
                return Some(taken);
            }
        }
        None
    }

    /// As [`take`](Self::take), of one writer.
    pub(super) fn take_of<T>(
        &mut self,
        writer: &Gid,
        mut take: impl FnMut(&mut Reader) -> Result<Option<(Meta, T)>, TakeError>,
        of: &SubscriptionInner,
    ) -> Option<(MessageInfo, T)> {
        self.matched_readers.iter_mut().for_each(|slot| slot.overtaken = false);
        for _ in 0..REPEATS {
            let Some(index) = self.next_of(writer) else {
                self.sweep();
                return None;
            };
            if let Some(taken) = self.take_at(index, &mut take, of, None) {
                return Some(taken);
            }
        }
        None
    }

    /// Takes samples of one writer, with their payloads one behind the other in `out`, which holds nothing. `each` is
    /// told where a sample's payload is. Returns how many samples it took.
    pub(super) fn take_many_of(
        &mut self,
        writer: &Gid,
        most: TakeLimit,
        out: &mut Vec<u8>,
        of: &SubscriptionInner,
        mut each: impl FnMut(MessageInfo, Range<usize>),
    ) -> usize {
        self.matched_readers.iter_mut().for_each(|slot| slot.overtaken = false);
        let received_timestamp = clock_now();
        let (mut taken, mut passed_over) = (0, 0);
        let mut last = None;
        while taken < most.samples && passed_over < REPEATS {
            // Most often the next one is where the last one was.
            let Some(index) = last.take().or_else(|| self.next_of(writer)) else {
                self.sweep();
                break;
            };
            let start = out.len();
            let mut take = |reader: &mut Reader| {
                let taken = reader.take_behind(out, most.bytes)?;
                Ok(taken.map(|(taken, len)| (taken.meta, len)))
            };
            match self.take_at(index, &mut take, of, Some(received_timestamp)) {
                Some((info, len)) => {
                    each(info, start..start + len);
                    taken += 1;
                    let slot = self.matched_readers.get(index);
                    last = slot.filter(|s| !s.over && s.reader.writer() == *writer).map(|_| index);
                }
                None => {
                    // A sample that does not count is no part of it.
                    out.truncate(start);
                    passed_over += 1;
                }
            }
        }
        let of = self.matched_readers.iter().filter(|slot| slot.reader.writer() == *writer);
        of.for_each(|slot| slot.reader.tell_taken());
        taken
    }

    /// Where the next sample of a writer is.
    fn next_of(&mut self, writer: &Gid) -> Option<usize> {
        self.skip_missing();
        self.matched_readers.iter().position(|slot| {
            !slot.overtaken && slot.reader.writer() == *writer && slot.reader.has_data()
        })
    }

    /// The publishers that have a lease, and when each was last alive, by the monotonic clock.
    pub(in crate::session) fn assertions(&self) -> Vec<(Gid, u64)> {
        let there = self.matched_readers.iter().filter(|slot| !slot.over);
        let times = there.map(|slot| (slot.reader.writer(), slot.reader.times()));
        let leased = times.filter(|(_, times)| times.lease.is_some());
        leased.filter_map(|(gid, times)| Some((gid, times.asserted?))).collect()
    }

    /// The writers of which there is something to take.
    pub(in crate::session) fn with_data(&self) -> impl Iterator<Item = Gid> {
        let some = self.matched_readers.iter().filter(|slot| slot.reader.has_data());
        some.map(|slot| slot.reader.writer())
    }

    /// Takes from a slot, unless nothing is to be had there, or nothing that counts. Without a time the sample's is
    /// that at which it was taken.
    fn take_at<T>(
        &mut self,
        index: usize,
        take: &mut impl FnMut(&mut Reader) -> Result<Option<(Meta, T)>, TakeError>,
        of: &SubscriptionInner,
        received_timestamp: Option<SystemTime>,
    ) -> Option<(MessageInfo, T)> {
        let endpoint = &of.endpoint;
        let slot = &mut self.matched_readers[index];
        let writer = slot.reader.writer();
        let (meta, taken) = match take(&mut slot.reader) {
            Ok(Some(taken)) => taken,
            // Overwritten again and again while we read: the others have their turn first.
            Ok(None) => {
                slot.overtaken = true;
                return None;
            }
            Err(error @ TakeError::TooLarge { .. }) => {
                tracing::error!(topic = endpoint.topic, %error, "a sample is lost");
                return None;
            }
            // It stands, and may be taken when there is memory again.
            Err(error @ TakeError::NoMemory { .. }) => {
                slot.overtaken = true;
                if !self.is_short() {
                    tracing::error!(topic = endpoint.topic, %error, "a sample is not taken yet");
                }
                self.short = Some(Instant::now());
                return None;
            }
            Err(error) => {
                self.discard(index, &error, endpoint);
                return None;
            }
        };
        let over = slot.over;
        let received_timestamp = received_timestamp.unwrap_or_else(clock_now);
        let lifetime = slot.lifespan.map(|lifespan| Lifetime::of(&meta, lifespan));
        let expired = lifetime.is_some_and(Lifetime::is_over);
        slot.passed(meta.sequence);
        let repeated = of.rising && slot.last.is_some_and(|last| meta.sequence <= last);
        if !repeated {
            self.note(writer, meta.sequence);
            if expired {
                self.expired += 1;
            } else {
                self.received += 1;
            }
        }
        if over {
            self.sweep();
        }
        if repeated || expired {
            return None;
        }
        let info = MessageInfo {
            publisher: writer,
            sequence: meta.sequence,
            source_timestamp: clock::from_unix_nanos(meta.source_timestamp),
            received_timestamp,
            reception: self.received,
            lifetime,
        };
        Some((info, taken))
    }

    pub(in crate::session) fn take_from(
        &mut self,
        writer: &Gid,
        of: &SubscriptionInner,
    ) -> Option<(Sample, u64)> {
        let endpoint = &of.endpoint;
        let index = self.matched_readers.iter().position(|slot| {
            slot.reader.writer() == *writer && (!slot.over || slot.reader.has_data())
        })?;
        let slot = &mut self.matched_readers[index];
        match slot.reader.take_sample() {
            Ok(sample) => {
                if let Some(sample) = &sample {
                    slot.passed(sample.meta().sequence);
                }
                // What a relay passes over, nobody asked it to.
                let relay = of.role == EndpointRole::Relay;
                let skipped = if relay { slot.reader.skipped() } else { 0 };
                let taken = sample.map(|sample| (sample, slot.lost().saturating_add(skipped)));
                self.sweep();
                taken
            }
            Err(error @ (TakeError::TooLarge { .. } | TakeError::NoMemory { .. })) => {
                tracing::error!(topic = endpoint.topic, %error, "a sample is not taken");
                None
            }
            Err(error) => {
                self.discard(index, &error, endpoint);
                None
            }
        }
    }

    /// Samples of `writer` up to this number are done with.
    pub(in crate::session) fn finish_of(&mut self, writer: &Gid, sequence: u64) {
        let of = self.matched_readers.iter_mut().filter(|slot| slot.reader.writer() == *writer);
        let mut over = false;
        for slot in of {
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
        let of = self.matched_readers.iter_mut().filter(|slot| slot.reader.writer() == *writer);
        of.for_each(|slot| slot.reader.finish_through(sequence));
        self.sweep();
    }

    /// So many samples of `writer` do not get where they are to go.
    pub(in crate::session) fn give_up_of(&mut self, writer: &Gid, samples: u64) {
        let slot = self.matched_readers.iter_mut().find(|slot| slot.reader.writer() == *writer);
        if let Some(slot) = slot {
            slot.reader.give_up(samples);
        }
    }

    /// What was taken and is not done with is to be taken once more; and all of the `history` that
    /// stands, if so.
    pub(in crate::session) fn take_back(&mut self, history: bool) {
        for MatchedReader { reader, last, .. } in &mut self.matched_readers {
            if history {
                reader.rewind()
            } else {
                reader.take_back()
            }
            // They are no repeats of those that were taken before.
            *last = None;
        }
    }

    /// How many publishes of `writer` found no room, if a reader of its oldest sample is not done with that.
    pub(in crate::session) fn refused_of(&self, writer: &Gid) -> Option<u64> {
        let of = self.matched_readers.iter().filter(|slot| slot.reader.writer() == *writer);
        of.filter_map(|slot| slot.reader.refused()).max()
    }

    /// Samples that are not done with, by writer.
    pub(in crate::session) fn undone(&self) -> HashMap<Gid, u64> {
        let mut undone = HashMap::new();
        for slot in &self.matched_readers {
            let samples = slot.reader.undone();
            if samples > 0 {
                *undone.entry(slot.reader.writer()).or_default() += samples;
            }
        }
        undone
    }

    pub(in crate::session) fn undone_bytes_of(&self, writer: &Gid) -> u64 {
        let of = self.matched_readers.iter().filter(|slot| slot.reader.writer() == *writer);
        of.map(|slot| slot.reader.undone_bytes()).fold(0, u64::saturating_add)
    }

    pub(in crate::session) fn has_from(&self, writer: &Gid) -> bool {
        self.matched_readers
            .iter()
            .any(|slot| slot.reader.writer() == *writer && slot.reader.has_data())
    }

    /// After what time a sample of `writer` may be taken, if any waits.
    pub(in crate::session) fn retry_of(&self, writer: &Gid) -> Option<Duration> {
        let wait = |until: Instant| until.saturating_duration_since(Instant::now());
        self.has_from(writer).then(|| self.short_until().map_or(Duration::ZERO, wait))
    }

    /// Samples of `writer` that newer ones replaced before they were taken, in its ring or within the depth.
    pub(in crate::session) fn lost_of(&mut self, writer: &Gid) -> u64 {
        let of = self.matched_readers.iter_mut().filter(|slot| slot.reader.writer() == *writer);
        of.map(|slot| {
            // Finds what a take would find lost. The take says what is wrong with the memory.
            let _ = slot.reader.peek();
            slot.reader.lost().saturating_add(slot.reader.skipped())
        })
        .sum()
    }

    /// Passes over all samples of `writer` but the newest `depth`. They count as those beyond the subscription's depth.
    pub(in crate::session) fn skip_of(&mut self, writer: &Gid, depth: u64) {
        let of = self.matched_readers.iter_mut().filter(|slot| slot.reader.writer() == *writer);
        of.for_each(|slot| slot.reader.skip_to_depth(depth));
    }

    /// Samples of `writer` that were lost before they came to its ring here. Samples missing before
    /// the `first` in that ring are seen by its number, where the subscription knows an earlier one.
    pub(in crate::session) fn lost_elsewhere(&mut self, writer: &Gid, samples: u64, first: bool) {
        let mut of = self.matched_readers.iter().filter(|slot| slot.reader.writer() == *writer);
        if of.any(|slot| !(slot.over || first && slot.resumed)) {
            self.lost = self.lost.saturating_add(samples);
        }
    }

    /// The slot whose next sample is the oldest, of those that are not faster than we are. What a
    /// writer wrote before it granted anew comes before what it wrote since, whatever its clock
    /// says: taken the other way round it would count as repeated.
    fn oldest(&mut self) -> Option<usize> {
        let index = self.oldest_by_time()?;
        let writer = self.matched_readers[index].reader.writer();
        let earlier = self.matched_readers[..index].iter().position(|slot| {
            slot.over && !slot.overtaken && slot.reader.writer() == writer && slot.reader.has_data()
        });
        Some(earlier.unwrap_or(index))
    }

    fn oldest_by_time(&mut self) -> Option<usize> {
        if let [slot] = self.matched_readers.as_slice() {
            // Taking finds out whether it has anything, which most often it has.
            return (!slot.overtaken).then_some(0);
        }
        let mut oldest = None;
        for (index, slot) in
            self.matched_readers.iter_mut().enumerate().filter(|(_, s)| !s.overtaken)
        {
            // A writer whose memory is corrupt is chosen, so that taking finds out.
            let stamp = match slot.reader.peek() {
                Ok(Some(meta)) => meta.source_timestamp,
                Ok(None) => continue,
                Err(_) => i64::MIN,
            };
            if oldest.is_none_or(|(least, _)| stamp < least) {
                oldest = Some((stamp, index));
            }
        }
        oldest.map(|(_, index)| index)
    }

    /// A subscription's KEEP_LAST(depth) counts over all publishers together.
    fn skip_to_depth(&mut self, depth: u64) {
        let mut unread: u64 = self.matched_readers.iter().map(|s| s.reader.unread()).sum();
        while unread > depth {
            let Some(index) = self.oldest() else { return };
            if !self.matched_readers[index].reader.skip() {
                return;
            }
            unread -= 1;
        }
    }

    fn discard(&mut self, index: usize, error: &TakeError, endpoint: &Endpoint) {
        tracing::error!(topic = endpoint.topic, %error, "a publisher's memory is not usable");
        let slot = self.matched_readers.remove(index);
        self.retire(&slot);
        if !slot.over {
            self.discarded.push(slot.reader.writer());
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use axon_shm::{
        PublishError,
        internal::{Peer, ReaderInfo, ReaderOptions, RingOptions, SessionSegment, Writer},
    };

    use super::*;
    use crate::{graph::EndpointKind, ids::SessionId, qos::Qos, session::subscription::Numbers};

    /// A subscription's reader of a publisher of the same session, which is made for it.
    fn reading(session: &Arc<SessionSegment>, writer: Gid, reader: Gid) -> (Writer, Reader) {
        let (qos, peer) = (Qos::default(), Peer::Local(session.clone()));
        let options = RingOptions { gid: writer, qos, budget: 0, max_message: 10, expected: 0 };
        let publisher = Writer::create(session.clone(), options).unwrap();
        let lane = session.allocate_lane().unwrap();
        let at = lane.location();
        let info = ReaderInfo { gid: reader, lane: at, qos, peer: peer.clone(), stands_for: None };
        let (grant, ring) = (publisher.attach(info).unwrap(), publisher.location());
        let options =
            ReaderOptions { reader, writer, peer, ring, lane, grant, qos, max_message: 10 };
        (publisher, Reader::map(options).unwrap())
    }

    fn subscription(gid: Gid) -> SubscriptionInner {
        let endpoint = Endpoint::example(gid, EndpointKind::Subscription);
        SubscriptionInner::new(endpoint, EndpointRole::Application, Vec::new())
    }

    #[test]
    fn nobody_is_woken_at_once_for_a_sample_that_there_is_no_memory_for() {
        let session = SessionSegment::create(SessionId::random()).unwrap();
        let [writer, gid] = [1, 2].map(|number| Gid::new(session.id(), number));
        let (publisher, reader) = reading(&session, writer, gid);
        let mut matched_readers = MatchedReaders::default();
        matched_readers.add(reader, None, Numbers::None);
        publisher.publish_next(0, b"sample").unwrap();
        assert!(matched_readers.has_data());
        let inner = subscription(gid);
        let none = |_: &mut Reader| Err::<Option<(Meta, ())>, _>(TakeError::NoMemory { len: 6 });
        assert!(matched_readers.take(none, &inner).is_none() && !matched_readers.has_data());
        // A caller that asks nevertheless gets it, if it can be had.
        let mut out = Vec::new();
        let take = |reader: &mut Reader| Ok(reader.take(&mut out)?.map(|taken| (taken.meta, ())));
        assert!(matched_readers.take(take, &inner).is_some());
        assert_eq!(out, b"sample");
    }

    #[test]
    fn unannounced_samples_of_an_ended_writer_are_read() {
        let session = SessionSegment::create(SessionId::random()).unwrap();
        session.follow();
        let [gid, writers @ ..] =
            std::array::from_fn::<_, 20, _>(|number| Gid::new(session.id(), number as u32));
        let mut matched_readers = MatchedReaders::default();
        let publishers = writers.map(|writer| {
            let (publisher, mut reader) = reading(&session, writer, gid);
            reader.follow(gid);
            matched_readers.add(reader, None, Numbers::None);
            publisher
        });
        let active = || {
            let mut found = Vec::new();
            session.take_active(&mut found);
            found
        };
        assert_eq!(active().len(), writers.len());
        // As one that died before it noted the sample: no relay reads here, so none is noted.
        publishers[10].publish_next(0, b"sample").unwrap();
        assert!(!active().contains(&(gid, writers[10])));
        assert!(matched_readers.end(&writers[10]));
        assert!(active().contains(&(gid, writers[10])) && matched_readers.has_from(&writers[10]));
    }

    #[test]
    fn numbers_from_other_hosts_leave_losses_that_can_be_counted() {
        const FURTHEST: u64 = 1 + (1 << 32);
        let session = SessionSegment::create(SessionId::random()).unwrap();
        let [gid, writers @ ..] = [1, 2, 3].map(|number| Gid::new(session.id(), number));
        let (mut matched_readers, inner, mut out) =
            (MatchedReaders::default(), subscription(gid), Vec::new());
        let mut publishers = Vec::new();
        for writer in writers {
            let (publisher, reader) = reading(&session, writer, gid);
            matched_readers.add(reader, None, Numbers::All);
            let say = |sequence| publisher.publish(Meta::at_nanos(sequence, 0), b"sample");
            say(1).unwrap();
            // So many cannot have been lost.
            let refused = PublishError::Sequence { sequence: u64::MAX, last: 1 };
            assert_eq!(say(u64::MAX).unwrap_err(), refused);
            say(FURTHEST).unwrap();
            publishers.push(publisher);
        }
        let mut numbers = Vec::new();
        let mut take = |matched_readers: &mut MatchedReaders| {
            let take = |reader: &mut Reader| Ok(reader.take(&mut out)?.map(|t| (t.meta, ())));
            matched_readers.take(take, &inner)
        };
        while let Some((info, ())) = take(&mut matched_readers) {
            numbers.push(info.sequence);
        }
        numbers.sort_unstable();
        let lost = 2 * (FURTHEST - 2);
        assert_eq!(numbers, [1, 1, FURTHEST, FURTHEST]);
        assert_eq!((matched_readers.new_losses(), matched_readers.losses()), (lost, lost));
        assert!(writers.iter().all(|writer| matched_readers.end(writer)));
        assert_eq!((matched_readers.new_losses(), matched_readers.losses()), (0, lost));
    }
}
