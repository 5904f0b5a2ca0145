//! The order of flows that share a limit: who passed least lately goes first.

use std::{collections::VecDeque, time::Duration};

use axon_shm::ids::Gid;

/// How long a flow that passed more lately lets each of the others go first.
const EACH: Duration = Duration::from_micros(200);
/// Flows that are known.
const MOST: usize = 32;
/// A flow that neither passed nor asked for so long is in nobody's way.
const REST: Duration = Duration::from_secs(2);

/// The flows that have samples, and when each was seen last. The one that passed last is at the end.
#[derive(Debug, Default)]
pub(super) struct Line(VecDeque<(Gid, Duration)>);

impl Line {
    /// How long after the limit is open the next sample of a flow passes. Flows that wait for the same time would else
    /// always pass in the same order, and where there is room for one only, the others never.
    pub(super) fn behind(&mut self, of: &Gid, now: Duration) -> Duration {
        self.0.retain(|(known, seen)| known == of || now.saturating_sub(*seen) <= REST);
        match self.0.iter().position(|(known, _)| known == of) {
            Some(before) => {
                self.0[before].1 = now;
                EACH * before as u32
            }
            None => {
                self.0.push_front((*of, now));
                self.0.truncate(MOST);
                Duration::ZERO
            }
        }
    }

    /// A sample of a flow passed.
    pub(super) fn pass(&mut self, of: &Gid, now: Duration) {
        self.0.retain(|(known, _)| known != of);
        self.0.push_back((*of, now));
        if self.0.len() > MOST {
            self.0.pop_front();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn who_passed_last_lets_all_others_go_first() {
        let (mut line, now) = (Line::default(), Duration::from_secs(9));
        let [a, b, c] = [1, 2, 3].map(|n| Gid([n; 16]));
        assert_eq!(line.behind(&a, now), Duration::ZERO);
        line.pass(&a, now);
        assert_eq!(line.behind(&a, now), Duration::ZERO, "it is alone");
        // The others wait, and have passed nothing yet.
        assert_eq!([b, c].map(|of| line.behind(&of, now)), [Duration::ZERO; 2]);
        assert_eq!(line.behind(&a, now), 2 * EACH);
        line.pass(&c, now);
        assert_eq!([b, a, c].map(|of| line.behind(&of, now)), [Duration::ZERO, EACH, 2 * EACH]);
        // Of those that are gone nothing is left.
        assert_eq!(line.behind(&c, now + REST + EACH), Duration::ZERO);
        (0..100).for_each(|n| line.pass(&Gid([n; 16]), now));
        assert_eq!(line.0.len(), MOST);
    }
}
