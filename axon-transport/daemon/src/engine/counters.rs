//! The counters of a link for status: what it carried, and what was dropped on the way.

use std::{
    cell::{Cell, RefCell},
    collections::BTreeMap,
    sync::Arc,
};

use axon_transport::internal::text::plain;

use crate::bridge::OTHER_TOPICS;

/// Topics of which losses are noted between two looks. Losses of further topics are noted together.
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

/// The counters of one peer.
#[derive(Debug, Default)]
pub(crate) struct Counters {
    samples_in: Cell<u64>,
    bytes_in: Cell<u64>,
    samples_out: Cell<u64>,
    bytes_out: Cell<u64>,
    dropped: RefCell<BTreeMap<&'static str, u64>>,
    /// What was dropped since it was looked at last.
    lost: RefCell<BTreeMap<Arc<str>, BTreeMap<&'static str, u64>>>,
}

impl Counters {
    /// A sample arrived and was published here.
    pub(crate) fn arrived(&self, bytes: usize) {
        self.samples_in.set(self.samples_in.get() + 1);
        self.bytes_in.set(self.bytes_in.get() + bytes as u64);
    }

    /// A sample was handed to QUIC.
    pub(crate) fn sent(&self, bytes: usize) {
        self.samples_out.set(self.samples_out.get() + 1);
        self.bytes_out.set(self.bytes_out.get() + bytes as u64);
    }

    /// `count` samples were dropped for `cause`.
    pub(crate) fn dropped(&self, cause: &'static str, count: u64) {
        if count > 0 {
            *self.dropped.borrow_mut().entry(cause).or_default() += count;
        }
    }

    /// As [`dropped`](Self::dropped), of a topic, for [`take_lost`](Self::take_lost).
    pub(crate) fn lost(&self, topic: &Arc<str>, cause: &'static str, count: u64) {
        if count == 0 {
            return;
        }
        self.dropped(cause, count);
        let mut lost = self.lost.borrow_mut();
        let there = lost.contains_key(topic) || lost.len() < TOPICS && topic.len() <= NAME;
        let topic = if there { Arc::clone(topic) } else { OTHER_TOPICS.into() };
        let samples = lost.entry(topic).or_default().entry(cause).or_default();
        *samples = samples.saturating_add(count);
    }

    /// What was lost since the last call, by topic and cause: each sample once.
    pub(crate) fn take_lost(&self) -> Vec<Loss> {
        let lost = self.lost.take();
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
        status.samples_in = self.samples_in.get();
        status.bytes_in = self.bytes_in.get();
        status.samples_out = self.samples_out.get();
        status.bytes_out = self.bytes_out.get();
        status.dropped =
            self.dropped.borrow().iter().map(|(cause, n)| ((*cause).to_owned(), *n)).collect();
    }
}

/// Logs what was lost on the way to or from a peer, in one line: the topic that lost most by name. What `max_hz` leaves
/// out is what its author wants.
pub(crate) fn log(losses: &[Loss], peer: &str) {
    let unwanted: Vec<_> = losses.iter().filter(|loss| loss.cause != "max_hz").cloned().collect();
    let losses = &unwanted;
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
    use axon_transport::status::LinkStatus;

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
