//! The rules of a pool, without I/O and without a clock: when to ask a KME for keys, and for how many.

use std::collections::VecDeque;
use std::fmt;
use std::time::Duration;

use super::supply::Supply;

mod status;
#[cfg(test)]
mod tests;

pub use status::{PoolStatus, Stock};

/// Time between two status calls.
const STATUS_EVERY: Duration = Duration::from_secs(5);
/// First and longest pause after a failure that cost no key.
const RETRY_PAUSE: (Duration, Duration) = (Duration::from_millis(100), Duration::from_secs(2));
/// First and longest pause after a failure that may have cost keys.
const PAUSE_LOST: (Duration, Duration) = (Duration::from_secs(1), Duration::from_secs(30));
/// Longest pause that a KME can ask for.
const RETRY_AFTER_MAX: Duration = Duration::from_secs(60);

/// The rules of a pool of keys for one peer, over any kind of key `K`.
///
/// It has no I/O, clock or randomness of its own. The owner reports events with their time (`now`, the time since any
/// fixed moment, which never decreases), makes the calls that [`poll`](Self::poll) returns, and reports their results.
/// [`KeyPool`](super::KeyPool) is such an owner.
///
/// - The number of keys that are held or requested is at most the target, and at most a quarter of the KME's
///   `stored_key_count`, but at least one. A count of 0 is ignored, because some KMEs always report 0. Keys that the
///   owner took and keeps ready count if it reports them ([`set_elsewhere`](Self::set_elsewhere)).
/// - A call asks for at most [`batch`](Settings::batch) keys and at most the KME's `max_key_per_request`; 0 is ignored.
///   Before a status was answered, a call asks for one key.
/// - A refill begins when a batch, or a quarter of the target, is missing. It goes on until all missing keys are
///   requested.
/// - The pool does not wait for a call that takes longer than [`overdue`](Settings::overdue): its keys are requested
///   again, and accepted as well if they come.
/// - An empty store halves the batch, because fewer keys may be available. A successful call doubles it again.
/// - After failures the pool waits: 100 ms to 2 s if they cost nothing, 1 s to 30 s if each may have cost keys. The
///   waits double, and are drawn from the upper half of their length. They are longer if the KME asks for that
///   ([`retry_after`](Self::retry_after)).
///
/// ```
/// use std::time::Duration;
/// use etsi_qkd014::pool::{Ask, Core, Settings, Stock};
///
/// let mut settings = Settings::default();
/// settings.target = 4;
/// let mut core = Core::new(settings, || 0);
/// let now = Duration::ZERO;
/// assert_eq!(core.poll(now), Some(Ask::Status));
/// core.on_stock(now, Stock { stored_key_count: 1000, max_key_per_request: 3 });
/// assert_eq!(core.poll(now), Some(Ask::Keys(3)));
/// core.on_keys(now, 3, ["x", "y", "z"]);
/// assert_eq!(core.take(now), Some("x"));
/// ```
pub struct Core<K> {
    settings: Settings,
    jitter: Box<dyn FnMut() -> u8 + Send>,
    /// The keys with the time at which each was requested, the oldest first.
    held: VecDeque<(Duration, K)>,
    in_flight: Vec<Call>,
    /// The number of keys that the owner keeps ready.
    elsewhere: usize,
    /// The number of keys that the next call may ask for.
    size: u32,
    /// True during a refill, which goes on until all missing keys are requested.
    refilling: bool,
    /// The number of failures since the last call that gave keys.
    failures: u32,
    not_before: Duration,
    /// When the last call failed. Calls that were in flight then fail for the same cause.
    failed_at: Option<Duration>,
    held_until: Duration,
    /// Since when keys have been wanted without an answer; for the supply's rate.
    unanswered_since: Option<Duration>,
    /// Since when keys have been wanted and none came.
    dry_since: Option<Duration>,
    stock: Stocktaking,
    supply: Supply,
    counts: Counts,
}

/// A call for keys in flight.
struct Call {
    keys: u32,
    since: Duration,
    /// True if the call takes so long that the pool no longer counts on its keys.
    overdue: bool,
}

#[derive(Default)]
struct Stocktaking {
    due: Duration,
    asked: bool,
    /// True if a status call has ended, with success or without.
    ended: bool,
    last: Option<Stock>,
}

#[derive(Default)]
struct Counts {
    obtained: u64,
    put: u64,
    taken: u64,
    expired: u64,
    unusable: u64,
}

/// The settings of a [`Core`].
#[derive(Clone, Debug)]
#[non_exhaustive]
pub struct Settings {
    /// Number of keys to hold. Default 16.
    pub target: usize,
    /// Most keys that one call asks for, and so most that a call can lose if it is cut off. 0 means 1. Default 8.
    pub batch: u32,
    /// Most calls for keys at a time. 0 means 1. Default 4.
    pub calls: usize,
    /// Age at which a key is dropped, counted from its request. Default ten minutes.
    pub max_age: Duration,
    /// Time after which the pool no longer counts on the keys of a call in flight, so that it requests others in their
    /// place, within [`calls`](Self::calls). Default one second.
    pub overdue: Duration,
}

impl Default for Settings {
    fn default() -> Self {
        let (max_age, overdue) = (Duration::from_secs(600), Duration::from_secs(1));
        Self { target: 16, batch: 8, calls: 4, max_age, overdue }
    }
}

/// A call that the owner of a [`Core`] has to make.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Ask {
    /// `status`. Ends with [`Core::on_stock`] or [`Core::on_failure`].
    Status,
    /// `enc_keys` for this number of keys, without repeats. Ends with [`Core::on_keys`] or [`Core::on_failure`].
    Keys(u32),
}

/// The cost of a failed call.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FailureClass {
    /// The KME did not serve it: it is unreachable, or does not accept this SAE. Costs nothing.
    Unserved,
    /// The KME answered but gave no keys, for example because its store is empty. Costs nothing; fewer keys may be
    /// available.
    Refused,
    /// The answer was cut off or unusable: its keys may be consumed.
    KeysLost,
}

impl<K> Core<K> {
    /// Creates an empty pool. `jitter` returns a random byte for each pause.
    pub fn new(settings: Settings, jitter: impl FnMut() -> u8 + Send + 'static) -> Self {
        let settings =
            Settings { batch: settings.batch.max(1), calls: settings.calls.max(1), ..settings };
        Self {
            size: settings.batch,
            refilling: false,
            settings,
            jitter: Box::new(jitter),
            held: VecDeque::new(),
            in_flight: Vec::new(),
            elsewhere: 0,
            failures: 0,
            not_before: Duration::ZERO,
            failed_at: None,
            held_until: Duration::ZERO,
            unanswered_since: None,
            dry_since: None,
            stock: Stocktaking::default(),
            supply: Supply::default(),
            counts: Counts::default(),
        }
    }

    /// Returns the next call to make now, if any. Repeat this until it returns `None`, after every other event and at
    /// [`poll_timeout`](Self::poll_timeout).
    pub fn poll(&mut self, now: Duration) -> Option<Ask> {
        self.expire(now);
        for call in &mut self.in_flight {
            call.overdue |= now.saturating_sub(call.since) >= self.settings.overdue;
        }
        if !self.stock.asked && now >= self.stock.due {
            self.stock.asked = true;
            return Some(Ask::Status);
        }
        self.refilling = self.refill_is_due();
        if !self.refilling {
            if self.in_flight.is_empty() {
                self.unanswered_since = None;
                self.dry_since = None;
            }
            return None;
        }
        self.unanswered_since.get_or_insert(now);
        self.dry_since.get_or_insert(now);
        if !self.may_call() || now < self.begins() {
            return None;
        }
        let missing = u32::try_from(self.missing()).unwrap_or(u32::MAX);
        let number = self.per_call().min(missing);
        self.in_flight.push(Call { keys: number, since: now, overdue: false });
        Some(Ask::Keys(number))
    }

    /// Returns when [`poll`](Self::poll) may return a call, or keys expire, without another event.
    #[must_use]
    pub fn poll_timeout(&self) -> Option<Duration> {
        let status = (!self.stock.asked).then_some(self.stock.due);
        let refill = (self.refill_is_due() && self.may_call()).then(|| self.begins());
        let expiry = self.held.front().and_then(|(at, _)| at.checked_add(self.settings.max_age));
        let in_time = self.in_flight.iter().filter(|call| !call.overdue);
        let overdue =
            in_time.filter_map(|call| call.since.checked_add(self.settings.overdue)).min();
        let overdue = overdue.filter(|_| self.may_call());
        [status, refill, expiry, overdue].into_iter().flatten().min()
    }

    /// Returns whether [`poll`](Self::poll) would return a call for keys. For an owner that makes its calls on another
    /// thread or task, and wakes it only when there is something to do.
    #[must_use]
    pub fn wants_keys(&self, now: Duration) -> bool {
        self.refill_is_due() && self.may_call() && now >= self.begins()
    }

    /// Handles the answer to a call for `asked` keys. `keys` are the usable ones; none at all counts as
    /// [`FailureClass::KeysLost`].
    pub fn on_keys(&mut self, now: Duration, asked: u32, keys: impl IntoIterator<Item = K>) {
        let since = self.ended(asked).unwrap_or(now);
        // Several calls may end in another order than they began.
        let at = self.place(since);
        let before = self.held.len();
        self.held.extend(keys.into_iter().map(|key| (since, key)));
        let came = self.held.len() - before;
        self.held.make_contiguous()[at..].rotate_right(came);
        self.counts.obtained += came as u64;
        let unusable = u64::from(asked).saturating_sub(came as u64);
        self.counts.unusable += unusable;
        self.refilling |= unusable > 0;
        self.answered(now, came);
        if came == 0 {
            self.back_off(now, since, FailureClass::KeysLost);
            return;
        }
        self.failures = 0;
        self.failed_at = None;
        self.not_before = now;
        self.dry_since = None;
        self.size = self.size.saturating_mul(2).min(self.settings.batch);
    }

    /// Handles a failed call.
    pub fn on_failure(&mut self, now: Duration, ask: Ask, class: FailureClass) {
        match ask {
            Ask::Status => self.status_ended(now),
            Ask::Keys(asked) => {
                let since = self.ended(asked).unwrap_or(now);
                self.refilling = true;
                self.answered(now, 0);
                self.back_off(now, since, class);
                if class == FailureClass::Refused {
                    self.size = (self.size / 2).max(1);
                }
            }
        }
    }

    /// Handles the answer to a status call.
    pub fn on_stock(&mut self, now: Duration, stock: Stock) {
        self.status_ended(now);
        self.stock.last = Some(stock);
        self.supply.stocked(now, stock);
    }

    /// Takes the oldest key. Each key is returned once, and none that is too old.
    pub fn take(&mut self, now: Duration) -> Option<K> {
        self.expire(now);
        let (_, key) = self.held.pop_front()?;
        self.counts.taken += 1;
        Some(key)
    }

    /// Adds a key: one that was taken and not used, or one from another source. It has the age of keys requested at
    /// `since`. The target does not limit it, so the owner has to limit their number.
    pub fn put(&mut self, since: Duration, key: K) {
        let at = self.place(since);
        self.held.insert(at, (since, key));
        self.counts.put += 1;
    }

    /// Sets how many keys to hold from now on. Keys beyond it stay until they are taken or too old.
    pub fn set_target(&mut self, keys: usize) {
        self.settings.target = keys;
    }

    /// Sets how many keys the owner took and keeps ready. They count towards the target as if they were held here.
    pub fn set_elsewhere(&mut self, keys: usize) {
        self.elsewhere = keys;
    }

    /// Returns how many keys should be held or requested: the target that was set, within the KME's stock.
    #[must_use]
    pub fn target(&self) -> usize {
        match self.stock.last {
            Some(Stock { stored_key_count: count @ 1.., .. }) => {
                let quarter = usize::try_from(count / 4).unwrap_or(usize::MAX);
                self.settings.target.min(quarter.max(1))
            }
            _ => self.settings.target,
        }
    }

    /// Handles the KME's request for a pause (see [`Error::Unavailable`](crate::Error::Unavailable)): makes no call for
    /// keys meanwhile, for at most a minute.
    pub fn retry_after(&mut self, now: Duration, asked: Duration) {
        self.hold_until(now.saturating_add(asked.min(RETRY_AFTER_MAX)));
    }

    /// Makes no call for keys before `at`.
    pub fn hold_until(&mut self, at: Duration) {
        self.held_until = self.held_until.max(at);
    }

    /// Drops keys that are too old, and returns their number.
    pub fn expire(&mut self, now: Duration) -> usize {
        let old = |at: &Duration| now.saturating_sub(*at) >= self.settings.max_age;
        let mut dropped = 0;
        while self.held.front().is_some_and(|(at, _)| old(at)) {
            self.held.pop_front();
            dropped += 1;
        }
        self.counts.expired += dropped as u64;
        dropped
    }

    /// Drops every key.
    pub fn clear(&mut self) {
        self.held.clear();
    }

    /// Returns the state of the pool.
    #[must_use]
    pub fn status(&self, now: Duration) -> PoolStatus {
        let fresh = |(at, _): &&(Duration, K)| now.saturating_sub(*at) < self.settings.max_age;
        PoolStatus {
            held: self.held.iter().filter(fresh).count(),
            asked: self.asked() + self.overdue(),
            overdue: self.overdue(),
            elsewhere: self.elsewhere,
            target: self.target(),
            supply: self.supply.rate(),
            waiting: self.dry_since.map(|since| now.saturating_sub(since)),
            failures: self.failures,
            obtained: self.counts.obtained,
            put: self.counts.put,
            taken: self.counts.taken,
            expired: self.counts.expired,
            unusable: self.counts.unusable,
            stock: self.stock.last,
        }
    }

    /// Returns the number of requested keys that the pool counts on.
    fn asked(&self) -> usize {
        let in_time = self.in_flight.iter().filter(|call| !call.overdue);
        in_time.map(|call| call.keys as usize).sum()
    }

    fn overdue(&self) -> usize {
        let overdue = self.in_flight.iter().filter(|call| call.overdue);
        overdue.map(|call| call.keys as usize).sum()
    }

    fn missing(&self) -> usize {
        let here = self.held.len() + self.asked();
        self.target().saturating_sub(here.saturating_add(self.elsewhere))
    }

    /// Returns the index for a key requested at `since`, so that the oldest key stays first.
    fn place(&self, since: Duration) -> usize {
        self.held.iter().rposition(|(held, _)| *held <= since).map_or(0, |i| i + 1)
    }

    fn per_call(&self) -> u32 {
        let most = match self.stock.last {
            None => 1,
            Some(Stock { max_key_per_request: 0, .. }) => u32::MAX,
            Some(stock) => u32::try_from(stock.max_key_per_request).unwrap_or(u32::MAX),
        };
        self.size.min(most)
    }

    fn refill_is_due(&self) -> bool {
        let missing = self.missing();
        let enough = self.target().div_ceil(4).min(self.per_call() as usize);
        missing > 0 && (self.refilling || missing >= enough)
    }

    fn may_call(&self) -> bool {
        self.stock.ended && self.in_flight.len() < self.settings.calls
    }

    fn begins(&self) -> Duration {
        self.not_before.max(self.held_until)
    }

    /// Ends a call for keys, and returns when it began.
    fn ended(&mut self, asked: u32) -> Option<Duration> {
        let call = self.in_flight.iter().position(|call| call.keys == asked)?;
        Some(self.in_flight.remove(call).since)
    }

    fn status_ended(&mut self, now: Duration) {
        self.stock.asked = false;
        self.stock.ended = true;
        self.stock.due = now.saturating_add(STATUS_EVERY);
    }

    fn answered(&mut self, now: Duration, came: usize) {
        let waited = now.saturating_sub(self.unanswered_since.replace(now).unwrap_or(now));
        self.supply.answered(waited, came);
    }

    /// Handles the failure of a call that began at `since`. Calls that were in flight together fail together; they
    /// count as one reason to wait longer.
    fn back_off(&mut self, now: Duration, since: Duration, class: FailureClass) {
        if self.failed_at.is_some_and(|at| since < at) {
            return;
        }
        self.failed_at = Some(now);
        let (first, longest) =
            if class == FailureClass::KeysLost { PAUSE_LOST } else { RETRY_PAUSE };
        let full = (first * (1 << self.failures.min(10))).min(longest);
        let pause = full / 2 + full / 2 * u32::from((self.jitter)()) / 255;
        self.not_before = self.not_before.max(now.saturating_add(pause));
        self.failures = self.failures.saturating_add(1);
    }
}

impl<K> fmt::Debug for Core<K> {
    /// Shows only counts, because `K` is a secret.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Core")
            .field("settings", &self.settings)
            .field("held", &self.held.len())
            .field("asked", &self.asked())
            .finish_non_exhaustive()
    }
}
