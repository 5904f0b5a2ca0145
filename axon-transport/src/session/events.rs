//! The events of endpoints: their statuses, and the wait sets and callbacks that receive them.

use std::{
    cmp::Ordering,
    collections::BTreeSet,
    fmt,
    sync::{Arc, Mutex, MutexGuard, PoisonError},
};

use axon_shm::internal::{Times, nanoseconds};

use super::{
    Session,
    callback::{Callback, OnNew},
    publisher::PublisherInner,
    subscription::SubscriptionInner,
};
use crate::{
    events::{Deadline, EventKind, EventStatus, Lease, Liveness, Statuses},
    graph::{Endpoint, Pairing},
    ids::Gid,
    qos::{Liveliness, Qos},
};

/// One event of a publisher or subscription. Thread-safe; it may outlive its endpoint, and then
/// never occurs again.
///
/// ```
/// use std::time::Duration;
///
/// use axon_transport::{
///     EndpointSpec, Session, SessionOptions,
///     config::{Config, DaemonPolicy},
///     events::{EventKind, EventStatus},
///     qos::Qos,
/// };
///
/// let config = Config::builder().daemon(DaemonPolicy::Off).build()?;
/// let session = Session::open(&config, SessionOptions::new("robot"))?;
/// let publisher = session.create_publisher(EndpointSpec::new("/t", "T", Qos::default()))?;
/// let matched = publisher.event(EventKind::PublicationMatched).expect("publishers have it");
/// let _reader = session.create_subscription(EndpointSpec::new("/t", "T", Qos::default()))?;
/// assert!(publisher.wait_matched(1, Duration::from_secs(10)));
/// let EventStatus::Matched(status) = matched.take() else { unreachable!() };
/// assert_eq!((status.total, status.current_change), (1, 1));
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub struct Event {
    source: EventSource,
    kind: EventKind,
    pub(super) session: Session,
    /// Its own, which the endpoint knows from when it is first set.
    callback: Arc<Callback>,
}

/// Whose event it is.
#[derive(Clone)]
pub(super) enum EventSource {
    Publisher(Arc<PublisherInner>),
    Subscription(Arc<SubscriptionInner>),
}

impl EventSource {
    pub(super) fn events(&self) -> &EndpointEvents {
        match self {
            Self::Publisher(inner) => &inner.events,
            Self::Subscription(inner) => &inner.events,
        }
    }

    pub(super) fn endpoint(&self) -> &Endpoint {
        match self {
            Self::Publisher(inner) => &inner.endpoint,
            Self::Subscription(inner) => &inner.endpoint,
        }
    }

    /// What became of its matches since it was asked last.
    pub(super) fn rematch(&self) -> Changes {
        match self {
            Self::Publisher(inner) => inner.rematch(),
            Self::Subscription(inner) => inner.rematch(),
        }
    }

    /// Counts what has passed until `now`. When to look again, and whether something happened.
    pub(super) fn look_at_time(&self, now: u64) -> (Option<u64>, bool) {
        match self {
            Self::Publisher(inner) => inner.look_at_time(now),
            Self::Subscription(inner) => inner.look_at_time(now),
        }
    }

    /// Whether `kind` occurred since its status was taken.
    pub(super) fn has(&self, kind: EventKind) -> bool {
        if let (Self::Subscription(inner), EventKind::MessageLost) = (self, kind) {
            inner.look_for_losses();
        }
        self.events().unread(kind) > 0
    }

    /// The same for other threads than the one that waits: while a thread is taking, it may.
    pub(super) fn may_have(&self, kind: EventKind) -> bool {
        let losing = match (self, kind) {
            (Self::Subscription(inner), EventKind::MessageLost) => inner.may_have_losses(),
            _ => false,
        };
        losing || self.events().unread(kind) > 0
    }
}

impl Event {
    pub(super) fn new(source: EventSource, kind: EventKind, session: Session) -> Option<Self> {
        let publishers = matches!(source, EventSource::Publisher(_));
        let callback = Arc::default();
        (kind.is_publishers() == publishers).then_some(Self { source, kind, session, callback })
    }

    /// Which it is.
    pub fn kind(&self) -> EventKind {
        self.kind
    }

    /// Whether it occurred since its status was last taken. False in a forked child.
    pub fn is_ready(&self) -> bool {
        !self.session.is_forked() && self.source.has(self.kind)
    }

    /// The status; its changes are counted anew from here. In a forked child, one of which nothing
    /// ever happened.
    pub fn take(&self) -> EventStatus {
        if self.session.is_forked() {
            let mut nothing = match self.source {
                EventSource::Publisher(_) => Statuses::of_publisher(),
                EventSource::Subscription(_) => Statuses::of_subscription(),
            };
            return nothing.take(self.kind).expect("checked when the event was made");
        }
        self.source.events().take(self.kind)
    }

    /// Has `callback` told of it from now on, in place of the one that this handle had before, which is
    /// not called any more once this returns. What happened since the status was last taken, and this
    /// handle told nobody of, it is told at once, on this thread; the rest on the control thread, or
    /// where another endpoint of the session comes or goes. It must neither block nor panic, nor hold
    /// the session. It ends with this handle.
    pub fn set_callback(&self, callback: Option<OnNew>) {
        if !self.session.is_forked() {
            self.source.events().tell(self.kind, &self.callback);
            self.callback.set(callback);
        }
    }

    /// The callback has returned and is not called any more once this returns, whatever is set from now
    /// on: for a handle that other threads may still use though it has ended.
    pub(crate) fn tell_no_more(&self) {
        if !self.session.is_forked() {
            self.callback.end();
            self.source.events().tell_no_more(&self.callback);
        }
    }

    /// What a wait set looks at.
    pub(super) fn parts(&self) -> (&EventSource, EventKind) {
        (&self.source, self.kind)
    }
}

impl fmt::Debug for Event {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("Event").field(&self.kind).finish()
    }
}

impl Drop for Event {
    fn drop(&mut self) {
        self.tell_no_more();
    }
}

/// Who is matched that was not, and who is not that was.
#[derive(Debug, Default, PartialEq, Eq)]
pub(super) struct Changes {
    pub(super) added: Vec<Gid>,
    pub(super) removed: Vec<Gid>,
}

impl Changes {
    pub(super) fn is_empty(&self) -> bool {
        self.added.is_empty() && self.removed.is_empty()
    }
}

/// The same, with the leases of those that are new.
#[derive(Default)]
struct Moved {
    added: Vec<(Gid, Option<u64>)>,
    removed: Vec<Gid>,
}

impl Moved {
    /// What makes `after` of `before`, both in order.
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
pub(super) struct EndpointEvents {
    inner: Mutex<EventsInner>,
}

struct EventsInner {
    statuses: Statuses,
    /// Of all handles of events that have one.
    callbacks: Vec<(EventKind, Arc<Callback>)>,
    /// In order.
    matched: Vec<Gid>,
    /// Those of the topic that do not go with this one, and have been counted.
    incompatible: BTreeSet<Gid>,
    /// A subscription's publishers.
    liveness: Liveness,
    /// A publisher's own lease, where it may run out.
    lease: Option<Lease>,
    deadline: Option<Deadline>,
}

/// The shortest time between two looks at deadlines and leases.
const SHORTEST: u64 = 1_000_000;

impl EndpointEvents {
    pub(super) fn of_publisher(qos: &Qos, now: u64) -> Self {
        let manual = qos.liveliness == Liveliness::ManualByTopic && qos.lease.is_some();
        let lease = manual.then(|| Lease::new(qos.lease.map(nanoseconds), now));
        Self::new(Statuses::of_publisher(), qos, lease)
    }

    pub(super) fn of_subscription(qos: &Qos) -> Self {
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

    pub(super) fn unread(&self, kind: EventKind) -> u64 {
        self.lock().statuses.unread(kind)
    }

    fn take(&self, kind: EventKind) -> EventStatus {
        let mut inner = self.lock();
        inner.callbacks_of(kind).for_each(|callback| callback.recount(0));
        inner.statuses.take(kind).expect("checked when the event was made")
    }

    /// Has a callback told of an event from now on, and of what happened since its status was taken.
    fn tell(&self, kind: EventKind, callback: &Arc<Callback>) {
        let mut inner = self.lock();
        if !inner.callbacks_of(kind).any(|known| Arc::ptr_eq(known, callback)) {
            callback.recount(inner.statuses.unread(kind));
            inner.callbacks.push((kind, Arc::clone(callback)));
        }
    }

    fn tell_no_more(&self, callback: &Arc<Callback>) {
        self.lock().callbacks.retain(|(_, known)| !Arc::ptr_eq(known, callback));
    }

    pub(super) fn is_matched(&self, gid: &Gid) -> bool {
        self.lock().matched.binary_search(gid).is_ok()
    }

    pub(super) fn matched_now(&self) -> Vec<Gid> {
        self.lock().matched.clone()
    }

    /// Those that a publisher sends to are these now. They are looked up under the lock: of two
    /// threads that do so, the later one knows the later state.
    pub(super) fn readers(&self, now: impl FnOnce() -> Vec<Gid>) -> Changes {
        self.rematch(|| now().into_iter().map(|gid| (gid, None)).collect(), |_, _| {})
    }

    /// As [`readers`](Self::readers), those that a subscription receives from, with the leases that
    /// they offer.
    pub(super) fn writers(
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

    /// An endpoint of the topic is not matched, for this reason. Whether that is news.
    pub(super) fn incompatible(&self, other: Gid, why: Pairing) -> bool {
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

    /// An endpoint that was incompatible is gone.
    pub(super) fn forget(&self, other: &Gid) {
        self.lock().incompatible.remove(other);
    }

    pub(super) fn lost(&self, count: u64) {
        if count > 0 {
            self.change(|inner| {
                inner.statuses.lost(count);
            });
        }
    }

    /// What has passed for a publisher until `now`. When to look again.
    pub(super) fn offered(&self, qos: &Qos, times: &Times, now: u64) -> (Option<u64>, bool) {
        let mut due = None;
        let news = self.change(|inner| {
            if let Some(lease) = &mut inner.lease {
                if let Some(asserted) = times.asserted {
                    lease.assert(asserted.min(now));
                }
                if lease.ran_out(now) {
                    inner.statuses.liveliness_lost();
                }
                // Where it has run out, one looks whether it is asserted again.
                due = earlier(due, lease.due().or(third(qos.lease.map(nanoseconds), now)));
            }
            due = earlier(due, inner.deadlines(qos, times.sampled, now));
        });
        (due.map(|due| due.max(now + SHORTEST)), news)
    }

    /// What has passed for a subscription until `now`, where its publishers say this of themselves.
    /// When to look again.
    pub(super) fn requested(
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
            // One that is not alive may be so again.
            let leases = writers.iter().filter_map(|(_, times)| times.lease).min();
            if inner.liveness.any_dead() {
                due = earlier(due, third(leases, now));
            }
            if writers.is_empty() {
                // It runs from the first sample of the next one on.
                inner.deadline = qos.deadline.map(nanoseconds).map(Deadline::new);
            } else {
                let sampled = writers.iter().filter_map(|(_, times)| times.sampled).max();
                due = earlier(due, inner.deadlines(qos, sampled, now));
            }
        });
        (due.map(|due| due.max(now + SHORTEST)), news)
    }

    /// Changes statuses and tells those who are to be told. Whether anything occurred.
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

    /// Counts the deadlines that have passed, where the newest sample is of `sampled`. When to look
    /// again.
    fn deadlines(&mut self, qos: &Qos, sampled: Option<u64>, now: u64) -> Option<u64> {
        let deadline = self.deadline.as_mut()?;
        if let Some(sampled) = sampled {
            deadline.sample(sampled.min(now));
        }
        let missed = deadline.missed(now);
        if missed > 0 {
            self.statuses.deadlines_missed(missed);
        }
        // The first sample, from which it runs, may come at any time.
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
