//! Counts the ECN marks that the peer of a connection reports.
//!
//! QUIC passes them only to its congestion controller, and its statistics do not distinguish them from losses. So this
//! module wraps the controller.

use std::{any::Any, sync::Arc, time::Instant};

use quinn_proto::{
    RttEstimator,
    congestion::{Controller, ControllerFactory, ControllerMetrics},
};

/// A congestion controller that counts reports of marks, and passes every call on to the controller that it wraps.
struct EcnCountingController {
    inner: Box<dyn Controller>,
    marks: u64,
}

/// Makes [`EcnCountingController`] controllers around those of another factory.
pub(in crate::engine) struct EcnCountingFactory<F>(pub(in crate::engine) Arc<F>);

impl<F: ControllerFactory> ControllerFactory for EcnCountingFactory<F> {
    fn build(self: Arc<Self>, now: Instant, current_mtu: u16) -> Box<dyn Controller> {
        Box::new(EcnCountingController {
            inner: Arc::clone(&self.0).build(now, current_mtu),
            marks: 0,
        })
    }
}

/// Returns how often the peer of a connection reported new marks. The count starts again at a new address of the peer.
pub(in crate::engine) fn marks_reported(quic: &quinn_proto::Connection) -> u64 {
    // Only a copy of the controller is accessible. It is made for status, once a second.
    let controller = quic.congestion_state().clone_box().into_any();
    controller.downcast_ref::<EcnCountingController>().map_or(0, |counting| counting.marks)
}

/// Returns a copy of the wrapped controller.
pub(in crate::engine) fn wrapped(quic: &quinn_proto::Connection) -> Option<Box<dyn Any>> {
    let counting =
        quic.congestion_state().clone_box().into_any().downcast::<EcnCountingController>().ok()?;
    Some(counting.inner.into_any())
}

impl Controller for EcnCountingController {
    fn on_sent(&mut self, now: Instant, bytes: u64, last_packet_number: u64) {
        self.inner.on_sent(now, bytes, last_packet_number);
    }

    fn on_ack(
        &mut self,
        now: Instant,
        sent: Instant,
        bytes: u64,
        app_limited: bool,
        rtt: &RttEstimator,
    ) {
        self.inner.on_ack(now, sent, bytes, app_limited, rtt);
    }

    fn on_end_acks(
        &mut self,
        now: Instant,
        in_flight: u64,
        app_limited: bool,
        largest_packet_num_acked: Option<u64>,
    ) {
        self.inner.on_end_acks(now, in_flight, app_limited, largest_packet_num_acked);
    }

    fn on_congestion_event(
        &mut self,
        now: Instant,
        sent: Instant,
        is_persistent_congestion: bool,
        lost_bytes: u64,
    ) {
        // A congestion event without a loss is a report of marks.
        self.marks += u64::from(lost_bytes == 0);
        self.inner.on_congestion_event(now, sent, is_persistent_congestion, lost_bytes);
    }

    fn on_mtu_update(&mut self, new_mtu: u16) {
        self.inner.on_mtu_update(new_mtu);
    }

    fn window(&self) -> u64 {
        self.inner.window()
    }

    fn metrics(&self) -> ControllerMetrics {
        self.inner.metrics()
    }

    fn clone_box(&self) -> Box<dyn Controller> {
        Box::new(Self { inner: self.inner.clone_box(), marks: self.marks })
    }

    fn initial_window(&self) -> u64 {
        self.inner.initial_window()
    }

    fn into_any(self: Box<Self>) -> Box<dyn Any> {
        self
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use quinn_proto::congestion::CubicConfig;

    use super::*;

    #[test]
    fn marks_are_counted_and_losses_are_not_and_both_reach_the_wrapped_controller() {
        let now = Instant::now();
        let factory = Arc::new(EcnCountingFactory(Arc::new(CubicConfig::default())));
        let mut controller = factory.build(now, 1200);
        let at = |seconds| now + Duration::from_secs(seconds);
        let initial = controller.window();
        controller.on_congestion_event(at(1), at(1), false, 0);
        let marked = controller.window();
        controller.on_congestion_event(at(2), at(2), false, 1200);
        assert!(initial > marked && marked > controller.window());
        let copy = controller.clone_box().into_any();
        assert_eq!(
            copy.downcast_ref::<EcnCountingController>().map(|counting| counting.marks),
            Some(1)
        );
    }
}
