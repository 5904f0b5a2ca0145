//! Finds lost packets of short samples early on links that lose many.
//!
//! QUIC detects the loss of a packet when a later packet is acknowledged. A camera sends later packets all the time,
//! but a command does not. QUIC then waits for a timer that doubles each time. At 40 % of loss this soon takes longer
//! than a command is useful. So while samples are in flight over a link that loses packets, and no other sample was
//! handed to QUIC, a PING follows them every few milliseconds. Each acknowledged PING shows which packets before it are
//! lost.

use std::{collections::HashMap, time::Duration};

use crate::engine::rank::FlowId;

/// Minimum distance of PINGs, which otherwise follow each other at half a round trip.
const MIN_PING_INTERVAL: Duration = Duration::from_millis(3);
/// Maximum number of PINGs after the last sample of a flow, if no acknowledgement ends them.
const MAX_PINGS: u8 = 100;

/// The samples in flight that PINGs follow.
#[derive(Debug, Default)]
pub(super) struct Pings {
    /// Flows with samples in flight, and the number of PINGs since the last sample.
    flows: HashMap<FlowId, u8>,
    due: Option<Duration>,
    /// True if samples were sent since the last PING: they have the same effect.
    sent: bool,
}

impl Pings {
    /// Records that a flow sent samples over a link that loses packets.
    pub(super) fn handle_sent(&mut self, now: Duration, flow: FlowId, rtt: Duration) {
        self.flows.insert(flow, 0);
        self.sent = true;
        self.due.get_or_insert(now + MIN_PING_INTERVAL.max(rtt / 2));
    }

    /// Forgets a flow that is gone.
    pub(super) fn forget(&mut self, flow: FlowId) {
        self.flows.remove(&flow);
    }

    /// Returns when [`handle_timeout`](Self::handle_timeout) is due.
    pub(super) fn poll_timeout(&self) -> Option<Duration> {
        self.due
    }

    /// Returns whether a PING is to be sent now. `on_the_way` returns whether a flow still has samples in flight.
    pub(super) fn handle_timeout(
        &mut self,
        now: Duration,
        rtt: Duration,
        on_the_way: impl Fn(FlowId) -> bool,
    ) -> bool {
        if self.due.is_none_or(|due| due > now) {
            return false;
        }
        self.flows.retain(|flow, pings| {
            *pings += 1;
            *pings <= MAX_PINGS && on_the_way(*flow)
        });
        let is_over = self.flows.is_empty();
        self.due = (!is_over).then(|| now + MIN_PING_INTERVAL.max(rtt / 2));
        !std::mem::take(&mut self.sent) && !is_over
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const RTT: Duration = Duration::from_millis(4);

    /// Returns the number of PINGs until nothing is due.
    fn count(pings: &mut Pings, on_the_way: impl Fn(Duration) -> bool) -> u32 {
        let mut sent = 0;
        while let Some(now) = pings.poll_timeout() {
            sent += u32::from(pings.handle_timeout(now, RTT, |_| on_the_way(now)));
        }
        sent
    }

    #[test]
    fn pings_follow_samples_until_they_have_arrived() {
        let mut pings = Pings::default();
        assert_eq!(pings.poll_timeout(), None);
        pings.handle_sent(Duration::ZERO, 7, RTT);
        assert_eq!(pings.poll_timeout(), Some(MIN_PING_INTERVAL));
        // At 3 ms the sample itself had just been sent; then there are PINGs at 6, 9 and 12 ms.
        assert_eq!(count(&mut pings, |now| now < Duration::from_millis(15)), 3);
        pings.handle_sent(Duration::ZERO, 7, RTT);
        pings.forget(7);
        assert_eq!(count(&mut pings, |_| true), 0);
    }

    #[test]
    fn pings_end_where_nothing_says_that_a_sample_arrived() {
        let mut pings = Pings::default();
        pings.handle_sent(Duration::ZERO, 7, RTT);
        assert_eq!(count(&mut pings, |_| true), u32::from(MAX_PINGS) - 1);
    }

    #[test]
    fn samples_that_follow_each_other_need_no_pings() {
        let mut pings = Pings::default();
        for time in 0..100 {
            let now = Duration::from_millis(time);
            pings.handle_sent(now, 7, RTT);
            assert!(!pings.handle_timeout(now, RTT, |_| true), "{time}");
        }
    }
}
