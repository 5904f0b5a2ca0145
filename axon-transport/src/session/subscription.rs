//! A reader of every matched publisher of a topic, merged into one stream.

use std::{
    collections::{BTreeMap, HashMap},
    fmt,
    sync::{Arc, Mutex, MutexGuard, PoisonError},
    time::{Duration, Instant},
};

use super::{
    OnNew, Session, SessionError,
    callback::Callback,
    clock,
    events::{Changes, EndpointEvents, Event, Source},
    message::{EndpointRole, Message, Pair},
    state::{Outgoing, Shared},
};
use crate::{
    events::EventKind,
    graph::{Endpoint, EndpointKind},
    ids::Gid,
    qos::{History, Qos},
    shm::{Grant, Lane, Location, Meta, Reader, Sample, ShmError, TakeError},
    wait::Look,
};

/// Publishers whose last sequence number is remembered after they are gone.
const REMEMBERED: usize = 4096;
/// Samples that one take passes over because they were taken before.
const REPEATS: usize = 64;
/// How long nobody is woken for a sample that there was no memory to take.
const SHORT: Duration = Duration::from_secs(1);

/// Receives the samples of a topic. Thread-safe.
pub struct Subscription {
    pub(super) inner: Arc<SubscriptionInner>,
    pub(super) session: Session,
}

/// What is known of a sample besides its bytes. Times are nanoseconds since the Unix epoch.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct MessageInfo {
    /// Who published it.
    pub publisher: Gid,
    /// The publication's number, from 1.
    pub sequence: u64,
    /// When it was published, by the publisher's clock.
    pub source_timestamp: i64,
    /// When it was taken, by this host's clock.
    pub received_timestamp: i64,
}

impl Subscription {
    /// Its GID.
    pub fn gid(&self) -> Gid {
        self.inner.endpoint.gid
    }

    /// Itself, as others see it.
    pub fn endpoint(&self) -> &Endpoint {
        &self.inner.endpoint
    }

    /// The oldest sample by source timestamp among all publishers, into `out`, which it replaces.
    /// `None` when there is none.
    ///
    /// Clocks are taken at their word. Where KEEP_LAST's depth passes samples over, they are those
    /// with the oldest timestamps: a publisher whose clock is ahead has the others' passed over.
    pub fn take(&self, out: &mut Vec<u8>) -> Option<MessageInfo> {
        let take = |reader: &mut Reader| Ok(reader.take(out)?.map(|taken| (taken.meta, ())));
        take_from(&self.inner, &self.session, take).map(|(info, ())| info)
    }

    /// As [`take`](Self::take), but a sample of more than 4 KiB stays in the publisher's memory for
    /// as long as it is kept, unless `AXON_SHM_COPY` asks for copies.
    pub fn take_sample(&self) -> Option<(MessageInfo, Sample)> {
        let copy = self.session.shared().config.shm_copy;
        take_from(&self.inner, &self.session, |reader| {
            let sample = if copy { reader.take_copy() } else { reader.take_sample() };
            Ok(sample?.map(|sample| (sample.meta(), sample)))
        })
    }

    /// As [`take`](Self::take), after waiting for a sample for at most `timeout`.
    pub fn recv(&self, out: &mut Vec<u8>, timeout: Option<Duration>) -> Option<MessageInfo> {
        recv_from(&self.inner, &self.session, timeout, || self.take(out))
    }

    /// Whether there is something to take.
    pub fn has_data(&self) -> bool {
        !self.session.is_forked() && self.inner.has_data()
    }

    /// The publishers it receives from.
    pub fn matched(&self) -> Vec<Gid> {
        if self.session.is_forked() {
            return Vec::new();
        }
        let slots = self.inner.lock();
        slots.slots.iter().filter(|s| !s.over).map(|s| s.reader.writer()).collect()
    }

    /// Waits until it receives from at least `count` publishers; whether it does.
    pub fn wait_matched(&self, count: usize, timeout: Duration) -> bool {
        self.session.wait_changed(timeout, || self.matched().len() >= count)
    }

    /// Samples that were overwritten before they were taken.
    pub fn lost(&self) -> u64 {
        if self.session.is_forked() {
            return 0;
        }
        self.inner.lock().losses()
    }

    /// Samples that were older than their publisher's lifespan when they would have been taken.
    pub fn expired(&self) -> u64 {
        if self.session.is_forked() { 0 } else { self.inner.lock().expired }
    }

    /// Has `callback` told of new samples from now on, in place of the one before, which is not
    /// called any more once this returns. Those that are there to be taken it is told at once, on
    /// this thread; others as they come, on the control thread. It must neither block nor panic, nor
    /// hold the session.
    ///
    /// # Errors
    /// In a forked child, or when an event loop of the program's listens already
    /// ([`SessionSegment::external_leader`](crate::shm::SessionSegment::external_leader)).
    pub fn set_on_new_sample(&self, callback: Option<OnNew>) -> Result<(), SessionError> {
        if self.session.is_forked() {
            return Err(ShmError::Forked.into());
        }
        Ok(self.inner.set_on_new_sample(callback, self.session.shared())?)
    }

    /// One of its events; `None` where `kind` is a publisher's.
    pub fn event(&self, kind: EventKind) -> Option<Event> {
        Event::new(Source::Subscription(self.inner.clone()), kind, self.session.clone())
    }

    /// Samples taken.
    pub fn received(&self) -> u64 {
        if self.session.is_forked() { 0 } else { self.inner.lock().received }
    }

    /// For a relay: the next sample of one publisher, and how many of that publisher's this
    /// subscription has lost by then.
    pub(crate) fn take_from(&self, writer: &Gid) -> Option<(Sample, u64)> {
        if self.session.is_forked() {
            return None;
        }
        self.inner.lock().take_from(writer, &self.inner)
    }

    /// Whether there is something to take of this publisher.
    pub(crate) fn has_from(&self, writer: &Gid) -> bool {
        !self.session.is_forked() && self.inner.lock().has_from(writer)
    }

    /// For a relay: the remote subscriptions that it stands for from now on.
    pub fn set_stands_for(&self, gids: Vec<Gid>) {
        if self.session.is_forked() {
            return;
        }
        *lock(&self.inner.stands_for) = gids;
        self.session.renew(self.gid());
    }
}

impl fmt::Debug for Subscription {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("Subscription").field(self.endpoint()).finish()
    }
}

impl Drop for Subscription {
    fn drop(&mut self) {
        if !self.session.is_forked() {
            // Only listening may fail, not ceasing to.
            let _ = self.inner.set_on_new_sample(None, self.session.shared());
        }
        self.session.forget_endpoint(&self.gid());
    }
}

/// The oldest of what one may take.
pub(super) fn take_from<T>(
    inner: &SubscriptionInner,
    session: &Session,
    take: impl FnMut(&mut Reader) -> Result<Option<(Meta, T)>, TakeError>,
) -> Option<(MessageInfo, T)> {
    // A thread of the parent may have held the lock when this process was forked.
    if session.is_forked() {
        tracing::error!("an endpoint of the parent process is used after fork");
        return None;
    }
    let mut slots = inner.lock();
    let taken = slots.take(take, inner);
    let gone = std::mem::take(&mut slots.discarded);
    let lost = slots.new_losses();
    drop(slots);
    inner.events.lost(lost);
    for writer in gone {
        let detach = Message::Detach(Pair { reader: inner.endpoint.gid, writer });
        session.shared().tell(Outgoing::Message(Box::new(detach)));
    }
    taken
}

/// What `take` finds, after waiting for at most `timeout`.
pub(super) fn recv_from<T>(
    inner: &Arc<SubscriptionInner>,
    session: &Session,
    timeout: Option<Duration>,
    mut take: impl FnMut() -> Option<T>,
) -> Option<T> {
    let deadline = timeout.and_then(|timeout| Instant::now().checked_add(timeout));
    loop {
        // Nothing comes to a forked child, however long it waits.
        if session.is_forked() {
            return None;
        }
        if let Some(taken) = take() {
            return Some(taken);
        }
        let left = deadline.map(|deadline| deadline.saturating_duration_since(Instant::now()));
        let look = Arc::clone(inner);
        if left.is_some_and(|left| left.is_zero()) || !session.segment().wait_for(look, left) {
            return None;
        }
    }
}

/// The reading side of a subscription, client or server, which the session's control thread shares
/// with the handle.
pub(super) struct SubscriptionInner {
    pub(super) endpoint: Endpoint,
    /// What its readers request: what the endpoint does, but for a client's or a server's, which
    /// lose nothing.
    pub(super) qos: Qos,
    /// Whether a writer's numbers rise: the responses of a server come in whatever order it likes.
    rising: bool,
    pub(super) role: EndpointRole,
    pub(super) events: EndpointEvents,
    stands_for: Mutex<Vec<Gid>>,
    slots: Mutex<Slots>,
    arrived: Callback,
    /// Whether the control thread listens for it.
    listens: Mutex<bool>,
}

#[derive(Default)]
pub(super) struct Slots {
    slots: Vec<Slot>,
    /// Lanes given to writers that have not granted yet.
    pending: HashMap<Gid, Lane>,
    /// The last sequence number taken of each publisher, also of those that are gone: one that
    /// comes back, as a remote one does with its link, must not be heard twice.
    last: HashMap<Gid, u64>,
    received: u64,
    expired: u64,
    lost: u64,
    /// Losses that were reported.
    lost_before: u64,
    /// Samples that came from writers that are gone, and all that somebody was told of.
    arrived: u64,
    arrived_before: u64,
    /// When there was no memory to take a sample last.
    short: Option<Instant>,
    /// Writers whose memory was not usable, of which the others have to be told.
    discarded: Vec<Gid>,
}

/// What a grant calls for.
pub(super) enum Accept {
    /// Nothing: it repeats the one that stands, or nobody asked.
    Stands,
    /// Map the ring with this lane.
    Map(Lane),
    /// Ask again, with a fresh lane.
    AskAgain,
}

struct Slot {
    reader: Reader,
    /// When it was mapped: what was published before is no news. By the monotonic clock.
    since: u64,
    /// The age at which its samples are not delivered any more.
    lifespan: Option<i64>,
    /// The writer is gone: take what it left, then unmap.
    over: bool,
    /// Found nothing in the take that is under way, since the writer was faster.
    overtaken: bool,
}

impl SubscriptionInner {
    pub(super) fn new(endpoint: Endpoint, role: EndpointRole, stands_for: Vec<Gid>) -> Self {
        let (stands_for, slots) = (Mutex::new(stands_for), Mutex::default());
        let events = EndpointEvents::of_subscription(&endpoint.qos);
        let (arrived, listens) = (Callback::default(), Mutex::new(false));
        let service = matches!(endpoint.kind, EndpointKind::Server | EndpointKind::Client);
        let qos = if service { Qos::keep_all() } else { endpoint.qos };
        let rising = endpoint.kind != EndpointKind::Client;
        Self { endpoint, qos, rising, role, events, stands_for, slots, arrived, listens }
    }

    pub(super) fn has_data(&self) -> bool {
        self.lock().has_data()
    }

    pub(super) fn set_on_new_sample(
        &self,
        callback: Option<OnNew>,
        shared: &Shared,
    ) -> Result<(), ShmError> {
        let mut listens = lock(&self.listens);
        let there = match (*listens, callback.is_some()) {
            (false, true) => {
                shared.listen()?;
                true
            }
            (listens, there) => {
                if listens && !there {
                    shared.listen_no_more();
                }
                there
            }
        };
        *listens = there;
        drop(listens);
        let untold = {
            let mut slots = self.lock();
            slots.new_arrivals();
            slots.unread(&self.qos)
        };
        self.arrived.replace(callback, Some(untold));
        Ok(())
    }

    /// Tells of samples that came, where somebody wants to hear of them.
    pub(super) fn tell_arrived(&self) {
        if self.arrived.is_set() {
            let new = self.lock().new_arrivals();
            self.arrived.add(new);
        }
    }

    /// What became of its matches since it was asked last.
    pub(super) fn rematch(&self) -> Changes {
        let leases: BTreeMap<Gid, Option<u64>> = {
            let slots = self.lock();
            let active = slots.slots.iter().filter(|slot| !slot.over);
            active.map(|slot| (slot.reader.writer(), slot.reader.times().lease)).collect()
        };
        self.events.writers(&leases, clock::monotonic())
    }

    /// Counts the deadlines that passed and looks who is alive. When to look again, and whether
    /// something happened.
    pub(super) fn look_at_time(&self, now: u64) -> (Option<u64>, bool) {
        let times: Vec<_> = {
            let slots = self.lock();
            let active = slots.slots.iter().filter(|slot| !slot.over);
            let times = active.map(|slot| {
                let mut times = slot.reader.times();
                times.sampled = times.sampled.filter(|sampled| *sampled >= slot.since);
                (slot.reader.writer(), times)
            });
            times.collect()
        };
        self.events.requested(&self.qos, &times, now)
    }

    /// The same for who must not wait for a thread that takes.
    pub(super) fn may_have_losses(&self) -> bool {
        let Ok(mut slots) = self.slots.try_lock() else { return true };
        slots.slots.iter_mut().for_each(|slot| drop(slot.reader.peek()));
        slots.losses() != slots.lost_before
    }

    /// Counts what would be found lost by taking now.
    pub(super) fn look_for_losses(&self) {
        let mut slots = self.lock();
        for slot in &mut slots.slots {
            // What is wrong with its memory, the next take says.
            let _ = slot.reader.peek();
        }
        let lost = slots.new_losses();
        drop(slots);
        self.events.lost(lost);
    }

    pub(super) fn lock(&self) -> MutexGuard<'_, Slots> {
        lock(&self.slots)
    }

    pub(super) fn stands_for(&self) -> Vec<Gid> {
        lock(&self.stands_for).clone()
    }
}

impl Look for SubscriptionInner {
    fn ready(&self) -> bool {
        match self.slots.try_lock() {
            Ok(slots) => slots.has_data(),
            // Whoever has it may be about to add something.
            Err(_) => true,
        }
    }
}

impl Slots {
    fn has_data(&self) -> bool {
        !self.is_short() && self.slots.iter().any(|slot| slot.reader.has_data())
    }

    fn is_short(&self) -> bool {
        self.short.is_some_and(|since| since.elapsed() < SHORT)
    }

    /// Whether the lease of one of the writers may run out.
    pub(super) fn offers_lease(&self) -> bool {
        self.slots.iter().any(|slot| !slot.over && slot.reader.times().lease.is_some())
    }

    fn losses(&self) -> u64 {
        self.lost + self.slots.iter().map(|slot| slot.reader.lost()).sum::<u64>()
    }

    /// Samples that came since this was last asked.
    fn new_arrivals(&mut self) -> u64 {
        let present = self.slots.iter().map(|slot| slot.reader.arrived()).sum::<u64>();
        let arrived = self.arrived + present;
        // A writer whose memory is corrupt takes its numbers with it.
        arrived.saturating_sub(std::mem::replace(&mut self.arrived_before, arrived))
    }

    /// Samples to be taken.
    fn unread(&self, qos: &Qos) -> u64 {
        let unread = self.slots.iter().map(|slot| slot.reader.unread()).sum::<u64>();
        match qos.history {
            History::KeepLast => unread.min(qos.depth.into()),
            History::KeepAll => unread,
        }
    }

    /// Losses since this was last asked.
    fn new_losses(&mut self) -> u64 {
        let losses = self.losses();
        losses - std::mem::replace(&mut self.lost_before, losses)
    }

    /// The lane that is, or from now on will be, the one for `writer`.
    pub(super) fn lane_for<E>(
        &mut self,
        writer: Gid,
        allocate: impl FnOnce() -> Result<Lane, E>,
    ) -> Result<Location, E> {
        if let Some(slot) = self.slots.iter().find(|s| s.reader.writer() == writer && !s.over) {
            return Ok(slot.reader.lane());
        }
        if let Some(lane) = self.pending.get(&writer) {
            return Ok(lane.location());
        }
        let lane = allocate()?;
        let location = lane.location();
        self.pending.insert(writer, lane);
        Ok(location)
    }

    /// The lanes of all that are attached, or asked to be: what is repeated when `stands_for`
    /// changes.
    pub(super) fn lanes(&self) -> Vec<(Gid, Location)> {
        let attached = self.slots.iter().filter(|s| !s.over);
        let attached = attached.map(|s| (s.reader.writer(), s.reader.lane()));
        attached.chain(self.pending.iter().map(|(gid, lane)| (*gid, lane.location()))).collect()
    }

    /// What a grant of `writer` calls for.
    pub(super) fn accept(&mut self, writer: Gid, grant: Grant) -> Accept {
        if let Some(slot) = self.slots.iter_mut().find(|s| !s.over && s.reader.writer() == writer) {
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
        self.pending.remove(&writer).map_or(Accept::Stands, Accept::Map)
    }

    pub(super) fn add(&mut self, reader: Reader) {
        let writer = reader.writer();
        let since = clock::monotonic();
        let lifespan = reader.times().lifespan.map(|age| i64::try_from(age).unwrap_or(i64::MAX));
        self.slots.push(Slot { reader, since, lifespan, over: false, overtaken: false });
        self.forget_older(writer);
    }

    /// The writer will not write any more. Whether that is news.
    pub(super) fn end(&mut self, writer: &Gid) -> bool {
        self.pending.remove(writer);
        self.end_where(|reader| reader.writer() == *writer)
    }

    /// Writers whose process is dead will not write any more. Whether there are any.
    pub(super) fn end_dead(&mut self) -> bool {
        self.end_where(Reader::writer_dead)
    }

    /// The writers that are attached, or asked to be.
    pub(super) fn writers(&self) -> Vec<Gid> {
        self.lanes().into_iter().map(|(gid, _)| gid).collect()
    }

    fn end_where(&mut self, which: impl Fn(&Reader) -> bool) -> bool {
        let mut news = false;
        for slot in self.slots.iter_mut().filter(|s| !s.over && which(&s.reader)) {
            slot.over = true;
            slot.reader.end();
            news = true;
        }
        self.sweep();
        news
    }

    /// Gives up all but the last of what a writer left: one that begins anew and anew would otherwise
    /// take all lanes. What comes after is read by the later grant, too.
    fn forget_older(&mut self, writer: Gid) {
        while let [older, newer, ..] = self.slots_of(writer)[..]
            && self.slots[newer].over
        {
            let later = self.slots[newer].reader.grant().first;
            let slot = self.slots.remove(older);
            self.lost += slot.reader.lost() + slot.reader.unread_below(later);
            self.arrived += slot.reader.arrived();
        }
    }

    /// Where this writer's are, in the order in which it granted them.
    fn slots_of(&self, writer: Gid) -> Vec<usize> {
        let of = |index: &usize| self.slots[*index].reader.writer() == writer;
        (0..self.slots.len()).filter(of).collect()
    }

    /// Whether anything of this writer's is read, or may be soon.
    pub(super) fn reads(&self, writer: &Gid) -> bool {
        self.pending.contains_key(writer) || self.slots.iter().any(|s| s.reader.writer() == *writer)
    }

    /// Unmaps writers that are gone and drained.
    fn sweep(&mut self) {
        let (lost, arrived) = (&mut self.lost, &mut self.arrived);
        self.slots.retain(|s| {
            let keep = !s.over || !s.reader.is_drained();
            if !keep {
                *lost += s.reader.lost();
                *arrived += s.reader.arrived();
            }
            keep
        });
        if self.last.len() > REMEMBERED {
            let slots = &self.slots;
            self.last.retain(|gid, _| slots.iter().any(|s| s.reader.writer() == *gid));
        }
    }

    fn take<T>(
        &mut self,
        mut take: impl FnMut(&mut Reader) -> Result<Option<(Meta, T)>, TakeError>,
        of: &SubscriptionInner,
    ) -> Option<(MessageInfo, T)> {
        let endpoint = &of.endpoint;
        self.slots.iter_mut().for_each(|slot| slot.overtaken = false);
        // A writer that repeats itself without end must not keep the lock: callers come back as
        // long as there is something to take.
        for _ in 0..REPEATS {
            if of.qos.history == History::KeepLast && self.slots.len() > 1 {
                self.skip_to_depth(u64::from(of.qos.depth));
            }
            let Some(index) = self.oldest() else {
                // What was skipped may have been the last of a writer that is gone.
                if self.slots.iter().any(|slot| slot.over) {
                    self.sweep();
                }
                return None;
            };
            let slot = &mut self.slots[index];
            let writer = slot.reader.writer();
            let (meta, taken) = match take(&mut slot.reader) {
                Ok(Some(taken)) => taken,
                // Overwritten again and again while we read: the others have their turn first.
                Ok(None) => {
                    slot.overtaken = true;
                    continue;
                }
                Err(error @ TakeError::TooLarge { .. }) => {
                    tracing::error!(topic = endpoint.topic, %error, "a sample is lost");
                    continue;
                }
                // It stands, and may be taken when there is memory again.
                Err(error @ TakeError::NoMemory { .. }) => {
                    slot.overtaken = true;
                    if !self.is_short() {
                        tracing::error!(topic = endpoint.topic, %error, "a sample is not taken yet");
                    }
                    self.short = Some(Instant::now());
                    continue;
                }
                Err(error) => {
                    self.discard(index, &error, endpoint);
                    continue;
                }
            };
            let over = slot.over;
            let received_timestamp = clock::wall();
            let expired = slot.lifespan.is_some_and(|lifespan| {
                meta.source_timestamp.saturating_add(lifespan) < received_timestamp
            });
            let last = self.last.entry(writer).or_default();
            let repeated = of.rising && meta.sequence <= *last;
            if !repeated {
                *last = meta.sequence;
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
                continue;
            }
            let info = MessageInfo {
                publisher: writer,
                sequence: meta.sequence,
                source_timestamp: meta.source_timestamp,
                received_timestamp,
            };
            return Some((info, taken));
        }
        None
    }

    fn take_from(&mut self, writer: &Gid, of: &SubscriptionInner) -> Option<(Sample, u64)> {
        let endpoint = &of.endpoint;
        let index = self.slots.iter().position(|slot| {
            slot.reader.writer() == *writer && (!slot.over || slot.reader.has_data())
        })?;
        let reader = &mut self.slots[index].reader;
        match reader.take_sample() {
            Ok(sample) => {
                // What a relay passes over, nobody asked it to.
                let skipped = if of.role == EndpointRole::Relay { reader.skipped() } else { 0 };
                let taken = sample.map(|sample| (sample, reader.lost() + skipped));
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

    fn has_from(&self, writer: &Gid) -> bool {
        self.slots.iter().any(|slot| slot.reader.writer() == *writer && slot.reader.has_data())
    }

    /// Samples of `writer` that were lost before they came to its ring here.
    pub(super) fn lost_elsewhere(&mut self, writer: &Gid, samples: u64) {
        if self.slots.iter().any(|slot| slot.reader.writer() == *writer) {
            self.lost += samples;
        }
    }

    /// The slot whose next sample is the oldest, of those that are not faster than we are. What a
    /// writer wrote before it granted anew comes before what it wrote since, whatever its clock
    /// says: taken the other way round it would count as repeated.
    fn oldest(&mut self) -> Option<usize> {
        let index = self.oldest_by_time()?;
        let writer = self.slots[index].reader.writer();
        let earlier = self.slots[..index].iter().position(|slot| {
            slot.over && !slot.overtaken && slot.reader.writer() == writer && slot.reader.has_data()
        });
        Some(earlier.unwrap_or(index))
    }

    fn oldest_by_time(&mut self) -> Option<usize> {
        if let [slot] = self.slots.as_slice() {
            return (!slot.overtaken && slot.reader.has_data()).then_some(0);
        }
        let mut oldest = None;
        for (index, slot) in self.slots.iter_mut().enumerate().filter(|(_, s)| !s.overtaken) {
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

    /// KEEP_LAST(depth) counts over all publishers together.
    fn skip_to_depth(&mut self, depth: u64) {
        let mut unread: u64 = self.slots.iter().map(|s| s.reader.unread()).sum();
        while unread > depth {
            let Some(index) = self.oldest() else { return };
            if !self.slots[index].reader.skip() {
                return;
            }
            unread -= 1;
        }
    }

    fn discard(&mut self, index: usize, error: &TakeError, endpoint: &Endpoint) {
        tracing::error!(topic = endpoint.topic, %error, "a publisher's memory is not usable");
        let slot = self.slots.remove(index);
        self.lost += slot.reader.lost();
        self.arrived += slot.reader.arrived();
        if !slot.over {
            self.discarded.push(slot.reader.writer());
        }
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        ids::SessionId,
        shm::{Peer, ReaderInfo, ReaderOptions, RingOptions, SessionSegment, Writer},
    };

    #[test]
    fn nobody_is_woken_at_once_for_a_sample_that_there_is_no_memory_for() {
        let session = SessionSegment::create(SessionId::random()).unwrap();
        let [writer, reader] = [1, 2].map(|number| Gid::new(session.id(), number));
        let (qos, peer) = (Qos::default(), Peer::Local(session.clone()));
        let options = RingOptions { gid: writer, qos, budget: 0, max_message: 10, expected: 0 };
        let publisher = Writer::create(session.clone(), options).unwrap();
        let lane = session.allocate_lane().unwrap();
        let at = lane.location();
        let info =
            ReaderInfo { gid: reader, lane: at, qos, peer: peer.clone(), stands_for: Vec::new() };
        let (grant, ring) = (publisher.attach(info).unwrap(), publisher.location());
        let mut slots = Slots::default();
        let options =
            ReaderOptions { reader, writer, peer, ring, lane, grant, qos, max_message: 10 };
        slots.add(Reader::map(options).unwrap());
        publisher.publish_next(0, b"sample").unwrap();
        assert!(slots.has_data());
        let endpoint = Endpoint {
            gid: reader,
            kind: EndpointKind::Subscription,
            topic: "/t".into(),
            type_name: "T".into(),
            type_hash: Vec::new(),
            qos,
            node: String::new(),
            namespace: String::new(),
            enclave: String::new(),
        };
        let inner = SubscriptionInner::new(endpoint, EndpointRole::Application, Vec::new());
        let none = |_: &mut Reader| Err::<Option<(Meta, ())>, _>(TakeError::NoMemory { len: 6 });
        assert!(slots.take(none, &inner).is_none() && !slots.has_data());
        // Whoever asks nevertheless gets it, if it can be had.
        let mut out = Vec::new();
        let take = |reader: &mut Reader| Ok(reader.take(&mut out)?.map(|taken| (taken.meta, ())));
        assert!(slots.take(take, &inner).is_some());
        assert_eq!(out, b"sample");
    }
}
