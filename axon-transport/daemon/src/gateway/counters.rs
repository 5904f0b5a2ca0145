//! The counters of a link for status: what it carried, and what was dropped on the way.

use std::{
    collections::BTreeMap,
    ops::Deref,
    sync::{
        Arc, Mutex,
        atomic::{AtomicU64, Ordering},
    },
};

use axon_transport::internal::text::plain;
use tokio::sync::watch;

use super::keyring::lock;
use crate::gateway::bridge::OTHER_TOPICS;

/// Topics of which losses are noted between two looks: as many as routes may cross each way.
const TOPICS: usize = 2048;
/// The longest name, in bytes, under which losses are noted.
const NAME: usize = 1024;
/// How much of a name is logged, in characters.
const LOGGED: usize = 256;

/// Samples of one topic that were dropped for one cause.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Loss {
    pub(crate) topic: Arc<str>,
    pub(crate) cause: &'static str,
    pub(crate) samples: u64,
}

/// The counters of one peer. Relaxed throughout: they are shown, never acted upon.
#[derive(Debug, Default)]
pub(crate) struct Counters {
    samples_in: AtomicU64,
    bytes_in: AtomicU64,
    samples_out: AtomicU64,
    bytes_out: AtomicU64,
    dropped: Mutex<BTreeMap<&'static str, u64>>,
    /// What was dropped since it was looked at last.
    lost: Mutex<BTreeMap<Arc<str>, BTreeMap<&'static str, u64>>>,
}

/// The counters of one peer, as the hub has them.
#[derive(Debug, Default)]
pub(crate) struct Tally {
    counters: Arc<Counters>,
    counting: watch::Sender<()>,
}

/// The counters of one peer, as a task has them that counts.
#[derive(Clone, Debug)]
pub(crate) struct Counting {
    counters: Arc<Counters>,
    _of: watch::Receiver<()>,
}

impl Tally {
    /// For one more task that counts.
    pub(crate) fn counting(&self) -> Counting {
        Counting { counters: Arc::clone(&self.counters), _of: self.counting.subscribe() }
    }

    /// Waits until nobody counts any more.
    pub(crate) async fn is_final(&self) {
        self.counting.closed().await;
    }
}

impl Deref for Tally {
    type Target = Counters;

    fn deref(&self) -> &Counters {
        &self.counters
    }
}

impl Deref for Counting {
    type Target = Counters;

    fn deref(&self) -> &Counters {
        &self.counters
    }
}

impl Counters {
    /// A sample arrived and was published here.
    pub(crate) fn arrived(&self, bytes: usize) {
        self.samples_in.fetch_add(1, Ordering::Relaxed);
        self.bytes_in.fetch_add(bytes as u64, Ordering::Relaxed);
    }

    /// A sample was handed to QUIC.
    pub(crate) fn sent(&self, bytes: usize) {
        self.samples_out.fetch_add(1, Ordering::Relaxed);
        self.bytes_out.fetch_add(bytes as u64, Ordering::Relaxed);
    }

    /// `count` samples were dropped for `cause`.
    pub(crate) fn dropped(&self, cause: &'static str, count: u64) {
        if count > 0 {
            *lock(&self.dropped).entry(cause).or_default() += count;
        }
    }

    /// As [`dropped`](Self::dropped), of a topic, for [`take_lost`](Self::take_lost).
    pub(crate) fn lost(&self, topic: &Arc<str>, cause: &'static str, count: u64) {
        if count == 0 {
            return;
        }
        self.dropped(cause, count);
        let mut lost = lock(&self.lost);
        let there = lost.contains_key(topic) || lost.len() < TOPICS && topic.len() <= NAME;
        let topic = if there { Arc::clone(topic) } else { OTHER_TOPICS.into() };
        let samples = lost.entry(topic).or_default().entry(cause).or_default();
        *samples = samples.saturating_add(count);
    }

    /// What was lost since the last call, by topic and cause: each sample once.
    pub(crate) fn take_lost(&self) -> Vec<Loss> {
        let lost = std::mem::take(&mut *lock(&self.lost));
        let each = lost.into_iter().flat_map(|(topic, causes)| {
            causes.into_iter().map(move |(cause, samples)| {
                let topic = Arc::clone(&topic);
                Loss { topic, cause, samples }
            })
        });
        each.collect()
    }

    /// Puts the counters into `status`.
    pub(crate) fn fill(&self, status: &mut axon_transport::status::LinkStatus) {
        status.samples_in = self.samples_in.load(Ordering::Relaxed);
        status.bytes_in = self.bytes_in.load(Ordering::Relaxed);
        status.samples_out = self.samples_out.load(Ordering::Relaxed);
        status.bytes_out = self.bytes_out.load(Ordering::Relaxed);
        status.dropped =
            lock(&self.dropped).iter().map(|(cause, n)| ((*cause).to_owned(), *n)).collect();
    }
}

/// Logs what was lost on the way to or from a peer, in one line: the topic that lost most by name.
pub(crate) fn log(losses: &[Loss], peer: &str) {
    let Some((topic, causes, samples, others)) = worst(losses) else { return };
    let topic = plain(topic, LOGGED);
    if others == 0 {
        tracing::warn!(topic, samples, causes, peer, "samples are dropped");
    } else {
        tracing::warn!(topic, samples, causes, others, peer, "samples are dropped");
    }
}

/// The topic that lost most, why, how many samples, and how many were lost of others.
fn worst(losses: &[Loss]) -> Option<(&str, String, u64, u64)> {
    let sum = |losses: &[Loss]| losses.iter().fold(0_u64, |all, l| all.saturating_add(l.samples));
    // Those of a topic are together.
    let topics = losses.chunk_by(|one, other| one.topic == other.topic);
    let worst = topics.max_by_key(|losses| sum(losses))?;
    let causes = worst.iter().map(|loss| format!("{} {}", loss.cause, loss.samples));
    let (samples, causes) = (sum(worst), causes.collect::<Vec<_>>().join(", "));
    Some((&worst.first()?.topic, causes, samples, sum(losses) - samples))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gateway::played::block_on;
    use axon_transport::status::LinkStatus;

    #[test]
    fn a_tally_is_final_once_the_last_task_that_counts_has_ended() {
        block_on(async {
            let tally = Tally::default();
            let (one, other) = (tally.counting(), tally.counting().clone());
            let topic = Arc::<str>::from("/scan");
            let counts = |counting: Counting| {
                let topic = Arc::clone(&topic);
                tokio::spawn(async move {
                    tokio::task::yield_now().await;
                    counting.lost(&topic, "no_link", 1);
                })
            };
            let tasks = [counts(one), counts(other)];
            tally.is_final().await;
            let loss = Loss { topic: Arc::clone(&topic), cause: "no_link", samples: 2 };
            assert_eq!(tally.take_lost(), [loss]);
            for task in tasks {
                task.await.unwrap();
            }
        });
    }

    #[test]
    fn losses_are_counted_by_topic_and_handed_over_once() {
        let counters = Counters::default();
        let [scan, image] = ["/scan", "/image"].map(Arc::<str>::from);
        counters.lost(&scan, "queue", 3);
        counters.lost(&image, "late", 0);
        counters.lost(&image, "late", 1);
        counters.lost(&scan, "queue", 2);
        counters.lost(&scan, "no_key", 1);
        let loss = |topic: &Arc<str>, cause, samples| Loss { topic: topic.clone(), cause, samples };
        let all = [loss(&image, "late", 1), loss(&scan, "no_key", 1), loss(&scan, "queue", 5)];
        let lost = counters.take_lost();
        assert_eq!(lost, all);
        assert_eq!(worst(&lost), Some(("/scan", "no_key 1, queue 5".to_owned(), 6, 1)));
        assert_eq!(worst(&[]), None);
        assert!(counters.take_lost().is_empty());
        let mut status = LinkStatus::default();
        counters.fill(&mut status);
        let of_link = [("late", 1), ("no_key", 1), ("queue", 5)];
        assert_eq!(status.dropped, of_link.map(|(cause, n)| (cause.to_owned(), n)).into());
    }

    #[test]
    fn topics_of_a_peer_that_makes_up_names_take_bounded_memory() {
        let counters = Counters::default();
        counters.lost(&"n".repeat(NAME + 1).into(), "queue", 1);
        for number in 0..2 * TOPICS {
            counters.lost(&number.to_string().into(), "queue", 1);
        }
        let losses = counters.take_lost();
        assert_eq!(losses.len(), TOPICS);
        assert!(losses.iter().all(|loss| loss.topic.len() <= NAME));
        let others = losses.iter().find(|loss| &*loss.topic == OTHER_TOPICS).unwrap();
        assert_eq!(others.samples, TOPICS as u64 + 2);
    }
}
