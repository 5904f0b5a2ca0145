//! A bounded set of key_IDs and identities that were seen. A new entry replaces the oldest one.

use std::{
    collections::{HashMap, VecDeque},
    time::Duration,
};

use sha2::{Digest, Sha256};

/// The SHA-256 of an identity or key_ID, which represents it in a [`SeenSet`].
pub(super) type Fingerprint = [u8; 32];

pub(super) fn fingerprint(bytes: &[u8]) -> Fingerprint {
    Sha256::digest(bytes).into()
}

/// The last `capacity` entries that were seen, each with its time.
pub(super) struct SeenSet<K> {
    capacity: usize,
    seen: HashMap<K, Duration>,
    order: VecDeque<(Duration, K)>,
}

impl<K: Clone + Eq + std::hash::Hash> SeenSet<K> {
    pub(super) fn new(capacity: usize) -> Self {
        Self { capacity, seen: HashMap::new(), order: VecDeque::new() }
    }

    /// Adds `key` with the time `now`, which replaces an earlier time. Returns false if `key` was remembered already.
    pub(super) fn insert(&mut self, now: Duration, key: K) -> bool {
        let new = self.seen.insert(key.clone(), now).is_none();
        if !new {
            self.order.retain(|(_, k)| *k != key);
        } else if self.seen.len() > self.capacity
            && let Some((_, oldest)) = self.order.pop_front()
        {
            self.seen.remove(&oldest);
        }
        self.order.push_back((now, key));
        new
    }

    pub(super) fn contains(&self, key: &K) -> bool {
        self.seen.contains_key(key)
    }

    /// Returns when `key` was last seen, if it is remembered.
    pub(super) fn last_seen(&self, key: &K) -> Option<Duration> {
        self.seen.get(key).copied()
    }

    /// Forgets the entries that were last seen before `limit`.
    pub(super) fn forget_before(&mut self, limit: Duration) {
        while self.order.front().is_some_and(|(at, _)| *at < limit) {
            if let Some((_, key)) = self.order.pop_front() {
                self.seen.remove(&key);
            }
        }
    }

    #[cfg(test)]
    pub(super) fn len(&self) -> usize {
        assert_eq!(self.seen.len(), self.order.len());
        self.seen.len()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const fn s(secs: u64) -> Duration {
        Duration::from_secs(secs)
    }

    #[test]
    fn the_oldest_makes_room() {
        let mut memory = SeenSet::new(3);
        for i in 0..10 {
            assert!(memory.insert(s(i), i));
            assert!(memory.len() <= 3);
        }
        assert!(!memory.contains(&6) && memory.contains(&7));
        assert!(!memory.insert(s(10), 7), "known already");
        assert!(memory.insert(s(11), 10));
        assert!(memory.contains(&7) && !memory.contains(&8), "seen again is young again");
        memory.forget_before(s(11));
        assert_eq!(memory.len(), 1);
    }
}
