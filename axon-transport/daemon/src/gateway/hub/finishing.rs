//! Shutdown: flushes queued samples while there is progress, for at most 5 s.

use std::time::{Duration, Instant};

use super::{Hub, Peer};
use crate::gateway::{bridge::ToControl, counters::Tally};

/// How long it may take in all, and how long nothing may get on.
const LONGEST: Duration = Duration::from_secs(5);
const PATIENCE: Duration = Duration::from_secs(2);
/// Between looks. What a publisher wrote just now is read from its ring within one.
const LOOK: Duration = Duration::from_millis(20);
/// How long what is left may take to be counted.
const COUNT: Duration = Duration::from_millis(500);

/// Since when the daemon is to end, and how far that is.
pub(super) struct Finishing {
    begun: Instant,
    /// Bytes that had arrived, or were given up, at the last look, and since when there were no more.
    gone: usize,
    since: Instant,
    next: Instant,
    /// Nothing waited at the last look.
    empty: bool,
}

impl Finishing {
    pub(super) fn new(now: Instant) -> Self {
        let next = now + LOOK;
        Self { begun: now, gone: 0, since: now, next, empty: false }
    }

    /// How long it is until the next look.
    pub(super) fn look_in(&self, now: Instant) -> Duration {
        self.next.saturating_duration_since(now)
    }

    /// Whether it is over, now that so many bytes wait, and so many are gone. As many may wait as before,
    /// since publishers go on.
    fn is_over(&mut self, waiting: usize, gone: usize, now: Instant) -> bool {
        self.next = now + LOOK;
        if gone != self.gone {
            (self.gone, self.since) = (gone, now);
        }
        let was_empty = std::mem::replace(&mut self.empty, waiting == 0);
        (was_empty && self.empty)
            || now.duration_since(self.begun) >= LONGEST
            || now.duration_since(self.since) >= PATIENCE
    }
}

impl Hub {
    /// The daemon is to end: it does once nothing waits.
    pub(super) fn finish(&mut self) {
        self.finishing.get_or_insert_with(|| Finishing::new(Instant::now()));
    }

    /// Looks whether something still waits, and tells the control plane if not.
    pub(super) async fn look_whether_finished(&mut self) {
        let Some(finishing) = &mut self.finishing else { return };
        let queues = &self.shared.queues;
        if finishing.is_over(queues.taken(), queues.released(), Instant::now()) {
            self.finishing = None;
            self.tell(ToControl::Finished).await;
        }
    }

    /// The links are closed: what they had not carried is counted, and logged by topic, by the tasks that
    /// carried it.
    pub(super) async fn count_what_is_left(&mut self) {
        let tallies: Vec<Tally> = self.peers.drain().map(|(_, peer)| Peer::over(peer)).collect();
        let counted = async {
            for tally in &tallies {
                tally.is_final().await;
            }
        };
        // An error: what could not be counted in time is not logged.
        let _ = tokio::time::timeout(COUNT, counted).await;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_is_over_when_nothing_waits_twice_or_nothing_gets_on() {
        let begun = Instant::now();
        let looks = |at: fn(u32) -> (usize, usize)| {
            let mut finishing = Finishing::new(begun);
            (1..).find(|look| {
                let (waiting, gone) = at(*look);
                finishing.is_over(waiting, gone, begun + LOOK * *look)
            })
        };
        let [patience, longest] = [PATIENCE, LONGEST].map(|t| t.div_duration_f64(LOOK) as u32);
        assert_eq!(looks(|_| (0, 9)), Some(2), "a publisher may have written just now");
        assert_eq!(looks(|look| (3_usize.saturating_sub(look as usize), look as usize)), Some(4));
        assert_eq!(looks(|_| (7, 0)), Some(patience));
        assert_eq!(looks(|look| (7, look.min(10) as usize)), Some(10 + patience));
        assert_eq!(looks(|look| (7, look as usize)), Some(longest), "publishers go on for ever");
    }
}
