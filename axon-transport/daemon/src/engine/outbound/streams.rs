//! Streams are scarce: the peer allows fewer than there may be flows. Those of flows that have nothing to send make room
//! for others.

use super::{FlowId, Outbound};
use crate::engine::{connection::Carrier, transport::STREAMS_OPEN};

/// Flows that one search looks at: all that have a stream. The peer may acknowledge all of them at once, and no further
/// acknowledgement would begin another search.
const SEARCHED: usize = STREAMS_OPEN as usize;

impl Outbound {
    /// Finishes streams that carry nothing, as many as flows wait for one, of flows that had something to send longest
    /// ago. The peer allows others in their place once it has read them.
    pub(super) fn finish_idle_streams(&mut self, carrier: &mut Carrier<'_>) {
        // A flow's timer runs since it began its stream, or was last found to use it.
        let oldest: Vec<FlowId> = self.timers.iter().take(SEARCHED).map(|(_, id)| *id).collect();
        let mut left = self.without.waits_for_stream();
        for id in oldest {
            if left == 0 {
                break;
            }
            let Some(flow) = self.flows[id].as_mut().filter(|flow| flow.has_idle_stream()) else {
                continue;
            };
            flow.finish_stream(carrier);
            left -= 1;
            let before = flow.timer;
            flow.restart_timer();
            if flow.timer != before {
                self.timers.remove(&(before.unwrap_or_default(), id));
                self.timers.extend(flow.timer.map(|due| (due, id)));
            }
        }
    }
}
