//! Publishers that ended: their remaining samples are sent as long as there is progress, then counted as
//! lost. After the end of a publisher only the daemon keeps its ring in memory. Therefore the memory that
//! such rings hold for one peer is bounded.

use std::{collections::HashMap, time::Duration};

use axon_shm::ids::Gid;

/// The samples of an ended publisher are given up after this time without progress.
const PROGRESS_TIMEOUT: Duration = Duration::from_secs(10);
/// Time between two checks.
const CHECK_INTERVAL: Duration = Duration::from_millis(250);
/// The most ended publishers whose samples wait for one peer.
const MAX_PUBLISHERS: usize = 1024;

/// Ended publishers whose samples are not all acknowledged.
#[derive(Debug)]
pub(super) struct PublisherDrains {
    publishers: HashMap<Gid, PublisherDrain>,
    next: Option<Duration>,
    /// Bytes that the samples of all ended publishers may take.
    most: u64,
    /// The number of publishers that ended so far.
    ended: u64,
}

#[derive(Debug)]
struct PublisherDrain {
    /// The publisher's route, until the peer asks for the route anew.
    route: u32,
    /// The flow's progress at the last check, and the time since which it has not changed.
    progress: (u64, u64),
    since: Duration,
    /// The number of publishers that ended before this one.
    number: u64,
    /// Bytes and number of the samples at the first check. Nothing is published afterwards.
    at_first: Option<(u64, u64)>,
}

impl PublisherDrain {
    /// Estimates the bytes of `samples` samples from those of the first check.
    fn bytes_of(&mut self, samples: u64, measure: impl FnOnce() -> u64) -> u64 {
        let (bytes, of) = *self.at_first.get_or_insert_with(|| (measure(), samples.max(1)));
        let left = u128::from(bytes) * u128::from(samples.min(of)) / u128::from(of);
        u64::try_from(left).unwrap_or(u64::MAX)
    }
}

/// The rest of an ended publisher.
#[derive(Debug)]
pub(super) struct DrainedFlow {
    /// The publisher's current route.
    pub(super) route: u32,
    /// Samples that are not acknowledged.
    pub(super) samples: u64,
    /// The flow's progress.
    pub(super) progress: (u64, u64),
    /// True if the flow is excused from making progress, because it waits for others.
    pub(super) is_excused: bool,
}

/// A publisher that is finished: none of its samples is sent any more.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct FinishedPublisher {
    pub(super) publisher: Gid,
    /// The samples that are given up; `None` if all were acknowledged.
    pub(super) given_up: Option<GivenUpSamples>,
}

/// Samples that are given up.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct GivenUpSamples {
    /// The route of the samples.
    pub(super) route: u32,
    /// The number of samples.
    pub(super) samples: u64,
    pub(super) why: GivenUpCause,
}

/// Why samples are given up.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum GivenUpCause {
    /// The samples made no progress.
    Stuck,
    /// The samples and those of publishers that ended later exceed the bound together.
    Bound,
}

impl GivenUpCause {
    /// Logs that samples of a publisher that ended are lost. Each reason has its own line: the log's rate limit is by
    /// line of code.
    pub(super) fn warn(self, topic: &str, publisher: &Gid, samples: u64) {
        match self {
            Self::Stuck => tracing::warn!(
                topic,
                %publisher,
                samples,
                "a publisher ended, and the peer did not take its last samples: they are lost"
            ),
            Self::Bound => tracing::warn!(
                topic,
                %publisher,
                samples,
                publishers = MAX_PUBLISHERS,
                "too many samples of ended publishers wait for the peer: those of the publisher that ended first are \
                 lost (AXON_RELIABLE_QUEUE_MB bounds their bytes)"
            ),
        }
    }
}

/// An ended publisher whose samples are still being sent.
struct DrainingPublisher {
    number: u64,
    publisher: Gid,
    route: u32,
    samples: u64,
    bytes: u64,
}

impl PublisherDrains {
    /// Creates an empty set. `most` bounds the bytes of all samples. One publisher alone may exceed it.
    pub(super) fn new(most: u64) -> Self {
        Self { publishers: HashMap::new(), next: None, most, ended: 0 }
    }

    /// Adds a publisher that ended.
    pub(super) fn add(&mut self, route: u32, publisher: Gid, now: Duration) {
        let (progress, since, number) = ((0, 0), now, self.ended);
        let ending = PublisherDrain { route, progress, since, number, at_first: None };
        self.publishers.entry(publisher).or_insert(ending);
        self.ended += 1;
        self.next = Some(now);
    }

    /// Returns the time of the next check.
    pub(super) fn poll_timeout(&self) -> Option<Duration> {
        self.next.filter(|_| !self.publishers.is_empty())
    }

    /// Checks all publishers if that is due. `left_of` returns the rest of a publisher, given its last known
    /// route. `bytes_of` returns the bytes of the rest. Removes and returns the publishers without a rest,
    /// those without progress, and those that ended first, until the others fit the bound.
    pub(super) fn handle_timeout(
        &mut self,
        now: Duration,
        left_of: impl Fn(u32, &Gid) -> Option<DrainedFlow>,
        bytes_of: impl Fn(u32, &Gid) -> u64,
    ) -> Vec<FinishedPublisher> {
        let (mut over, mut waiting) = (Vec::new(), Vec::new());
        if self.poll_timeout().is_none_or(|due| due > now) {
            return over;
        }
        self.next = Some(now + CHECK_INTERVAL);
        self.publishers.retain(|publisher, ending| {
            let Some(left) = left_of(ending.route, publisher) else {
                over.push(FinishedPublisher { publisher: *publisher, given_up: None });
                return false;
            };
            let DrainedFlow { route, samples, progress, is_excused } = left;
            ending.route = route;
            if progress != ending.progress || is_excused {
                (ending.progress, ending.since) = (progress, now);
            }
            let waits = now.saturating_sub(ending.since) < PROGRESS_TIMEOUT;
            if waits {
                let (number, publisher) = (ending.number, *publisher);
                let bytes = ending.bytes_of(samples, || bytes_of(route, &publisher));
                waiting.push(DrainingPublisher { number, publisher, route, samples, bytes });
            } else {
                let given_up = Some(GivenUpSamples { route, samples, why: GivenUpCause::Stuck });
                over.push(FinishedPublisher { publisher: *publisher, given_up });
            }
            waits
        });
        over.extend(self.give_up_beyond(waiting));
        over
    }

    /// Removes the publishers that ended first, until the others fit the bound. The last publisher stays in
    /// any case.
    fn give_up_beyond(&mut self, mut waiting: Vec<DrainingPublisher>) -> Vec<FinishedPublisher> {
        let mut bytes = waiting.iter().fold(0u64, |sum, of| sum.saturating_add(of.bytes));
        let most = self.most;
        let fits = |bytes: u64, publishers: usize| {
            publishers <= 1 || bytes <= most && publishers <= MAX_PUBLISHERS
        };
        if fits(bytes, waiting.len()) {
            return Vec::new();
        }
        waiting.sort_unstable_by_key(|of| of.number);
        let publishers = waiting.len();
        let mut over = Vec::new();
        for (at, DrainingPublisher { publisher, route, samples, bytes: of, .. }) in
            waiting.into_iter().enumerate()
        {
            if fits(bytes, publishers - at) {
                break;
            }
            bytes = bytes.saturating_sub(of);
            self.publishers.remove(&publisher);
            let given_up = Some(GivenUpSamples { route, samples, why: GivenUpCause::Bound });
            over.push(FinishedPublisher { publisher, given_up });
        }
        over
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const PUBLISHER: Gid = Gid([1; 16]);

    fn endings() -> PublisherDrains {
        PublisherDrains::new(1000)
    }

    /// Returns 0, for tests in which the length of samples does not matter.
    fn no_bytes(_: u32, _: &Gid) -> u64 {
        0
    }

    fn stuck(route: u32, samples: u64) -> Option<GivenUpSamples> {
        Some(GivenUpSamples { route, samples, why: GivenUpCause::Stuck })
    }

    fn left(samples: u64, progress: u64, is_excused: bool) -> Option<DrainedFlow> {
        Some(DrainedFlow { route: 1, samples, progress: (progress, 0), is_excused })
    }

    /// Runs the checks until the publisher is finished; `left` returns its rest at a given time. Returns the
    /// time and the finished publisher.
    fn over_after(
        left: impl Fn(Duration) -> Option<DrainedFlow>,
    ) -> (Duration, Vec<FinishedPublisher>) {
        let mut endings = endings();
        assert_eq!(endings.poll_timeout(), None);
        endings.add(1, PUBLISHER, Duration::ZERO);
        while let Some(now) = endings.poll_timeout() {
            let over = endings.handle_timeout(now, |_, _| left(now), no_bytes);
            if !over.is_empty() {
                assert_eq!(endings.poll_timeout(), None, "it is forgotten");
                return (now, over);
            }
        }
        panic!("a publisher was forgotten");
    }

    #[test]
    fn a_publisher_whose_samples_are_acknowledged_is_over_at_once() {
        let over = FinishedPublisher { publisher: PUBLISHER, given_up: None };
        assert_eq!(over_after(|_| None), (Duration::ZERO, vec![over]));
    }

    #[test]
    fn samples_without_progress_are_given_up() {
        let given_up = FinishedPublisher { publisher: PUBLISHER, given_up: stuck(1, 5) };
        let (at, over) = over_after(|_| left(5, 0, false));
        assert_eq!((at, over), (PROGRESS_TIMEOUT, vec![given_up]));
    }

    #[test]
    fn progress_and_an_excuse_begin_the_patience_again() {
        let last = Duration::from_secs(30);
        let (at, _) = over_after(|now| left(5, now.min(last).as_secs(), false));
        assert_eq!(at, last + PROGRESS_TIMEOUT);
        let (at, _) = over_after(|now| left(5, 0, now <= last));
        assert_eq!(at, last + PROGRESS_TIMEOUT);
    }

    #[test]
    fn a_route_that_was_asked_for_anew_is_remembered() {
        let mut endings = endings();
        endings.add(1, PUBLISHER, Duration::ZERO);
        let moved = |route: u32| DrainedFlow { route, ..left(5, 0, false).unwrap() };
        assert!(endings.handle_timeout(Duration::ZERO, |_, _| Some(moved(2)), no_bytes).is_empty());
        let given_up =
            endings.handle_timeout(PROGRESS_TIMEOUT, |route, _| Some(moved(route)), no_bytes);
        assert_eq!(given_up[0].given_up, stuck(2, 5));
    }

    #[test]
    fn a_publisher_that_ends_twice_has_the_patience_of_its_first_end() {
        let mut endings = endings();
        endings.add(1, PUBLISHER, Duration::ZERO);
        endings.add(1, PUBLISHER, PROGRESS_TIMEOUT / 2);
        assert!(
            endings
                .handle_timeout(PROGRESS_TIMEOUT / 2, |_, _| left(5, 0, false), no_bytes)
                .is_empty()
        );
        assert_eq!(
            endings.handle_timeout(PROGRESS_TIMEOUT, |_, _| left(5, 0, false), no_bytes).len(),
            1
        );
    }

    /// Ends the publishers with these numbers, each with 5 samples in `bytes`. Returns the publishers that
    /// the bound gives up.
    fn given_up_beyond(endings: &mut PublisherDrains, numbers: &[u16], bytes: u64) -> Vec<u8> {
        let gid = |number: u16| {
            let [high, low] = number.to_be_bytes();
            Gid([high, low, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0])
        };
        numbers.iter().for_each(|number| endings.add(1, gid(*number), Duration::ZERO));
        let over = endings.handle_timeout(Duration::ZERO, |_, _| left(5, 0, false), |_, _| bytes);
        let bound = Some(GivenUpSamples { route: 1, samples: 5, why: GivenUpCause::Bound });
        assert!(over.iter().all(|over| over.given_up == bound), "{over:?}");
        over.iter().map(|over| over.publisher.0[1]).collect()
    }

    #[test]
    fn drains_beyond_the_byte_bound_are_given_up_oldest_first() {
        let mut endings = endings();
        assert!(given_up_beyond(&mut endings, &[3, 1], 500).is_empty());
        assert_eq!(given_up_beyond(&mut endings, &[2], 500), [3]);
        // The samples exceed the bound alone, so the last publisher waits alone.
        assert_eq!(given_up_beyond(&mut endings, &[4], 1001), [1, 2]);
        assert!(given_up_beyond(&mut endings, &[], 0).is_empty());
        assert_eq!(given_up_beyond(&mut endings, &[5], 1), [4]);
    }

    #[test]
    fn no_more_publishers_wait_than_the_bound_in_number() {
        let mut endings = endings();
        let most: Vec<u16> = (0..MAX_PUBLISHERS as u16).collect();
        assert!(given_up_beyond(&mut endings, &most, 0).is_empty());
        assert_eq!(given_up_beyond(&mut endings, &[2000, 2001], 0), [0, 1]);
    }

    #[test]
    fn samples_that_arrived_no_longer_count_for_the_bound() {
        let mut endings = endings();
        endings.add(1, PUBLISHER, Duration::ZERO);
        assert!(
            endings
                .handle_timeout(Duration::ZERO, |_, _| left(10, 0, false), |_, _| 1000)
                .is_empty()
        );
        endings.add(1, Gid([2; 16]), CHECK_INTERVAL);
        // One sample of ten is left: 100 bytes.
        let left_of = |_, of: &Gid| left(if *of == PUBLISHER { 1 } else { 10 }, 1, false);
        assert!(endings.handle_timeout(CHECK_INTERVAL, left_of, |_, _| 900).is_empty());
        endings.add(1, Gid([3; 16]), CHECK_INTERVAL);
        let over = endings.handle_timeout(CHECK_INTERVAL, left_of, |_, _| 1);
        assert_eq!(over.len(), 1, "one byte too many");
        assert_eq!((over[0].publisher, over[0].given_up.unwrap().samples), (PUBLISHER, 1));
    }
}
