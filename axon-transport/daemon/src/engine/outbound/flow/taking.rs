//! Moves the samples of one flow from their rings into its queue.

use std::{collections::VecDeque, sync::Arc, time::Duration};

use axon_envelope::Kind;
use axon_shm::{
    ids::Gid,
    qos::{Durability, Qos},
};
use axon_transport::{
    access::Overflow,
    internal::session::{
        TakeLimit,
        merge::{Merge, MergedSample},
    },
};

use crate::engine::{
    counters::Counters,
    limits::{Exceeded, RouteLimit},
    outbound::{
        queue::{Offered, Queue},
        served::ResponseNumbers,
        source::Source,
    },
    rings::RingSample,
};

/// Maximum number of samples, and of bytes, that one turn moves from the rings.
const FILL: (usize, usize) = (1024, 256 << 10);
/// Bytes of short samples that share one piece of memory. The piece stays as long as one of them is not
/// acknowledged.
const SHARED: usize = 32 << 10;
/// Maximum number of takes in one turn that find only samples which were sent before.
const REPEATS: u32 = 16;
/// Maximum number of takes in one turn of samples that a limit drops.
const DROPS: usize = 64;
/// Number of waiting bytes at which a KEEP_ALL flow leaves further samples in the ring, which keeps them.
const AHEAD: usize = 1 << 20;
/// Number of bytes that a KEEP_LAST flow which is behind moves. The samples that it leaves in the ring are replaced
/// there without a copy.
const BEHIND: usize = 64 << 10;
/// Time after which a relay that may lose nothing tries again when it waits for memory.
const HELD_UP: Duration = Duration::from_millis(1);
/// Turns that move a burst while QUIC takes nothing. The bound keeps a busy publisher from delaying the
/// others.
const BURST: usize = 4;

/// A flow's samples that are still in the rings.
pub(super) struct FlowRings {
    /// The publisher, or the client of a service.
    of: Gid,
    kind: Kind,
    /// The numbers for responses if responses are acknowledged.
    responses: Option<ResponseNumbers>,
    /// The samples of all sources, merged in order.
    merge: Merge<RingSample>,
    /// Samples that were taken and are not in the queue.
    taken: VecDeque<RingSample>,
    /// True if the queue had no room for the first taken sample.
    held: bool,
    /// True if the rings may hold more samples than the last turn moved.
    more: bool,
    /// Time after which to check the rings again, if the last turn moved no sample.
    retry: Option<Duration>,
    /// Samples that each relay is known to have lost.
    known_lost: Vec<(Gid, u64)>,
    limit: RouteLimit,
    /// The limit that the last turn reached. Samples that newer ones have replaced in the ring since count as
    /// lost by this limit.
    exceeded: Option<Exceeded>,
    /// The newest sample that a limit dropped after it was taken, since the last report to the sources.
    dropped: Option<u64>,
    /// Number of such samples that were not reported to the publisher.
    given_up: u64,
}

impl FlowRings {
    /// Creates the rings of a flow without sources.
    pub(super) fn new(
        of: Gid,
        kind: Kind,
        responses: Option<ResponseNumbers>,
        limit: RouteLimit,
    ) -> Self {
        Self {
            of,
            kind,
            responses,
            merge: Merge::default(),
            taken: VecDeque::new(),
            held: false,
            more: false,
            retry: None,
            known_lost: Vec::new(),
            limit,
            exceeded: None,
            dropped: None,
            given_up: 0,
        }
    }

    /// Handles a change of the limits: waiting samples may pass now.
    pub(super) fn handle_limits(&mut self) {
        self.more |= self.exceeded.is_some();
    }

    /// Returns whether samples wait and a limit lets none pass.
    pub(super) fn is_limited(&self) -> bool {
        self.exceeded.is_some() && self.has_more()
    }

    /// Takes the number of the newest sample that a limit dropped.
    pub(super) fn take_dropped(&mut self) -> Option<u64> {
        self.dropped.take()
    }

    /// Takes the number of samples that a limit dropped and that were not reported to the publisher.
    pub(super) fn take_given_up(&mut self) -> u64 {
        std::mem::take(&mut self.given_up)
    }

    /// Replaces the sources. The peer has the samples up to number `seen`.
    pub(super) fn set_sources(&mut self, sources: &[Source], seen: Option<u64>) {
        self.merge.set(sources.iter().map(Source::gid));
        self.merge.pass(seen.unwrap_or(0));
        self.more = true;
    }

    /// Records that samples wait in a ring.
    pub(super) fn handle_samples(&mut self) {
        self.more = true;
    }

    /// Returns whether there may be samples to move.
    pub(super) fn has_more(&self) -> bool {
        self.more || !self.taken.is_empty()
    }

    /// Returns whether a sample found no room in the queue.
    pub(super) fn is_held(&self) -> bool {
        self.held
    }

    /// Takes the time after which to check the rings again, if the last turn moved nothing although samples
    /// wait.
    pub(super) fn take_retry(&mut self) -> Option<Duration> {
        self.retry.take()
    }

    /// Returns whether the rings may hold samples that the last turn did not reach.
    pub(super) fn goes_on(&self) -> bool {
        self.more && !self.held
    }

    /// Returns whether every taken sample is in the queue.
    pub(super) fn is_idle(&self) -> bool {
        self.taken.is_empty() && !self.merge.holds_any()
    }

    /// Returns the number of taken samples that are not in the queue.
    pub(super) fn waiting(&self) -> usize {
        self.taken.len() + self.merge.held()
    }

    /// Forgets the taken samples that are not in the queue. Returns their number.
    pub(super) fn end(&mut self) -> usize {
        self.held = false;
        std::mem::take(&mut self.taken).len() + self.merge.held()
    }

    /// Moves samples from the rings into the queue. Returns how many were queued.
    pub(super) fn fill(
        &mut self,
        sources: &[Source],
        queue: &mut Queue,
        topic: &Arc<str>,
        counters: &Counters,
        now: Duration,
    ) -> u32 {
        if !self.has_more() {
            return 0;
        }
        if !queue.wants_more(now) {
            // The flow is checked again when its waiting samples are sent.
            self.held = false;
            return 0;
        }
        let first = sources.iter().find(|source| source.reads(&self.of));
        queue.set_qos(&first.map_or_else(Qos::keep_all, Source::qos));
        let most_bytes = self.leave_stale(sources, queue, now);
        let is_behind = queue.is_behind(now);
        // The queue may drop a sample for a newer one. The dropped sample must not keep shared memory in use.
        let together = match queue.depth() {
            Some(depth) if is_behind || !queue.keeps_bursts() => depth.min(FILL.0),
            _ => FILL.0,
        };
        let most_samples = if is_behind { together } else { FILL.0 };
        let (mut samples, mut bytes, mut dropped, mut repeats) = (0, 0, 0, 0);
        (self.held, self.retry) = (false, None);
        while samples < most_samples && bytes < most_bytes {
            let has_enough = match queue.keeps_all() {
                true => queue.waiting_bytes() >= AHEAD,
                false => !is_behind && !queue.wants_more(now),
            };
            if has_enough {
                break;
            }
            let is_limited = self.exceeded.is_some() || !self.limit.is_none();
            if is_limited && !self.pass_limit(sources, queue, topic, counters, now) {
                break;
            }
            let Some(sample) = self.taken.pop_front() else {
                let left = together
                    .min(most_samples - samples)
                    .min(self.limit.passes(&self.of, now).max(1));
                let most = limit(queue.room(), left, most_bytes - bytes);
                if !self.take(sources, most, now) {
                    let behind = self.merge.is_behind().then_some(Duration::ZERO);
                    let held_up = self.merge.is_held_up().then_some(HELD_UP);
                    let retries = sources.iter().filter_map(|source| source.retry_of(&self.of));
                    self.retry = retries.chain(behind).chain(held_up).min();
                    self.more = self.retry.is_some();
                    if !self.more {
                        queue.handle_empty_ring(now);
                    }
                    break;
                }
                repeats += u32::from(self.taken.is_empty());
                if repeats > REPEATS {
                    break;
                }
                continue;
            };
            let length = sample.payload.len();
            bytes += length;
            match queue.offer(sample, now) {
                Offered::Queued { dropped: older } => {
                    self.limit.pass(&self.of, length, now);
                    samples += 1;
                    dropped += older;
                }
                Offered::Full(sample) => {
                    self.taken.push_front(sample);
                    self.held = true;
                    break;
                }
            }
        }
        counters.lost(topic, "queue", dropped);
        self.count_overwritten(sources, topic, counters);
        samples as u32
    }

    /// Moves a burst into the queue while QUIC takes nothing. Returns how many samples were queued.
    pub(super) fn take_burst(
        &mut self,
        sources: &[Source],
        queue: &mut Queue,
        topic: &Arc<str>,
        counters: &Counters,
        now: Duration,
    ) -> u32 {
        let mut all = 0;
        for _ in 0..BURST {
            let queued = self.fill(sources, queue, topic, counters, now);
            all += queued;
            if queued == 0 || !self.more {
                break;
            }
        }
        all
    }

    /// Skips the samples in the rings that the queue would drop for newer ones. Returns the number of bytes
    /// to move then.
    fn leave_stale(&self, sources: &[Source], queue: &Queue, now: Duration) -> usize {
        let Some(depth) = queue.depth().filter(|_| queue.is_behind(now)) else { return FILL.1 };
        for source in sources.iter().filter(|source| source.reads(&self.of)) {
            source.skip_of(&self.of, depth);
        }
        // BEST_EFFORT samples are judged by their age, so all of them are examined: at most the depth.
        if queue.keeps_bursts() { BEHIND } else { usize::MAX }
    }

    /// Counts the samples that newer ones replaced in the ring. Only the losses of the relay that asks for
    /// most count, because it loses the fewest: a sample that it has is sent. The losses of the other relays
    /// are recorded, so that they do not count when another relay takes its place.
    pub(super) fn count_overwritten(
        &mut self,
        sources: &[Source],
        topic: &Arc<str>,
        counters: &Counters,
    ) {
        self.known_lost.retain(|(relay, _)| sources.iter().any(|source| source.gid() == *relay));
        let mut first = None;
        for source in sources.iter().filter(|source| source.reads(&self.of)) {
            let (relay, lost) = (source.gid(), source.lost_of(&self.of));
            let known = match self.known_lost.iter_mut().find(|(known, _)| *known == relay) {
                Some((_, known)) => std::mem::replace(known, lost),
                None => {
                    self.known_lost.push((relay, lost));
                    // Samples that a relay with history skips at its start are no loss.
                    let history = source.qos().durability == Durability::TransientLocal;
                    if history { lost } else { 0 }
                }
            };
            first = first.or(Some(lost.saturating_sub(known)));
        }
        let Some(lost) = first else { return };
        if let Some(limit) = &self.exceeded {
            limit.dropped(lost);
        }
        let cause = self.exceeded.as_ref().map_or("queue", Exceeded::cause);
        counters.lost(topic, cause, lost);
    }

    /// Returns whether the next sample may pass the limits. If not, the sample waits or samples are dropped,
    /// depending on the limit.
    fn pass_limit(
        &mut self,
        sources: &[Source],
        queue: &Queue,
        topic: &Arc<str>,
        counters: &Counters,
        now: Duration,
    ) -> bool {
        let may_wait = |over| over != Overflow::DropNewest;
        let exceeded = self.limit.exceeded_by(&self.of, may_wait, now);
        if self.exceeded.is_some() || exceeded.is_some() {
            // Losses so far had another cause, or the limit that the last turn reached.
            self.count_overwritten(sources, topic, counters);
        }
        // A single ring keeps the newest samples and replaces the others without a copy. With a KEEP_ALL
        // queue the publisher would wait instead, and several rings would each keep other samples.
        let in_ring = !queue.keeps_all() && sources.len() == 1;
        let (limit, most, waits) = match exceeded {
            None => match self.exceeded.take_if(|before| before.overflow() == Overflow::DropOldest)
            {
                Some(before) => (before, self.limit.passes(&self.of, now).max(1), false),
                None => {
                    self.exceeded = None;
                    return true;
                }
            },
            Some(exceeded) => {
                let most = match exceeded.overflow() {
                    Overflow::DropOldest => 1,
                    Overflow::DropNewest => 0,
                    Overflow::Hold => usize::MAX,
                };
                (exceeded, most, true)
            }
        };
        let is_whole = match limit.overflow() {
            Overflow::Hold => true,
            Overflow::DropOldest if in_ring && waits => true,
            Overflow::DropOldest if in_ring => {
                self.leave_oldest(sources, &limit, most, topic, counters);
                true
            }
            Overflow::DropOldest | Overflow::DropNewest => {
                self.drop_for(&limit, most, sources, topic, counters, now)
            }
        };
        if !is_whole {
            // There are newer samples: they are examined before any sample passes.
            (self.retry, self.more, self.exceeded) = (Some(Duration::ZERO), true, Some(limit));
            return false;
        }
        if !waits {
            return true;
        }
        let may_pass_later = limit.overflow() != Overflow::DropNewest;
        if may_pass_later {
            self.more |= in_ring || limit.overflow() == Overflow::Hold;
            self.retry = self.has_more().then_some(limit.wait);
        }
        self.exceeded = Some(limit);
        false
    }

    /// Skips the samples that waited for a limit, except the newest `most`.
    fn leave_oldest(
        &mut self,
        sources: &[Source],
        limit: &Exceeded,
        most: usize,
        topic: &Arc<str>,
        counters: &Counters,
    ) {
        let own = sources.iter().filter(|source| source.reads(&self.of));
        let mut newer = 0;
        for source in own {
            source.skip_of(&self.of, most);
            newer += source.with_data_of(&self.of).len();
        }
        // Taken samples are older than those in the ring.
        let keep = if newer > 0 { 0 } else { most };
        self.drop_taken(limit, keep, topic, counters);
        self.exceeded = Some(limit.clone());
        self.count_overwritten(sources, topic, counters);
        self.exceeded = None;
    }

    /// Drops the taken samples except the newest `most`.
    fn drop_taken(&mut self, limit: &Exceeded, most: usize, topic: &Arc<str>, counters: &Counters) {
        let mut dropped = 0;
        while self.taken.len() > most
            && let Some(sample) = self.taken.pop_front()
        {
            dropped += 1;
            self.dropped = self.dropped.max(Some(sample.info.sequence));
        }
        self.given_up += dropped;
        limit.dropped(dropped);
        counters.lost(topic, limit.cause(), dropped);
    }

    /// Takes the samples in the rings and drops all but the newest `most`. Returns whether it reached the
    /// end. The number of rounds is bounded, so that a busy publisher does not delay the others.
    fn drop_for(
        &mut self,
        limit: &Exceeded,
        most: usize,
        sources: &[Source],
        topic: &Arc<str>,
        counters: &Counters,
        now: Duration,
    ) -> bool {
        for _ in 0..DROPS {
            let some = TakeLimit { samples: FILL.0, bytes: SHARED };
            let there = self.take(sources, some, now);
            self.drop_taken(limit, most, topic, counters);
            if !there {
                self.more = false;
                return true;
            }
        }
        false
    }

    /// Takes the next samples, up to `most`. Returns whether there were any, including samples that were sent
    /// before.
    fn take(&mut self, sources: &[Source], most: TakeLimit, now: Duration) -> bool {
        let Self { of, kind, responses, merge, taken, .. } = self;
        if *kind == Kind::Response {
            let mut next = sources.iter().find_map(|source| source.take_of(of, now));
            if let (Some(response), Some(numbers)) = (&mut next, responses) {
                response.info.sequence = numbers.next();
            }
            let there = next.is_some();
            taken.extend(next);
            return there;
        }
        if let [source] = sources
            && merge.is_of_one()
        {
            let mut each = |sample: RingSample| {
                if merge.give(sample.info.sequence) {
                    taken.push_back(sample);
                }
            };
            return source.take_many(of, most, now, &mut each) > 0;
        }
        let of_reader = |reader: &Gid| sources.iter().find(|source| source.gid() == *reader);
        let take = |reader: &Gid| {
            let content = of_reader(reader)?.take_of(of, now)?;
            Some(MergedSample { number: content.info.sequence, lost: 0, content })
        };
        let waits = |reader: &Gid| of_reader(reader).is_some_and(|source| source.is_held_up(of));
        let next = merge.next(take, waits);
        let there = next.is_some();
        taken.extend(next.map(|next| next.content));
        there
    }
}

/// Returns the limit for one take. The queue has `room` bytes of memory left and is to get at most `samples`
/// and `bytes`. All taken samples fit, unless it is a single one.
fn limit(room: usize, samples: usize, bytes: usize) -> TakeLimit {
    let half = room / 2;
    TakeLimit {
        samples: samples.min(half / size_of::<RingSample>()).max(1),
        bytes: bytes.min(half).min(SHARED),
    }
}
