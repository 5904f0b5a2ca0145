//! Two sessions, or one session in both roles.

use axon_transport::{EndpointSpec, Publisher, Session, Subscription, qos::Qos};

use super::{
    alone, spec,
    support::{Host, Kept, PATIENCE},
};

/// A session that publishes and one that subscribes.
pub(super) struct Pair {
    pub(super) here: Session,
    pub(super) there: Session,
    /// Dropped in this order.
    _daemon: Option<(Kept, Host)>,
}

impl Pair {
    /// One session without a daemon.
    pub(super) fn alone() -> Self {
        let session = alone();
        Self { here: session.clone(), there: session, _daemon: None }
    }

    /// Two sessions of one daemon, which share as much as sessions of two processes.
    pub(super) fn apart() -> Self {
        let host = Host::new();
        let daemon = host.daemon();
        let [here, there] = ["here", "there"].map(|name| host.session(name).unwrap());
        Self { here, there, _daemon: Some((daemon, host)) }
    }

    pub(super) fn all() -> [Self; 2] {
        [Self::alone(), Self::apart()]
    }

    /// Creates a publisher and a subscription, and waits until they are matched.
    pub(super) fn matched(&self, offered: Qos, requested: Qos) -> (Publisher, Subscription) {
        self.matched_as(spec(offered), spec(requested))
    }

    pub(super) fn matched_as(
        &self,
        offered: EndpointSpec,
        requested: EndpointSpec,
    ) -> (Publisher, Subscription) {
        let subscription = self.there.create_subscription(requested).unwrap();
        let publisher = self.here.create_publisher(offered).unwrap();
        assert!(publisher.wait_matched(1, PATIENCE) && subscription.wait_matched(1, PATIENCE));
        (publisher, subscription)
    }
}
