//! The endpoints and nodes that a session has.

use std::{
    collections::{BTreeMap, BTreeSet, HashMap},
    sync::Arc,
    time::Instant,
};

use crate::{
    graph::{Endpoint, TopicIndex},
    ids::Gid,
    session::{
        core::GuardCondition,
        endpoint_state::{PublisherInner, SubscriptionInner},
    },
    wire::session::EndpointRole,
};

/// The endpoints and nodes of a session, including endpoints that it has for other processes.
#[derive(Default)]
pub(in crate::session) struct OwnEndpoints {
    last_number: u32,
    /// The nodes, each with the condition that is triggered by changes of the graph.
    pub(in crate::session) nodes: HashMap<Gid, (Endpoint, GuardCondition)>,
    pub(in crate::session) publishers: HashMap<Gid, Arc<PublisherInner>>,
    pub(in crate::session) subscriptions: HashMap<Gid, Arc<SubscriptionInner>>,
    /// Publishers that the application has dropped, each with the time until which it stays at most.
    pub(in crate::session) leaving: BTreeMap<Gid, Instant>,
    /// Applications' endpoints by topic or service.
    pub(in crate::session) topics: TopicIndex,
}

impl OwnEndpoints {
    /// Returns the number of a new endpoint.
    pub(in crate::session) fn next_number(&mut self) -> u32 {
        self.last_number += 1;
        self.last_number
    }

    /// Returns the nodes and endpoints of the session's application.
    pub(in crate::session) fn own(&self) -> impl Iterator<Item = &Endpoint> {
        let application = |role| role == EndpointRole::Application;
        let nodes = self.nodes.values().map(|(node, _)| node);
        let publishers = self
            .publishers
            .values()
            .filter(move |p| application(p.role) && !self.leaving.contains_key(&p.endpoint.gid));
        let subscriptions = self.subscriptions.values().filter(move |s| application(s.role));
        nodes
            .chain(publishers.map(|publisher| &publisher.endpoint))
            .chain(subscriptions.map(|subscription| &subscription.endpoint))
    }

    /// Returns the publishers and subscriptions, including the sides of services.
    pub(in crate::session) fn all(
        &self,
    ) -> (Vec<Arc<PublisherInner>>, Vec<Arc<SubscriptionInner>>) {
        let publishers = self.publishers.values().cloned().collect();
        (publishers, self.subscriptions.values().cloned().collect())
    }

    /// Returns the GIDs of all nodes and endpoints.
    pub(in crate::session) fn gids(&self) -> BTreeSet<Gid> {
        let endpoints = self.publishers.keys().chain(self.subscriptions.keys());
        self.nodes.keys().chain(endpoints).copied().collect()
    }
}
