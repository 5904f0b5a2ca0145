//! Decides whether the reactor looks for the next input before it sleeps.
//!
//! A wake-up costs more than a look that finds an input at once. A look costs processor time, which is wasted if no
//! input comes. So the rule counts the results of looks, and stops looking while too few looks find an input.

use std::time::Duration;

use axon_transport::config::LinkPoll;

/// Duration of one look.
const POLL_TIME: Duration = Duration::from_micros(50);
/// Looks that are judged together.
const TRIAL: u32 = 16;
/// Divisor of the required hit rate: at least one look in this many has to find an input.
const MIN_HIT_DIVISOR: u32 = 4;
/// Passes without a look after a trial with too few hits: the first number, and the maximum. Each such trial doubles
/// the number.
const SKIPPED_PASSES: (u32, u32) = (64, 4096);

/// The reactor's action after a pass.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum PollDecision {
    /// The reactor sleeps.
    Not,
    /// The reactor looks for this time, and then sleeps.
    For(Duration),
    /// The reactor looks until there is an input.
    On,
}

/// The rule, and the results of its looks.
#[derive(Debug)]
pub(super) struct PollRule {
    poll: LinkPoll,
    /// Looks of this trial, and those among them that found an input.
    made: u32,
    found: u32,
    /// Passes left without a look.
    skipped: u32,
    /// Passes without a look after the next trial that does not pay.
    pause: u32,
}

impl PollRule {
    /// Creates a rule that has not looked yet. On a host with one processor a look would keep the sender of the input
    /// from running.
    pub(super) fn new(poll: LinkPoll, processors: usize) -> Self {
        let poll = match poll {
            LinkPoll::Adaptive if processors < 2 => LinkPoll::Never,
            poll => poll,
        };
        Self { poll, made: 0, found: 0, skipped: 0, pause: SKIPPED_PASSES.0 }
    }

    /// Returns the action after a pass; `busy` says whether the pass had work.
    pub(super) fn after_pass(&mut self, busy: bool) -> PollDecision {
        match self.poll {
            LinkPoll::Always => PollDecision::On,
            LinkPoll::Adaptive if busy && self.skipped == 0 => PollDecision::For(POLL_TIME),
            LinkPoll::Adaptive => {
                self.skipped = self.skipped.saturating_sub(u32::from(busy));
                PollDecision::Not
            }
            LinkPoll::Never => PollDecision::Not,
        }
    }

    /// Records the result of a look.
    pub(super) fn handle_look(&mut self, found: bool) {
        self.made += 1;
        self.found += u32::from(found);
        // The rest of the trial cannot change its result.
        let lost = self.made - self.found > TRIAL - TRIAL / MIN_HIT_DIVISOR;
        if lost {
            self.skipped = self.pause;
            self.pause = (self.pause * 2).min(SKIPPED_PASSES.1);
        } else if self.made == TRIAL {
            self.pause = SKIPPED_PASSES.0;
        }
        if lost || self.made == TRIAL {
            (self.made, self.found) = (0, 0);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns the number of looks made in `passes` busy passes. `comes` says whether an input follows in time for the
    /// look of a pass.
    fn looks(looks: &mut PollRule, passes: u32, comes: impl Fn(u32) -> bool) -> u32 {
        let mut made = 0;
        for pass in 0..passes {
            if looks.after_pass(true) != PollDecision::Not {
                made += 1;
                looks.handle_look(comes(pass));
            }
        }
        made
    }

    #[test]
    fn a_daemon_whose_looks_find_nothing_nearly_stops_looking() {
        let mut adaptive = PollRule::new(LinkPoll::Adaptive, 2);
        assert_eq!(looks(&mut adaptive, 13, |_| false), 13, "a trial");
        assert_eq!(looks(&mut adaptive, 64, |_| false), 0, "and a pause");
        looks(&mut adaptive, 20_000, |_| false);
        assert!(looks(&mut adaptive, 40_960, |_| false) <= 10 * 13);
    }

    #[test]
    fn a_daemon_whose_inputs_follow_each_other_looks_after_each_pass() {
        let mut adaptive = PollRule::new(LinkPoll::Adaptive, 2);
        assert_eq!(looks(&mut adaptive, 10_000, |_| true), 10_000);
        assert_eq!(looks(&mut adaptive, 10_000, |pass| pass % MIN_HIT_DIVISOR == 0), 10_000);
        // The rule notices that the inputs stopped, and soon that they began again.
        assert!(looks(&mut adaptive, 100, |_| false) < 50);
        assert!(looks(&mut adaptive, 1_000, |_| true) > 800);
    }

    #[test]
    fn a_pass_without_work_is_not_followed_by_a_look() {
        let mut adaptive = PollRule::new(LinkPoll::Adaptive, 2);
        assert_eq!(adaptive.after_pass(false), PollDecision::Not);
        assert_eq!(adaptive.after_pass(true), PollDecision::For(POLL_TIME));
        // Nor does it shorten a pause.
        looks(&mut adaptive, 13, |_| false);
        assert!((0..1_000).all(|_| adaptive.after_pass(false) == PollDecision::Not));
        assert_eq!(looks(&mut adaptive, SKIPPED_PASSES.0, |_| true), 0);
        assert_eq!(looks(&mut adaptive, 1, |_| true), 1);
    }

    #[test]
    fn fixed_poll_rules_hold_and_adaptive_does_not_poll_on_one_processor() {
        for busy in [false, true] {
            let after = |poll, processors| PollRule::new(poll, processors).after_pass(busy);
            assert_eq!(after(LinkPoll::Always, 1), PollDecision::On);
            assert_eq!(after(LinkPoll::Never, 64), PollDecision::Not);
            assert_eq!(after(LinkPoll::Adaptive, 1), PollDecision::Not);
        }
    }
}
