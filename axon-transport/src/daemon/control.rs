//! The control plane's state in a running daemon. One thread; never borrowed across an await.

use std::{
    collections::{BTreeMap, HashMap, VecDeque},
    os::fd::OwnedFd,
    rc::Rc,
    sync::Arc,
    time::Instant,
};

use tokio::sync::Notify;

use super::{
    admission::Admission,
    bridge::ToControl,
    registry::Registry,
    status::{LinkStatus, RefusalStatus, TrafficStatus, unix_ms},
};
use crate::{
    config::Config,
    ids::{DaemonId, SessionId},
    passed::PassedFd,
    relay::Pool,
    session::address::Address,
    shm::probe::probe,
};

/// Refusals that are remembered.
const REFUSALS: usize = 32;

pub(super) struct Control {
    pub(super) config: Arc<Config>,
    pub(super) admission: Admission,
    pub(super) id: DaemonId,
    pub(super) started: Instant,
    pub(super) address: Address,
    pub(super) registry: Registry<Arc<PassedFd>>,
    pub(super) links: BTreeMap<String, LinkStatus>,
    pub(super) refusals: VecDeque<RefusalStatus>,
    pub(super) keys: serde_json::Value,
    pub(super) port: Option<u16>,
    pub(super) gateway: String,
    /// For the samples that arrive over relays.
    pub(super) pool: Arc<Pool>,
    /// Memory that sessions try whether they can map it.
    pub(super) probe: Option<OwnedFd>,
    /// Packets that were exchanged with sessions.
    pub(super) traffic: TrafficStatus,
    wakers: HashMap<SessionId, Rc<Notify>>,
    /// Wakes the task that flushes the graph.
    pub(super) changed: Rc<Notify>,
    /// Whether there is an application, and what wakes the task that waits for that to change.
    needed: bool,
    pub(super) need: Rc<Notify>,
}

impl Control {
    pub(super) fn new(config: Arc<Config>, settings: Vec<(String, String)>) -> Self {
        Self {
            admission: Admission::new(Arc::clone(&config), settings),
            id: DaemonId::random(),
            started: Instant::now(),
            address: Address::of(&config),
            registry: Registry::default(),
            links: BTreeMap::new(),
            refusals: VecDeque::new(),
            keys: serde_json::Value::Null,
            port: None,
            gateway: "off".into(),
            pool: Pool::new(config.reliable_queue),
            probe: probe().inspect_err(|error| tracing::error!(%error, "no memory to try")).ok(),
            traffic: TrafficStatus::default(),
            wakers: HashMap::new(),
            config,
            changed: Rc::default(),
            needed: false,
            need: Rc::default(),
        }
    }

    /// The bell of a session's task.
    pub(super) fn add_waker(&mut self, id: SessionId) -> Rc<Notify> {
        let bell = Rc::new(Notify::new());
        // The task of a connection that is replaced ends at once, and with it its descriptors.
        if let Some(replaced) = self.wakers.insert(id, bell.clone()) {
            replaced.notify_one();
        }
        bell
    }

    /// A session's task ends. `bell` is its own: a session that came back has another.
    pub(super) fn remove(&mut self, id: &SessionId, bell: &Rc<Notify>) {
        if self.wakers.get(id).is_some_and(|current| Rc::ptr_eq(current, bell)) {
            self.wakers.remove(id);
            self.registry.disconnect(id);
            self.settle();
        }
    }

    /// Whether `bell` is still that of the session's task.
    pub(super) fn is_current(&self, id: &SessionId, bell: &Rc<Notify>) -> bool {
        self.wakers.get(id).is_some_and(|current| Rc::ptr_eq(current, bell))
    }

    /// Wakes the tasks of sessions that got something to be told.
    pub(super) fn settle(&mut self) {
        for (id, why) in self.registry.take_refused() {
            let who = self.registry.session(&id).map_or_else(
                || format!("session {id}"),
                |session| format!("session {} (pid {})", session.name, session.pid),
            );
            self.refused(who, "endpoint".into(), why);
        }
        for id in self.registry.take_ready() {
            if let Some(bell) = self.wakers.get(&id) {
                bell.notify_one();
            }
        }
        self.changed.notify_one();
        if std::mem::replace(&mut self.needed, self.registry.is_needed()) != self.needed {
            self.need.notify_one();
        }
    }

    /// Answers a session that asks for the status. One that asks again before it has taken the
    /// answer gets the same one from its beginning.
    pub(super) fn send_status(&mut self, id: &SessionId) {
        if self.registry.repeat_status(id) {
            return;
        }
        let text = match serde_json::to_vec(&super::report::status(self)) {
            Ok(text) => text,
            Err(error) => {
                tracing::error!(%error, "the status cannot be written");
                Vec::new()
            }
        };
        self.registry.tell_status(id, text.into());
    }

    pub(super) fn refused(&mut self, peer: String, what: String, reason: String) {
        tracing::warn!(peer, what, reason, "refused");
        // The same peer refused for the same cause again is the same news.
        self.refusals.retain(|r| r.peer != peer || r.what != what || r.reason != reason);
        if self.refusals.len() == REFUSALS {
            self.refusals.pop_front();
        }
        self.refusals.push_back(RefusalStatus { unix_ms: unix_ms(), peer, what, reason });
    }

    /// What the gateway says, but for what concerns discovery alone.
    pub(super) fn gateway_says(&mut self, message: ToControl) {
        match message {
            ToControl::Started { port } => {
                self.port = Some(port);
                self.gateway = "running".into();
            }
            ToControl::RemoteGraph { daemon, reset, added, removed } => {
                self.registry.remote_graph(daemon, reset, added, removed);
            }
            ToControl::Link(status) => {
                self.links.insert(status.peer.clone(), *status);
            }
            ToControl::LinkDown { daemon, reason } => {
                tracing::info!(%daemon, reason, "link down");
                self.links.remove(&daemon.to_string());
                self.registry.remote_gone(&daemon);
            }
            ToControl::Refusal { peer, what, reason } => self.refused(peer, what, reason),
            ToControl::Keys(keys) => self.keys = keys,
            ToControl::LinkUp { .. }
            | ToControl::DialFailed { .. }
            | ToControl::Datagram { .. } => {}
        }
        self.settle();
    }

    /// The gateway is no more, and with it everything that was known of other hosts.
    pub(super) fn gateway_ended(&mut self, why: &str) {
        self.gateway = why.to_owned();
        self.port = None;
        self.links.clear();
        let daemons: std::collections::BTreeSet<DaemonId> =
            self.registry.remote_endpoints().map(|(daemon, _)| *daemon).collect();
        for daemon in daemons {
            self.registry.remote_gone(&daemon);
        }
        self.settle();
    }
}
