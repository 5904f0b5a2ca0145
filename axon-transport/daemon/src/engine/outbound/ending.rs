//! Publishers that ended: the samples that they left are sent as long as there is progress, then counted as lost.
//! After its publisher's end only the daemon holds a ring in memory. So what these rings hold for one peer is bounded.

use std::{collections::HashMap, time::Duration};

use axon_shm::ids::Gid;

/// The samples of a publisher that ended are given up after this time without progress.
const PATIENCE: Duration = Duration::from_secs(10);
/// Between two looks.
const LOOK: Duration = Duration::from_millis(250);
/// Ended publishers whose samples wait for one peer.
const MAX_PUBLISHERS: usize = 1024;

/// Publishers that ended and whose samples are not all acknowledged.
#[derive(Debug)]
pub(super) struct Endings {
    publishers: HashMap<Gid, Ending>,
    next: Option<Duration>,
    /// Bytes that the samples of all of them may take.
    most: u64,
    /// Publishers that ended so far.
    ended: u64,
}

#[derive(Debug)]
struct Ending {
    /// Its route, until the peer asks for that anew.
    route: u32,
    /// The flow's progress at the last look, and since when it has been the same.
    progress: (u64, u64),
    since: Duration,
    /// Publishers that ended before it.
    number: u64,
    /// Bytes and number of its samples at the first look. Nothing is published after it.
    at_first: Option<(u64, u64)>,
}

impl Ending {
    /// Bytes that so many samples take, estimated by those of the first look.
    fn bytes_of(&mut self, samples: u64, measure: impl FnOnce() -> u64) -> u64 {
        let (bytes, of) = *self.at_first.get_or_insert_with(|| (measure(), samples.max(1)));
        let left = u128::from(bytes) * u128::from(samples.min(of)) / u128::from(of);
        u64::try_from(left).unwrap_or(u64::MAX)
    }
}

/// What is left of a publisher that ended.
#[derive(Debug)]
pub(super) struct EndedFlow {
    /// Its route now.
    pub(super) route: u32,
    /// Samples that are not acknowledged.
    pub(super) samples: u64,
    /// The flow's progress.
    pub(super) progress: (u64, u64),
    /// Whether the flow is excused: it waits for others.
    pub(super) is_excused: bool,
}

/// A publisher of which nothing is sent any more.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct FinishedPublisher {
    pub(super) publisher: Gid,
    /// What is given up; `None`: nothing was left.
    pub(super) given_up: Option<GivenUpSamples>,
}

/// Samples that are given up.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct GivenUpSamples {
    /// Their route.
    pub(super) route: u32,
    /// How many.
    pub(super) samples: u64,
    pub(super) why: GivenUpCause,
}

/// Why samples are given up.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum GivenUpCause {
    /// They made no progress.
    Stuck,
    /// Together with those of publishers that ended later they exceed the bound.
    Bound,
}

impl GivenUpCause {
    /// Logs that samples of a publisher that ended are lost. Each reason has its own line: the log's rate limit is by line
    /// of code.
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

/// A publisher whose samples are sent on.
struct DrainingPublisher {
    number: u64,
    publisher: Gid,
    route: u32,
    samples: u64,
    bytes: u64,
}

impl Endings {
    /// No publisher ended. The samples of those that end may take `most` bytes. Those of one may take more.
    pub(super) fn new(most: u64) -> Self {
        Self { publishers: HashMap::new(), next: None, most, ended: 0 }
    }

    /// A publisher ended.
    pub(super) fn add(&mut self, route: u32, publisher: Gid, now: Duration) {
        let (progress, since, number) = ((0, 0), now, self.ended);
        let ending = Ending { route, progress, since, number, at_first: None };
        self.publishers.entry(publisher).or_insert(ending);
        self.ended += 1;
        self.next = Some(now);
    }

    /// When to look again.
    pub(super) fn poll_timeout(&self) -> Option<Duration> {
        self.next.filter(|_| !self.publishers.is_empty())
    }

    /// Looks at all of them, if that is due. `left_of` says what is left of a publisher, whose route was the one that
    /// it is given, and `bytes_of` how many bytes that takes. Returns, and forgets, those of which nothing is left, whose
    /// samples make no progress, and the first of those that exceed the bound together.
    pub(super) fn handle_timeout(
        &mut self,
        now: Duration,
        left_of: impl Fn(u32, &Gid) -> Option<EndedFlow>,
        bytes_of: impl Fn(u32, &Gid) -> u64,
    ) -> Vec<FinishedPublisher> {
        let (mut over, mut waiting) = (Vec::new(), Vec::new());
        if self.poll_timeout().is_none_or(|due| due > now) {
            return over;
        }
        self.next = Some(now + LOOK);
        self.publishers.retain(|publisher, ending| {
            let Some(left) = left_of(ending.route, publisher) else {
                over.push(FinishedPublisher { publisher: *publisher, given_up: None });
                return false;
            };
            let EndedFlow { route, samples, progress, is_excused } = left;
            ending.route = route;
            if progress != ending.progress || is_excused {
                (ending.progress, ending.since) = (progress, now);
            }
            let waits = now.saturating_sub(ending.since) < PATIENCE;
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

    /// Forgets the publishers that ended first, until the others fit the bound. The last one stays.
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

    fn endings() -> Endings {
        Endings::new(1000)
    }

    /// Nothing is known of the length of samples.
    fn no_bytes(_: u32, _: &Gid) -> u64 {
        0
    }

    fn stuck(route: u32, samples: u64) -> Option<GivenUpSamples> {
        Some(GivenUpSamples { route, samples, why: GivenUpCause::Stuck })
    }

    fn left(samples: u64, progress: u64, is_excused: bool) -> Option<EndedFlow> {
        Some(EndedFlow { route: 1, samples, progress: (progress, 0), is_excused })
    }

    /// Looks until the publisher is over, `left` after the given time being what is left. Returns when it is over.
    fn over_after(
        left: impl Fn(Duration) -> Option<EndedFlow>,
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
        assert_eq!((at, over), (PATIENCE, vec![given_up]));
    }

    #[test]
    fn progress_and_an_excuse_begin_the_patience_again() {
        let last = Duration::from_secs(30);
        let (at, _) = over_after(|now| left(5, now.min(last).as_secs(), false));
        assert_eq!(at, last + PATIENCE);
        let (at, _) = over_after(|now| left(5, 0, now <= last));
        assert_eq!(at, last + PATIENCE);
    }

    #[test]
    fn a_route_that_was_asked_for_anew_is_remembered() {
        let mut endings = endings();
        endings.add(1, PUBLISHER, Duration::ZERO);
        let moved = |route: u32| EndedFlow { route, ..left(5, 0, false).unwrap() };
        assert!(endings.handle_timeout(Duration::ZERO, |_, _| Some(moved(2)), no_bytes).is_empty());
        let given_up = endings.handle_timeout(PATIENCE, |route, _| Some(moved(route)), no_bytes);
        assert_eq!(given_up[0].given_up, stuck(2, 5));
    }

    #[test]
    fn a_publisher_that_ends_twice_has_the_patience_of_its_first_end() {
        let mut endings = endings();
        endings.add(1, PUBLISHER, Duration::ZERO);
        endings.add(1, PUBLISHER, PATIENCE / 2);
        assert!(
            endings.handle_timeout(PATIENCE / 2, |_, _| left(5, 0, false), no_bytes).is_empty()
        );
        assert_eq!(endings.handle_timeout(PATIENCE, |_, _| left(5, 0, false), no_bytes).len(), 1);
    }

    /// The publishers with these numbers end, each with 5 samples in `bytes`. Returns those that the bound gives up.
    fn given_up_beyond(endings: &mut Endings, numbers: &[u16], bytes: u64) -> Vec<u8> {
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
    fn what_exceeds_the_bound_in_bytes_is_given_up_from_the_first_that_ended() {
        let mut endings = endings();
        assert!(given_up_beyond(&mut endings, &[3, 1], 500).is_empty());
        assert_eq!(given_up_beyond(&mut endings, &[2], 500), [3]);
        // Longer than the bound: the last publisher waits alone.
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
        endings.add(1, Gid([2; 16]), LOOK);
        // One of ten is left: 100 bytes.
        let left_of = |_, of: &Gid| left(if *of == PUBLISHER { 1 } else { 10 }, 1, false);
        assert!(endings.handle_timeout(LOOK, left_of, |_, _| 900).is_empty());
        endings.add(1, Gid([3; 16]), LOOK);
        let over = endings.handle_timeout(LOOK, left_of, |_, _| 1);
        assert_eq!(over.len(), 1, "one byte too many");
        assert_eq!((over[0].publisher, over[0].given_up.unwrap().samples), (PUBLISHER, 1));
    }
}
