//! The counters of a link for status: samples that it carried, and samples that were dropped.

use std::{
    cell::{Cell, RefCell},
    cmp::Reverse,
    collections::BTreeMap,
    sync::Arc,
};

use axon_transport::{internal::text::plain, status::CompressedStatus};

use crate::bridge::OTHER_TOPICS;

/// Number of topics whose losses are counted separately between two reports. Losses of further topics are counted
/// together.
const TOPICS: usize = 2048;
/// The longest name, in bytes, under which losses are noted.
const NAME: usize = 1024;
/// Maximum number of characters of a logged name.
const LOGGED: usize = 256;
/// Maximum number of topics that one line of the log names.
const NAMED: usize = 20;

/// Samples of one topic that were dropped for one cause.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct TopicLoss {
    pub(crate) topic: Arc<str>,
    pub(crate) cause: &'static str,
    pub(crate) samples: u64,
}

/// The counters of one peer.
#[derive(Debug, Default)]
pub(crate) struct Counters {
    samples_in: Cell<u64>,
    bytes_in: Cell<u64>,
    /// Samples that came over the second path first.
    copies_in: Cell<u64>,
    samples_out: Cell<u64>,
    bytes_out: Cell<u64>,
    compressed: Cell<CompressedStatus>,
    dropped: RefCell<BTreeMap<&'static str, u64>>,
    /// Samples that were dropped since the last report, by topic and cause.
    lost: RefCell<BTreeMap<Arc<str>, BTreeMap<&'static str, u64>>>,
}

impl Counters {
    /// Records that a sample arrived and was published here.
    pub(crate) fn arrived(&self, bytes: usize) {
        self.samples_in.set(self.samples_in.get() + 1);
        self.bytes_in.set(self.bytes_in.get() + bytes as u64);
    }

    /// Counts a sample that arrived over the second path first.
    pub(crate) fn arrived_as_copy(&self, bytes: usize) {
        self.arrived(bytes);
        self.copies_in.set(self.copies_in.get() + 1);
    }

    /// Records that a sample was handed to QUIC.
    pub(crate) fn sent(&self, bytes: usize) {
        self.samples_out.set(self.samples_out.get() + 1);
        self.bytes_out.set(self.bytes_out.get() + bytes as u64);
    }

    /// Records that a sample of `length` bytes was compressed to `frame` bytes.
    pub(crate) fn compressed(&self, length: usize, frame: usize) {
        let mut compressed = self.compressed.get();
        compressed.samples += 1;
        compressed.bytes += length as u64;
        compressed.bytes_sent += frame as u64;
        self.compressed.set(compressed);
    }

    /// Counts samples of the link that were dropped for `cause`.
    pub(crate) fn dropped(&self, cause: &'static str, count: u64) {
        if count > 0 {
            *self.dropped.borrow_mut().entry(cause).or_default() += count;
        }
    }

    /// Counts as [`dropped`](Self::dropped) does, and for the topic as well, which [`take_lost`](Self::take_lost) reports.
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

    /// Returns the samples lost since the last call, by topic and cause. Each sample counts once.
    pub(crate) fn take_lost(&self) -> Vec<TopicLoss> {
        let lost = self.lost.take();
        let each = lost.into_iter().flat_map(|(topic, causes)| {
            causes.into_iter().map(move |(cause, samples)| {
                let topic = Arc::clone(&topic);
                TopicLoss { topic, cause, samples }
            })
        });
        each.collect()
    }

    /// Puts the counters into `status`.
    pub(crate) fn fill(&self, status: &mut axon_transport::status::LinkStatus) {
        status.samples_in = self.samples_in.get();
        status.copies_in = self.copies_in.get();
        status.bytes_in = self.bytes_in.get();
        status.samples_out = self.samples_out.get();
        status.bytes_out = self.bytes_out.get();
        status.compressed = self.compressed.get();
        status.dropped =
            self.dropped.borrow().iter().map(|(cause, n)| ((*cause).to_owned(), *n)).collect();
    }
}

/// Returns the samples by topic as text for one line of the log: the names of the topics with the most samples, and the
/// number of the other topics. One line for each topic would not work, because the log's rate limit counts by line of
/// code.
pub(crate) fn by_topic<'a>(samples: impl IntoIterator<Item = (&'a str, u64)>) -> (String, u64) {
    let mut topics = BTreeMap::<_, u64>::new();
    for (topic, samples) in samples {
        let of_topic = topics.entry(topic).or_default();
        *of_topic = of_topic.saturating_add(samples);
    }
    let mut topics: Vec<_> = topics.into_iter().collect();
    topics.sort_by_key(|(_, samples)| Reverse(*samples));
    let sum = |topics: &[(_, u64)]| topics.iter().fold(0_u64, |all, of| all.saturating_add(of.1));
    let (named, others) = topics.split_at(topics.len().min(NAMED));
    let named = named.iter().map(|(topic, samples)| format!("{} {samples}", plain(topic, LOGGED)));
    let mut text = named.collect::<Vec<_>>().join(", ");
    if !others.is_empty() {
        text += &format!(", {} of {} other topics", sum(others), others.len());
    }
    (text, sum(&topics))
}

/// Logs the losses on the way to or from a peer in one line, which names the topic with the most losses. Samples that
/// `max_hz` leaves out are intended, so they are not logged.
pub(crate) fn log(losses: &[TopicLoss], peer: &str) {
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

/// Returns the topic with the most losses, the causes, the number of its lost samples, and the number of samples lost
/// of other topics.
fn worst(losses: &[TopicLoss]) -> Option<(&str, String, u64, u64)> {
    let sum =
        |losses: &[TopicLoss]| losses.iter().fold(0_u64, |all, l| all.saturating_add(l.samples));
    // The losses of one topic are adjacent.
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
        let loss =
            |topic: &Arc<str>, cause, samples| TopicLoss { topic: topic.clone(), cause, samples };
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
    fn a_line_names_the_topics_with_most_samples_and_counts_the_others() {
        let names: Vec<_> = (1..=50).map(|number| format!("/t{number}")).collect();
        let (text, samples) = by_topic(names.iter().map(|name| (&**name, 3)).chain([("/t50", 2)]));
        assert_eq!(samples, 152);
        let parts: Vec<_> = text.split(", ").collect();
        assert_eq!((parts.len(), parts[0]), (NAMED + 1, "/t50 5"));
        assert!(parts[1..NAMED].iter().all(|part| part.ends_with(" 3")), "{text}");
        assert_eq!(parts[NAMED], "90 of 30 other topics");
        assert_eq!(by_topic([("/a", 1), ("/b", 2)]), ("/b 2, /a 1".to_owned(), 3));
        let long = "n".repeat(NAME);
        assert!(by_topic([(&*long, 1)]).0.len() < 2 * LOGGED);
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
