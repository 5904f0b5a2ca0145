//! A peer: its graph, the routes in both directions, and the samples that pass over them.

mod access;
mod asking;
mod context;
mod control_queue;
pub(super) mod kept_relays;
mod local_graph;
mod rights;
pub(super) mod routes;
mod serving;
pub(super) mod stalls;

use std::{collections::BTreeSet, rc::Rc, time::Duration};

use axon_envelope::Kind;
use axon_shm::ids::{DaemonId, Gid};
use axon_transport::{
    access::{Permissions, Verb},
    config::Config,
    graph::Endpoint,
    internal::{events::Alive, wire::session::CheckedUse},
    status::{LinkStatus, PeerDecision},
};

use self::{
    access::PeerAccess,
    control_queue::ControlQueue,
    kept_relays::KeptRelays,
    local_graph::{LocalGraph, Visibility},
    routes::{
        asked::AskedRoutes,
        limits::PeerLimits,
        refused::RefusedRoutes,
        served::{DENIED_AGAIN, ServedRoute, ServedRoutes},
        unanswered::UnansweredServices,
    },
};
pub(crate) use self::{
    context::{LocalEndpoints, PeerContext},
    routes::{
        lanes::LocalWriterCounts,
        served::{MAX_ROUTES, StalledRoute},
    },
};
use super::{
    inbound::Inbound,
    outbound::{Outbound, Source, StallCause},
};
use crate::{
    bridge::RefusedRoute,
    engine::{
        account::{Account, MAX_STAND_INS},
        counters::Counters,
        peer_graph::{GraphTaken, PeerGraph, owners::Prover},
        route::RouteKey,
    },
    link::{AccessDecisions, CloseCode, GraphUpdate, LinkClosed, LinkMessage, LivelinessAsserted},
    owner::ChannelBinding,
};

/// The number of routes of a peer whose HELLO does not state how many it serves.
pub(crate) const ROUTES_UNSAID: usize = 1024;

/// Returns the use that a peer makes of a route of this kind when it reads it.
fn reader_of(kind: Kind) -> Verb {
    match kind {
        Kind::Topic => Verb::Subscribe,
        Kind::Request => Verb::Serve,
        Kind::Response => Verb::Call,
    }
}

/// A peer with an elected link.
pub(crate) struct Peer {
    pub(super) daemon: DaemonId,
    /// The link in use.
    pub(super) link: u64,
    /// The identity that the peer proved.
    identity: String,
    pub(super) counters: Rc<Counters>,
    /// The peer's graph.
    pub(super) remote: PeerGraph,
    /// The peer's rights on this host.
    access: PeerAccess,
    /// True if endpoints of the peer were ignored because another peer has the same ones.
    pub(super) displaced: bool,
    /// The graph of this host that the peer is shown.
    local_graph: LocalGraph,
    /// True if the peer has been silent for so long that the control plane counts it as gone.
    pub(super) silent: bool,
    /// True if the peer's graph changed and the change still has to be processed.
    pub(super) stirred: bool,
    refusal_said: bool,
    asked: AskedRoutes,
    refused: RefusedRoutes,
    pub(super) inbound: Inbound,
    pub(super) outbound: Outbound,
    served: ServedRoutes,
    alive: Alive,
    answering: BTreeSet<Gid>,
    unanswered: UnansweredServices,
    messages: ControlQueue,
}

/// The parts of a new peer.
pub(crate) struct PeerParts {
    /// The peer's daemon.
    pub(crate) daemon: DaemonId,
    /// The link in use.
    pub(crate) link: u64,
    /// The identity that the peer proved.
    pub(crate) identity: String,
    /// The identity's account.
    pub(crate) account: Rc<Account>,
    /// Proves to the peer that sessions belong to this host.
    pub(crate) prover: Prover,
    /// The peer's rights on this host.
    pub(crate) permissions: Permissions,
    /// Counters of the peer's samples.
    pub(crate) counters: Rc<Counters>,
    /// Samples from the peer.
    pub(crate) inbound: Inbound,
    /// Samples to the peer.
    pub(crate) outbound: Outbound,
    /// The most routes that the peer serves.
    pub(crate) serves: usize,
}

impl Peer {
    /// Creates a peer without a graph.
    pub(super) fn new(parts: PeerParts) -> Self {
        let PeerParts {
            daemon,
            link,
            identity,
            account,
            prover,
            permissions,
            counters,
            inbound,
            outbound,
            serves,
        } = parts;
        Self {
            daemon,
            link,
            identity,
            counters,
            refused: RefusedRoutes::new(Rc::clone(&account.refusals)),
            access: PeerAccess::new(permissions.clone(), &account),
            remote: PeerGraph::new(account, prover.is_needed(), permissions),
            local_graph: LocalGraph::new(daemon, prover),
            displaced: false,
            silent: false,
            stirred: false,
            refusal_said: false,
            asked: AskedRoutes::new(serves),
            inbound,
            outbound,
            served: ServedRoutes::default(),
            alive: Alive::default(),
            answering: BTreeSet::new(),
            unanswered: UnansweredServices::default(),
            messages: ControlQueue::default(),
        }
    }

    /// Moves the peer to a new link. The peer's routes stay; this side asks for its own routes again.
    pub(super) fn succeed(
        &mut self,
        link: u64,
        binding: Option<ChannelBinding>,
        local: &LocalEndpoints,
    ) {
        self.link = link;
        self.messages.succeed();
        self.remote.succeed();
        let (visibility, graph, messages) = self.local_graph(local);
        graph.succeed(binding, visibility, messages);
        self.asked.messages().into_iter().for_each(|message| self.messages.say(message));
        self.refused.succeed(&mut self.messages);
        let denied = self.access.succeed();
        denied.into_iter().for_each(|message| self.say(message));
        self.served.iter_mut().for_each(|(_, served)| served.repeated = false);
    }

    /// Queues the list of links that are closed here.
    pub(super) fn say_closed(&mut self, closed: Option<LinkClosed>) {
        self.messages.say_closed(closed);
    }

    /// Queues a control message.
    pub(super) fn say(&mut self, message: LinkMessage) {
        self.messages.say(message);
    }

    /// Returns the next control message.
    pub(super) fn poll_message(&mut self) -> Option<LinkMessage> {
        self.messages.poll()
    }

    /// Handles a message that concerns only this peer.
    ///
    /// # Errors
    /// The peer violated the protocol.
    pub(super) fn handle_message(
        &mut self,
        now: Duration,
        message: LinkMessage,
        with: &PeerContext<'_>,
    ) -> Result<(), (CloseCode, String)> {
        match message {
            LinkMessage::GraphResync(_) => self.resync(with.local, now),
            LinkMessage::Subscribe(subscribe) => {
                let services = self.served.service_count();
                let of_service = subscribe.kind != Kind::Topic as u8;
                let served = self.serve(subscribe, with, now);
                if of_service || self.served.service_count() != services {
                    self.stirred |= self.services_changed();
                }
                return served.map_err(|reason| (CloseCode::Malformed, reason));
            }
            LinkMessage::Unsubscribe(unsubscribe) => {
                let of_service = self.served.is_service(unsubscribe.route);
                self.unserve(unsubscribe.route);
                self.stirred |= of_service && self.services_changed();
            }
            LinkMessage::Asserted(asserted) => self.handle_asserted(&asserted),
            LinkMessage::ReceiveLimits(intake) => self.outbound.set_receive_limits(&intake),
            LinkMessage::Received(received) => self.outbound.handle_received(&received.flows),
            LinkMessage::RouteRefused(refused) => self.handle_route_refused(now, refused),
            LinkMessage::Denied(denied) => {
                let allowed = self.access.handle_denied(now, self.daemon, denied);
                self.ask_for_allowed(&allowed);
            }
            LinkMessage::AccessCheck(check) => {
                let answer = self.access.answer(&check);
                self.say(answer);
            }
            LinkMessage::RouteUnasked(unasked) => self.refused.handle_route_unasked(now, unasked),
            LinkMessage::RouteReady(ready) => {
                self.handle_route_ready(ready.route);
                tracing::debug!(peer = %self.daemon, route = ready.route,
                    publishers = ready.publishers.len(), "route ready");
            }
            _ => {}
        }
        Ok(())
    }

    /// Replaces the access rules. Routes that they deny end at once; the graphs follow.
    pub(super) fn set_permissions(
        &mut self,
        permissions: Permissions,
        config: &Config,
        now: Duration,
    ) {
        self.access.set_permissions(permissions.clone());
        self.remote.set_permissions(permissions);
        self.local_graph.handle_permissions(&mut self.access);
        let denied = |served: &ServedRoute| {
            let why = self.access.denial(reader_of(served.key.kind), &served.key.topic)?;
            Some((served.key.clone(), why))
        };
        let ended = self.served.iter().filter_map(|(route, s)| Some((route, denied(s)?)));
        for (route, (key, why)) in ended.collect::<Vec<_>>() {
            self.unserve(route);
            self.refuse(route, &key, why, Some(DENIED_AGAIN), now);
        }
        self.renew_limits(config);
    }

    /// Returns the limits that the access rules set for the peer.
    fn limits<'a>(&'a self, config: &'a Config) -> PeerLimits<'a> {
        let (account, permissions) = (self.remote.account(), self.access.permissions());
        PeerLimits { account, permissions, config }
    }

    /// Gives the existing routes the limits that the access rules set now.
    fn renew_limits(&mut self, config: &Config) {
        let limits = self.limits(config);
        let served = self.served.iter();
        let outgoing = served.map(|(number, of)| (number, limits.outgoing(&of.key)));
        let outgoing: Vec<_> = outgoing.collect();
        let asked = self.asked.iter();
        let incoming: Vec<_> = asked.map(|(key, of)| (of.number, limits.incoming(key))).collect();
        for (number, limits) in outgoing {
            self.outbound.set_limits(number, limits);
        }
        for (number, limits) in incoming {
            if let Some(route) = self.inbound.routes().get_mut(&number) {
                route.limit.set(limits);
            }
        }
        self.inbound.handle_limits();
    }

    /// Asks the peer whether its access rules permit these uses to this host.
    pub(super) fn check_access(&mut self, number: u64, uses: Vec<CheckedUse>) {
        let question = self.access.ask(number, uses);
        self.say(question);
    }

    /// Handles the peer's answer about its access rules; `None` if there was no question.
    pub(super) fn take_decisions(&mut self, answer: AccessDecisions) -> Option<Vec<PeerDecision>> {
        self.access.take_decisions(answer)
    }

    /// Sends the peer the list of its endpoints that access rules deny, if the list changed.
    fn tell_denied(&mut self, now: Duration) {
        let messages = self.access.set_denied(self.daemon, self.remote.denied(), now);
        messages.into_iter().for_each(|message| self.say(message));
    }

    /// Handles a change of this host's graph: sends it to the peer and updates the routes.
    pub(super) fn handle_local_graph(&mut self, now: Duration, with: &PeerContext<'_>) {
        self.keep_ending(with.local, now);
        self.fit_relays(with, now);
        self.fit_stand_ins(with, now);
        self.send_graph(with.local, false);
        self.update(with, now);
    }

    /// Keeps ended publishers in the graph that the peer sees until their samples have arrived.
    fn keep_ending(&mut self, local: &LocalEndpoints, now: Duration) {
        let carried = |gid: &Gid, publisher: &Endpoint| {
            let number = self.served.number_of(&RouteKey::of(publisher)?)?;
            let sources = &self.served.get(number)?.sources;
            self.outbound.has_left(number, sources, gid).then_some(number)
        };
        let ended = self.local_graph.ended_publishers(local).filter_map(|(gid, publisher)| {
            Some((carried(gid, &publisher.endpoint)?, *gid, publisher.clone()))
        });
        for (number, gid, publisher) in ended.collect::<Vec<_>>() {
            self.outbound.handle_publisher_ended(now, number, gid);
            self.local_graph.keep(gid, publisher);
        }
    }

    /// Removes an ended publisher without remaining samples from the graph that the peer sees.
    pub(super) fn handle_drained(&mut self, gid: &Gid, local: &LocalEndpoints) {
        if self.local_graph.remove_ended(gid) {
            self.send_graph(local, false);
        }
    }

    /// Returns whether samples of ended publishers are still being sent.
    pub(super) fn is_draining(&self) -> bool {
        self.local_graph.is_draining()
    }

    /// Returns the graph of this host that the peer is shown, with its inputs and the queue for its messages.
    fn local_graph<'a>(
        &'a mut self,
        local: &'a LocalEndpoints,
    ) -> (Visibility<'a>, &'a mut LocalGraph, &'a mut ControlQueue) {
        let listed = self.remote.endpoints().any(|remote| remote.toward.lists);
        let visibility = Visibility { local, listed, access: &mut self.access };
        (visibility, &mut self.local_graph, &mut self.messages)
    }

    /// Sends the peer the changes of this host's graph, or the whole graph.
    pub(super) fn send_graph(&mut self, local: &LocalEndpoints, whole: bool) {
        let (visibility, graph, messages) = self.local_graph(local);
        graph.send(visibility, whole, messages);
    }

    /// Sends the whole graph, which the peer asked for.
    fn resync(&mut self, local: &LocalEndpoints, now: Duration) {
        let (visibility, graph, messages) = self.local_graph(local);
        graph.resync(visibility, now, messages);
    }

    /// Takes in a part of the peer's graph.
    pub(super) fn take_graph(&mut self, graph: GraphUpdate) -> GraphTaken {
        self.remote.take(graph)
    }

    /// Handles a change of the peer's graph.
    pub(super) fn handle_remote_graph(&mut self, now: Duration, with: &PeerContext<'_>) {
        self.tell_denied(now);
        // A session of the peer may now list this host, or list it no longer.
        self.send_graph(with.local, false);
        self.update(with, now);
    }

    /// Returns why a part of the peer's graph is refused, if that was not reported before.
    pub(super) fn newly_refused(&mut self) -> Option<String> {
        let refused = self.remote.refused().map(str::to_owned);
        let said = std::mem::replace(&mut self.refusal_said, refused.is_some());
        refused.filter(|_| !said)
    }

    /// Returns when to report the liveliness of this host's publishers to the peer.
    fn alive_due(&self, now: Duration) -> Option<Duration> {
        self.alive.left(now).map(|left| now + left)
    }

    fn tell_alive(&mut self, now: Duration) {
        let sources = self.served.iter().flat_map(|(_, served)| &served.sources);
        let asserted = sources.flat_map(|source| match source {
            Source::Relay(_, reader) => reader.assertions(),
            Source::StandIn(_) => Vec::new(),
        });
        for publishers in self.alive.due_assertions(now, asserted) {
            self.say(LinkMessage::Asserted(LivelinessAsserted { publishers }));
        }
    }

    fn handle_asserted(&self, asserted: &LivelinessAsserted) {
        let known = asserted.publishers.iter().filter_map(|gid| self.remote.get(gid));
        // The publisher's topic names the one route that may have its stand-in.
        let stand_ins = known.take(MAX_STAND_INS).filter_map(|publisher| {
            let asked = self.asked.get(&RouteKey::of(publisher)?)?;
            asked.stand_ins.get(&publisher.gid)
        });
        stand_ins.for_each(|stand_in| stand_in.ring().assert_alive());
    }

    /// Returns when [`handle_timeout`](Self::handle_timeout) is due. The peer's samples have timers of their
    /// own.
    pub(super) fn poll_timeout(&self, now: Duration) -> Option<Duration> {
        let alive = self.alive_due(now);
        let (attaching, announcing) = (self.asked.poll_timeout(), self.served.poll_timeout());
        let (resync, asks) = (self.local_graph.poll_timeout(), self.refused.poll_timeout());
        let unanswered = self.unanswered.poll_timeout();
        [attaching, announcing, alive, resync, asks, unanswered].into_iter().flatten().min()
    }

    /// Does the work that is due.
    pub(super) fn handle_timeout(&mut self, now: Duration, with: &PeerContext<'_>) {
        self.ask_for_attached(now);
        self.announce_ready(now);
        self.tell_alive(now);
        self.ask_again_in_time(now);
        self.check_unanswered(with, now);
        if self.local_graph.owes_resync() {
            self.resync(with.local, now);
        }
    }

    /// Returns whether the peer proved this identity.
    pub(super) fn has_identity(&self, identity: &str) -> bool {
        self.identity == identity
    }

    /// Keeps the KEEP_ALL relays of the peer, which is gone, for its next daemon.
    pub(super) fn keep_relays(&mut self, kept: &mut KeptRelays, now: Duration) {
        kept.add(&self.identity, &mut self.served, &mut self.outbound, now);
    }

    /// Gives up a route that the peer does not read.
    pub(super) fn handle_stalled(
        &mut self,
        now: Duration,
        route: u32,
        why: StallCause,
        with: &PeerContext<'_>,
    ) -> Option<StalledRoute> {
        let key = self.served.get(route)?.key.clone();
        let stalled = self.give_up_stalled(route, why, with, now)?;
        if key.kind != Kind::Topic {
            // The other direction of the service ends with it.
            self.unanswered.handle_stalled(key);
            self.update(with, now);
        }
        Some(stalled)
    }

    /// Returns the refused routes for the status of the endpoints that wait for them.
    pub(super) fn refused_routes(&self) -> Vec<RefusedRoute> {
        self.refused.at_endpoints().chain(self.access.refused_routes()).collect()
    }

    /// Adds the peer's graph and refused routes to the link's status.
    pub(super) fn fill(&self, status: &mut LinkStatus, now: Duration) {
        self.counters.fill(status);
        self.refused.fill(status);
        self.access.fill(status);
        self.remote.account().limits.fill(status);
        self.outbound.backlog().fill(status, now);
        status.endpoints = self.remote.len() as u64;
        status.endpoints_left_out = self.remote.left_out();
        status.graph_bytes = self.remote.account().graph.held() as u64;
        let held = &self.remote.account().held;
        (status.held_bytes, status.held_limit) = (held.held(), held.most());
    }

    /// Returns the bytes of remembered refused routes.
    #[cfg(test)]
    pub(super) fn held_of_refusals(&self) -> usize {
        self.refused.held()
    }

    /// Returns the number of routes that the peer is served.
    #[cfg(test)]
    pub(super) fn served_routes(&self) -> usize {
        self.served.len()
    }

    /// Counts the publishers, servers and clients of the peer that are shown here.
    #[cfg(test)]
    pub(super) fn stand_ins(&self) -> usize {
        self.asked.iter().map(|(_, asked)| asked.stand_ins.len()).sum()
    }
}
