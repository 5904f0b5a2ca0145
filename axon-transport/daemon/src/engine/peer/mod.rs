//! A peer: its graph, the routes in both directions, and the samples that pass over them.

mod access;
mod asking;
mod context;
mod control_queue;
pub(super) mod kept_relays;
mod lanes;
mod limits;
mod refused;
mod rights;
pub(super) mod routes;
mod served;
mod serving;
pub(super) mod stalls;
mod unanswered;

use std::{
    collections::{BTreeMap, BTreeSet, HashMap},
    rc::Rc,
    sync::Arc,
    time::Duration,
};

use axon_envelope::Kind;
use axon_shm::ids::{DaemonId, Gid};
use axon_transport::{
    access::{Permissions, Verb},
    config::{Config, DiscoveryRange},
    graph::EndpointKind,
    internal::{events::Alive, graph::RemoteEndpoint, wire::session::CheckedUse},
    status::{LinkStatus, PeerDecision},
};

use self::{
    access::PeerAccess,
    asking::{AskedRoute, Attaching},
    control_queue::ControlQueue,
    refused::RefusedRoutes,
    served::{ServedRoute, ServedRoutes},
    serving::DENIED_AGAIN,
    unanswered::UnansweredServices,
};
pub(crate) use self::{
    context::{LocalEndpoints, PeerContext},
    lanes::WritersHere,
    serving::{MAX_ROUTES, StalledRoute},
};
use super::peer_graph::shown::{ShownEndpoint, ShownToPeer};
use super::{
    inbound::Inbound,
    outbound::{Outbound, Source, StallCause},
};
use crate::{
    engine::{
        account::{Account, MAX_STAND_INS},
        counters::Counters,
        peer::routes::RouteKey,
        peer_graph::{GraphTaken, PeerGraph, owners::Prover},
    },
    link::{AccessDecisions, CloseCode, GraphUpdate, LinkClosed, LinkMessage, LivelinessAsserted},
    owner::Binding,
};

/// The shortest time between two checks of pairs that are being attached.
const POLL: Duration = Duration::from_millis(5);
/// The shortest time for each of these pairs, so that thousands of waiting pairs leave time for samples.
const POLL_EACH: Duration = Duration::from_micros(4);
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

/// Returns the time until the next check of so many pairs.
fn poll_after(pairs: usize) -> Duration {
    POLL.max(POLL_EACH * u32::try_from(pairs).unwrap_or(u32::MAX))
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
    prover: Prover,
    /// The peer's rights on this host.
    access: PeerAccess,
    /// Whether endpoints of the peer were ignored because another peer has the same ones.
    pub(super) displaced: bool,
    /// The graph that was sent to the peer.
    shown_graph: ShownToPeer,
    /// Whether the peer has been silent for so long that the control plane counts it as gone.
    pub(super) silent: bool,
    /// Whether the peer's graph changed and the change still has to be processed.
    pub(super) stirred: bool,
    refusal_said: bool,
    next_route: u32,
    /// The most routes that the peer serves.
    serves: usize,
    asked: BTreeMap<RouteKey, AskedRoute>,
    /// The routes of `asked`, by number.
    numbers: HashMap<u32, RouteKey>,
    attaching: BTreeMap<u32, Attaching>,
    look_at_attaching: Option<Duration>,
    refused: RefusedRoutes,
    pub(super) inbound: Inbound,
    pub(super) outbound: Outbound,
    /// Ended publishers of this host whose samples have not all arrived. The peer sees them until then.
    ending: BTreeMap<Gid, RemoteEndpoint>,
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
            prover,
            displaced: false,
            shown_graph: ShownToPeer::default(),
            silent: false,
            stirred: false,
            refusal_said: false,
            next_route: 1,
            serves,
            asked: BTreeMap::new(),
            numbers: HashMap::new(),
            attaching: BTreeMap::new(),
            look_at_attaching: None,
            inbound,
            outbound,
            ending: BTreeMap::new(),
            served: ServedRoutes::default(),
            alive: Alive::default(),
            answering: BTreeSet::new(),
            unanswered: UnansweredServices::default(),
            messages: ControlQueue::default(),
        }
    }

    /// Moves the peer to a new link. The peer's routes stay; this side asks for its own routes again.
    pub(super) fn succeed(&mut self, link: u64, binding: Option<Binding>, local: &LocalEndpoints) {
        self.link = link;
        self.messages.succeed();
        self.prover.succeed(binding);
        self.remote.succeed();
        let visible = self.visible(local);
        self.prove(&visible);
        let asks: Vec<_> = self.asked.iter().map(|(key, asked)| asked.message(key)).collect();
        asks.into_iter().for_each(|message| self.say(message));
        self.say_unasked_again();
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
        message: LinkMessage,
        with: &PeerContext<'_>,
        now: Duration,
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
            LinkMessage::Intake(intake) => self.outbound.set_intake(&intake),
            LinkMessage::Received(received) => self.outbound.handle_received(&received.flows),
            LinkMessage::RouteRefused(refused) => self.handle_route_refused(refused, now),
            LinkMessage::Denied(denied) => {
                let allowed = self.access.handle_denied(self.daemon, denied, now);
                self.ask_for_allowed(&allowed);
            }
            LinkMessage::AccessCheck(check) => {
                let answer = self.access.answer(&check);
                self.say(answer);
            }
            LinkMessage::RouteUnasked(unasked) => self.handle_route_unasked(unasked, now),
            LinkMessage::RouteReady(ready) => {
                self.handle_route_ready(ready.route);
                tracing::debug!(peer = %self.daemon, route = ready.route,
                    publishers = ready.publishers.len(), "route ready");
            }
            _ => {}
        }
        Ok(())
    }

    /// Returns the endpoints of this host that the peer may see.
    fn shown(&mut self, local: &LocalEndpoints) -> BTreeMap<Gid, RemoteEndpoint> {
        let listed = self.remote.endpoints().any(|remote| remote.toward.lists);
        let shown = local.iter().filter_map(|(gid, (endpoint, reach))| {
            let toward = reach.toward(self.daemon);
            let shown = match toward.range {
                DiscoveryRange::Off => false,
                DiscoveryRange::Localhost => toward.lists || listed,
                DiscoveryRange::Subnet => true,
            };
            shown.then(|| (*gid, RemoteEndpoint { endpoint: Arc::clone(endpoint), toward }))
        });
        self.permitted(shown.collect())
    }

    /// Removes the endpoints that access rules hide from the peer.
    fn permitted(
        &mut self,
        mut all: BTreeMap<Gid, RemoteEndpoint>,
    ) -> BTreeMap<Gid, RemoteEndpoint> {
        all.retain(|_, e| self.access.judge(&e.endpoint).shown);
        all
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
        let ending = std::mem::take(&mut self.ending);
        self.ending = self.permitted(ending);
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
    pub(super) fn handle_local_graph(&mut self, with: &PeerContext<'_>, now: Duration) {
        self.keep_ending(with.local, now);
        self.fit_lanes(with, now);
        self.send_graph(with.local, false);
        self.update(with, now);
    }

    /// Keeps ended publishers in the graph that the peer sees until their samples have arrived.
    fn keep_ending(&mut self, local: &LocalEndpoints, now: Duration) {
        let ended = self.shown_graph.iter().filter(|(gid, shown)| {
            shown.remote.endpoint.kind == EndpointKind::Publisher
                && !local.contains_key(gid)
                && !self.ending.contains_key(gid)
        });
        let carried = |gid: &Gid, shown: &ShownEndpoint| {
            let number = self.served.number_of(&RouteKey::of(&shown.remote.endpoint)?)?;
            let sources = &self.served.get(number)?.sources;
            self.outbound.has_left(number, sources, gid).then_some(number)
        };
        let ended = ended
            .filter_map(|(gid, shown)| Some((carried(gid, shown)?, *gid, shown.remote.clone())));
        for (number, gid, shown) in ended.collect::<Vec<_>>() {
            self.outbound.handle_publisher_ended(number, gid, now);
            self.ending.insert(gid, shown);
        }
    }

    /// Removes an ended publisher without remaining samples from the graph that the peer sees.
    pub(super) fn handle_drained(&mut self, gid: &Gid, local: &LocalEndpoints) {
        if self.ending.remove(gid).is_some() {
            self.send_graph(local, false);
        }
    }

    /// Returns whether samples of ended publishers are still being sent.
    pub(super) fn is_draining(&self) -> bool {
        !self.ending.is_empty()
    }

    fn visible(&mut self, local: &LocalEndpoints) -> BTreeMap<Gid, RemoteEndpoint> {
        let mut visible = self.ending.clone();
        visible.extend(self.shown(local));
        visible
    }

    fn prove(&mut self, visible: &BTreeMap<Gid, RemoteEndpoint>) {
        for proofs in self.prover.owed(visible.keys()) {
            self.say(proofs);
        }
    }

    /// Sends the peer the changes of this host's graph, or the whole graph.
    pub(super) fn send_graph(&mut self, local: &LocalEndpoints, whole: bool) {
        let visible = self.visible(local);
        self.prove(&visible);
        let mut told = |remote: RemoteEndpoint| {
            let denied = !self.access.judge(&remote.endpoint).usable;
            ShownEndpoint { remote, denied }
        };
        let now: BTreeMap<_, _> = visible.into_iter().map(|(gid, e)| (gid, told(e))).collect();
        self.access.retain_rights(|gid| local.contains_key(gid) || self.ending.contains_key(gid));
        self.shown_graph
            .tell(now, whole)
            .into_iter()
            .for_each(|message| self.messages.say(message));
    }

    /// Sends the whole graph, which the peer asked for.
    fn resync(&mut self, local: &LocalEndpoints, now: Duration) {
        if self.shown_graph.handle_resync(now) {
            self.prover.forget();
            self.send_graph(local, true);
        }
    }

    /// Takes in a part of the peer's graph.
    pub(super) fn take_graph(&mut self, graph: GraphUpdate) -> GraphTaken {
        let taken = self.remote.take(graph);
        if taken == (GraphTaken::Changed { whole: true }) {
            self.unserve_unrepeated();
        }
        taken
    }

    /// Handles a change of the peer's graph.
    pub(super) fn handle_remote_graph(&mut self, with: &PeerContext<'_>, now: Duration) {
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
        let (attaching, announcing) = (self.look_at_attaching, self.served.poll_timeout());
        let (resync, asks) = (self.shown_graph.poll_timeout(), self.refused.poll_timeout());
        let unanswered = self.unanswered.poll_timeout();
        [attaching, announcing, alive, resync, asks, unanswered].into_iter().flatten().min()
    }

    /// Does the work that is due.
    pub(super) fn handle_timeout(&mut self, with: &PeerContext<'_>, now: Duration) {
        self.ask_for_attached(now);
        self.announce_ready(now);
        self.tell_alive(now);
        self.ask_again(now);
        self.look_at_unanswered(with, now);
        if self.shown_graph.owes_resync() {
            self.resync(with.local, now);
        }
    }

    /// Gives up a route that the peer does not read.
    pub(super) fn handle_stalled(
        &mut self,
        route: u32,
        why: StallCause,
        with: &PeerContext<'_>,
        now: Duration,
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

    /// Adds the peer's graph and refused routes to the link's status.
    pub(super) fn fill(&self, status: &mut LinkStatus, now: Duration) {
        self.counters.fill(status);
        self.show_refused(status);
        self.access.fill(status);
        self.remote.account().limits.fill(status);
        self.outbound.backlog().fill(status, now);
        status.endpoints = self.remote.len() as u64;
        status.endpoints_left_out = self.remote.left_out();
        status.graph_bytes = self.remote.account().graph.held() as u64;
        let held = &self.remote.account().held;
        (status.held_bytes, status.held_limit) = (held.held(), held.most());
    }

    /// Bytes of refused routes that are remembered.
    #[cfg(test)]
    pub(super) fn held_of_refusals(&self) -> usize {
        self.refused.held()
    }

    /// Counts the publishers, servers and clients of the peer that are shown here.
    #[cfg(test)]
    pub(super) fn stand_ins(&self) -> usize {
        self.asked.values().map(|asked| asked.stand_ins.len()).sum()
    }
}
