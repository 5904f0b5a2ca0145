//! The state of a subscription, which its handle and the session's control thread share.

use std::sync::{Mutex, MutexGuard, PoisonError};

use axon_shm::{
    ShmError,
    internal::{Grant, Lane, Location, Peer, Reader, ReaderOptions, WakeCheck, holds},
};

use super::{matched_readers::MatchedReaders, taking::TakeRules};
use crate::{
    graph::{Endpoint, EndpointKind},
    ids::Gid,
    qos::{History, Qos},
    session::{
        OnNew,
        callback::Callback,
        clock,
        events::{Changes, EndpointEvents},
        state::SessionShared,
        tasks::{Calls, Wakers},
    },
    wire::session::EndpointRole,
};

/// The reading side of a subscription, client or server, which the session's control thread shares
/// with the handle.
pub(in crate::session) struct SubscriptionInner {
    pub(in crate::session) endpoint: Endpoint,
    /// What its readers request.
    pub(in crate::session) qos: Qos,
    /// How many samples stand of all its writers together. Of each alone it is what `qos` says: a
    /// client's requests do not take the room of another's.
    pub(super) shared_depth: Option<u32>,
    /// Whether it is never matched with publishers of its own session.
    pub(in crate::session) ignores_local: bool,
    /// The only publisher that a relay reads, where it is not all.
    pub(in crate::session) only: Option<Gid>,
    /// Whether it carries samples to another process, which says what it has.
    pub(in crate::session) carries: bool,
    /// Whether a writer's numbers rise: the responses of a server come in whatever order it likes.
    pub(in crate::session) rising: bool,
    pub(in crate::session) role: EndpointRole,
    pub(in crate::session) events: EndpointEvents,
    stands_for: Mutex<Vec<Gid>>,
    matched_readers: Mutex<MatchedReaders>,
    arrived: Callback,
    /// Whether the control thread listens for its callback.
    listens: Mutex<bool>,
    /// The tasks that wait for a message.
    pub(in crate::session) wakers: Wakers,
    /// Of a client: the requests whose responses tasks wait for.
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

    /// The reading side of a client or server.
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

    /// Whether it wants every sample of its publishers.
    pub(in crate::session) fn keeps_all(&self) -> bool {
        self.endpoint.kind == EndpointKind::Subscription && holds(&self.qos)
    }

    /// What a take has to know.
    pub(super) fn take_rules(&self) -> TakeRules<'_> {
        TakeRules {
            topic: &self.endpoint.topic,
            shared_depth: self.shared_depth,
            rising: self.rising,
            loses_skipped: self.role == EndpointRole::Relay,
        }
    }

    pub(in crate::session) fn has_data(&self) -> bool {
        self.lock().slots.has_data()
    }

    pub(in crate::session) fn set_on_new_sample(
        &self,
        callback: Option<OnNew>,
        shared: &SessionShared,
    ) -> Result<(), ShmError> {
        let listens = callback.is_some();
        self.arrived.replace(callback, |untold| {
            self.listen(listens, shared)?;
            let mut matched_readers = self.lock();
            // Of those that nobody was told of some may have been taken, or lost.
            let untold = untold + matched_readers.new_arrivals();
            Ok(untold.min(self.within_depth(matched_readers.slots.unread())))
        })
    }

    /// At most as many samples as all writers together may have to be taken, if they share a depth.
    fn within_depth(&self, unread: u64) -> u64 {
        self.shared_depth.map_or(unread, |depth| unread.min(depth.into()))
    }

    /// Nobody hears of samples any more, whatever is set from now on.
    pub(in crate::session) fn tell_no_more(&self, shared: &SessionShared) {
        self.arrived.end();
        // Only listening may fail, not ceasing to.
        let _ = self.listen(false, shared);
    }

    /// Has the control thread listen for its callback, or not any more.
    fn listen(&self, whether: bool, shared: &SessionShared) -> Result<(), ShmError> {
        let mut listens = lock(&self.listens);
        match (*listens, whether) {
            (false, true) => shared.listen()?,
            (true, false) => shared.listen_no_more(),
            _ => {}
        }
        *listens = whether;
        Ok(())
    }

    /// Tells of samples that came, where somebody wants to hear of them.
    pub(in crate::session) fn tell_arrived(&self) {
        if self.arrived.is_set() {
            let new = self.lock().new_arrivals();
            self.arrived.add(new);
        }
    }

    /// What reads the ring that a writer granted.
    pub(in crate::session) fn map(
        &self,
        writer: Gid,
        peer: Peer,
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
        // Where its session is a gateway's, which reads too many rings to look at all of them.
        if self.role != EndpointRole::Application {
            mapped.follow(self.endpoint.gid);
        }
        Ok(mapped)
    }

    /// What became of its matches since it was asked last.
    pub(in crate::session) fn rematch(&self) -> Changes {
        let leases = || {
            let matched_readers = self.lock();
            let active = matched_readers.slots.iter().filter(|slot| slot.counts());
            active.map(|slot| (slot.reader.writer(), slot.lease)).collect()
        };
        self.events.writers(leases, clock::monotonic())
    }

    /// Counts the deadlines that passed and looks who is alive. When to look again, and whether
    /// something happened.
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

    /// The same for who must not wait for a thread that takes.
    pub(in crate::session) fn may_have_losses(&self) -> bool {
        let Ok(mut matched_readers) = self.matched_readers.try_lock() else { return true };
        matched_readers.slots.iter_mut().for_each(|slot| drop(slot.reader.peek()));
        matched_readers.counts.has_new_losses(matched_readers.slots.lost())
    }

    /// Counts what would be found lost by taking now.
    pub(in crate::session) fn look_for_losses(&self) {
        let mut matched_readers = self.lock();
        for slot in matched_readers.slots.iter_mut() {
            // What is wrong with its memory, the next take says.
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
            // The thread that holds the lock may be about to add something.
            Err(_) => true,
        }
    }
}

pub(in crate::session) fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
