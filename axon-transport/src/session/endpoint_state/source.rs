//! A side of an endpoint, for code that treats both sides alike.

use std::sync::Arc;

use super::{
    events::{Changes, EndpointEvents},
    publisher::PublisherInner,
    subscription::SubscriptionInner,
};
use crate::{events::EventKind, graph::Endpoint};

/// The side of the endpoint that an event belongs to.
#[derive(Clone)]
pub(in crate::session) enum EventSource {
    Publisher(Arc<PublisherInner>),
    Subscription(Arc<SubscriptionInner>),
}

impl EventSource {
    pub(in crate::session) fn events(&self) -> &EndpointEvents {
        match self {
            Self::Publisher(inner) => &inner.events,
            Self::Subscription(inner) => &inner.events,
        }
    }

    pub(in crate::session) fn endpoint(&self) -> &Endpoint {
        match self {
            Self::Publisher(inner) => &inner.endpoint,
            Self::Subscription(inner) => &inner.endpoint,
        }
    }

    /// Updates the matched endpoints. Returns the changes since the last call.
    pub(in crate::session) fn rematch(&self) -> Changes {
        match self {
            Self::Publisher(inner) => inner.rematch(),
            Self::Subscription(inner) => inner.rematch(),
        }
    }

    /// Counts missed deadlines and changes of liveliness until `now`. Returns when to look again, and whether an event
    /// occurred.
    pub(in crate::session) fn look_at_time(&self, now: u64) -> (Option<u64>, bool) {
        match self {
            Self::Publisher(inner) => inner.look_at_time(now),
            Self::Subscription(inner) => inner.look_at_time(now),
        }
    }

    /// Returns whether `kind` occurred since its status was taken.
    pub(in crate::session) fn has(&self, kind: EventKind) -> bool {
        if let (Self::Subscription(inner), EventKind::MessageLost) = (self, kind) {
            inner.look_for_losses();
        }
        self.events().unread(kind) > 0
    }

    /// Like [`has`](Self::has), for other threads than the waiting one: while a thread is taking samples, this returns
    /// true.
    pub(in crate::session) fn may_have(&self, kind: EventKind) -> bool {
        let losing = match (self, kind) {
            (Self::Subscription(inner), EventKind::MessageLost) => inner.may_have_losses(),
            _ => false,
        };
        losing || self.events().unread(kind) > 0
    }
}
