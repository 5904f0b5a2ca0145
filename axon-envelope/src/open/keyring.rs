//! The keys of an opener: the live keys, the indexes opened under each, and when a key is retired.

use alloc::collections::{BTreeMap, VecDeque};
use core::time::Duration;

use super::error::RefusalCause;
use super::{AddKeyError, Expired, Limits, RetireError, RetireOutcome};
use crate::aead::Aead;
use crate::channel::KeyId;
use crate::key::KmeKey;
use crate::mask::IndexMask;

/// Keys by key_ID. One map holds live keys and the key_IDs of retired ones, so that one look-up
/// answers for both.
pub(super) struct Keyring<A> {
    keys: BTreeMap<KeyId, Slot<A>>,
    /// Retired key_IDs, oldest first. Those beyond the limit are removed from the map.
    retired: VecDeque<KeyId>,
    live: usize,
    /// Messages that RETIRE reported as used and that had not opened when their key was retired.
    missing: usize,
    limits: Limits,
}

enum Slot<A> {
    Live(Live<A>),
    Retired,
}

/// A key that can still open messages.
pub(super) struct Live<A> {
    pub(super) aead: A,
    id: KeyId,
    /// The key itself, kept until the first message opens, for a caller that moves the key to
    /// another connection.
    key: Option<KmeKey>,
    opened: IndexMask,
    first_opened: Option<Duration>,
    retire: Option<Retire>,
}

/// A RETIRE that arrived while messages could still arrive.
struct Retire {
    at: Duration,
    used: IndexMask,
    reliable: IndexMask,
}

impl<A: Aead> Live<A> {
    /// Returns the indexes that can still open at `now`.
    fn open_indexes(&self, now: Duration, limits: &Limits) -> IndexMask {
        let expected = match (&self.retire, self.first_opened) {
            (Some(retire), _) if now.saturating_sub(retire.at) < limits.best_effort_grace => {
                retire.used
            }
            // A stream that was stopped never delivers its message. Without this limit its key
            // would be kept forever.
            (Some(retire), _) if now.saturating_sub(retire.at) >= limits.max_age => {
                IndexMask::EMPTY
            }
            (Some(retire), _) => retire.reliable,
            (None, Some(first)) if now.saturating_sub(first) >= limits.max_age => IndexMask::EMPTY,
            (None, _) => IndexMask::ALL,
        };
        expected.minus(self.opened)
    }

    /// Returns how many messages were sealed according to RETIRE and have not opened.
    fn missing(&self) -> usize {
        self.retire.as_ref().map_or(0, |retire| retire.used.minus(self.opened).len())
    }

    /// Checks whether message `index` may open at `now` if its tag is valid.
    fn check(&self, index: u8, now: Duration, limits: &Limits) -> Result<(), RefusalCause> {
        if self.opened.contains(index) {
            Err(RefusalCause::Replayed)
        } else if !self.open_indexes(now, limits).contains(index) {
            Err(RefusalCause::Retired)
        } else {
            Ok(())
        }
    }
}

impl<A: Aead> Keyring<A> {
    pub(super) fn new(limits: Limits) -> Self {
        Self { keys: BTreeMap::new(), retired: VecDeque::new(), live: 0, missing: 0, limits }
    }

    pub(super) fn add(&mut self, id: KeyId, key: KmeKey, aead: A) -> Result<(), AddKeyError> {
        match self.keys.get(id.as_bytes()) {
            Some(Slot::Live(_)) => return Err(AddKeyError::Held),
            Some(Slot::Retired) => return Err(AddKeyError::Retired),
            None => {}
        }
        if self.live >= self.limits.max_keys {
            return Err(AddKeyError::Full(self.limits.max_keys));
        }
        // This is space for every live key to retire, so that opening a tenth message allocates
        // nothing.
        self.retired.reserve(self.live + 1);
        let live = Live {
            aead,
            id: id.clone(),
            key: Some(key),
            opened: IndexMask::EMPTY,
            first_opened: None,
            retire: None,
        };
        self.keys.insert(id, Slot::Live(live));
        self.live += 1;
        Ok(())
    }

    /// Returns the key that an envelope names, if that index may open now.
    pub(super) fn select(
        &self,
        id: &[u8],
        index: u8,
        now: Duration,
    ) -> Result<&Live<A>, RefusalCause> {
        match self.keys.get(id) {
            None => Err(RefusalCause::UnknownKey),
            Some(Slot::Retired) => Err(RefusalCause::Retired),
            Some(Slot::Live(live)) => live.check(index, now, &self.limits).map(|()| live),
        }
    }

    /// Records that message `index` has opened, and retires the key if no index can open any more.
    pub(super) fn opened(&mut self, id: &[u8], index: u8, now: Duration) {
        let Some(Slot::Live(live)) = self.keys.get_mut(id) else { return };
        live.opened.insert(index);
        live.key = None;
        live.first_opened.get_or_insert(now);
        self.retire_if_done(id, now);
    }

    pub(super) fn retire(
        &mut self,
        now: Duration,
        id: &[u8],
        used: IndexMask,
        reliable: IndexMask,
    ) -> Result<RetireOutcome, RetireError> {
        if !reliable.is_subset(used) {
            return Err(RetireError::Masks { used, reliable });
        }
        // A key that is too old is retired here, even if `expire` was not called since.
        self.retire_if_done(id, now);
        let Some(Slot::Live(live)) = self.keys.get_mut(id) else {
            return Ok(RetireOutcome::NotHeld);
        };
        if !live.opened.is_subset(used) {
            return Err(RetireError::OpenedUnused { used, opened: live.opened });
        }
        // The first RETIRE applies. A repeated one must not restart the grace time.
        live.retire.get_or_insert(Retire { at: now, used, reliable });
        let waiting = live.open_indexes(now, &self.limits);
        self.retire_if_done(id, now);
        Ok(if waiting.is_empty() { RetireOutcome::Erased } else { RetireOutcome::Waiting(waiting) })
    }

    pub(super) fn expire(&mut self, now: Duration) -> Expired {
        let mut expired = Expired::default();
        for slot in self.keys.values_mut() {
            let Slot::Live(live) = slot else { continue };
            if !live.open_indexes(now, &self.limits).is_empty() {
                continue;
            }
            expired.keys += 1;
            self.missing += live.missing();
            self.retired.push_back(live.id.clone());
            self.live -= 1;
            *slot = Slot::Retired;
        }
        self.forget_oldest();
        expired.messages_missing = core::mem::take(&mut self.missing);
        expired
    }

    /// Removes and returns a key under which nothing has opened.
    pub(super) fn take_unused(&mut self, id: &[u8]) -> Option<(KeyId, KmeKey)> {
        let Some(Slot::Live(live)) = self.keys.get_mut(id) else { return None };
        if live.retire.is_some() {
            return None;
        }
        let key = live.key.take()?;
        let id = live.id.clone();
        self.keys.remove(id.as_bytes());
        self.live -= 1;
        Some((id, key))
    }

    pub(super) fn unused(&self) -> impl Iterator<Item = &KeyId> {
        self.keys.values().filter_map(|slot| match slot {
            Slot::Live(live) if live.key.is_some() && live.retire.is_none() => Some(&live.id),
            _ => None,
        })
    }

    pub(super) fn contains(&self, id: &[u8]) -> bool {
        matches!(self.keys.get(id), Some(Slot::Live(_)))
    }

    pub(super) fn len(&self) -> usize {
        self.live
    }

    pub(super) fn limits(&self) -> &Limits {
        &self.limits
    }

    fn retire_if_done(&mut self, id: &[u8], now: Duration) {
        let Some(slot) = self.keys.get_mut(id) else { return };
        let Slot::Live(live) = slot else { return };
        if live.open_indexes(now, &self.limits).is_empty() {
            self.missing += live.missing();
            self.retired.push_back(live.id.clone());
            self.live -= 1;
            *slot = Slot::Retired;
            self.forget_oldest();
        }
    }

    fn forget_oldest(&mut self) {
        while self.retired.len() > self.limits.retired_memory {
            if let Some(oldest) = self.retired.pop_front() {
                self.keys.remove(oldest.as_bytes());
            }
        }
    }
}
