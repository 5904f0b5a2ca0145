//! The constant properties of one flow.

use std::sync::Arc;

use axon_envelope::{Kind, Route};
use axon_shm::ids::Gid;
use axon_transport::config::TopicPriority;

use crate::engine::{
    inbound::StreamHeader,
    outbound::{
        schedule::{Class, Rank},
        served::FlowRoute,
    },
};

/// What a flow carries over which route, and how the peer reads it.
#[derive(Clone, Debug)]
pub(in crate::engine::outbound) struct FlowInfo {
    pub(in crate::engine::outbound) route_number: u32,
    /// The publisher, or the client of a service.
    pub(in crate::engine::outbound) of: Gid,
    pub(super) topic: Arc<str>,
    pub(super) route: Route,
    /// Of the topic.
    pub(super) priority: TopicPriority,
    /// Whether the peer acknowledges the samples.
    pub(super) acknowledged: bool,
    /// Whether the peer reads short headers.
    pub(super) short_headers: bool,
    /// Whether its samples may be compressed. Of a flow that is not acknowledged nothing says when a stream with short headers
    /// may be followed by one without.
    pub(super) compressed: bool,
}

impl FlowInfo {
    /// The flow of a publisher, or client, over a route.
    pub(super) fn new(of: Gid, route: &FlowRoute) -> Self {
        Self {
            route_number: route.number,
            of,
            topic: Arc::clone(&route.topic),
            route: route.route,
            priority: route.priority,
            acknowledged: route.acknowledged,
            short_headers: route.short_headers,
            compressed: route.compressed && route.acknowledged,
        }
    }

    /// Whether it carries the requests or responses of a service.
    pub(super) fn is_service(&self) -> bool {
        self.route.kind != Kind::Topic
    }

    /// The rank of a sample of this length.
    pub(super) fn rank(&self, reliable: bool, length: usize) -> Rank {
        let class = Class::of(self.is_service(), reliable, length);
        Rank { priority: self.priority, class }
    }

    /// The rank of a BEST_EFFORT sample of this length. No service has any.
    pub(super) fn best_effort_rank(&self, length: usize) -> Rank {
        Rank { priority: self.priority, class: Class::of(false, false, length) }
    }

    /// The header of a stream of RELIABLE samples.
    pub(super) fn reliable_header(&self, short: bool) -> StreamHeader {
        StreamHeader {
            reliable: true,
            short,
            acknowledged: self.acknowledged && self.is_service(),
            route: self.route_number,
            of: self.of,
        }
    }

    /// The header of the stream of one BEST_EFFORT sample.
    pub(super) fn best_effort_header(&self, short: bool) -> StreamHeader {
        let (route, of) = (self.route_number, self.of);
        StreamHeader { reliable: false, short, acknowledged: false, route, of }
    }
}
