//! Publishers that ended: the samples that they left are sent as long as there is progress, then counted as lost.

use std::{collections::HashMap, time::Duration};

use axon_shm::ids::Gid;

/// The samples of a publisher that ended are given up after this time without progress.
const PATIENCE: Duration = Duration::from_secs(10);
/// Between two looks.
const LOOK: Duration = Duration::from_millis(250);

/// Publishers that ended and whose samples are not all acknowledged.
#[derive(Debug, Default)]
pub(super) struct Endings {
    publishers: HashMap<Gid, Ending>,
    next: Option<Duration>,
}

#[derive(Debug)]
struct Ending {
    /// Its route, until the peer asks for that anew.
    route: u32,
    /// The flow's progress at the last look, and since when it has been the same.
    progress: (u64, u64),
    since: Duration,
}

/// What is left of a publisher that ended.
#[derive(Debug)]
pub(super) struct Left {
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
pub(super) struct Over {
    pub(super) publisher: Gid,
    /// The route and the number of samples that are given up; `None`: nothing was left.
    pub(super) given_up: Option<(u32, u64)>,
}

impl Endings {
    /// A publisher ended.
    pub(super) fn add(&mut self, route: u32, publisher: Gid, now: Duration) {
        let ending = Ending { route, progress: (0, 0), since: now };
        self.publishers.entry(publisher).or_insert(ending);
        self.next = Some(now);
    }

    /// When to look again.
    pub(super) fn poll_timeout(&self) -> Option<Duration> {
        self.next.filter(|_| !self.publishers.is_empty())
    }

    /// Looks at all of them, if that is due. `left_of` says what is left of a publisher, whose route was the one that
    /// it is given. Returns, and forgets, those of which nothing is left, or whose samples make no progress.
    pub(super) fn handle_timeout(
        &mut self,
        now: Duration,
        left_of: impl Fn(u32, &Gid) -> Option<Left>,
    ) -> Vec<Over> {
        let mut over = Vec::new();
        if self.poll_timeout().is_none_or(|due| due > now) {
            return over;
        }
        self.next = Some(now + LOOK);
        self.publishers.retain(|publisher, ending| {
            let Some(left) = left_of(ending.route, publisher) else {
                over.push(Over { publisher: *publisher, given_up: None });
                return false;
            };
            ending.route = left.route;
            if left.progress != ending.progress || left.is_excused {
                (ending.progress, ending.since) = (left.progress, now);
            }
            let waits = now.saturating_sub(ending.since) < PATIENCE;
            if !waits {
                let given_up = Some((left.route, left.samples));
                over.push(Over { publisher: *publisher, given_up });
            }
            waits
        });
        over
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const PUBLISHER: Gid = Gid([1; 16]);

    fn left(samples: u64, progress: u64, is_excused: bool) -> Option<Left> {
        Some(Left { route: 1, samples, progress: (progress, 0), is_excused })
    }

    /// Looks until the publisher is over, `left` after the given time being what is left. Returns when it is over.
    fn over_after(left: impl Fn(Duration) -> Option<Left>) -> (Duration, Vec<Over>) {
        let mut endings = Endings::default();
        assert_eq!(endings.poll_timeout(), None);
        endings.add(1, PUBLISHER, Duration::ZERO);
        while let Some(now) = endings.poll_timeout() {
            let over = endings.handle_timeout(now, |_, _| left(now));
            if !over.is_empty() {
                assert_eq!(endings.poll_timeout(), None, "it is forgotten");
                return (now, over);
            }
        }
        panic!("a publisher was forgotten");
    }

    #[test]
    fn a_publisher_whose_samples_are_acknowledged_is_over_at_once() {
        let over = Over { publisher: PUBLISHER, given_up: None };
        assert_eq!(over_after(|_| None), (Duration::ZERO, vec![over]));
    }

    #[test]
    fn samples_without_progress_are_given_up() {
        let given_up = Over { publisher: PUBLISHER, given_up: Some((1, 5)) };
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
        let mut endings = Endings::default();
        endings.add(1, PUBLISHER, Duration::ZERO);
        let moved = |route: u32| Left { route, ..left(5, 0, false).unwrap() };
        assert!(endings.handle_timeout(Duration::ZERO, |_, _| Some(moved(2))).is_empty());
        let given_up = endings.handle_timeout(PATIENCE, |route, _| Some(moved(route)));
        assert_eq!(given_up[0].given_up, Some((2, 5)));
    }

    #[test]
    fn a_publisher_that_ends_twice_has_the_patience_of_its_first_end() {
        let mut endings = Endings::default();
        endings.add(1, PUBLISHER, Duration::ZERO);
        endings.add(1, PUBLISHER, PATIENCE / 2);
        assert!(endings.handle_timeout(PATIENCE / 2, |_, _| left(5, 0, false)).is_empty());
        assert_eq!(endings.handle_timeout(PATIENCE, |_, _| left(5, 0, false)).len(), 1);
    }
}
