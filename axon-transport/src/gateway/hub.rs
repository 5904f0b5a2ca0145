//! The gateway's centre: which links stand, who is a peer, and what each is told.
//!
//! One task owns this state; dialling, accepting and every stream run in tasks of their own and
//! reach it by events.

use std::{
    collections::{BTreeMap, HashMap},
    sync::{Arc, RwLock, RwLockReadGuard},
    time::Duration,
};

use axon_tls::Negotiated;
use tokio::sync::{Notify, mpsc};

use super::{
    accept::Incomer,
    context::Context,
    control::{ControlError, ControlReader, Outbox},
    dial::{Target, dial},
    endpoint::{Endpoints, open_windows},
    establish::{Established, Sealing, close, peer_text},
    inbound::Inbound,
    outbound::Carrier,
    peer::{GraphChange, Peer, spawn_reader},
    pulse::Pulse,
    refusal::{Refusal, RefusedBy},
    routes,
    seal::Protection,
};
use crate::{
    daemon::bridge::{ToControl, ToGateway},
    graph::Endpoint,
    ids::{DaemonId, Gid},
    link::{Candidate, CloseCode, GraphResync, Hello, Message, Side, keep},
    qos::Qos,
    session::Session,
};

/// A link that the lower id has not elected by then is closed.
const ELECTION_TIMEOUT: Duration = Duration::from_secs(10);
/// A superseded connection may still carry the end of its streams for this long.
const HAND_OVER: Duration = Duration::from_secs(5);

/// Why somebody who claims a linked daemon's id gets no link.
const TAKEN: &str = "this daemon id is linked already, under another identity";

/// What the hub and the peers' tasks share.
pub(super) struct Shared {
    /// The gateway's own session.
    pub(super) session: Session,
    /// Wakes tasks when rings change.
    pub(super) pulse: Pulse,
    /// What local publishers offer.
    pub(super) local_qos: Arc<RwLock<HashMap<Gid, Qos>>>,
    /// ROS domain.
    pub(super) domain: u32,
    /// Largest payload.
    pub(super) max_message: u64,
}

/// Reads a lock; a panic elsewhere leaves nothing half-done.
pub(super) fn read<T>(lock: &RwLock<T>) -> RwLockReadGuard<'_, T> {
    lock.read().unwrap_or_else(std::sync::PoisonError::into_inner)
}

/// What the hub reacts to.
pub(super) enum Event {
    /// The control plane wants something.
    Order(ToGateway),
    /// A dial of ours came to an end.
    Dialled(Target, Box<Result<Established, Refusal>>),
    /// A dial of a peer came to an end.
    Incomer(Incomer),
    /// A control message, or the end of the control stream.
    Control(u64, Result<Message, ControlError>),
    /// A data stream broke the protocol.
    Violation(u64, CloseCode, String),
    /// A link was not elected in time.
    Unelected(u64),
    /// It is time for a successor under a new key.
    Renew(u64),
    /// The link is as old as a link may get.
    Expired(u64),
}

/// A connection between HELLO and its end.
struct Link {
    connection: quinn::Connection,
    established: Summary,
    order: crate::link::Order,
    candidate: Candidate,
    outbox: Outbox,
    carrier: Carrier,
    /// Until the election: what then lets it announce keys.
    sealing: Option<Sealing>,
    /// The peer's link id, once elected.
    id: Option<[u8; 16]>,
    since_unix_ms: u64,
}

/// What is kept of a link's beginning.
#[derive(Clone)]
pub(super) struct Summary {
    /// The peer's HELLO.
    pub(super) hello: Hello,
    /// What the handshake agreed on.
    pub(super) negotiated: Negotiated,
    /// As whom the peer proved itself.
    pub(super) authenticated_as: String,
}

impl Summary {
    /// Whether `other` proved to be the same daemon: the same SAE, the same public key (which even
    /// in `none` is one for a daemon's life).
    fn same_peer(&self, hello: &Hello, negotiated: &Negotiated) -> bool {
        self.hello.sae == hello.sae && self.negotiated.peer == negotiated.peer
    }
}

/// The hub's state.
pub(super) struct Hub {
    context: Arc<Context>,
    endpoints: Arc<Endpoints>,
    shared: Arc<Shared>,
    control: mpsc::Sender<ToControl>,
    events: mpsc::Sender<Event>,
    links: HashMap<u64, Link>,
    peers: HashMap<DaemonId, Peer>,
    local: BTreeMap<Gid, Endpoint>,
}

impl Hub {
    /// A hub without links.
    pub(super) fn new(
        context: Arc<Context>,
        endpoints: Arc<Endpoints>,
        shared: Arc<Shared>,
        control: mpsc::Sender<ToControl>,
        events: mpsc::Sender<Event>,
    ) -> Self {
        Self {
            context,
            endpoints,
            shared,
            control,
            events,
            links: HashMap::new(),
            peers: HashMap::new(),
            local: BTreeMap::new(),
        }
    }

    /// Reacts to events until the control plane says `Shutdown` or is gone.
    /// `graph` is notified when the local graph changed.
    pub(super) async fn run(mut self, mut inbox: mpsc::Receiver<Event>, graph: &Notify) {
        self.local_graph().await;
        let mut second = tokio::time::interval(Duration::from_secs(1));
        loop {
            tokio::select! {
                event = inbox.recv() => match event {
                    None | Some(Event::Order(ToGateway::Shutdown)) => break,
                    Some(event) => self.on_event(event).await,
                },
                () = graph.notified() => self.local_graph().await,
                _ = second.tick() => self.report().await,
            }
        }
        for link in self.links.values() {
            close(&link.connection, CloseCode::Goodbye, "the daemon ends");
        }
        for endpoint in &self.endpoints.all {
            // Lets the CONNECTION_CLOSE frames out.
            let _ = tokio::time::timeout(Duration::from_millis(500), endpoint.wait_idle()).await;
        }
    }

    async fn on_event(&mut self, event: Event) {
        match event {
            Event::Order(ToGateway::Dial { daemon, sae, addresses, listed }) => {
                let daemon = Some(daemon);
                self.dial(Target { daemon, sae, addresses, listed, replaces: None });
            }
            Event::Order(ToGateway::SendDatagram { to, bytes }) => self.endpoints.send(to, &bytes),
            Event::Order(ToGateway::Shutdown) => {}
            Event::Dialled(target, result) => match *result {
                Ok(established) => self.established(established, target.replaces).await,
                Err(refusal) => {
                    self.refused(target.text(), refusal).await;
                    if let (Some(daemon), None) = (target.daemon, target.replaces) {
                        self.tell(ToControl::DialFailed { daemon }).await;
                    }
                }
            },
            Event::Incomer(Incomer::Established(established)) => {
                let replaces = established.hello.replaces;
                self.established(*established, replaces).await;
            }
            Event::Incomer(Incomer::Refused { peer, refusal }) => {
                self.refused(peer, refusal).await;
            }
            Event::Control(link, Ok(message)) => self.on_message(link, message).await,
            Event::Control(link, Err(error)) => {
                if let (Some(code), Some(l)) = (error.code(), self.links.get(&link)) {
                    close(&l.connection, code, &error.to_string());
                }
                self.link_ended(link, &error.to_string()).await;
            }
            Event::Violation(link, code, reason) => {
                if let Some(l) = self.links.get(&link) {
                    let peer = self.peer_of(l);
                    self.refused(peer, Refusal::here(code, &reason)).await;
                }
                self.link_ended(link, &reason).await;
            }
            Event::Unelected(link) => {
                if let Some(l) = self.links.get(&link).filter(|l| l.id.is_none()) {
                    close(&l.connection, CloseCode::Duplicate, "not elected within 10 s");
                    self.link_ended(link, "not elected").await;
                }
            }
            Event::Renew(link) => self.renew(link),
            Event::Expired(link) => {
                let text = "AXON_QKD_SESSION_MAX_AGE is reached and no successor came";
                if let Some(l) = self.links.get(&link) {
                    close(&l.connection, CloseCode::KeySupply, text);
                    self.link_ended(link, text).await;
                }
            }
        }
    }

    // ---- links ----

    fn dial(&self, target: Target) {
        let (context, endpoints) = (Arc::clone(&self.context), Arc::clone(&self.endpoints));
        let events = self.events.clone();
        tokio::spawn(async move {
            let result = dial(&context, &endpoints, &target).await;
            let _ = events.send(Event::Dialled(target, Box::new(result))).await;
        });
    }

    /// A connection completed HELLO and proof; the lower id elects. `replaces` names the link that
    /// it succeeds.
    async fn established(&mut self, established: Established, replaces: Option<[u8; 16]>) {
        let daemon = established.hello.daemon;
        let number = established.number;
        let current = self.peers.get(&daemon).and_then(|p| self.links.get(&p.link));
        // Daemon ids are public: beacons carry them. Who has a link keeps it against anyone who
        // proves to be somebody else.
        let (hello, negotiated) = (&established.hello, &established.negotiated);
        if current.is_some_and(|c| !c.established.same_peer(hello, negotiated)) {
            close(&established.connection, CloseCode::NotAllowed, TAKEN);
            self.forget(&established);
            let peer = peer_text(
                established.hello.sae.as_deref(),
                established.connection.remote_address(),
            );
            return self.refused(peer, Refusal::here(CloseCode::NotAllowed, TAKEN)).await;
        }
        let successor = replaces.is_some() && current.is_some_and(|c| c.id == replaces);
        let candidate = Candidate { side: established.side, successor };
        let we_elect = self.context.hello.daemon < daemon;
        let ours = self.context.hello.daemon;
        if we_elect && current.is_some_and(|c| !keep(ours, daemon, c.candidate, candidate)) {
            close(&established.connection, CloseCode::Duplicate, "another connection stands");
            self.forget(&established);
            if established.side == Side::Client {
                let address = established.connection.remote_address();
                self.tell(ToControl::LinkUp { daemon, address }).await;
            }
            return;
        }
        let reader = self.insert(established, candidate);
        spawn_reader(number, reader, self.events.clone());
        if we_elect {
            self.elect(number).await;
        } else {
            let events = self.events.clone();
            tokio::spawn(async move {
                tokio::time::sleep(ELECTION_TIMEOUT).await;
                let _ = events.send(Event::Unelected(number)).await;
            });
        }
    }

    /// The connection does not become a link: its keys are let go.
    fn forget(&self, established: &Established) {
        if let Some(keyring) = &self.context.keyring {
            keyring.forget_connection(established.number);
        }
    }

    fn insert(&mut self, established: Established, candidate: Candidate) -> ControlReader {
        let protection = match (&self.context.keyring, &established.sealing) {
            (Some(keyring), Some(sealing)) => Protection::Envelope {
                keyring: Arc::clone(keyring),
                keys: Arc::clone(&sealing.keys),
                connection: established.number,
            },
            _ => Protection::Link,
        };
        let authenticated_as =
            super::status::authenticated_as(&self.context, &established.hello, &established.negotiated);
        let connection = established.connection;
        let link = Link {
            carrier: Carrier { connection: connection.clone(), protection },
            connection,
            established: Summary {
                hello: established.hello,
                negotiated: established.negotiated,
                authenticated_as,
            },
            order: established.order,
            candidate,
            outbox: established.outbox,
            sealing: established.sealing,
            id: None,
            since_unix_ms: crate::daemon::status::unix_ms(),
        };
        self.links.insert(established.number, link);
        established.reader
    }

    /// This side has the lower id: the connection stays.
    async fn elect(&mut self, number: u64) {
        let id: [u8; 16] = rand::random();
        if let Some(link) = self.links.get_mut(&number) {
            link.outbox.send(Message::Elected(id));
            link.order.elected();
            self.open(number, id).await;
        }
    }

    /// The connection was elected: it becomes the peer's link.
    async fn open(&mut self, number: u64, id: [u8; 16]) {
        let Some(link) = self.links.get(&number) else { return };
        let daemon = link.established.hello.daemon;
        // Another connection may have been elected while this one waited.
        let current = self.peers.get(&daemon).and_then(|p| self.links.get(&p.link));
        let Summary { hello, negotiated, .. } = &link.established;
        if current.is_some_and(|c| !c.established.same_peer(hello, negotiated)) {
            return self.violation(number, CloseCode::NotAllowed, TAKEN.into()).await;
        }
        let Some(link) = self.links.get_mut(&number) else { return };
        link.id = Some(id);
        let (connection, outbox) = (link.connection.clone(), link.outbox.clone());
        let (carrier, side) = (link.carrier.clone(), link.candidate.side);
        if let (Some(keyring), Some(sealing)) = (&self.context.keyring, link.sealing.take()) {
            let Sealing { keys, exporters, first } = sealing;
            if let Err(error) = keys.attach_sender(keyring, number, &exporters, first) {
                tracing::error!(peer = %daemon, %error, "no message keys for this link");
            }
        }
        open_windows(&connection);
        let new = match self.peers.get_mut(&daemon) {
            Some(peer) => {
                let old = peer.link;
                peer.succeed(number, outbox, carrier.clone());
                self.hand_over(old);
                false
            }
            None => {
                let peer = Peer::new(number, outbox, carrier.clone(), &self.shared);
                self.peers.insert(daemon, peer);
                true
            }
        };
        self.spawn_inbound(number, daemon, carrier);
        self.plan_end(number, side);
        if let Some(peer) = self.peers.get_mut(&daemon) {
            peer.send_graph(&self.local, true);
        }
        let address = connection.remote_address();
        tracing::info!(peer = %daemon, %address, new, "link up");
        self.tell(ToControl::LinkUp { daemon, address }).await;
        self.report().await;
    }

    fn spawn_inbound(&self, number: u64, daemon: DaemonId, carrier: Carrier) {
        let Some(peer) = self.peers.get(&daemon) else { return };
        let (refused, mut violations) = mpsc::channel(1);
        let inbound: Inbound = peer.inbound(carrier, &self.shared, refused);
        tokio::spawn(inbound.run());
        let events = self.events.clone();
        tokio::spawn(async move {
            if let Some((code, reason)) = violations.recv().await {
                let _ = events.send(Event::Violation(number, code, reason)).await;
            }
        });
    }

    /// The old connection of a peer ends once its streams have been read.
    fn hand_over(&mut self, old: u64) {
        if let Some(link) = self.links.remove(&old) {
            let keyring = self.context.keyring.clone();
            tokio::spawn(async move {
                // All of it: dropping the outbox would end the control stream, and with it the
                // link at the peer, before the successor's ELECTED is read there.
                let link = link;
                tokio::time::sleep(HAND_OVER).await;
                close(&link.connection, CloseCode::Replaced, "a successor took over");
                if let Some(keyring) = keyring {
                    keyring.forget_connection(old);
                }
            });
        }
    }

    /// In qkd a link lives no longer than AXON_QKD_SESSION_MAX_AGE: its dialler makes a successor
    /// in time, and should none come, both sides close it.
    fn plan_end(&self, number: u64, side: Side) {
        let Some(keyring) = &self.context.keyring else { return };
        let age = keyring.config.session_max_age;
        let events = self.events.clone();
        tokio::spawn(async move {
            let renewal = age.mul_f64(0.9);
            tokio::time::sleep(renewal).await;
            if side == Side::Client && events.send(Event::Renew(number)).await.is_err() {
                return;
            }
            tokio::time::sleep(age.saturating_sub(renewal)).await;
            let _ = events.send(Event::Expired(number)).await;
        });
    }

    fn renew(&self, number: u64) {
        let Some(link) = self.links.get(&number) else { return };
        self.dial(Target {
            daemon: Some(link.established.hello.daemon),
            sae: link.established.hello.sae.clone(),
            addresses: vec![link.connection.remote_address()],
            listed: false,
            replaces: link.id,
        });
        // Should the dial fail, the next try is due before the key's age is reached.
        let after = self.context.keyring.as_ref().map(|k| k.config.session_max_age.mul_f64(0.04));
        let events = self.events.clone();
        tokio::spawn(async move {
            tokio::time::sleep(after.unwrap_or_default().max(Duration::from_secs(1))).await;
            let _ = events.send(Event::Renew(number)).await;
        });
    }

    async fn link_ended(&mut self, number: u64, reason: &str) {
        let Some(link) = self.links.remove(&number) else { return };
        let refusal = link.connection.close_reason().map(|e| Refusal::of(&e));
        let reason = refusal.as_ref().map_or_else(|| reason.to_owned(), ToString::to_string);
        if let Some(keyring) = &self.context.keyring {
            keyring.forget_connection(number);
        }
        let daemon = link.established.hello.daemon;
        // Closing what is closed already changes nothing.
        close(&link.connection, CloseCode::Goodbye, "the control stream ended");
        if self.peers.get(&daemon).is_none_or(|p| p.link != number) {
            return;
        }
        self.peers.remove(&daemon);
        tracing::info!(peer = %daemon, reason, "link down");
        if let Some(refusal) = refusal.filter(|r| r.by == RefusedBy::Peer) {
            let ordinary = ["GOODBYE", "DUPLICATE", "REPLACED"];
            if !ordinary.contains(&refusal.name.as_str()) {
                let peer = self.peer_of(&link);
                self.refused(peer, refusal).await;
            }
        }
        self.tell(ToControl::LinkDown { daemon, reason }).await;
    }

    // ---- messages ----

    async fn on_message(&mut self, number: u64, message: Message) {
        let Some(link) = self.links.get_mut(&number) else { return };
        if let Err(error) = link.order.accept(&message) {
            return self.violation(number, CloseCode::OutOfOrder, error.to_string()).await;
        }
        let daemon = link.established.hello.daemon;
        if let Message::Elected(id) = message {
            link.order.elected();
            return self.open(number, id).await;
        }
        if let Message::Keys(keys) = &message {
            let Protection::Envelope { keyring, keys: peer, .. } = link.carrier.protection.clone()
            else {
                return;
            };
            if let Err(error) = peer.on_message(&keyring, number, keys) {
                let code = CloseCode::from_code(error.code()).unwrap_or(CloseCode::Internal);
                self.violation(number, code, error.to_string()).await;
            }
            return;
        }
        // What a superseded link still says was said again on its successor.
        let Some(peer) = self.peers.get_mut(&daemon).filter(|p| p.link == number) else { return };
        let result = match message {
            Message::Graph(graph) => match peer.take_graph(graph) {
                Ok(Some(change)) => {
                    self.remote_graph(daemon, change).await;
                    Ok(())
                }
                Ok(None) => {
                    let version = peer.remote_version();
                    peer.say(Message::GraphResync(GraphResync { version }));
                    Ok(())
                }
                Err(reason) => Err((CloseCode::TooLarge, reason.to_owned())),
            },
            Message::GraphResync(_) => {
                peer.send_graph(&self.local, true);
                Ok(())
            }
            Message::Subscribe(subscribe) => {
                peer.serve(subscribe, &self.shared).map_err(|e| (CloseCode::Malformed, e))
            }
            Message::Unsubscribe(unsubscribe) => {
                peer.unserve(unsubscribe.route);
                Ok(())
            }
            Message::RouteReady(ready) => {
                tracing::debug!(peer = %daemon, route = ready.route,
                    publishers = ready.publishers.len(), "route ready");
                Ok(())
            }
            Message::Hello(_) | Message::Elected(_) | Message::Keys(_) | Message::Keepalive => {
                Ok(())
            }
        };
        if let Err((code, reason)) = result {
            self.violation(number, code, reason).await;
        }
    }

    async fn violation(&mut self, number: u64, code: CloseCode, reason: String) {
        if let Some(link) = self.links.get(&number) {
            close(&link.connection, code, &reason);
            let peer = self.peer_of(link);
            self.refused(peer, Refusal::here(code, &reason)).await;
        }
        self.link_ended(number, &reason).await;
    }

    // ---- graph ----

    /// The local graph changed: peers are told, and routes follow.
    async fn local_graph(&mut self) {
        let view = self.shared.session.graph();
        self.local = view
            .endpoints
            .values()
            .filter(|e| e.daemon.is_none())
            .map(|e| (e.endpoint.gid, (*e.endpoint).clone()))
            .collect();
        let qos = self.local.values().map(|e| (e.gid, e.qos)).collect();
        *self.shared.local_qos.write().unwrap_or_else(std::sync::PoisonError::into_inner) = qos;
        for peer in self.peers.values_mut() {
            peer.send_graph(&self.local, false);
            peer.want(routes::wanted(self.local.values(), peer.remote()), &self.shared);
        }
    }

    async fn remote_graph(&mut self, daemon: DaemonId, change: GraphChange) {
        let GraphChange { reset, added, removed } = change;
        self.take_over(daemon, &added).await;
        if let Some(peer) = self.peers.get_mut(&daemon) {
            peer.want(routes::wanted(self.local.values(), peer.remote()), &self.shared);
        }
        self.tell(ToControl::RemoteGraph { daemon, reset, added, removed }).await;
    }

    /// A restarted daemon announces the endpoints of its predecessor, whose link may not have timed
    /// out yet: they are the new daemon's from now on, if it is the same host by what both proved.
    async fn take_over(&mut self, daemon: DaemonId, added: &[Endpoint]) {
        let Some(owner) = self.identity_of(daemon) else { return };
        let others: Vec<_> = self.peers.keys().filter(|d| **d != daemon).copied().collect();
        for other in others {
            let same_host = self.identity_of(other).is_some_and(|i| i == owner);
            let Some(peer) = self.peers.get_mut(&other) else { continue };
            let moved: Vec<_> = added
                .iter()
                .map(|e| e.gid)
                .filter(|gid| peer.remote().any(|e| e.gid == *gid))
                .collect();
            if moved.is_empty() {
                continue;
            }
            if !same_host {
                tracing::warn!(peer = %daemon, endpoints = moved.len(),
                    "a peer announces endpoints of another peer; they stay where they were");
                if let Some(claimer) = self.peers.get_mut(&daemon) {
                    claimer.forget(&moved);
                }
                continue;
            }
            peer.forget(&moved);
            peer.want(routes::wanted(self.local.values(), peer.remote()), &self.shared);
            let gone =
                ToControl::RemoteGraph { daemon: other, reset: false, added: vec![], removed: moved };
            self.tell(gone).await;
        }
    }

    /// What a peer proved to be, beyond its daemon id.
    fn identity_of(&self, daemon: DaemonId) -> Option<String> {
        let link = self.links.get(&self.peers.get(&daemon)?.link)?;
        Some(super::status::host_identity(&link.established, link.connection.remote_address()))
    }

    // ---- what the control plane hears ----

    fn peer_of(&self, link: &Link) -> String {
        peer_text(link.established.hello.sae.as_deref(), link.connection.remote_address())
    }

    async fn refused(&self, peer: String, refusal: Refusal) {
        if refusal.by == RefusedBy::Network {
            tracing::debug!(peer, %refusal, "no link");
        } else {
            tracing::warn!(peer, %refusal, "link refused");
        }
        let by = match refusal.by {
            RefusedBy::Here => "refused here",
            RefusedBy::Peer => "refused by the peer",
            RefusedBy::Network => "not reached",
        };
        let reason = format!("{by}: {}", refusal.reason);
        self.tell(ToControl::Refusal { peer, what: refusal.name, reason }).await;
    }

    async fn report(&self) {
        for peer in self.peers.values() {
            if let Some(link) = self.links.get(&peer.link) {
                let mut status = super::status::link(
                    &link.established,
                    &link.connection,
                    link.since_unix_ms,
                );
                peer.counters.fill(&mut status);
                self.tell(ToControl::Link(Box::new(status))).await;
            }
        }
        if let Some(keyring) = &self.context.keyring {
            self.tell(ToControl::Keys(keyring.status())).await;
        }
    }

    /// Status and notices are dropped when the control plane is behind; graph and links are not.
    async fn tell(&self, what: ToControl) {
        if matches!(what, ToControl::Link(_) | ToControl::Keys(_) | ToControl::Refusal { .. }) {
            let _ = self.control.try_send(what);
        } else {
            let _ = self.control.send(what).await;
        }
    }
}
