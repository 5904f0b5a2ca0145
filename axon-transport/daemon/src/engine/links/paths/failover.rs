//! Decides when the traffic of a peer moves to the link that stands by.

use std::time::Duration;

use crate::engine::quic::answers::Exchange;

/// Time without an acknowledgement after which a path counts as cut if the other path answers. On a slow path it is
/// [`ROUND_TRIPS`] round trips, if that is longer.
const SILENT: Duration = Duration::from_millis(300);
const ROUND_TRIPS: u32 = 3;
/// Interval between two checks while neither path answers, in the first seconds of the silence and later.
const FIRST_INTERVAL: Duration = Duration::from_millis(50);
const FIRST_CHECKS: Duration = Duration::from_secs(2);
const LATER_INTERVAL: Duration = Duration::from_millis(500);

/// The answers of a peer over the link in use, compared with those over the link that stands by. A state machine as
/// `docs/architecture.md` describes them.
///
/// The path in use is not taken for cut because of its silence alone: a peer that is stopped answers over neither path,
/// and a second handshake would not help. So the other path is asked first.
#[derive(Debug, Default)]
pub(in crate::engine::links) struct Failover {
    /// The exchange over the link in use at its latest acknowledgement.
    answered: Exchange,
    /// The exchange over the link that stands by when it was asked for an answer.
    asked: Option<Exchange>,
    /// True if the switch was decided for the link that stands by now.
    decided: bool,
    /// The time of the next check, if the first ones had no result.
    next_check: Option<Duration>,
}

/// The next step for two links.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in crate::engine::links) enum FailoverStep {
    /// The link in use answered, or nothing was asked over it: the time of its next packet counts.
    Answered,
    /// Ask for an answer over the link that stands by.
    Ask,
    /// Put the link that stands by in use.
    Switch,
}

impl Failover {
    /// Creates the state for another link in use.
    pub(in crate::engine::links) fn new(in_use: Exchange) -> Self {
        Self { answered: in_use, ..Self::default() }
    }

    /// Handles that another link stands by: it was not asked yet. The silence of the link in use goes on.
    pub(in crate::engine::links) fn handle_standby(&mut self) {
        *self = Self::new(self.answered);
    }

    /// Records the exchange over the link in use. Returns whether the peer acknowledged something.
    pub(in crate::engine::links) fn handle_exchange(&mut self, in_use: Exchange) -> bool {
        let answered = in_use.is_answered_since(self.answered);
        if answered {
            *self = Self { decided: self.decided, ..Self::new(in_use) };
        }
        answered
    }

    /// Returns when [`handle_timeout`](Self::handle_timeout) is due. The first packet since the latest acknowledgement
    /// left at `sent_at`.
    pub(in crate::engine::links) fn poll_timeout(
        &self,
        sent_at: Option<Duration>,
        round_trip: Duration,
    ) -> Option<Duration> {
        let sent_at = sent_at.filter(|_| !self.decided)?;
        let silent = silent_after(round_trip);
        let first = if self.asked.is_none() { silent / 2 } else { silent };
        Some(self.next_check.unwrap_or(sent_at + first))
    }

    /// Returns the step that is due at `now`.
    pub(in crate::engine::links) fn handle_timeout(
        &mut self,
        now: Duration,
        sent_at: Option<Duration>,
        in_use: Exchange,
        standby: Exchange,
        round_trip: Duration,
    ) -> Option<FailoverStep> {
        let due = self.poll_timeout(sent_at, round_trip)?;
        if now < due {
            return None;
        }
        if self.handle_exchange(in_use) || !in_use.asks_since(self.answered) {
            return Some(FailoverStep::Answered);
        }
        let Some(asked) = self.asked else {
            self.asked = Some(standby);
            return Some(FailoverStep::Ask);
        };
        if standby.is_answered_since(asked) {
            self.decided = true;
            return Some(FailoverStep::Switch);
        }
        let is_first = sent_at.is_some_and(|sent_at| now < sent_at + FIRST_CHECKS);
        self.next_check = Some(now + if is_first { FIRST_INTERVAL } else { LATER_INTERVAL });
        // The packet that asked may be lost, and QUIC repeats it ever more seldom.
        Some(FailoverStep::Ask)
    }
}

/// Returns the time without an acknowledgement after which a path counts as cut.
pub(super) fn silent_after(round_trip: Duration) -> Duration {
    SILENT.max(ROUND_TRIPS * round_trip)
}

#[cfg(test)]
mod tests {
    use super::*;

    const SENT: Duration = Duration::from_secs(1000);
    const RTT: Duration = Duration::from_millis(5);

    fn millis(millis: u64) -> Duration {
        Duration::from_millis(millis)
    }

    /// The counts of acknowledgements and of frames that ask for one.
    fn exchange(acknowledged: u64, asked: u64) -> Exchange {
        Exchange { acknowledged, asked, pings: 0 }
    }

    #[test]
    fn silent_path_is_left_after_300_ms_if_the_other_one_answers() {
        let mut failover = Failover::new(exchange(5, 5));
        let step = |failover: &mut Failover, after, standby| {
            failover.handle_timeout(SENT + millis(after), Some(SENT), exchange(5, 6), standby, RTT)
        };
        assert_eq!(failover.poll_timeout(Some(SENT), RTT), Some(SENT + millis(150)));
        assert_eq!(step(&mut failover, 149, exchange(1, 1)), None);
        assert_eq!(step(&mut failover, 150, exchange(1, 1)), Some(FailoverStep::Ask));
        assert_eq!(failover.poll_timeout(Some(SENT), RTT), Some(SENT + millis(300)));
        assert_eq!(step(&mut failover, 299, exchange(2, 1)), None, "not before its time");
        assert_eq!(step(&mut failover, 300, exchange(2, 1)), Some(FailoverStep::Switch));
        assert_eq!(failover.poll_timeout(Some(SENT), RTT), None, "once");
    }

    #[test]
    fn no_path_is_left_while_the_other_one_is_silent_too() {
        let mut failover = Failover::new(exchange(5, 5));
        let mut checks = 0;
        let mut now = SENT;
        while now < SENT + millis(10_000) {
            now = failover.poll_timeout(Some(SENT), RTT).unwrap();
            let step =
                failover.handle_timeout(now, Some(SENT), exchange(5, 6), exchange(1, 1), RTT);
            assert_ne!(step, Some(FailoverStep::Switch));
            checks += 1;
        }
        assert!(checks < 60, "{checks} checks in ten seconds");
        let now = failover.poll_timeout(Some(SENT), RTT).unwrap();
        let step = failover.handle_timeout(now, Some(SENT), exchange(5, 6), exchange(2, 1), RTT);
        assert_eq!(step, Some(FailoverStep::Switch), "it answers now");
    }

    #[test]
    fn acknowledgement_ends_the_suspicion() {
        let mut failover = Failover::new(exchange(5, 5));
        let step = failover.handle_timeout(
            SENT + millis(150),
            Some(SENT),
            exchange(5, 6),
            exchange(1, 1),
            RTT,
        );
        assert_eq!(step, Some(FailoverStep::Ask));
        assert!(failover.handle_exchange(exchange(6, 6)));
        assert!(!failover.handle_exchange(exchange(6, 7)));
        // The next packet has its own time.
        let later = SENT + millis(280);
        assert_eq!(failover.poll_timeout(Some(later), RTT), Some(later + millis(150)));
    }

    #[test]
    fn link_that_only_acknowledges_is_not_silent() {
        let mut failover = Failover::new(exchange(5, 5));
        let now = SENT + millis(150);
        let step = failover.handle_timeout(now, Some(SENT), exchange(5, 5), exchange(1, 1), RTT);
        assert_eq!(step, Some(FailoverStep::Answered), "nothing was asked");
        assert_eq!(failover.poll_timeout(None, RTT), None);
    }

    #[test]
    fn second_link_that_comes_during_the_silence_takes_over_at_once() {
        let mut failover = Failover::new(exchange(5, 5));
        let now = SENT + millis(2000);
        failover.handle_standby();
        let step = |failover: &mut Failover, now, standby| {
            failover.handle_timeout(now, Some(SENT), exchange(5, 6), standby, RTT)
        };
        assert_eq!(step(&mut failover, now, exchange(1, 1)), Some(FailoverStep::Ask));
        assert_eq!(
            step(&mut failover, now + millis(5), exchange(2, 2)),
            Some(FailoverStep::Switch)
        );
    }

    #[test]
    fn slow_path_has_three_round_trips() {
        let failover = Failover::new(exchange(5, 5));
        let due = failover.poll_timeout(Some(SENT), millis(400));
        assert_eq!(due, Some(SENT + millis(600)));
    }
}
