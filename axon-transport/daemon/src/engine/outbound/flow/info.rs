//! The constant properties of one flow.

use std::sync::Arc;

use axon_envelope::{Kind, Route};
use axon_shm::ids::Gid;
use axon_transport::config::TopicPriority;

use crate::engine::{
    outbound::served::FlowRoute,
    rank::{Class, Rank, SMALL},
    rings::RingSample,
    sample::stream_header::StreamHeader,
};

/// The content and route of a flow, and the formats that the peer reads.
#[derive(Clone, Debug)]
pub(in crate::engine::outbound) struct FlowInfo {
    pub(in crate::engine::outbound) route_number: u32,
    /// The publisher, or the client of a service.
    pub(in crate::engine::outbound) of: Gid,
    pub(super) topic: Arc<str>,
    pub(super) route: Route,
    /// The priority of the topic.
    pub(super) priority: TopicPriority,
    /// True if the peer acknowledges the samples.
    pub(super) acknowledged: bool,
    /// True if the peer reads short headers.
    pub(super) short_headers: bool,
    /// True if its samples may be compressed. Without acknowledgements, a flow does not know when a stream with short
    /// headers may be followed by one without.
    pub(super) compressed: bool,
    /// True if small samples may cross both paths. Without acknowledgements, the peer delivers a sample twice.
    pub(super) redundant: bool,
}

impl FlowInfo {
    /// Describes the flow of a publisher, or client, over a route.
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
            redundant: route.redundant && route.acknowledged,
        }
    }

    /// Returns whether it carries the requests or responses of a service.
    pub(super) fn is_service(&self) -> bool {
        self.route.kind != Kind::Topic
    }

    /// Returns the rank of a sample of this length.
    pub(super) fn rank(&self, reliable: bool, length: usize) -> Rank {
        let class = Class::of(self.is_service(), reliable, length);
        Rank { priority: self.priority, class }
    }

    /// Returns the rank of a BEST_EFFORT sample of this length. Services have none.
    pub(super) fn best_effort_rank(&self, length: usize) -> Rank {
        Rank { priority: self.priority, class: Class::of(false, false, length) }
    }

    /// Returns the header of a stream of RELIABLE samples.
    pub(super) fn reliable_header(&self, short: bool) -> StreamHeader {
        StreamHeader {
            reliable: true,
            copy: false,
            short,
            acknowledged: self.acknowledged && self.is_service(),
            route: self.route_number,
            of: self.of,
        }
    }

    /// Returns whether a sample also leaves over the second path, if there is one.
    pub(super) fn is_copied(&self, sample: &RingSample) -> bool {
        self.redundant && !sample.is_compressed() && sample.payload.len() <= SMALL
    }

    /// Returns the header of the stream of a RELIABLE sample's copy.
    pub(super) fn copy_header(&self) -> StreamHeader {
        StreamHeader { copy: true, ..self.reliable_header(false) }
    }

    /// Returns the header of the stream of one BEST_EFFORT sample.
    pub(super) fn best_effort_header(&self, short: bool) -> StreamHeader {
        let (route, of) = (self.route_number, self.of);
        StreamHeader { reliable: false, copy: false, short, acknowledged: false, route, of }
    }
}
