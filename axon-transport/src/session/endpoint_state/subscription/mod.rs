//! The reading side of a subscription, client or server: a reader of all matched publishers of a topic, merged into
//! one stream.

mod counts;
mod departed_writers;
mod matched_reader;
mod matched_readers;
mod message_info;
mod slots;
mod taking;
#[cfg(test)]
mod tests;

use std::{
    ops::Range,
    sync::{Arc, Mutex, MutexGuard, PoisonError},
    time::{Duration, Instant},
};

use axon_shm::{
    Meta, Sample, ShmError, TakeError,
    internal::{Grant, Lane, Location, Reader, ReaderOptions, RingPeer, WakeCheck, holds},
};

pub(in crate::session) use self::{
    matched_reader::NumberKind,
    matched_readers::{Accept, ServeRequest},
};
use self::{
    matched_readers::MatchedReaders,
    taking::{Take, TakeRules},
};
pub use self::{
    message_info::{Lifetime, MessageInfo},
    taking::TakeLimit,
};
use super::{
    callback::{Callback, NewDataCallback},
    calls::Calls,
    events::{Changes, EndpointEvents},
    wakers::Wakers,
};
use crate::{
    graph::{Endpoint, EndpointKind},
    ids::Gid,
    qos::{History, Qos},
    session::{
        clock,
        core::{Outgoing, SessionCore},
        error::RecvError,
    },
    wire::session::{EndpointRole, Pair, SessionMessage},
};

/// The reading side of a subscription, client or server, which the session's control thread shares
/// with the handle.
pub(in crate::session) struct SubscriptionInner {
    pub(in crate::session) endpoint: Endpoint,
    /// The QoS that its readers request.
    pub(in crate::session) qos: Qos,
    /// Maximum number of unread samples of all writers together. For each writer alone, `qos` has the maximum: a
    /// client's requests do not take the space of another client's.
    shared_depth: Option<u32>,
    /// True if it is never matched with publishers of its own session.
    pub(in crate::session) ignores_local: bool,
    /// The only publisher that a relay reads, if it does not read all.
    pub(in crate::session) only: Option<Gid>,
    /// True if the subscription carries samples to another process, which reports the samples that it has received.
    pub(in crate::session) carries: bool,
    /// True if a writer's numbers rise. The responses of a server come in any order.
    pub(in crate::session) rising: bool,
    pub(in crate::session) role: EndpointRole,
    pub(in crate::session) events: EndpointEvents,
    stands_for: Mutex<Vec<Gid>>,
    matched_readers: Mutex<MatchedReaders>,
    arrived: Callback,
    /// True if the control thread listens for its callback.
    listens: Mutex<bool>,
    /// The tasks that wait for a message.
    pub(in crate::session) wakers: Wakers,
    /// The requests of a client whose tasks wait for the responses.
    pub(in crate::session) calls: Calls,
}

impl SubscriptionInner {
    pub(in crate::session) fn new(
        endpoint: Endpoint,
        role: EndpointRole,
        stands_for: Vec<Gid>,
    ) -> Self {
        let qos = endpoint.qos;
        let shared_depth = (qos.history == History::KeepLast).then_some(qos.depth);
        Self { shared_depth, stands_for: stands_for.into(), ..Self::reading(endpoint, role, qos) }
    }

    /// Creates the reading side of a client or server.
    pub(in crate::session) fn of_service(endpoint: Endpoint, role: EndpointRole, qos: Qos) -> Self {
        let rising = endpoint.kind != EndpointKind::Client;
        let matched_readers = MatchedReaders::of_service().into();
        Self { rising, matched_readers, ..Self::reading(endpoint, role, qos) }
    }

    fn reading(endpoint: Endpoint, role: EndpointRole, qos: Qos) -> Self {
        let events = EndpointEvents::of_subscription(&endpoint.qos);
        let keeps_all = endpoint.kind == EndpointKind::Subscription && holds(&qos);
        let matched_readers = MatchedReaders::new(keeps_all);
        Self {
            endpoint,
            qos,
            shared_depth: None,
            ignores_local: false,
            only: None,
            carries: false,
            rising: true,
            role,
            events,
            stands_for: Mutex::default(),
            matched_readers: matched_readers.into(),
            arrived: Callback::default(),
            listens: Mutex::new(false),
            wakers: Wakers::default(),
            calls: Calls::default(),
        }
    }

    /// Returns whether it wants every sample of its publishers.
    pub(in crate::session) fn keeps_all(&self) -> bool {
        self.endpoint.kind == EndpointKind::Subscription && holds(&self.qos)
    }

    /// Returns the rules of a take.
    fn take_rules(&self) -> TakeRules<'_> {
        TakeRules {
            topic: &self.endpoint.topic,
            shared_depth: self.shared_depth,
            rising: self.rising,
            loses_skipped: self.role == EndpointRole::Relay,
        }
    }

    /// Takes the oldest available sample, in place.
    pub(in crate::session) fn take_sample(
        &self,
        core: &SessionCore,
    ) -> Option<(MessageInfo, Sample)> {
        let copy = core.config.shm_copy;
        self.take(core, |reader| {
            let sample = if copy { reader.take_copy() } else { reader.take_sample() };
            Ok(sample?.map(|sample| (sample.meta(), sample)))
        })
    }

    /// Takes the oldest available sample; `take` takes it from its ring.
    pub(in crate::session) fn take<T>(
        &self,
        core: &SessionCore,
        take: impl FnMut(&mut Reader) -> Result<Option<(Meta, T)>, TakeError>,
    ) -> Option<(MessageInfo, T)> {
        self.take_with(core, |begun| begun.next(take))
    }

    /// Takes the oldest available sample, as bytes, into `out`, whose content it replaces.
    pub(in crate::session) fn take_bytes(
        &self,
        core: &SessionCore,
        out: &mut Vec<u8>,
    ) -> Option<MessageInfo> {
        let take = |reader: &mut Reader| Ok(reader.take(out)?.map(|taken| (taken.meta, ())));
        self.take(core, take).map(|(info, ())| info)
    }

    /// Takes the next sample of one writer, as bytes.
    pub(in crate::session) fn take_of(
        &self,
        core: &SessionCore,
        writer: &Gid,
    ) -> Option<(MessageInfo, Vec<u8>)> {
        let mut out = Vec::new();
        let take = |reader: &mut Reader| Ok(reader.take(&mut out)?.map(|taken| (taken.meta, ())));
        let (info, ()) = self.take_with(core, |begun| begun.next_of(writer, take))?;
        Some((info, out))
    }

    /// Takes samples of one writer into `out`, whose content it replaces. `each` receives the position of each sample's
    /// payload. Returns the number of samples.
    pub(in crate::session) fn take_many_of(
        &self,
        core: &SessionCore,
        writer: &Gid,
        most: TakeLimit,
        out: &mut Vec<u8>,
        each: impl FnMut(MessageInfo, Range<usize>),
    ) -> usize {
        out.clear();
        let taken = self.take_with(core, |begun| {
            Some(begun.many_of(writer, most, out, each)).filter(|taken| *taken > 0)
        });
        taken.unwrap_or(0)
    }

    /// Takes the next sample of one writer, for a relay. Returns it and the number of that writer's samples lost by
    /// then. The caller has made sure that the process has not forked.
    pub(in crate::session) fn sample_of(&self, writer: &Gid) -> Option<(Sample, u64)> {
        Take::begin(&mut self.lock(), self.take_rules()).sample_of(writer)
    }

    /// Returns the result of `take`; `None` if there is no message.
    fn take_with<T>(
        &self,
        core: &SessionCore,
        take: impl FnOnce(Take<'_>) -> Option<T>,
    ) -> Option<T> {
        // A thread of the parent may have held the lock when this process was forked.
        if core.is_forked() {
            tracing::error!("an endpoint of the parent process is used after fork");
            return None;
        }
        let mut matched_readers = self.lock();
        let taken = take(Take::begin(&mut matched_readers, self.take_rules()));
        let gone = std::mem::take(&mut matched_readers.discarded);
        let lost = matched_readers.new_losses();
        let again = if taken.is_none() { matched_readers.slots.look_again() } else { None };
        drop(matched_readers);
        if let Some(again) = again {
            core.look_again(again);
        }
        self.events.lost(lost);
        for writer in gone {
            let detach = SessionMessage::Detach(Pair { reader: self.endpoint.gid, writer });
            core.tell(Outgoing::message(detach));
        }
        taken
    }

    /// Returns what `take` finds, after waiting for at most `timeout`.
    pub(in crate::session) fn recv<T>(
        self: &Arc<Self>,
        core: &SessionCore,
        timeout: Option<Duration>,
        mut take: impl FnMut() -> Option<T>,
    ) -> Result<T, RecvError> {
        let mut begun = None;
        loop {
            // A forked child receives nothing, however long it waits.
            if core.is_forked() {
                return Err(RecvError::Forked);
            }
            if let Some(taken) = take() {
                return Ok(taken);
            }
            // A sample that is already there is taken without reading the clock.
            let now = Instant::now();
            let waited = now.duration_since(*begun.get_or_insert(now));
            let left = timeout.map(|timeout| timeout.saturating_sub(waited));
            let look = || -> Arc<dyn WakeCheck> { self.clone() };
            let over = left.is_some_and(|left| left.is_zero());
            if over || !core.segment.wait_for(|| self.has_data(), &look, left) {
                return Err(RecvError::TimedOut);
            }
        }
    }

    /// Wakes the tasks whose message or response came. Called by the control thread. Returns whether further tasks
    /// wait: in that case, a writer has to ring the doorbell for its next sample.
    pub(in crate::session) fn wake_tasks(&self, core: &SessionCore) -> bool {
        let calls = self.collect_responses(core);
        let receivers = self.wakers.wake_if(|| self.has_data());
        calls || receivers
    }

    /// Gives each call its response; see [`Calls::collect`].
    pub(in crate::session) fn collect_responses(&self, core: &SessionCore) -> bool {
        let take = || self.take_sample(core).map(|(info, sample)| (info.sequence, sample));
        self.calls.collect(core, take, |servers| {
            let matched_readers = self.lock();
            servers.retain(|server| !matched_readers.reads(server));
        })
    }

    /// Returns the publishers that it receives from.
    pub(in crate::session) fn matched(&self) -> Vec<Gid> {
        let matched_readers = self.lock();
        let matched = matched_readers.slots.iter().filter(|slot| slot.counts());
        matched.map(|slot| slot.reader.writer()).collect()
    }

    /// Counts the publishers that it receives from.
    pub(in crate::session) fn matched_count(&self) -> usize {
        self.lock().slots.iter().filter(|slot| slot.counts()).count()
    }

    /// Returns the number of samples taken.
    pub(in crate::session) fn received(&self) -> u64 {
        self.lock().counts.received
    }

    /// Returns the number of samples that were older than their publisher's lifespan when their turn came.
    pub(in crate::session) fn expired(&self) -> u64 {
        self.lock().counts.expired
    }

    /// Returns the number of samples that were lost.
    pub(in crate::session) fn lost(&self) -> u64 {
        self.lock().losses()
    }

    pub(in crate::session) fn has_data(&self) -> bool {
        self.lock().slots.has_data()
    }

    pub(in crate::session) fn set_on_new_sample(
        &self,
        callback: Option<NewDataCallback>,
        core: &SessionCore,
    ) -> Result<(), ShmError> {
        let listens = callback.is_some();
        self.arrived.replace(callback, |untold| {
            self.listen(listens, core)?;
            let mut matched_readers = self.lock();
            // Some of the unreported samples may have been taken, or lost.
            let untold = untold + matched_readers.new_arrivals();
            Ok(untold.min(self.within_depth(matched_readers.slots.unread())))
        })
    }

    /// Limits `unread` to the shared depth of all writers, if there is one.
    fn within_depth(&self, unread: u64) -> u64 {
        self.shared_depth.map_or(unread, |depth| unread.min(depth.into()))
    }

    /// Ends the callback for good: a callback that is set later is ignored.
    pub(in crate::session) fn tell_no_more(&self, core: &SessionCore) {
        self.arrived.end();
        // Only the start of listening can fail.
        let _ = self.listen(false, core);
    }

    /// Makes the control thread listen for its callback, or stop listening.
    fn listen(&self, whether: bool, core: &SessionCore) -> Result<(), ShmError> {
        let mut listens = lock(&self.listens);
        match (*listens, whether) {
            (false, true) => core.listen()?,
            (true, false) => core.listen_no_more(),
            _ => {}
        }
        *listens = whether;
        Ok(())
    }

    /// Reports new samples to the callback, if one is set.
    pub(in crate::session) fn tell_arrived(&self) {
        if self.arrived.is_set() {
            let new = self.lock().new_arrivals();
            self.arrived.add(new);
        }
    }

    /// Maps the ring that a writer granted, and returns its reader.
    pub(in crate::session) fn map(
        &self,
        writer: Gid,
        peer: RingPeer,
        ring: Location,
        lane: Lane,
        grant: Grant,
        max_message: u64,
    ) -> Result<Reader, ShmError> {
        let (reader, qos) = (self.endpoint.gid, self.qos);
        let options = ReaderOptions { reader, writer, peer, ring, lane, grant, qos, max_message };
        let mut mapped = Reader::map(options)?;
        if self.role == EndpointRole::Relay {
            mapped.tell_progress();
        }
        if self.role == EndpointRole::Relay || self.carries {
            mapped.finish_later();
        }
        if matches!(self.endpoint.kind, EndpointKind::Server | EndpointKind::Client) {
            mapped.tell_room();
        }
        // If the session belongs to a gateway, it reads too many rings to check all of them.
        if self.role != EndpointRole::Application {
            mapped.follow(self.endpoint.gid);
        }
        Ok(mapped)
    }

    /// Updates the matched writers. Returns the changes since the last call.
    pub(in crate::session) fn rematch(&self) -> Changes {
        let leases = || {
            let matched_readers = self.lock();
            let active = matched_readers.slots.iter().filter(|slot| slot.counts());
            active.map(|slot| (slot.reader.writer(), slot.lease)).collect()
        };
        self.events.writers(leases, clock::monotonic())
    }

    /// Counts the missed deadlines, and checks the publishers' liveliness. Returns when to look again, and whether an
    /// event occurred.
    pub(in crate::session) fn look_at_time(&self, now: u64) -> (Option<u64>, bool) {
        let times: Vec<_> = {
            let matched_readers = self.lock();
            let active = matched_readers.slots.iter().filter(|slot| slot.counts());
            let times = active.map(|slot| {
                let mut times = slot.reader.times();
                times.sampled = times.sampled.filter(|sampled| *sampled >= slot.since);
                (slot.reader.writer(), times)
            });
            times.collect()
        };
        self.events.requested(&self.qos, &times, now)
    }

    /// Like [`look_for_losses`](Self::look_for_losses), for a thread that must not wait for a thread that takes
    /// samples: returns whether there may be new losses.
    pub(in crate::session) fn may_have_losses(&self) -> bool {
        let Ok(mut matched_readers) = self.matched_readers.try_lock() else { return true };
        matched_readers.slots.iter_mut().for_each(|slot| drop(slot.reader.peek()));
        matched_readers.counts.has_new_losses(matched_readers.slots.lost())
    }

    /// Counts the losses that a take would find now.
    pub(in crate::session) fn look_for_losses(&self) {
        let mut matched_readers = self.lock();
        for slot in matched_readers.slots.iter_mut() {
            // The next take reports an error of the memory.
            let _ = slot.reader.peek();
        }
        let lost = matched_readers.new_losses();
        drop(matched_readers);
        self.events.lost(lost);
    }

    pub(in crate::session) fn lock(&self) -> MutexGuard<'_, MatchedReaders> {
        lock(&self.matched_readers)
    }

    pub(in crate::session) fn set_stands_for(&self, gids: Vec<Gid>) {
        *lock(&self.stands_for) = gids;
    }

    pub(in crate::session) fn stands_for(&self) -> Vec<Gid> {
        lock(&self.stands_for).clone()
    }
}

impl WakeCheck for SubscriptionInner {
    fn ready(&self) -> bool {
        match self.matched_readers.try_lock() {
            Ok(matched_readers) => matched_readers.slots.has_data(),
            // The thread that holds the lock may be about to add a sample.
            Err(_) => true,
        }
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
