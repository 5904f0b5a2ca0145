//! The flows that wait for a limit that they share, in the order in which they pass.

use std::{collections::VecDeque, time::Duration};

use axon_shm::ids::Gid;

/// A flow that does not ask again for this time after its turn loses the turn: it may be blocked, or gone.
const GRACE: Duration = Duration::from_millis(20);

/// The flows that wait, each with the time of its turn. The first one is the next to pass.
#[derive(Debug, Default)]
pub(super) struct FlowQueue(VecDeque<(Gid, Duration)>);

impl FlowQueue {
    /// Returns how many flows pass before this one: all waiting flows, if it does not wait itself.
    pub(super) fn ahead_of(&mut self, flow: &Gid, now: Duration) -> usize {
        self.0.retain(|(waiting, turn)| waiting == flow || *turn + GRACE >= now);
        let place = self.0.iter().position(|(waiting, _)| waiting == flow);
        place.unwrap_or(self.0.len())
    }

    /// Records that the flow waits for its turn at this time.
    pub(super) fn wait(&mut self, flow: &Gid, turn: Duration) {
        match self.0.iter_mut().find(|(waiting, _)| waiting == flow) {
            Some((_, before)) => *before = turn,
            None => self.0.push_back((*flow, turn)),
        }
    }

    /// Removes the flow from the queue.
    pub(super) fn leave(&mut self, flow: &Gid) {
        if !self.0.is_empty() {
            self.0.retain(|(waiting, _)| waiting != flow);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn flows_pass_in_the_order_in_which_they_began_to_wait() {
        let (mut line, now) = (FlowQueue::default(), Duration::from_secs(9));
        let [a, b, c] = [1, 2, 3].map(|n| Gid([n; 16]));
        assert_eq!(line.ahead_of(&a, now), 0);
        line.wait(&a, now);
        line.wait(&b, now + GRACE);
        line.wait(&a, now + GRACE / 2);
        assert_eq!([a, b, c].map(|flow| line.ahead_of(&flow, now)), [0, 1, 2]);
        line.leave(&a);
        line.wait(&a, now + GRACE);
        assert_eq!([a, b].map(|flow| line.ahead_of(&flow, now)), [1, 0]);
        // A flow that does not use its turn holds up no other flow.
        assert_eq!(line.ahead_of(&a, now + 3 * GRACE), 0);
    }
}
