//! The state of the control plane in a running daemon. One thread uses it, and no borrow of it lives across
//! an await.

mod refusals;
#[cfg(test)]
mod tests;

use std::{
    collections::{BTreeMap, BTreeSet, HashMap},
    net::IpAddr,
    os::fd::OwnedFd,
    rc::Rc,
    sync::Arc,
    time::{Instant, SystemTime},
};

use axon_shm::{
    ids::{DaemonId, SessionId},
    internal::{KnownPeers, descriptors::PassedFd, probe},
};
use axon_transport::{
    config::Config,
    internal::{
        log_limit::LogLimit,
        registry::Registry,
        session::{daemon::address::Address, relayed::ArrivalPool},
    },
    status::{LinkStatus, RefusalStatus, TrafficStatus},
};
use tokio::sync::{Notify, watch};

use self::refusals::Refusals;
use super::{
    admission::Admission,
    descriptors::SpareDescriptors,
    losses::Losses,
    report::{
        questions::{AccessQuestions, NOT_LINKED},
        waiting::NotifiedEndpoints,
    },
    scheduler::ProcessScheduler,
};
use crate::{
    bridge::{RefusalKind, RefusedRoute, ToControl, TrafficRules},
    daemon_key::DaemonKey,
    discovery::DiscoveryNeeds,
    owner::SessionKeys,
};

pub(super) struct ControlPlane {
    pub(super) config: Arc<Config>,
    pub(super) admission: Admission,
    pub(super) id: DaemonId,
    /// The key from which the id is made.
    pub(super) daemon_key: Option<Arc<DaemonKey>>,
    pub(super) started: Instant,
    pub(super) address: Address,
    pub(super) registry: Registry<Arc<PassedFd>>,
    pub(super) links: BTreeMap<String, LinkStatus>,
    /// The refused routes by link.
    pub(super) refused_routes: BTreeMap<String, Vec<RefusedRoute>>,
    /// The endpoints whose sessions were notified of the refused routes.
    told: NotifiedEndpoints,
    pub(super) refusals: Refusals,
    /// Descriptors to answer callers when no other descriptor is left.
    pub(super) spare: Rc<SpareDescriptors>,
    /// Number of sessions that were refused for want of descriptors.
    pub(super) crowded_out: u64,
    crowded_log: LogLimit,
    /// Samples that did not reach other hosts, or that ended relayed sessions left.
    pub(super) lost: Arc<Losses>,
    /// True if samples of ended publishers are in flight to other hosts.
    draining: bool,
    pub(super) keys: serde_json::Value,
    pub(super) port: Option<u16>,
    pub(super) gateway: String,
    /// The sessions' own keys, with which the gateway proves that they are this daemon's.
    pub(super) keys_of_sessions: Arc<SessionKeys>,
    /// The sessions' descriptors, which the gateway uses in place of its copies.
    pub(super) known_peers: Arc<KnownPeers>,
    /// The memory for samples that arrive over relays.
    pub(super) pool: Arc<ArrivalPool>,
    /// Memory with which sessions check that they can map the daemon's memory.
    pub(super) probe: Option<OwnedFd>,
    /// Counters of the packets exchanged with sessions.
    pub(super) traffic: TrafficStatus,
    /// The rules for the gateway, and the number of changes.
    pub(super) rules: watch::Sender<(u64, TrafficRules)>,
    /// The number of the rules that the gateway reported to be in force.
    pub(super) rules_in_force: watch::Sender<u64>,
    /// Wakes the task that reads the settings again; `reload_asked` has the sessions that asked for it.
    pub(super) reload: Rc<Notify>,
    pub(super) reload_asked: Vec<SessionId>,
    /// Questions about the access rules of peers.
    pub(super) questions: AccessQuestions,
    /// The range and the hosts of discovery that the widest session needs.
    pub(super) wanted: watch::Sender<DiscoveryNeeds>,
    /// The addresses of the names of static peers.
    names: BTreeMap<String, Vec<IpAddr>>,
    /// The addresses of linked peers.
    linked: BTreeMap<DaemonId, IpAddr>,
    wakers: HashMap<SessionId, Rc<Notify>>,
    pub(super) turns: ProcessScheduler,
    /// Wakes the task that flushes the graph.
    pub(super) changed: Rc<Notify>,
    /// True if there is an application. `need` wakes the task that waits for a change of that.
    needed: bool,
    pub(super) need: Rc<Notify>,
}

impl ControlPlane {
    pub(super) fn new(
        config: Arc<Config>,
        settings: Vec<(String, String)>,
        spare: SpareDescriptors,
    ) -> Self {
        let mut registry = Registry::default();
        registry.set_access(config.access.clone());
        let daemon_key = DaemonKey::generate().map(Arc::new);
        if daemon_key.is_none() {
            tracing::error!(
                "could not make a key for the daemon's id: another host may claim the id"
            );
        }
        Self {
            admission: Admission::new(Arc::clone(&config), settings),
            id: daemon_key.as_ref().map_or_else(DaemonId::random, |key| key.id()),
            daemon_key,
            started: Instant::now(),
            address: Address::of(&config),
            registry,
            links: BTreeMap::new(),
            refused_routes: BTreeMap::new(),
            told: NotifiedEndpoints::default(),
            refusals: Refusals::default(),
            spare: Rc::new(spare),
            crowded_out: 0,
            crowded_log: LogLimit::default(),
            lost: Arc::default(),
            draining: false,
            keys: serde_json::Value::Null,
            port: None,
            gateway: "off".into(),
            keys_of_sessions: Arc::default(),
            known_peers: Arc::default(),
            pool: ArrivalPool::new(config.reliable_queue),
            probe: probe()
                .inspect_err(
                    |error| tracing::error!(%error, "could not create the shared-memory probe"),
                )
                .ok(),
            traffic: TrafficStatus::default(),
            rules: watch::Sender::new((0, TrafficRules::of(&config))),
            rules_in_force: watch::Sender::new(0),
            reload: Rc::default(),
            reload_asked: Vec::new(),
            questions: AccessQuestions::default(),
            wanted: watch::Sender::new(DiscoveryNeeds::of(&config, [])),
            names: BTreeMap::new(),
            linked: BTreeMap::new(),
            wakers: HashMap::new(),
            turns: ProcessScheduler::default(),
            config,
            changed: Rc::default(),
            needed: false,
            need: Rc::default(),
        }
    }

    /// Creates the bell of a session's task.
    pub(super) fn add_waker(&mut self, id: SessionId) -> Rc<Notify> {
        let bell = Rc::new(Notify::new());
        // The task of a connection that is replaced ends at once, and with it its descriptors.
        if let Some(replaced) = self.wakers.insert(id, bell.clone()) {
            replaced.notify_one();
        }
        bell
    }

    /// Removes a part of the remaining state of a session whose task ends. Returns whether there is more. `bell` is the
    /// task's own: a session that came back has another.
    pub(super) fn remove_some(&mut self, id: &SessionId, bell: &Rc<Notify>) -> bool {
        if !self.is_current(id, bell) {
            return false;
        }
        self.known_peers.remove(id);
        let more = self.registry.handle_hang_up_in_parts(id);
        if !more {
            self.wakers.remove(id);
            self.keys_of_sessions.remove(id);
        }
        self.settle();
        more
    }

    /// Ends a session at once. Its task closes the connection.
    pub(super) fn disconnect(&mut self, id: &SessionId) {
        if let Some(bell) = self.wakers.remove(id) {
            bell.notify_one();
        }
        self.known_peers.remove(id);
        while self.registry.handle_hang_up_in_parts(id) {}
        self.keys_of_sessions.remove(id);
    }

    /// Returns whether `bell` is still that of the session's task.
    pub(super) fn is_current(&self, id: &SessionId, bell: &Rc<Notify>) -> bool {
        self.wakers.get(id).is_some_and(|current| Rc::ptr_eq(current, bell))
    }

    /// Wakes the tasks of sessions that have new messages.
    pub(super) fn settle(&mut self) {
        self.registry.answer_fences();
        for (id, why) in self.registry.take_refused() {
            let who = self.registry.session(&id).map_or_else(
                || format!("session {id}"),
                |session| format!("session {} (pid {})", session.name, session.pid),
            );
            self.refused(RefusalKind::Local, who, "endpoint".into(), why);
        }
        for id in self.registry.take_ready() {
            if let Some(bell) = self.wakers.get(&id) {
                bell.notify_one();
            }
        }
        if self.registry.take_rescoped() {
            self.look_for_hosts();
        }
        self.changed.notify_one();
        let needed = self.is_needed();
        if std::mem::replace(&mut self.needed, needed) != needed {
            self.need.notify_one();
        }
    }

    /// Sends discovery the hosts that the present sessions want.
    pub(super) fn look_for_hosts(&self) {
        let wanted = DiscoveryNeeds::of(&self.config, self.registry.scopes());
        self.wanted.send_if_modified(|known| std::mem::replace(known, wanted.clone()) != wanted);
    }

    /// Returns whether there is an application, or a sample in flight to another host.
    pub(super) fn is_needed(&self) -> bool {
        self.draining || self.registry.is_needed()
    }

    /// Logs a refusal, and shows it in the status.
    pub(super) fn refused(
        &mut self,
        kind: RefusalKind,
        peer: String,
        what: String,
        reason: String,
    ) {
        refusals::warn(kind, &peer, &what, &reason);
        self.refusals.add(kind, RefusalStatus::new(SystemTime::now(), peer, what, reason));
    }

    /// Records that a session is refused for want of descriptors. All sessions of a host may come again and again.
    pub(super) fn refused_for_room(&mut self, peer: String, reason: String) {
        const WHAT: &str = "descriptors";
        self.crowded_out += 1;
        if let Some(sessions) = self.crowded_log.count(self.started.elapsed()) {
            tracing::warn!(peer, reason, sessions, "sessions are refused for want of descriptors");
        }
        // The numbers in the reason change.
        self.refusals.forget(&peer, WHAT);
        let refusal = RefusalStatus::new(SystemTime::now(), peer, WHAT.to_owned(), reason);
        self.refusals.add(RefusalKind::Local, refusal);
    }

    /// Handles a message of the gateway, except for discovery's part of it.
    pub(super) fn gateway_says(&mut self, message: ToControl) {
        match message {
            ToControl::Rules(number) => drop(self.rules_in_force.send_replace(number)),
            ToControl::Decisions { number, decisions } => {
                let decisions = decisions.ok_or_else(|| NOT_LINKED.to_owned());
                self.answer_decisions(number, decisions);
            }
            ToControl::Started { port } => {
                self.port = Some(port);
                self.gateway = "running".into();
            }
            ToControl::LinkUp { daemon, address, .. } => self.linked_at(daemon, address.ip()),
            ToControl::RemoteGraph { daemon, reset, added, removed } => {
                self.registry.remote_graph(daemon, reset, added, removed);
            }
            ToControl::Link(status, refused) => {
                // A peer may have moved.
                let daemon = self.linked.keys().find(|d| d.to_string() == status.peer).copied();
                let address = status.address.parse::<std::net::SocketAddr>();
                if let (Some(daemon), Ok(address)) = (daemon, address) {
                    self.linked_at(daemon, address.ip());
                }
                self.told.tell(&mut self.registry, &status.peer, &status.host, &refused);
                self.refused_routes.insert(status.peer.clone(), refused);
                self.links.insert(status.peer.clone(), *status);
            }
            ToControl::Silent { daemon } => {
                self.links.remove(&daemon.to_string());
                self.refused_routes.remove(&daemon.to_string());
                self.registry.remote_gone(&daemon);
            }
            ToControl::LinkDown { daemon, reason } => {
                tracing::info!(%daemon, reason, "link down");
                self.told.forget(&daemon.to_string());
                self.links.remove(&daemon.to_string());
                self.refused_routes.remove(&daemon.to_string());
                self.registry.remote_gone(&daemon);
                self.linked.remove(&daemon);
                self.forget_questions(Some(daemon));
                self.relist();
            }
            ToControl::Refusal { kind, peer, what, reason } => {
                self.refused(kind, peer, what, reason);
            }
            ToControl::Keys(keys) => self.keys = keys,
            ToControl::Lost { topic, cause, samples } => self.lost.add(&topic, cause, samples),
            ToControl::Draining(draining) => self.draining = draining,
            ToControl::DialFailed { .. }
            | ToControl::Datagrams(_)
            | ToControl::Path { .. }
            | ToControl::Finished => {}
        }
        self.settle();
    }

    /// Sets the present addresses of the names of static peers.
    pub(super) fn named(&mut self, names: BTreeMap<String, Vec<IpAddr>>) {
        self.names = names;
        self.relist();
        self.settle();
    }

    /// Returns whether there is a link with this daemon.
    pub(super) fn is_linked(&self, daemon: &DaemonId) -> bool {
        self.linked.contains_key(daemon)
    }

    fn linked_at(&mut self, daemon: DaemonId, address: IpAddr) {
        let address = address.to_canonical();
        if self.linked.insert(daemon, address) != Some(address) {
            self.relist();
        }
    }

    /// Decides anew which linked peers each session lists: the peers whose link is at an address of one of its static
    /// peers. Addresses in beacons do not count, because any host can write them.
    pub(super) fn relist(&mut self) {
        let (names, linked) = (&self.names, &self.linked);
        self.registry.relist(|peers| {
            let addresses: BTreeSet<IpAddr> = peers
                .iter()
                .flat_map(|peer| match peer.parse::<IpAddr>() {
                    Ok(address) => vec![address.to_canonical()],
                    Err(_) => names.get(peer).cloned().unwrap_or_default(),
                })
                .collect();
            let listed = linked.iter().filter(|(_, address)| addresses.contains(address));
            listed.map(|(daemon, _)| *daemon).collect()
        });
    }

    /// Handles the end of the gateway, and forgets everything about other hosts.
    pub(super) fn gateway_ended(&mut self, why: &str) {
        self.gateway = why.to_owned();
        self.port = None;
        self.draining = false;
        self.links.clear();
        self.linked.clear();
        self.refused_routes.clear();
        self.told = NotifiedEndpoints::default();
        self.forget_questions(None);
        self.relist();
        let daemons: BTreeSet<DaemonId> =
            self.registry.remote_endpoints().map(|(daemon, _)| *daemon).collect();
        for daemon in daemons {
            self.registry.remote_gone(&daemon);
        }
        self.settle();
    }
}
