//! Decides which flow sends next, and tracks the flows that cannot send: they wait for QUIC, a stream, a key, space or
//! credit.

mod held_back;
mod starvation;

use std::{collections::HashSet, rc::Rc, time::Duration};

use self::{held_back::BlockedFlows, starvation::StarvationCredit};
use super::{
    budget::Budget,
    flow::{CreditQueue, Flow, FlowPause, PeerCredit},
    schedule::Schedule,
    table::Flows,
};
use crate::engine::rank::{FlowId, Rank};

/// The turn of one flow.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct FlowTurn {
    pub(super) flow: FlowId,
    /// The rank under which it has the turn.
    pub(super) rank: Rank,
    /// The rank as which it sends, if it differs.
    pub(super) lender: Option<Rank>,
}

/// The turns of the flows towards one peer.
pub(super) struct FlowScheduler {
    schedule: Schedule,
    lending: StarvationCredit,
    without: BlockedFlows,
    credit: Rc<PeerCredit>,
    /// The flows that wait for credit.
    for_credit: CreditQueue,
    budget: Rc<Budget>,
    /// The flows whose last turn ended because QUIC took no more.
    for_quic: HashSet<FlowId>,
    /// True if streams may have become idle since a flow found none.
    frees_streams: bool,
}

impl FlowScheduler {
    /// Creates the turns without flows.
    pub(super) fn new(budget: Rc<Budget>) -> Self {
        Self {
            schedule: Schedule::default(),
            lending: StarvationCredit::default(),
            without: BlockedFlows::new(&budget),
            credit: PeerCredit::new(),
            for_credit: CreditQueue::default(),
            budget,
            for_quic: HashSet::new(),
            frees_streams: false,
        }
    }

    /// Returns whether a flow waits for QUIC to take more.
    pub(super) fn wait_for_quic(&self) -> bool {
        !self.for_quic.is_empty()
    }

    /// Returns the peer's credit.
    pub(super) fn credit(&self) -> &Rc<PeerCredit> {
        &self.credit
    }

    /// Returns whether a flow waits for credit.
    pub(super) fn wait_for_credit(&self) -> bool {
        !self.for_credit.is_empty()
    }

    /// Returns the place of the highest rank whose flows wait for credit.
    pub(super) fn closed_from(&self) -> Option<usize> {
        self.for_credit.closed_from()
    }

    /// Gives a flow a turn, if it has samples to send and QUIC may take them.
    pub(super) fn add(&mut self, id: FlowId, flow: &Flow) {
        if !self.schedule.contains(id)
            && !flow.blocked
            && let Some(rank) = flow.rank()
        {
            self.schedule.push(id, rank);
        }
    }

    /// Forgets a flow that is gone. Its number may be used for another flow.
    pub(super) fn forget(&mut self, id: FlowId) {
        self.schedule.remove(id);
        self.for_quic.remove(&id);
        self.without.forget(id);
        self.for_credit.forget(id);
    }

    /// Tries the flows again that found no space or no credit, if there is more now.
    pub(super) fn retry(&mut self, flows: &mut Flows) {
        let held = self.without.take_for_room(&self.budget);
        self.add_all(held, flows);
        self.retry_for_credit(flows);
    }

    fn add_all(&mut self, ids: impl IntoIterator<Item = FlowId>, flows: &Flows) {
        for id in ids {
            if let Some(flow) = flows.get(id) {
                self.add(id, flow);
            }
        }
    }

    fn retry_for_credit(&mut self, flows: &mut Flows) {
        if !self.for_credit.is_due(&self.credit) {
            return;
        }
        for id in self.for_credit.take(&self.credit).into_iter().rev() {
            let Some(flow) = flows.get_mut(id) else { continue };
            flow.blocked = false;
            let rank = flow.rank();
            // Its samples may have been acknowledged meanwhile.
            flow.waits_for_credit &= rank.is_some();
            if let Some(rank) = rank {
                self.schedule.push_first(id, rank);
            }
        }
    }

    /// Returns the next turn.
    pub(super) fn next(&mut self) -> Option<FlowTurn> {
        let (flow, rank) = self.schedule.pop(|at| self.lending.borrows(at))?;
        Some(FlowTurn { flow, rank, lender: self.lending.borrow(rank) })
    }

    /// Records that a flow handed `bytes` bytes to QUIC in its turn.
    pub(super) fn handle_sent(&mut self, turn: FlowTurn, bytes: u64) {
        match (bytes, turn.lender) {
            (0, _) => {}
            (bytes, Some(_)) => self.lending.handle_borrowed(turn.rank, bytes),
            (bytes, None) => self.lending.handle_sent(turn.rank, bytes),
        }
    }

    /// Records that a flow found no space for a sample in its turn.
    pub(super) fn handle_held(&mut self, turn: FlowTurn) {
        self.without.room(turn.flow);
    }

    /// Ends a turn. Flows that gave credit back in this pass may be the last ones that use any: if there is no other
    /// turn, the flows that wait for credit are tried again.
    pub(super) fn handle_over(
        &mut self,
        now: Duration,
        turn: FlowTurn,
        pause: FlowPause,
        flows: &mut Flows,
    ) {
        match pause {
            FlowPause::Blocked => self.for_quic.insert(turn.flow),
            _ => self.for_quic.remove(&turn.flow),
        };
        match pause {
            FlowPause::Turn => self.add_all([turn.flow], flows),
            // The compressor's answer, or the peer's acknowledgement, gives it its next turn.
            FlowPause::Empty | FlowPause::Compressing => {}
            FlowPause::Blocked => self.lending.handle_blocked(turn.rank),
            FlowPause::NoStream => {
                self.without.stream(turn.flow);
                self.frees_streams = true;
            }
            FlowPause::NoKey => self.without.key(turn.flow, now),
            FlowPause::NoCredit => {
                // The sample that the flow took from its rings may have another rank.
                let rank = flows.get(turn.flow).and_then(Flow::rank).unwrap_or(turn.rank);
                self.for_credit.add(turn.flow, rank.place());
                self.lending.handle_blocked(turn.rank);
            }
        }
        if self.schedule.is_empty() {
            self.retry_for_credit(flows);
        }
    }

    /// Records that the peer acknowledged samples, so that streams may have become idle.
    pub(super) fn handle_acknowledged(&mut self) {
        self.frees_streams |= self.without.waits_for_stream() > 0;
    }

    /// Returns the number of idle streams to finish now, so that flows that wait for a stream get one.
    pub(super) fn take_wanted_streams(&mut self) -> usize {
        match std::mem::take(&mut self.frees_streams) {
            true => self.without.waits_for_stream(),
            false => 0,
        }
    }

    /// Continues flows that wait for a stream, because the peer allows more streams.
    pub(super) fn handle_streams_available(&mut self, flows: &Flows) {
        let waiting = self.without.take_for_stream();
        self.add_all(waiting, flows);
    }

    /// Continues flows that wait for keys, because there may be some now.
    pub(super) fn handle_keys(&mut self, flows: &Flows) {
        let waiting = self.without.take_for_key();
        self.add_all(waiting, flows);
    }

    /// Returns when flows without a key look for one again.
    pub(super) fn poll_timeout(&self) -> Option<Duration> {
        self.without.poll_timeout()
    }

    /// Makes the flows without a key look for one again, if that is due.
    pub(super) fn handle_timeout(&mut self, now: Duration, flows: &Flows) {
        if self.poll_timeout().is_some_and(|due| due <= now) {
            self.handle_keys(flows);
        }
    }

    /// Returns whether a pass has work to do.
    pub(super) fn has_work(&self) -> bool {
        !self.schedule.is_empty() || self.frees_streams || self.for_credit.is_due(&self.credit)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::outbound::{flow::UsedCredit, model::flow};

    const NOW: Duration = Duration::from_secs(1);

    /// Creates flows, each of which has samples to send, and their turns.
    fn turns(count: usize) -> (FlowScheduler, Flows) {
        let mut flows = Flows::default();
        let mut turns = FlowScheduler::new(Budget::new(1 << 20).of_peer());
        for number in 0..count {
            let id = flows.insert(flow(number as u8));
            flows.get_mut(id).unwrap().handle_samples();
            turns.add(id, flows.get(id).unwrap());
        }
        (turns, flows)
    }

    fn next(turns: &mut FlowScheduler) -> Option<FlowId> {
        turns.next().map(|turn| turn.flow)
    }

    /// Lets the next flow pause, and lose its turn.
    fn pause(turns: &mut FlowScheduler, flows: &mut Flows, pause: FlowPause) -> FlowId {
        let turn = turns.next().unwrap();
        turns.handle_over(NOW, turn, pause, flows);
        turn.flow
    }

    #[test]
    fn a_flow_whose_turn_is_over_goes_on_after_the_others() {
        let (mut turns, mut flows) = turns(2);
        assert_eq!(pause(&mut turns, &mut flows, FlowPause::Turn), 0);
        assert_eq!(pause(&mut turns, &mut flows, FlowPause::Empty), 1);
        assert_eq!((next(&mut turns), next(&mut turns)), (Some(0), None));
        assert!(!turns.has_work());
    }

    #[test]
    fn a_flow_that_is_blocked_or_has_nothing_gets_no_turn() {
        let (mut turns, mut flows) = turns(1);
        next(&mut turns);
        flows.get_mut(0).unwrap().blocked = true;
        turns.add(0, flows.get(0).unwrap());
        turns.add(1, &flow(1));
        assert_eq!(next(&mut turns), None);
        flows.get_mut(0).unwrap().blocked = false;
        turns.add(0, flows.get(0).unwrap());
        assert_eq!(next(&mut turns), Some(0));
    }

    #[test]
    fn paused_flows_resume_when_a_stream_or_key_is_available() {
        let (mut turns, mut flows) = turns(2);
        assert_eq!(pause(&mut turns, &mut flows, FlowPause::NoStream), 0);
        assert_eq!(pause(&mut turns, &mut flows, FlowPause::NoKey), 1);
        turns.handle_timeout(NOW, &flows);
        assert_eq!(next(&mut turns), None, "not at once");
        turns.handle_streams_available(&flows);
        assert_eq!((next(&mut turns), next(&mut turns)), (Some(0), None));
        turns.handle_timeout(turns.poll_timeout().unwrap(), &flows);
        assert_eq!((next(&mut turns), next(&mut turns)), (Some(1), None));
        assert_eq!(turns.poll_timeout(), None);
    }

    #[test]
    fn idle_streams_are_wanted_while_a_flow_has_none() {
        let (mut turns, mut flows) = turns(1);
        turns.handle_acknowledged();
        assert!(turns.take_wanted_streams() == 0, "no flow waits for one");
        pause(&mut turns, &mut flows, FlowPause::NoStream);
        assert!(turns.has_work());
        assert_eq!((turns.take_wanted_streams(), turns.take_wanted_streams()), (1, 0));
        turns.handle_acknowledged();
        assert_eq!(turns.take_wanted_streams(), 1);
    }

    #[test]
    fn flows_without_credit_keep_their_order_and_are_first_when_some_comes_back() {
        let (mut turns, mut flows) = turns(4);
        for id in 0..3 {
            flows.get_mut(id).unwrap().blocked = true;
            assert_eq!(pause(&mut turns, &mut flows, FlowPause::NoCredit), id);
        }
        assert!(turns.wait_for_credit() && turns.closed_from().is_some());
        turns.forget(1);
        let mut share = turns.credit().share();
        share.set(UsedCredit::of(1, 1));
        drop(share);
        turns.retry(&mut flows);
        assert!(!turns.wait_for_credit() && turns.closed_from().is_none());
        assert!(!flows.get(0).unwrap().blocked);
        let order: Vec<_> = std::iter::from_fn(|| next(&mut turns)).collect();
        assert_eq!(order, [0, 2, 3]);
    }

    #[test]
    fn credit_that_the_last_turn_gave_back_is_used_in_the_same_pass() {
        let (mut turns, mut flows) = turns(2);
        pause(&mut turns, &mut flows, FlowPause::NoCredit);
        let mut share = turns.credit().share();
        share.set(UsedCredit::of(1, 1));
        let turn = turns.next().unwrap();
        drop(share);
        turns.handle_over(NOW, turn, FlowPause::Empty, &mut flows);
        assert_eq!(next(&mut turns), Some(0));
    }

    #[test]
    fn a_flow_that_is_gone_has_no_turn_and_waits_for_nothing() {
        let (mut turns, mut flows) = turns(3);
        pause(&mut turns, &mut flows, FlowPause::NoStream);
        pause(&mut turns, &mut flows, FlowPause::NoKey);
        (0..3).for_each(|id| turns.forget(id));
        turns.handle_streams_available(&flows);
        turns.handle_keys(&flows);
        assert_eq!(next(&mut turns), None);
    }
}
