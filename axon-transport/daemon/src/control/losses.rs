//! Counts samples that did not reach their destination, by topic and cause. The control plane and the threads of
//! relayed sessions count them.

use std::{
    collections::BTreeMap,
    sync::{Mutex, PoisonError},
};

use crate::bridge::OTHER_TOPICS;

/// Maximum number of topics that are counted separately.
const MAX_TOPICS: usize = 1024;

pub(super) type ByTopic = BTreeMap<String, BTreeMap<&'static str, u64>>;

/// The counts of lost samples. Thread-safe.
#[derive(Debug, Default)]
pub(crate) struct Losses(Mutex<ByTopic>);

impl Losses {
    /// Counts lost samples of a topic.
    pub(super) fn add(&self, topic: &str, cause: &'static str, samples: u64) {
        let mut all = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let there = all.contains_key(topic) || all.len() < MAX_TOPICS;
        let topic = if there { topic } else { OTHER_TOPICS };
        let count = all.entry(topic.to_owned()).or_default().entry(cause).or_default();
        *count = count.saturating_add(samples);
    }

    /// Returns all counts.
    pub(super) fn all(&self) -> ByTopic {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn topics_beyond_the_limit_are_counted_together() {
        let losses = Losses::default();
        for number in 0..MAX_TOPICS + 10 {
            losses.add(&format!("/{number}"), "ring", 1);
        }
        losses.add("/0", "ring", u64::MAX);
        let all = losses.all();
        assert_eq!(all.len(), MAX_TOPICS + 1);
        assert_eq!((all[OTHER_TOPICS]["ring"], all["/0"]["ring"]), (10, u64::MAX));
    }
}
