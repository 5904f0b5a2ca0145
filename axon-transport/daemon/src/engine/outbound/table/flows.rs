//! The flows towards one peer by number, with their timers and the streams that they leave.

use std::{collections::BTreeSet, time::Duration};

use quinn_proto::StreamId;

use crate::engine::{
    outbound::flow::Flow,
    quic::{connection::Carrier, transport::STREAMS_OPEN},
    rank::FlowId,
};

/// Number of flows that one search for idle streams checks: all flows that have a stream. The peer may acknowledge all
/// of them at once, and no further acknowledgement would begin another search.
const SEARCHED: usize = STREAMS_OPEN as usize;

/// A flow, and the time in `timers` at which its timer is due.
struct FlowSlot {
    flow: Flow,
    due: Option<Duration>,
}

/// All flows. A number is used again once its flow is removed.
#[derive(Default)]
pub(in crate::engine::outbound) struct Flows {
    slots: Vec<Option<FlowSlot>>,
    free: Vec<FlowId>,
    timers: BTreeSet<(Duration, FlowId)>,
    /// Flows with samples that are not acknowledged. The others cost nothing.
    busy: BTreeSet<FlowId>,
    /// Streams of flows that ended, each with whether a sample is cut off there.
    ended: Vec<(StreamId, bool)>,
}

impl Flows {
    /// Adds a flow. Returns its number.
    pub(in crate::engine::outbound) fn insert(&mut self, flow: Flow) -> FlowId {
        let slot = Some(FlowSlot { flow, due: None });
        match self.free.pop() {
            Some(id) => {
                self.slots[id] = slot;
                id
            }
            None => {
                self.slots.push(slot);
                self.slots.len() - 1
            }
        }
    }

    /// Removes a flow. Returns whether it existed. The caller forgets its number first.
    pub(in crate::engine::outbound) fn remove(&mut self, id: FlowId) -> bool {
        let Some(FlowSlot { mut flow, due }) = self.slots.get_mut(id).and_then(Option::take) else {
            return false;
        };
        self.ended.extend(flow.take_streams());
        if let Some(due) = due {
            self.timers.remove(&(due, id));
        }
        self.busy.remove(&id);
        self.free.push(id);
        true
    }

    /// Returns a flow.
    pub(in crate::engine::outbound) fn get(&self, id: FlowId) -> Option<&Flow> {
        Some(&self.slots.get(id)?.as_ref()?.flow)
    }

    /// Returns a flow. If its timer may change, the caller has to call [`note_timer`](Self::note_timer) afterwards.
    pub(in crate::engine::outbound) fn get_mut(&mut self, id: FlowId) -> Option<&mut Flow> {
        Some(&mut self.slots.get_mut(id)?.as_mut()?.flow)
    }

    /// Returns the numbers of all flows.
    pub(in crate::engine::outbound) fn ids(&self) -> Vec<FlowId> {
        (0..self.slots.len()).filter(|id| self.slots[*id].is_some()).collect()
    }

    /// Updates the timer of a flow, which may have changed.
    pub(in crate::engine::outbound) fn note_timer(&mut self, id: FlowId) {
        let Some(FlowSlot { flow, due }) = self.slots.get_mut(id).and_then(Option::as_mut) else {
            return;
        };
        if flow.timer == *due {
            return;
        }
        if let Some(before) = std::mem::replace(due, flow.timer) {
            self.timers.remove(&(before, id));
        }
        self.timers.extend(due.map(|due| (due, id)));
    }

    /// Returns when [`take_due`](Self::take_due) returns a flow.
    pub(in crate::engine::outbound) fn poll_timeout(&self) -> Option<Duration> {
        self.timers.first().map(|(due, _)| *due)
    }

    /// Takes the next flow whose timer is due. The timer stops; [`note_timer`](Self::note_timer) starts it again.
    pub(in crate::engine::outbound) fn take_due(&mut self, now: Duration) -> Option<FlowId> {
        self.poll_timeout().filter(|due| *due <= now)?;
        let (_, id) = self.timers.pop_first()?;
        if let Some(slot) = &mut self.slots[id] {
            slot.due = None;
        }
        Some(id)
    }

    /// Records that samples of a flow wait. Returns whether no flow had waiting samples before.
    pub(in crate::engine::outbound) fn set_busy(&mut self, id: FlowId) -> bool {
        let first = self.busy.is_empty();
        self.busy.insert(id);
        first
    }

    /// Records that no sample of a flow waits or is unacknowledged.
    pub(in crate::engine::outbound) fn set_quiet(&mut self, id: FlowId) {
        self.busy.remove(&id);
    }

    /// Returns whether all flows are quiet.
    pub(in crate::engine::outbound) fn are_quiet(&self) -> bool {
        self.busy.is_empty()
    }

    /// Returns the flows with unacknowledged samples.
    pub(in crate::engine::outbound) fn busy(&self) -> impl Iterator<Item = (FlowId, &Flow)> {
        self.busy.iter().filter_map(|id| Some((*id, self.get(*id)?)))
    }

    /// Calls `each` for the flows with unacknowledged samples.
    pub(in crate::engine::outbound) fn for_each_busy(&mut self, mut each: impl FnMut(&mut Flow)) {
        for id in &self.busy {
            if let Some(slot) = &mut self.slots[*id] {
                each(&mut slot.flow);
            }
        }
    }

    /// Returns whether ended flows left streams.
    pub(in crate::engine::outbound) fn has_ended_streams(&self) -> bool {
        !self.ended.is_empty()
    }

    /// Takes the streams of flows that ended, each with whether a sample is cut off there.
    pub(in crate::engine::outbound) fn take_ended_streams(&mut self) -> Vec<(StreamId, bool)> {
        std::mem::take(&mut self.ended)
    }

    /// Finishes at most `most` idle streams, of the flows that have been idle longest. The peer allows other streams in
    /// their place once it has read them.
    pub(in crate::engine::outbound) fn finish_idle_streams(
        &mut self,
        most: usize,
        carrier: &mut Carrier<'_>,
    ) {
        // A flow's timer runs since it began its stream, or was last found to use it.
        let oldest: Vec<FlowId> = self.timers.iter().take(SEARCHED).map(|(_, id)| *id).collect();
        let mut left = most;
        for id in oldest {
            if left == 0 {
                break;
            }
            let Some(flow) = self.get_mut(id).filter(|flow| flow.has_idle_stream()) else {
                continue;
            };
            flow.finish_stream(carrier);
            flow.restart_timer();
            left -= 1;
            self.note_timer(id);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::outbound::model::flow;

    fn at(millis: u64) -> Duration {
        Duration::from_millis(millis)
    }

    /// Creates flows with timers that are due at these times.
    fn flows<const N: usize>(timers: [Option<u64>; N]) -> Flows {
        let mut flows = Flows::default();
        for (expected, timer) in timers.into_iter().enumerate() {
            let id = flows.insert(flow(expected as u8));
            assert_eq!(id, expected);
            flows.get_mut(id).unwrap().timer = timer.map(at);
            flows.note_timer(id);
        }
        flows
    }

    #[test]
    fn timers_are_due_in_order_and_stop_until_they_are_noted_again() {
        let mut flows = flows([Some(30), None, Some(10), Some(20)]);
        assert_eq!(flows.poll_timeout(), Some(at(10)));
        assert_eq!(flows.take_due(at(9)), None);
        assert_eq!([flows.take_due(at(25)), flows.take_due(at(25))], [Some(2), Some(3)]);
        assert_eq!(flows.take_due(at(25)), None);
        flows.note_timer(2);
        assert_eq!(flows.take_due(at(25)), Some(2), "its timer was not changed");
        flows.get_mut(0).unwrap().timer = Some(at(5));
        flows.note_timer(0);
        assert_eq!(flows.poll_timeout(), Some(at(5)), "the earlier time replaces the later one");
        flows.get_mut(0).unwrap().timer = None;
        flows.note_timer(0);
        assert_eq!(flows.poll_timeout(), None);
    }

    #[test]
    fn a_number_is_used_again_and_its_new_flow_inherits_nothing() {
        let mut flows = flows([Some(10), Some(20)]);
        flows.set_busy(0);
        assert!(flows.remove(0) && !flows.remove(0));
        assert!(flows.get(0).is_none() && flows.are_quiet());
        assert_eq!((flows.poll_timeout(), flows.ids()), (Some(at(20)), vec![1]));
        assert_eq!(flows.insert(flow(7)), 0);
        assert_eq!(flows.get(0).unwrap().info.of, flow(7).info.of);
        assert_eq!((flows.poll_timeout(), flows.are_quiet()), (Some(at(20)), true));
        assert_eq!(flows.insert(flow(8)), 2);
    }

    #[test]
    fn the_first_flow_that_is_busy_is_told() {
        let mut flows = flows([None, None]);
        assert!(flows.set_busy(1));
        assert!(!flows.set_busy(0) && !flows.set_busy(1));
        assert_eq!(flows.busy().map(|(id, _)| id).collect::<Vec<_>>(), [0, 1]);
        flows.set_quiet(1);
        let mut seen = 0;
        flows.for_each_busy(|_| seen += 1);
        assert_eq!((seen, flows.are_quiet()), (1, false));
        flows.set_quiet(0);
        assert!(flows.set_busy(1));
    }
}
