//! The events of an endpoint: their statuses, and the callbacks that receive them.

use std::{
    cmp::Ordering,
    collections::BTreeSet,
    sync::{Arc, Mutex, MutexGuard, PoisonError},
};

use axon_shm::internal::{Times, nanoseconds};

use super::callback::Callback;
use crate::{
    events::{Deadline, EventKind, EventStatus, Lease, Liveness, Statuses},
    graph::Pairing,
    ids::Gid,
    qos::{Liveliness, Qos},
};

/// Endpoints that became matched, and endpoints that are not matched any more.
#[derive(Debug, Default, PartialEq, Eq)]
pub(in crate::session) struct Changes {
    pub(in crate::session) added: Vec<Gid>,
    pub(in crate::session) removed: Vec<Gid>,
}

impl Changes {
    pub(in crate::session) fn is_empty(&self) -> bool {
        self.added.is_empty() && self.removed.is_empty()
    }
}

/// Like [`Changes`], with the lease of each new endpoint.
#[derive(Default)]
struct Moved {
    added: Vec<(Gid, Option<u64>)>,
    removed: Vec<Gid>,
}

impl Moved {
    /// Returns the difference between `before` and `after`, which are both sorted.
    fn between(before: &[Gid], after: &[(Gid, Option<u64>)]) -> Self {
        let mut moved = Self::default();
        let (mut before, mut after) = (before.iter().peekable(), after.iter().peekable());
        loop {
            let order = match (before.peek(), after.peek()) {
                (Some(old), Some((new, _))) => (*old).cmp(new),
                (Some(_), None) => Ordering::Less,
                (None, Some(_)) => Ordering::Greater,
                (None, None) => return moved,
            };
            if order.is_le() {
                moved.removed.extend(before.next().filter(|_| order.is_lt()));
            }
            if order.is_ge() {
                moved.added.extend(after.next().filter(|_| order.is_gt()));
            }
        }
    }
}

/// The events of one endpoint.
pub(in crate::session) struct EndpointEvents {
    inner: Mutex<EventsInner>,
}

struct EventsInner {
    statuses: Statuses,
    /// The callbacks of all event handles that have one.
    callbacks: Vec<(EventKind, Arc<Callback>)>,
    /// The matched endpoints, sorted.
    matched: Vec<Gid>,
    /// Endpoints of the topic that are incompatible with this one and have been counted.
    incompatible: BTreeSet<Gid>,
    /// The liveness of a subscription's publishers.
    liveness: Liveness,
    /// A publisher's own lease, if it can run out.
    lease: Option<Lease>,
    deadline: Option<Deadline>,
}

/// Minimum time between two checks of deadlines and leases, in nanoseconds.
const SHORTEST: u64 = 1_000_000;

impl EndpointEvents {
    pub(in crate::session) fn of_publisher(qos: &Qos, now: u64) -> Self {
        let manual = qos.liveliness == Liveliness::ManualByTopic && qos.lease.is_some();
        let lease = manual.then(|| Lease::new(qos.lease.map(nanoseconds), now));
        Self::new(Statuses::of_publisher(), qos, lease)
    }

    pub(in crate::session) fn of_subscription(qos: &Qos) -> Self {
        Self::new(Statuses::of_subscription(), qos, None)
    }

    fn new(statuses: Statuses, qos: &Qos, lease: Option<Lease>) -> Self {
        let inner = EventsInner {
            statuses,
            callbacks: Vec::new(),
            matched: Vec::new(),
            incompatible: BTreeSet::new(),
            liveness: Liveness::default(),
            lease,
            deadline: qos.deadline.map(nanoseconds).map(Deadline::new),
        };
        Self { inner: Mutex::new(inner) }
    }

    pub(in crate::session) fn unread(&self, kind: EventKind) -> u64 {
        self.lock().statuses.unread(kind)
    }

    pub(in crate::session) fn take(&self, kind: EventKind) -> EventStatus {
        let mut inner = self.lock();
        inner.callbacks_of(kind).for_each(|callback| callback.recount(0));
        inner.statuses.take(kind).expect("checked when the event was made")
    }

    /// Registers a callback for an event. It also receives the number of occurrences since the status was taken.
    pub(in crate::session) fn tell(&self, kind: EventKind, callback: &Arc<Callback>) {
        let mut inner = self.lock();
        if !inner.callbacks_of(kind).any(|known| Arc::ptr_eq(known, callback)) {
            callback.recount(inner.statuses.unread(kind));
            inner.callbacks.push((kind, Arc::clone(callback)));
        }
    }

    pub(in crate::session) fn tell_no_more(&self, callback: &Arc<Callback>) {
        self.lock().callbacks.retain(|(_, known)| !Arc::ptr_eq(known, callback));
    }

    pub(in crate::session) fn is_matched(&self, gid: &Gid) -> bool {
        self.lock().matched.binary_search(gid).is_ok()
    }

    pub(in crate::session) fn matched_now(&self) -> Vec<Gid> {
        self.lock().matched.clone()
    }

    /// Updates the readers that a publisher sends to. `now` runs under the lock: of two threads that call this, the
    /// later one sees the later state.
    pub(in crate::session) fn readers(&self, now: impl FnOnce() -> Vec<Gid>) -> Changes {
        self.rematch(|| now().into_iter().map(|gid| (gid, None)).collect(), |_, _| {})
    }

    /// Like [`readers`](Self::readers), for the writers that a subscription receives from, each with the lease that it
    /// offers.
    pub(in crate::session) fn writers(
        &self,
        now: impl FnOnce() -> Vec<(Gid, Option<u64>)>,
        time: u64,
    ) -> Changes {
        self.rematch(now, |inner, changes| {
            let (mut alive, mut not_alive) = (0, 0);
            let mut add = |change: (i64, i64)| {
                alive += change.0;
                not_alive += change.1;
            };
            for gid in &changes.removed {
                add(inner.liveness.unmatched(gid));
            }
            for (gid, lease) in &changes.added {
                add(inner.liveness.matched(*gid, *lease, time));
            }
            inner.statuses.liveliness_changed(alive, not_alive);
        })
    }

    fn rematch(
        &self,
        now: impl FnOnce() -> Vec<(Gid, Option<u64>)>,
        liveness: impl FnOnce(&mut EventsInner, &Moved),
    ) -> Changes {
        let mut changes = Changes::default();
        self.change(|inner| {
            let mut now = now();
            now.sort_unstable_by_key(|(gid, _)| *gid);
            now.dedup_by_key(|(gid, _)| *gid);
            let moved = Moved::between(&inner.matched, &now);
            if moved.added.is_empty() && moved.removed.is_empty() {
                return;
            }
            inner.matched = now.into_iter().map(|(gid, _)| gid).collect();
            moved.removed.iter().for_each(|_| {
                inner.statuses.unmatched();
            });
            moved.added.iter().for_each(|_| {
                inner.statuses.matched();
            });
            liveness(inner, &moved);
            changes.added = moved.added.into_iter().map(|(gid, _)| gid).collect();
            changes.removed = moved.removed;
        });
        changes
    }

    /// Counts an endpoint of the topic that is not matched for this reason. Returns whether it was not counted before.
    pub(in crate::session) fn incompatible(&self, other: Gid, why: Pairing) -> bool {
        let mut news = false;
        self.change(|inner| {
            news = match why {
                Pairing::IncompatibleQos(_) | Pairing::IncompatibleType => {
                    inner.incompatible.insert(other)
                }
                Pairing::Match | Pairing::Unrelated => false,
            };
            if !news {
                return;
            }
            if let Pairing::IncompatibleQos(policy) = why {
                inner.statuses.incompatible_qos(policy);
            } else {
                inner.statuses.incompatible_type();
            }
        });
        news
    }

    /// Forgets an incompatible endpoint that is gone.
    pub(in crate::session) fn forget(&self, other: &Gid) {
        self.lock().incompatible.remove(other);
    }

    pub(in crate::session) fn lost(&self, count: u64) {
        if count > 0 {
            self.change(|inner| {
                inner.statuses.lost(count);
            });
        }
    }

    /// Counts a publisher's missed deadlines and its lost liveliness until `now`. Returns when to look again, and
    /// whether an event occurred.
    pub(in crate::session) fn offered(
        &self,
        qos: &Qos,
        times: &Times,
        now: u64,
    ) -> (Option<u64>, bool) {
        let mut due = None;
        let news = self.change(|inner| {
            if let Some(lease) = &mut inner.lease {
                if let Some(asserted) = times.asserted {
                    lease.assert(asserted.min(now));
                }
                if lease.ran_out(now) {
                    inner.statuses.liveliness_lost();
                }
                // After the lease has run out, the check repeats to see whether it is asserted again.
                due = earlier(due, lease.due().or(third(qos.lease.map(nanoseconds), now)));
            }
            due = earlier(due, inner.deadlines(qos, times.sampled, now));
        });
        (due.map(|due| due.max(now + SHORTEST)), news)
    }

    /// Counts a subscription's missed deadlines and the liveliness of its publishers until `now`, by the times that the
    /// publishers report. Returns when to look again, and whether an event occurred.
    pub(in crate::session) fn requested(
        &self,
        qos: &Qos,
        writers: &[(Gid, Times)],
        now: u64,
    ) -> (Option<u64>, bool) {
        let mut due = None;
        let news = self.change(|inner| {
            let (mut alive, mut not_alive) = (0, 0);
            let mut add = |change: (i64, i64)| {
                alive += change.0;
                not_alive += change.1;
            };
            for (gid, times) in writers {
                if let Some(asserted) = times.asserted {
                    add(inner.liveness.assert(gid, asserted.min(now)));
                }
            }
            add(inner.liveness.ran_out(now));
            if (alive, not_alive) != (0, 0) {
                inner.statuses.liveliness_changed(alive, not_alive);
            }
            due = inner.liveness.due();
            // A publisher that is not alive may become alive again.
            let leases = writers.iter().filter_map(|(_, times)| times.lease).min();
            if inner.liveness.any_dead() {
                due = earlier(due, third(leases, now));
            }
            if writers.is_empty() {
                // The deadline starts again with the first sample of the next publisher.
                inner.deadline = qos.deadline.map(nanoseconds).map(Deadline::new);
            } else {
                let sampled = writers.iter().filter_map(|(_, times)| times.sampled).max();
                due = earlier(due, inner.deadlines(qos, sampled, now));
            }
        });
        (due.map(|due| due.max(now + SHORTEST)), news)
    }

    /// Changes statuses, and calls the callbacks of the events that occurred. Returns whether an event occurred.
    fn change(&self, change: impl FnOnce(&mut EventsInner)) -> bool {
        let mut told = Vec::new();
        let mut news = false;
        {
            let mut inner = self.lock();
            let unread =
                |inner: &EventsInner| EventKind::ALL.map(|kind| inner.statuses.unread(kind));
            let before = unread(&inner);
            change(&mut inner);
            for ((kind, before), after) in EventKind::ALL.iter().zip(before).zip(unread(&inner)) {
                if after > before {
                    news = true;
                    let callbacks = inner.callbacks_of(*kind);
                    told.extend(callbacks.map(|callback| (callback.clone(), after - before)));
                }
            }
        }
        told.iter().for_each(|(callback, count)| callback.add(*count));
        news
    }

    fn lock(&self) -> MutexGuard<'_, EventsInner> {
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl EventsInner {
    fn callbacks_of(&self, kind: EventKind) -> impl Iterator<Item = &Arc<Callback>> {
        self.callbacks.iter().filter(move |(of, _)| *of == kind).map(|(_, callback)| callback)
    }

    /// Counts the missed deadlines; the newest sample was published at `sampled`. Returns when to look again.
    fn deadlines(&mut self, qos: &Qos, sampled: Option<u64>, now: u64) -> Option<u64> {
        let deadline = self.deadline.as_mut()?;
        if let Some(sampled) = sampled {
            deadline.sample(sampled.min(now));
        }
        let missed = deadline.missed(now);
        if missed > 0 {
            self.statuses.deadlines_missed(missed);
        }
        // The deadline runs from the first sample, which may come at any time.
        let after = |period| now.saturating_add(nanoseconds(period));
        deadline.due().or(qos.deadline.map(after))
    }
}

fn earlier(one: Option<u64>, other: Option<u64>) -> Option<u64> {
    one.into_iter().chain(other).min()
}

fn third(period: Option<u64>, now: u64) -> Option<u64> {
    period.map(|period| now.saturating_add(period / 3))
}
