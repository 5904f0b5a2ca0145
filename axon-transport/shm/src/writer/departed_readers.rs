//! Readers whose process ended while they carried samples to another process or host. The publisher keeps their
//! unconfirmed samples for 10 s.
//!
//! Such a reader belongs to the daemon. On behalf of a relayed session, the next daemon attaches under the same GID. On
//! behalf of subscriptions of another host, it attaches under a GID of its own and stands for the same subscriptions.
//! Either reader continues at the last one's position.

use std::time::{Duration, Instant};

use crate::ids::Gid;

/// Time for which samples are kept for a reader whose process ended.
const ABSENCE: Duration = Duration::from_secs(10);

/// The reason why samples are kept for a reader that carries them to another process.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CarrierState {
    /// The reader is attached.
    Attached,
    /// The process that carried the samples ended. They are kept until this time for the next process.
    Absent(Instant),
}

/// The absent readers of one ring.
#[derive(Debug, Default)]
pub(crate) struct DepartedReaders(Vec<DepartedReader>);

#[derive(Debug)]
struct DepartedReader {
    gid: Gid,
    /// The subscriptions of another host that it stood for.
    stood_for: Vec<Gid>,
    /// The oldest position that is not delivered.
    position: u64,
    until: Instant,
}

impl DepartedReaders {
    /// Keeps samples from `position` on for a reader.
    pub(crate) fn add(&mut self, gid: Gid, stood_for: Vec<Gid>, position: u64) {
        self.0.retain(|absent| absent.gid != gid);
        self.0.push(DepartedReader { gid, stood_for, position, until: Instant::now() + ABSENCE });
    }

    /// Ends the absence of a reader that is attached again, or whose subscriptions another reader stands for.
    pub(crate) fn end(&mut self, gid: &Gid, stands_for: &[Gid]) {
        self.0.retain_mut(|absent| {
            let stood = !absent.stood_for.is_empty();
            absent.stood_for.retain(|of| !stands_for.contains(of));
            absent.gid != *gid && !(stood && absent.stood_for.is_empty())
        });
    }

    /// Forgets the readers that were absent for too long. Returns how many samples below `head` are given up.
    pub(crate) fn expire(&mut self, head: u64) -> u64 {
        if self.0.is_empty() {
            return 0;
        }
        let now = Instant::now();
        let over = self.0.extract_if(.., |absent| absent.until <= now);
        over.fold(0, |all, DepartedReader { gid, position, .. }| {
            let samples = head.saturating_sub(position);
            tracing::warn!(
                reader = %gid, samples,
                "gave up samples: the daemon's reader did not reconnect within {ABSENCE:?}"
            );
            all.saturating_add(samples)
        })
    }

    /// Returns whether no samples are kept for an absent reader.
    #[inline]
    pub(crate) fn is_empty(&self) -> bool {
        self.there().next().is_none()
    }

    /// Returns the readers that were not absent for too long. Usually there are none, and then no clock is read.
    #[inline]
    fn there(&self) -> impl Iterator<Item = &DepartedReader> {
        self.0.iter().filter(|absent| absent.until > Instant::now())
    }

    /// Returns the time until the first absent reader is given up.
    pub(crate) fn left(&self) -> Option<Duration> {
        let until = self.0.iter().map(|absent| absent.until).min()?;
        Some(until.saturating_duration_since(Instant::now()))
    }

    /// Returns the position at which a reader that stands for these subscriptions continues.
    pub(crate) fn position_of(&self, gid: &Gid, stands_for: &[Gid]) -> Option<u64> {
        let same = |absent: &&DepartedReader| {
            absent.gid == *gid || absent.stood_for.iter().any(|of| stands_for.contains(of))
        };
        self.there().filter(same).map(|absent| absent.position).min()
    }

    /// Returns the time until which samples are kept for this reader, if they are.
    pub(crate) fn until(&self, gid: &Gid) -> Option<Instant> {
        self.there().filter(|absent| absent.gid == *gid).map(|absent| absent.until).max()
    }

    /// Returns the oldest position that is kept, and its reader.
    #[inline]
    pub(crate) fn oldest(&self) -> Option<(u64, Gid)> {
        self.there().map(|absent| (absent.position, absent.gid)).min()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn samples_are_kept_from_the_oldest_position_until_the_reader_is_back() {
        let mut absences = DepartedReaders::default();
        assert!(absences.is_empty() && absences.oldest().is_none() && absences.left().is_none());
        let [one, other] = [1, 2].map(|byte| Gid([byte; 16]));
        absences.add(one, Vec::new(), 7);
        absences.add(other, Vec::new(), 5);
        // The reader died once more before it had made progress.
        absences.add(one, Vec::new(), 6);
        assert_eq!(
            (absences.position_of(&one, &[]), absences.oldest()),
            (Some(6), Some((5, other)))
        );
        assert_eq!(absences.expire(9), 0, "they were not absent for long");
        assert!(absences.until(&one).is_some_and(|until| until > Instant::now()));
        absences.end(&other, &[]);
        assert_eq!((absences.position_of(&other, &[]), absences.oldest()), (None, Some((6, one))));
        absences.0[0].until = Instant::now();
        assert!(absences.is_empty() && absences.position_of(&one, &[]).is_none());
        assert_eq!(absences.until(&one), None);
        assert_eq!((absences.expire(9), absences.left()), (3, None));
    }

    #[test]
    fn a_relay_goes_on_where_one_for_the_same_subscriptions_ended() {
        let mut absences = DepartedReaders::default();
        let [old, new, here, there, later] = [1, 2, 3, 4, 5].map(|byte| Gid([byte; 16]));
        absences.add(old, vec![here, there], 7);
        assert_eq!(absences.position_of(&new, &[later]), None);
        assert_eq!(absences.position_of(&new, &[there, later]), Some(7));
        absences.end(&new, &[there, later]);
        assert_eq!(absences.oldest(), Some((7, old)), "one subscription is not back");
        absences.end(&new, &[here, there]);
        assert!(absences.is_empty());
    }
}
