//! Connects the control plane to other hosts: discovery selects the daemons to dial, the gateway dials them, and the
//! registry receives their endpoints.

use std::{
    cell::RefCell,
    collections::{BTreeMap, BTreeSet},
    net::IpAddr,
    rc::Rc,
    sync::Arc,
    time::Duration,
};

use axon_shm::ids::DaemonId;
use tokio::{
    sync::{mpsc, watch},
    task::{JoinHandle, spawn_local},
    time::Instant,
};

use super::{
    gateway::{GatewayEntry, RestartPause, RunningGateway},
    plane::ControlPlane,
};
use crate::{
    bridge::{CHANNEL, RefusalKind, ToControl, ToGateway, TrafficRules},
    discovery::{self, DiscoveryAction, DiscoveryEvent},
};

/// Pause between two attempts to send an order to a busy gateway.
const BUSY: Duration = Duration::from_millis(10);
/// Maximum time that a gateway may take to finish: longer than it waits for its samples in flight.
const FINISH: Duration = Duration::from_secs(6);

/// The default gateway of a daemon.
pub(super) const GATEWAY: Option<GatewayEntry> =
    Some(|parts| crate::reactor::run(parts).map_err(|error| error.to_string()));

/// The gateway and discovery of a running daemon.
pub(super) struct DaemonGateway {
    entry: Option<GatewayEntry>,
    running: Option<RunningGateway>,
    pause: RestartPause,
    discovery: Option<Discovery>,
    /// The linked daemons, each with whether its id was proven.
    linked: BTreeMap<DaemonId, bool>,
    /// Addresses of listed peers, as sent to the gateway.
    listed: BTreeSet<IpAddr>,
    /// True if the gateway has nothing in flight any more, or makes no progress.
    finished: bool,
    /// The rules in force; `rules_due` is the time at which to send them to the gateway again.
    rules: watch::Receiver<(u64, TrafficRules)>,
    rules_due: Option<Instant>,
}

struct Discovery {
    events: mpsc::Sender<DiscoveryEvent>,
    actions: mpsc::Receiver<DiscoveryAction>,
    task: JoinHandle<()>,
}

impl DaemonGateway {
    /// Starts the gateway, waits until it has started, and starts discovery.
    ///
    /// # Errors
    /// The reason why the gateway has not started.
    pub(super) async fn start(
        control: &Rc<RefCell<ControlPlane>>,
        entry: Option<GatewayEntry>,
    ) -> Result<Self, String> {
        let mut remote = Self {
            entry,
            running: None,
            pause: RestartPause::new(),
            discovery: None,
            linked: BTreeMap::new(),
            listed: BTreeSet::new(),
            finished: false,
            rules: control.borrow().rules.subscribe(),
            rules_due: None,
        };
        let Some(entry) = entry else { return Ok(remote) };
        let mut running = RunningGateway::start(control, entry).map_err(|e| e.to_string())?;
        running.stands(control).await?;
        remote.running = Some(running);
        let discovery = Discovery::start(&control.borrow());
        if let Some(port) = control.borrow().port {
            discovery.tell(DiscoveryEvent::QuicPort(port));
        }
        remote.discovery = Some(discovery);
        Ok(remote)
    }

    /// Returns the sender for changes of this host's graph.
    pub(super) fn digests(&self) -> Option<mpsc::Sender<DiscoveryEvent>> {
        self.discovery.as_ref().map(|discovery| discovery.events.clone())
    }

    /// Lets the samples queued for other hosts arrive before the daemon ends, as far as that makes progress.
    pub(super) async fn finish(&mut self, control: &Rc<RefCell<ControlPlane>>) {
        // An order that finds the channel full is dropped: this one is sent again.
        let finish = async {
            while self.running.is_some() && !self.order(ToGateway::Finish) {
                tokio::time::sleep(BUSY).await;
            }
            if self.running.is_some() {
                self.run(control).await;
            }
        };
        if tokio::time::timeout(FINISH, finish).await.is_err() {
            tracing::warn!("the gateway did not report its send queues in time; ending anyway");
        }
    }

    /// Passes on the messages of the gateway and of discovery, and restarts a failed gateway, until the gateway [has
    /// finished](Self::finish).
    pub(super) async fn run(&mut self, control: &Rc<RefCell<ControlPlane>>) {
        let Some(entry) = self.entry else { return std::future::pending().await };
        let questions = control.borrow().questions.bell();
        while !self.finished {
            tokio::select! {
                event = said(self.running.as_mut()) => match event {
                    Ok(event) => self.event(control, event),
                    Err(why) => {
                        tracing::error!(why, "the gateway failed; it is started again");
                        self.gateway_ended(control, &why);
                        self.pause.wait().await;
                        match RunningGateway::start(control, entry) {
                            Ok(running) => self.running = Some(running),
                            Err(error) => tracing::error!(%error, "could not start the gateway's thread"),
                        }
                    }
                },
                Ok(()) = self.rules.changed() => self.order_rules(),
                () = due(self.rules_due) => self.order_rules(),
                () = questions.notified() => self.pass_questions(control),
                action = wanted(self.discovery.as_mut()) => match action {
                    Some(action) => self.action(control, action),
                    None => {
                        tracing::error!("discovery failed; it is started again");
                        self.pause.wait().await;
                        self.restart_discovery(control);
                    }
                },
            }
        }
    }

    /// Sends the gateway the rules in force. An order that finds the channel full is sent again.
    fn order_rules(&mut self) {
        let (number, rules) = self.rules.borrow_and_update().clone();
        // A gateway that is started later gets the rules when it has started.
        let missed = self.running.is_some() && !self.order(ToGateway::Rules(rules, number));
        self.rules_due = missed.then(|| Instant::now() + BUSY);
    }

    /// Sends the gateway the questions of tools about the rules of peers.
    fn pass_questions(&mut self, control: &Rc<RefCell<ControlPlane>>) {
        let mut control = control.borrow_mut();
        while let Some((number, daemon, uses)) = control.questions.poll() {
            if !self.order(ToGateway::CheckAccess { daemon, number, uses }) {
                let why = "the gateway is busy or has failed: ask again".to_owned();
                control.answer_decisions(number, Err(why));
            }
        }
        control.settle();
    }

    fn event(&mut self, control: &Rc<RefCell<ControlPlane>>, event: ToControl) {
        match &event {
            ToControl::Started { port } => {
                self.order(ToGateway::Listed(self.listed.clone()));
                // The rules may have changed since the gateway was started. It reports when they are in force.
                self.order_rules();
                self.tell(DiscoveryEvent::QuicPort(*port));
            }
            ToControl::LinkUp { daemon, address, proven } => {
                let (daemon, address, proven) = (*daemon, *address, *proven);
                self.linked.insert(daemon, proven);
                self.tell(DiscoveryEvent::LinkUp { daemon, address, proven });
            }
            ToControl::LinkDown { daemon, .. } => {
                self.linked.remove(daemon);
                self.tell(DiscoveryEvent::LinkDown { daemon: *daemon });
            }
            ToControl::DialFailed { daemon, standing, absent_at } => {
                let (daemon, standing, absent_at) = (*daemon, *standing, *absent_at);
                self.tell(DiscoveryEvent::DialFailed { daemon, standing, absent_at });
            }
            ToControl::Path { daemon, works } => {
                self.tell(DiscoveryEvent::Path { daemon: *daemon, works: *works });
            }
            ToControl::Finished => self.finished = true,
            _ => {}
        }
        match event {
            ToControl::Datagrams(datagrams) => self.tell(DiscoveryEvent::Datagrams(datagrams)),
            other => control.borrow_mut().gateway_says(other),
        }
    }

    fn action(&mut self, control: &Rc<RefCell<ControlPlane>>, action: DiscoveryAction) {
        match action {
            DiscoveryAction::Dial { daemon, sae, addrs: addresses, listed, standing } => {
                let dial = ToGateway::Dial { daemon, sae, addresses, listed, standing };
                if !self.order(dial) {
                    let absent_at = None;
                    self.tell(DiscoveryEvent::DialFailed { daemon, standing, absent_at });
                }
            }
            DiscoveryAction::Addresses { daemon, addresses } => {
                self.order(ToGateway::Addresses { daemon, addresses });
            }
            DiscoveryAction::SendFromQuicPort { to, bytes } => {
                self.order(ToGateway::SendDatagram { to, bytes });
            }
            DiscoveryAction::Mismatch(mismatch) => {
                let peer = format!("{} at {}", mismatch.peer, mismatch.address);
                let what = mismatch.setting.to_owned();
                let reason =
                    format!("{what} is {} here and {} there", mismatch.ours, mismatch.theirs);
                control.borrow_mut().refused(RefusalKind::Beacon, peer, what, reason);
            }
            DiscoveryAction::Named(names) => {
                self.listed = names.values().flatten().copied().collect();
                self.order(ToGateway::Listed(self.listed.clone()));
                control.borrow_mut().named(names);
            }
            // In a flood of beacons, this happens a thousand times a second.
            DiscoveryAction::Gone { daemon } => tracing::trace!(%daemon, "a peer is gone"),
        }
    }

    /// Returns whether the gateway got the order.
    fn order(&self, order: ToGateway) -> bool {
        self.running.as_ref().is_some_and(|running| running.order(order))
    }

    fn tell(&self, event: DiscoveryEvent) {
        if let Some(discovery) = &self.discovery {
            discovery.tell(event);
        }
    }

    fn gateway_ended(&mut self, control: &Rc<RefCell<ControlPlane>>, why: &str) {
        self.running = None;
        control.borrow_mut().gateway_ended(why);
        for daemon in std::mem::take(&mut self.linked).into_keys() {
            self.tell(DiscoveryEvent::LinkDown { daemon });
        }
    }

    fn restart_discovery(&mut self, control: &Rc<RefCell<ControlPlane>>) {
        let control = control.borrow();
        let discovery = Discovery::start(&control);
        if let Some(port) = control.port {
            discovery.tell(DiscoveryEvent::QuicPort(port));
        }
        for link in control.links.values() {
            let peer = self.linked.iter().find(|(daemon, _)| daemon.to_string() == link.peer);
            if let (Some((&daemon, &proven)), Ok(address)) = (peer, link.address.parse()) {
                discovery.tell(DiscoveryEvent::LinkUp { daemon, address, proven });
            }
        }
        self.discovery = Some(discovery);
    }

    /// Lets discovery and the gateway say goodbye.
    pub(super) async fn end(mut self) {
        if let Some(Discovery { events, mut actions, task }) = self.discovery.take() {
            drop(events);
            let goodbye = async {
                while let Some(action) = actions.recv().await {
                    if let DiscoveryAction::SendFromQuicPort { to, bytes } = action {
                        self.order(ToGateway::SendDatagram { to, bytes });
                    }
                }
            };
            // Discovery sends its last datagrams at once.
            let patience = Duration::from_millis(500);
            let _ = tokio::time::timeout(patience, goodbye).await;
            task.abort();
        }
        if let Some(running) = self.running {
            running.end().await;
        }
    }
}

impl Discovery {
    fn start(control: &ControlPlane) -> Self {
        let (events, inbox) = mpsc::channel(CHANNEL);
        let (outbox, actions) = mpsc::channel(CHANNEL);
        let (config, daemon) = (Arc::clone(&control.config), control.id);
        let wanted = control.wanted.subscribe();
        let task = spawn_local(async move {
            discovery::run(&config, daemon, wanted, inbox, outbox).await;
        });
        Self { events, actions, task }
    }

    fn tell(&self, event: DiscoveryEvent) {
        // Any host can send datagrams: they leave space for the gateway's messages about links.
        let crowded = self.events.capacity() < CHANNEL / 4;
        if matches!(event, DiscoveryEvent::Datagrams(_)) && crowded {
            return;
        }
        if self.events.try_send(event).is_err() {
            tracing::debug!("discovery is busy; an event was dropped");
        }
    }
}

/// Returns the gateway's next message, or the reason for its end.
async fn said(running: Option<&mut RunningGateway>) -> Result<ToControl, String> {
    match running {
        Some(running) => running.next().await,
        None => Err("it has no thread".to_owned()),
    }
}

/// Ends at a time, if there is one.
async fn due(at: Option<Instant>) {
    match at {
        Some(at) => tokio::time::sleep_until(at).await,
        None => std::future::pending().await,
    }
}

/// Returns discovery's next action.
async fn wanted(discovery: Option<&mut Discovery>) -> Option<DiscoveryAction> {
    match discovery {
        Some(discovery) => discovery.actions.recv().await,
        None => std::future::pending().await,
    }
}
