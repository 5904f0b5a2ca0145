//! The gateway's centre: which links stand, who is a peer, and what each is told.
//!
//! One task owns this state; dialling, accepting and every stream run in tasks of their own and
//! reach it by events.

mod finishing;
mod graph;
mod leaving;
mod links;

use std::{
    collections::{BTreeMap, HashMap},
    sync::{Arc, Mutex},
    time::{Duration, Instant},
};

use axon_shm::ids::{DaemonId, Gid};
use axon_tls::Negotiated;
use axon_transport::{Session, graph::Endpoint, internal::graph::EndpointRange};
use tokio::{
    sync::{Notify, mpsc, watch},
    task::JoinHandle,
    time::sleep,
};

use self::{finishing::Finishing, leaving::Leaving};
use super::{
    accept::Incomer,
    account::{Account, Accounts, Charge, Unpacked},
    context::Context,
    control::{ControlError, Outbox},
    counters::{self, Loss},
    dial::Target,
    endpoint::Endpoints,
    establish::{Established, Sealing, close, peer_text},
    outbound::Carrier,
    peer::{GraphTaken, Peer, binding},
    protection::Protection,
    queue_budget::QueueBudget,
    refusal::{Refusal, RefusedBy},
    ring_wakeups::RingWakeups,
    shares::Said,
    silence::{Echoes, Traffic},
    stalls::Stalls,
    stand_in::StandIns,
    status::{self, Who},
};
use crate::{
    gateway::bridge::{ToControl, ToGateway},
    link::{Candidate, CloseCode, Elected, GraphResync, Hello, Message},
    owner::SessionKeys,
};

/// Seconds between two looks whether the certificate of a linked peer has run out.
const CERTIFICATES_EVERY: u32 = 60;

/// What the hub and the peers' tasks share.
pub(super) struct Shared {
    /// The gateway's own session.
    pub(super) session: Session,
    /// Remote publishers as they are seen here.
    pub(super) stand_ins: StandIns,
    /// Wakes tasks when rings change.
    pub(super) ring_wakeups: RingWakeups,
    /// ROS domain.
    pub(super) domain: u32,
    /// Largest payload.
    pub(super) max_message: u64,
    /// The keys of the sessions here, which prove that they are this daemon's.
    pub(super) keys: Arc<SessionKeys>,
    /// What peers may have this daemon hold.
    pub(super) accounts: Accounts,
    /// What may wait to be sent reliably.
    pub(super) queues: Arc<QueueBudget>,
    /// A peer that reads nothing for so long is disconnected from the topic.
    pub(super) stalled_after: Duration,
    /// Those that were.
    pub(super) stalls: Mutex<Stalls>,
}

/// What the gateway's session notices.
#[derive(Default)]
pub(super) struct Noticed {
    /// The local graph changed.
    pub(super) graph: Notify,
    /// The session with the control plane is over.
    pub(super) lost: Notify,
}

/// What the hub reacts to.
pub(crate) enum Event {
    /// The control plane wants something.
    Order(ToGateway),
    /// A dial of ours came to an end.
    Dialled(Target, Box<Result<Established, Refusal>>),
    /// A dial of a peer came to an end.
    Incomer(Incomer),
    /// A control message, or the end of the control stream.
    Control(u64, Result<(Message, Unpacked), ControlError>),
    /// A data stream of this link, with this peer, broke the protocol; the connection is closed.
    Violation(u64, String, CloseCode, String),
    /// A link was not elected in time.
    Unelected(u64),
    /// It is time for a successor under a new key.
    Renew(u64),
    /// The link is as old as a link may get.
    Expired(u64),
    /// Nothing comes over the link, though its path works.
    Silent(u64, Traffic),
    /// Other keys or certificates may be trusted than before.
    Identity,
    /// Nothing is left of what this publisher here left for this peer.
    Drained(DaemonId, Gid),
    /// A peer does not read what it asked for.
    Stalled {
        /// The peer.
        daemon: DaemonId,
        /// Its number for the route.
        route: u32,
    },
    /// Samples of a topic did not get to a peer.
    Lost {
        /// The topic.
        topic: Arc<str>,
        /// Why, as the status names it.
        cause: &'static str,
        /// How many.
        samples: u64,
    },
    /// What was dropped on the way to or from this peer and was not told when its link ended.
    LinkLost(String, Vec<Loss>),
}

/// A connection between HELLO and its end.
struct Link {
    connection: quinn::Connection,
    established: Summary,
    order: crate::link::Order,
    candidate: Candidate,
    outbox: Outbox,
    carrier: Carrier,
    /// Closed once nothing that was given to it waits for its acknowledgement; beside `carrier`.
    carrying: watch::Sender<()>,
    /// Held by what reads its streams, which gives up when it is dropped.
    reading: watch::Sender<()>,
    /// Until the election: what then lets it announce keys.
    sealing: Option<Sealing>,
    /// What the lower id said of it, once elected.
    elected: Option<Elected>,
    /// When its key is as old as a key may get, once elected.
    until: Option<Instant>,
    since_unix_ms: u64,
    account: Arc<Account>,
    /// Its share of the stream data that its peer may have sent and that was not read.
    unread: Charge,
    /// What had gone over it a second ago.
    traffic: Traffic,
    /// Probes it while it is silent.
    watch: Option<JoinHandle<()>>,
    /// A successor was dialled since it is silent: what it has under way goes over that.
    silent: bool,
}

/// What is kept of a link's beginning.
#[derive(Clone)]
pub(crate) struct Summary {
    /// The peer's HELLO.
    pub(crate) hello: Hello,
    /// What the handshake agreed on.
    pub(crate) negotiated: Negotiated,
    /// As whom the peer proved itself.
    pub(crate) who: Who,
}

/// The endpoints of applications on this host, and how far their sessions are discovered.
pub(crate) type Local = BTreeMap<Gid, (Arc<Endpoint>, EndpointRange)>;

/// The hub's state.
pub(super) struct Hub {
    context: Arc<Context>,
    endpoints: Arc<Endpoints>,
    echoes: Arc<Echoes>,
    shared: Arc<Shared>,
    control: mpsc::Sender<ToControl>,
    events: mpsc::Sender<Event>,
    links: HashMap<u64, Link>,
    /// Superseded links that still carry something.
    leaving: HashMap<u64, Leaving>,
    peers: HashMap<DaemonId, Peer>,
    local: Local,
    /// Hosts that were told just now that there is no place for them.
    crowded: Said,
    /// Whether publishers ended of which something is on its way, as the control plane was told.
    draining: bool,
    /// A peer went, or an endpoint of one, since peers that lost endpoints to another were asked again.
    freed: bool,
    /// The daemon is to end.
    finishing: Option<Finishing>,
}

impl Hub {
    /// A hub without links.
    pub(super) fn new(
        context: Arc<Context>,
        endpoints: Arc<Endpoints>,
        echoes: Arc<Echoes>,
        shared: Arc<Shared>,
        control: mpsc::Sender<ToControl>,
        events: mpsc::Sender<Event>,
    ) -> Self {
        Self {
            context,
            endpoints,
            echoes,
            shared,
            control,
            events,
            links: HashMap::new(),
            leaving: HashMap::new(),
            peers: HashMap::new(),
            local: BTreeMap::new(),
            crowded: Said::default(),
            draining: false,
            freed: false,
            finishing: None,
        }
    }

    /// Reacts to events until the control plane says `Shutdown`, or is gone, or dropped the
    /// gateway's session (`lost`): then it returns false, and the gateway must be started again.
    pub(super) async fn run(mut self, mut inbox: mpsc::Receiver<Event>, session: &Noticed) -> bool {
        self.local_graph().await;
        let mut second = tokio::time::interval(Duration::from_secs(1));
        second.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
        let mut seconds = 0_u32;
        let mut kept = true;
        loop {
            let now = Instant::now();
            let alive_in = self.peers.values().filter_map(|peer| peer.alive_in(now)).min();
            let turn_in = self.turn_in(now);
            let look_in = self.finishing.as_ref().map(|finishing| finishing.look_in(now));
            tokio::select! {
                event = inbox.recv() => match event {
                    None | Some(Event::Order(ToGateway::Shutdown)) => break,
                    Some(event) => self.on_event(event).await,
                },
                () = session.graph.notified() => self.local_graph().await,
                () = session.lost.notified() => {
                    kept = false;
                    break;
                }
                () = sleep(alive_in.unwrap_or_default()), if alive_in.is_some() => {
                    let now = Instant::now();
                    self.peers.values_mut().for_each(|peer| peer.tell_alive(now));
                }
                () = sleep(turn_in.unwrap_or_default()), if turn_in.is_some() => {
                    self.take_turns().await;
                }
                () = sleep(look_in.unwrap_or_default()), if look_in.is_some() => {
                    self.look_whether_finished().await;
                }
                // Without a link, and keys, there is nothing that time would change.
                _ = second.tick(), if !self.links.is_empty() || self.context.keyring.is_some() => {
                    seconds = seconds.wrapping_add(1);
                    self.close_untrusted(seconds.is_multiple_of(CERTIFICATES_EVERY)).await;
                    self.resync();
                    self.watch_silent();
                    self.links.values_mut().filter(|l| l.elected.is_some()).for_each(Link::widen);
                    self.report().await;
                    let now = Instant::now();
                    self.peers.values_mut().for_each(|peer| peer.ask_again(now));
                }
            }
        }
        for link in self.links.values() {
            close(&link.connection, CloseCode::Goodbye, "the daemon ends");
        }
        self.count_what_is_left().await;
        for endpoint in &self.endpoints.all {
            // Lets the CONNECTION_CLOSE frames out.
            let _ = tokio::time::timeout(Duration::from_millis(500), endpoint.wait_idle()).await;
        }
        kept
    }

    async fn on_event(&mut self, event: Event) {
        match event {
            Event::Order(ToGateway::Dial { daemon, sae, addresses, listed, standing }) => {
                let (daemon, standing) = (Some(daemon), Some(standing));
                self.dial(Target { daemon, sae, addresses, listed, standing, replaces: None });
            }
            Event::Order(ToGateway::SendDatagram { to, bytes }) => self.endpoints.send(to, &bytes),
            Event::Order(ToGateway::Listed(addresses)) => self.context.set_listed(addresses),
            Event::Order(ToGateway::Finish) => self.finish(),
            Event::Order(ToGateway::Shutdown) => {}
            Event::Dialled(target, result) => match *result {
                Ok(established) => self.established(established, target.replaces).await,
                Err(refusal) => {
                    self.refused(target.text(), refusal).await;
                    if let (Some(daemon), Some(standing)) = (target.daemon, target.standing) {
                        self.tell(ToControl::DialFailed { daemon, standing }).await;
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
            Event::Control(link, Ok((message, _until_handled))) => {
                self.handle_message(link, message).await;
            }
            Event::Control(link, Err(error)) => {
                if let (Some(code), Some(l)) = (error.code(), self.links.get(&link)) {
                    close(&l.connection, code, &error.to_string());
                }
                self.link_ended(link, &error.to_string()).await;
            }
            // The end of the control stream may have been heard of first.
            Event::Violation(link, peer, code, reason) => {
                self.refused(peer, Refusal::here(code, &reason)).await;
                self.link_ended(link, &reason).await;
            }
            Event::Unelected(link) => {
                if let Some(l) = self.links.get(&link).filter(|l| l.elected.is_none()) {
                    close(&l.connection, CloseCode::Duplicate, "not elected within 10 s");
                    self.link_ended(link, "not elected").await;
                }
            }
            Event::Renew(link) => self.renew(link),
            Event::Silent(link, since) => self.replace_silent(link, since),
            Event::Identity => self.close_untrusted(true).await,
            Event::Drained(daemon, publisher) => self.drained(daemon, publisher).await,
            Event::Stalled { daemon, route } => self.stalled(daemon, route).await,
            Event::Lost { topic, cause, samples } => {
                self.tell(ToControl::Lost { topic: topic.to_string(), cause, samples }).await;
            }
            Event::LinkLost(peer, losses) => self.tell_lost(&peer, losses).await,
            Event::Expired(link) => {
                let text = "AXON_QKD_SESSION_MAX_AGE is reached and no successor came";
                if let Some(l) = self.links.get(&link) {
                    close(&l.connection, CloseCode::KeySupply, text);
                    self.link_ended(link, text).await;
                }
            }
        }
    }

    async fn handle_message(&mut self, number: u64, message: Message) {
        let Some(link) = self.links.get_mut(&number) else { return };
        if let Err(error) = link.order.accept(&message) {
            return self.violation(number, CloseCode::OutOfOrder, error.to_string()).await;
        }
        let daemon = link.established.hello.daemon;
        if let Message::Elected(elected) = message {
            link.order.elected();
            return self.open(number, elected).await;
        }
        if let Message::Keys(keys) = &message {
            let Protection::Envelope { keyring, keys: peer, .. } = link.carrier.protection.clone()
            else {
                return;
            };
            if let Err(error) = peer.handle_message(&keyring, number, keys) {
                let code = CloseCode::from_code(error.code()).unwrap_or(CloseCode::Internal);
                self.violation(number, code, error.to_string()).await;
            }
            return;
        }
        // What a superseded link still says was said again on its successor.
        if self.peers.get(&daemon).is_none_or(|peer| peer.link != number) {
            return;
        }
        match &message {
            Message::Graph(_) => self.succeeded(daemon),
            Message::LinkClosed(closed) => self.closed_by_peer(daemon, *closed),
            _ => {}
        }
        let Some(peer) = self.peers.get_mut(&daemon) else { return };
        let result = match message {
            Message::Graph(graph) => {
                match peer.take_graph(graph) {
                    GraphTaken::Changed { .. } => {
                        peer.stirred = true;
                        self.take_turn(daemon).await;
                    }
                    GraphTaken::Part => {}
                    GraphTaken::Gap => {
                        let version = peer.remote.version();
                        peer.say(Message::GraphResync(GraphResync { version }));
                    }
                }
                Ok(())
            }
            Message::GraphResync(_) => {
                peer.resync(&self.local, Instant::now());
                Ok(())
            }
            Message::Subscribe(subscribe) => {
                let served = peer.serve(subscribe, &self.shared);
                peer.update_services(&self.local, &self.shared);
                served.map_err(|reason| (CloseCode::Malformed, reason))
            }
            Message::Unsubscribe(unsubscribe) => {
                peer.unserve(unsubscribe.route);
                peer.update_services(&self.local, &self.shared);
                Ok(())
            }
            Message::Owners(owners) => {
                let link = self.links.get(&number);
                if let Some(binding) = link.and_then(|link| binding(&link.connection)) {
                    peer.remote.prove(&owners.proofs, &binding, daemon);
                }
                Ok(())
            }
            Message::Asserted(asserted) => {
                peer.hear_alive(&asserted);
                Ok(())
            }
            Message::Received(received) => {
                peer.received(&received);
                Ok(())
            }
            Message::RouteRefused(refused) => {
                peer.route_refused(refused);
                Ok(())
            }
            Message::RouteReady(ready) => {
                peer.route_ready(ready.route);
                tracing::debug!(peer = %daemon, route = ready.route,
                    publishers = ready.publishers.len(), "route ready");
                Ok(())
            }
            Message::Hello(_)
            | Message::Elected(_)
            | Message::Keys(_)
            | Message::LinkClosed(_)
            | Message::Keepalive => Ok(()),
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

    /// What was dropped since it was told last, on the way to or from a peer.
    async fn tell_lost(&self, peer: &str, losses: Vec<Loss>) {
        counters::log(&losses, peer);
        for Loss { topic, cause, samples } in losses {
            self.tell(ToControl::Lost { topic: topic.to_string(), cause, samples }).await;
        }
    }

    async fn report(&self) {
        for peer in self.peers.values() {
            if let Some(link) = self.links.get(&peer.link) {
                self.tell_lost(&self.peer_of(link), peer.counters.take_lost()).await;
                let mut status =
                    status::link(
                    &link.established,
                    link.connection.remote_address(),
                    link.connection.rtt(),
                    link.since_unix_ms,
                );
                peer.counters.fill(&mut status);
                peer.show_refused(&mut status);
                peer.fill(&mut status);
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
