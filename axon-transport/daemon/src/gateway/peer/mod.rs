//! One linked peer: its graph, the routes in both directions, and the tasks that carry samples.

mod alive;
mod asking;
pub(crate) mod graph;
pub(crate) mod owners;
mod refused;
mod serving;

use std::{
    collections::{BTreeMap, BTreeSet, HashMap},
    sync::Arc,
    time::{Duration, Instant},
};

use axon_shm::ids::{DaemonId, Gid};
use axon_transport::{
    config::DiscoveryRange,
    graph::{Endpoint, EndpointKind},
    internal::{
        events::Alive,
        graph::{RangeToHost, RemoteEndpoint},
    },
    status::LinkStatus,
};
use tokio::sync::{mpsc, watch};

use self::{asking::Asked, graph::Remote, refused::RefusedRoutes, serving::Served};
pub(super) use self::{
    graph::{GraphChange, GraphTaken},
    owners::{Prover, binding},
};
use super::{
    account::Account,
    control::Outbox,
    counters::Tally,
    hub::{Event, Local, Shared},
    inbound::Inbound,
    intake::Intake,
    outbound::{self, Acknowledged, Carrier, Inbox, Owner},
    receipts::Receipts,
    routes::RouteKey,
    routes_in::RoutesIn,
};
use crate::link::{Graph, Message, Received};

/// Routes that a peer may ask for, and that it is asked for.
const MAX_ROUTES: usize = 1024;
/// Endpoints in one GRAPH message; a larger graph takes several.
const GRAPH_PART: usize = 512;
/// How often a peer may ask for the whole graph.
const RESYNC: Duration = Duration::from_secs(1);
/// How often readers are looked for meanwhile.
const POLL: Duration = Duration::from_millis(5);

/// A peer with an elected link.
pub(super) struct Peer {
    daemon: DaemonId,
    /// The number of the link in use.
    pub(super) link: u64,
    /// Control messages to it.
    pub(super) outbox: Outbox,
    /// What was carried and dropped.
    pub(super) counters: Tally,
    pub(super) remote: Remote,
    /// Proves to it which sessions are this daemon's.
    prover: Prover,
    /// Endpoints of its were left out because another peer announced them first, where nothing is proved.
    pub(super) displaced: bool,
    sent: BTreeMap<Gid, RemoteEndpoint>,
    sent_version: u64,
    /// When the peer was sent the whole graph last that it asked for, and whether it asked again.
    resynced: Option<Instant>,
    resync_due: bool,
    /// Its graph changed, and what follows from that was not worked out yet.
    pub(super) stirred: bool,
    /// Whether it was said that something is left out of its graph.
    refusal_said: bool,
    next_route: u32,
    /// Routes that this side asked for.
    asked: BTreeMap<RouteKey, Asked>,
    /// Who it proved to be.
    identity: String,
    /// Routes that do not come about.
    refused: RefusedRoutes,
    routes_in: Arc<RoutesIn>,
    /// Memory for what comes from it, over whichever link.
    intake: Arc<Intake>,
    /// What it is told of it, and the task that does so.
    receipts: Arc<Receipts>,
    _telling: OnDrop,
    /// Publishers here that ended, which it sees until it has what they left.
    ending: BTreeMap<Gid, RemoteEndpoint>,
    /// Routes that the peer asked for.
    served: HashMap<u32, Served>,
    /// Which publishers here were alive, as the peer was told.
    alive: Alive,
    /// Servers there whose host takes requests for them.
    answering: BTreeSet<Gid>,
    orders: mpsc::UnboundedSender<outbound::Order>,
    /// Samples that it acknowledged.
    acknowledged: Arc<Acknowledged>,
}

impl Peer {
    /// A peer whose first link was elected.
    pub(super) fn new(
        link: u64,
        outbox: Outbox,
        carrier: Carrier,
        account: Arc<Account>,
        prover: Prover,
        shared: &Arc<Shared>,
        owner: Owner,
    ) -> Self {
        let counters = Tally::default();
        let intake = Arc::clone(&account.intake);
        let (orders, receiver) = mpsc::unbounded_channel();
        let acknowledged = Arc::<Acknowledged>::default();
        let inbox = Inbox { orders: receiver, acknowledged: Arc::clone(&acknowledged) };
        let (queues, ring_wakeups) = (shared.queues.of_peer(), shared.ring_wakeups.clone());
        let (daemon, stalled_after) = (owner.daemon, shared.stalled_after);
        let owner_identity = owner.identity.clone();
        let sent = counters.counting();
        tokio::spawn(outbound::run(
            carrier,
            inbox,
            sent,
            queues,
            ring_wakeups,
            owner,
            stalled_after,
        ));
        let receipts = Receipts::new(outbox.clone());
        let telling = OnDrop(tokio::spawn(Arc::clone(&receipts).run()));
        Self {
            daemon,
            link,
            outbox,
            counters,
            remote: Remote::new(account, prover.is_needed()),
            prover,
            displaced: false,
            sent: BTreeMap::new(),
            sent_version: 0,
            resynced: None,
            resync_due: false,
            stirred: false,
            refusal_said: false,
            next_route: 1,
            asked: BTreeMap::new(),
            identity: owner_identity,
            refused: RefusedRoutes::default(),
            routes_in: Arc::default(),
            intake,
            receipts,
            _telling: telling,
            ending: BTreeMap::new(),
            served: HashMap::new(),
            alive: Alive::default(),
            answering: BTreeSet::new(),
            orders,
            acknowledged,
        }
    }

    /// A successor link takes over: samples go over it from now on, and both sides repeat what they
    /// said last, since it may have been lost with the old one.
    pub(super) fn succeed(&mut self, link: u64, outbox: Outbox, carrier: Carrier, local: &Local) {
        self.link = link;
        self.receipts.succeed(outbox.clone());
        self.outbox = outbox;
        self.prover.succeed(binding(&carrier.connection));
        self.remote.succeed();
        // SUBSCRIBE names sessions as GRAPH does.
        let visible = self.visible(local);
        self.prove(&visible);
        let _ = self.orders.send(outbound::Order::Connection(carrier));
        for (key, asked) in &self.asked {
            self.say(asked.message(key));
        }
        for served in self.served.values_mut() {
            served.repeated = false;
        }
    }

    /// What a data stream of `connection` needs.
    pub(super) fn inbound(
        &self,
        carrier: Carrier,
        shared: &Shared,
        wanted: watch::Receiver<()>,
        refused: mpsc::Sender<(crate::link::CloseCode, String)>,
    ) -> Inbound {
        Inbound {
            connection: carrier.connection,
            protection: carrier.protection,
            routes: Arc::clone(&self.routes_in),
            counters: self.counters.counting(),
            ring_wakeups: shared.ring_wakeups.clone(),
            max_message: shared.max_message,
            wanted,
            intake: Arc::clone(&self.intake),
            receipts: Arc::clone(&self.receipts),
            losses: Arc::default(),
            refused,
        }
    }

    /// Puts a message into the outbox.
    pub(super) fn say(&self, message: Message) {
        self.outbox.send(message);
    }

    // ---- graph ----

    /// What the peer is shown of this host. A LOCALHOST session's endpoints are shown to a host that
    /// the session lists, and to one of which a session lists this host; those of an OFF one to nobody.
    fn shown(&self, local: &Local) -> BTreeMap<Gid, RemoteEndpoint> {
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
        shown.collect()
    }

    /// Keeps publishers that ended in the peer's sight for as long as it has not got what they left.
    pub(super) fn keep_ending(&mut self, local: &Local) {
        let ended = self.sent.iter().filter(|(gid, shown)| {
            shown.endpoint.kind == EndpointKind::Publisher
                && !local.contains_key(gid)
                && !self.ending.contains_key(gid)
        });
        let carried = |gid: &Gid| {
            let sources = self.served.values().flat_map(|served| &served.sources);
            sources.into_iter().any(|source| source.has_unacknowledged(gid))
        };
        let ended = ended.filter(|(gid, _)| carried(gid));
        let ended: Vec<_> = ended.map(|(gid, shown)| (*gid, shown.clone())).collect();
        for (gid, shown) in ended {
            let _ = self.orders.send(outbound::Order::Ending(gid));
            self.ending.insert(gid, shown);
        }
    }

    /// Nothing is left of what a publisher left.
    pub(super) fn drained(&mut self, gid: &Gid, local: &Local) {
        if self.ending.remove(gid).is_some() {
            self.send_graph(local, false);
        }
    }

    /// Whether there are publishers that ended and whose samples are on their way.
    pub(super) fn is_draining(&self) -> bool {
        !self.ending.is_empty()
    }

    /// The peer acknowledges samples.
    pub(super) fn received(&self, received: &Received) {
        self.acknowledged.note(&received.flows);
    }

    /// What the peer sees: what it is shown, and publishers that ended and are kept in its sight.
    fn visible(&self, local: &Local) -> BTreeMap<Gid, RemoteEndpoint> {
        let mut visible = self.ending.clone();
        visible.extend(self.shown(local));
        visible
    }

    /// Proves to the peer that the sessions of these endpoints are this daemon's, where it was not told.
    fn prove(&mut self, visible: &BTreeMap<Gid, RemoteEndpoint>) {
        for proofs in self.prover.owed(visible.keys()) {
            self.say(proofs);
        }
    }

    /// Sends what changed since the last time, or all of it.
    pub(super) fn send_graph(&mut self, local: &Local, whole: bool) {
        if whole {
            self.sent.clear();
        }
        let now = self.visible(local);
        self.prove(&now);
        let added: Vec<_> =
            now.iter().filter(|(gid, e)| self.sent.get(gid) != Some(e)).map(|(_, e)| e).collect();
        let removed: Vec<_> =
            self.sent.keys().filter(|gid| !now.contains_key(gid)).copied().collect();
        if !whole && added.is_empty() && removed.is_empty() {
            return;
        }
        let mut before = if whole { 0 } else { self.sent_version };
        let mut removed = Some(removed);
        let mut parts: Vec<&[_]> = added.chunks(GRAPH_PART).collect();
        if parts.is_empty() {
            parts.push(&[]);
        }
        let last = parts.len() - 1;
        for (index, part) in parts.into_iter().enumerate() {
            self.sent_version += 1;
            let named = |is: fn(&RangeToHost) -> bool| {
                let gids = part.iter().filter(|e| is(&e.toward)).map(|e| e.endpoint.gid);
                Some(gids.collect::<Vec<_>>()).filter(|gids| !gids.is_empty())
            };
            let graph = Graph {
                version: self.sent_version,
                before,
                localhost: named(|toward| toward.range != DiscoveryRange::Subnet),
                listing: named(|toward| toward.lists),
                added: part.iter().map(|e| Endpoint::clone(&e.endpoint)).collect(),
                removed: removed.take().unwrap_or_default(),
                more: index < last,
            };
            self.say(Message::Graph(graph));
            before = self.sent_version;
        }
        self.sent = now;
    }

    /// The peer asks for the whole graph: once a second it gets it.
    pub(super) fn resync(&mut self, local: &Local, now: Instant) {
        let recent = |sent| now.saturating_duration_since(sent) < RESYNC;
        self.resync_due = self.resynced.is_some_and(recent);
        if !self.resync_due {
            self.resynced = Some(now);
            self.prover.forget();
            self.send_graph(local, true);
        }
    }

    /// Sends the whole graph where that was put off.
    pub(super) fn resync_if_due(&mut self, local: &Local) {
        if self.resync_due {
            self.resync(local, Instant::now());
        }
    }

    /// Takes a GRAPH in.
    pub(super) fn take_graph(&mut self, graph: Graph) -> GraphTaken {
        let taken = self.remote.take(graph);
        if taken == (GraphTaken::Changed { whole: true }) {
            self.unserve_unrepeated();
        }
        taken
    }

    /// What is to be said of endpoints that are left out, once until the graph was complete again.
    pub(super) fn newly_refused(&mut self) -> Option<String> {
        let refused = self.remote.refused().map(str::to_owned);
        let said = std::mem::replace(&mut self.refusal_said, refused.is_some());
        refused.filter(|_| !said)
    }

    /// The peer is gone. What its tasks count until they have ended.
    pub(super) fn over(self) -> Tally {
        self.counters
    }

    /// Puts what the peer's graph takes into `status`.
    pub(super) fn fill(&self, status: &mut LinkStatus) {
        status.endpoints = self.remote.len() as u64;
        status.endpoints_left_out = self.remote.left_out();
        status.graph_bytes = self.remote.account().graph.held() as u64;
    }
}

/// A task that ends with what it is for.
struct OnDrop(tokio::task::JoinHandle<()>);

impl Drop for OnDrop {
    fn drop(&mut self) {
        self.0.abort();
    }
}

/// What the hub hears from the tasks of a peer.
pub(super) fn spawn_reader(
    link: u64,
    mut reader: super::control::ControlReader,
    account: Arc<Account>,
    connection: quinn::Connection,
    events: mpsc::Sender<Event>,
) {
    tokio::spawn(async move {
        let pace = |cost| {
            let (account, connection) = (Arc::clone(&account), connection.clone());
            async move {
                tokio::select! {
                    () = account.pace(cost) => {}
                    // Its end is heard of at once.
                    _ = connection.closed() => {}
                }
            }
        };
        loop {
            let next = reader.next_within(&account, &pace).await;
            let ended = next.is_err();
            if events.send(Event::Control(link, next)).await.is_err() || ended {
                return;
            }
        }
    });
}
