//! A process's way into AXON: publishers and subscriptions over shared memory, and the
//! conversation with the daemon that brings them together.
//!
//! Samples never pass the daemon. It tells readers and writers of each other and hands the
//! descriptors over; when it dies, what is attached flows on, and the control thread `axon-ctl`
//! finds or starts another and repeats what the first one knew.

pub mod address;
mod arrivals;
mod callback;
mod clock;
pub(crate) mod connect;
mod control;
mod create;
mod error;
mod events;
mod guard;
pub(crate) mod local;
pub mod message;
mod node;
mod options;
mod peers;
mod publisher;
mod rings;
mod service;
pub(crate) mod signals;
pub mod socket;
mod state;
mod status;
mod subscription;
#[cfg(test)]
mod tests;
mod waiting;

use std::{
    os::fd::OwnedFd,
    sync::{Arc, PoisonError},
    thread::JoinHandle,
    time::Duration,
};

pub use callback::OnNew;
pub use error::SessionError;
pub use events::Event;
pub use guard::GuardCondition;
pub use message::SessionRole;
pub use node::Node;
pub use options::{DaemonCommand, EndpointSpec, SessionOptions};
pub(crate) use publisher::OwnedLoan;
pub use publisher::{Loan, Publisher};
pub use service::{Client, Server};
pub use state::SessionEvent;
pub(crate) use state::Shared;
pub use subscription::{MessageInfo, Subscription};
pub use waiting::Waitable;

use self::{
    connect::Caller,
    control::{Control, Start},
    local::House,
    message::{EndpointRole, Message},
    state::{Outgoing, StatusAnswer},
    subscription::SubscriptionInner,
};
use crate::{
    config::{Config, DaemonPolicy},
    graph::{Endpoint, EndpointKind, GraphEntry, GraphView},
    ids::{DaemonId, Gid, SessionId},
    qos::Qos,
    relay::near::Near,
    shm::{SessionSegment, ShmError},
};

/// How long a daemon may take to answer a question.
const ANSWER: Duration = Duration::from_secs(5);

/// A process's session. Cheap to clone; thread-safe. It ends when the last clone and the last of
/// its publishers and subscriptions are gone.
///
/// ```no_run
/// use axon_transport::{
///     config::Config,
///     qos::Qos,
///     session::{EndpointSpec, Session, SessionOptions},
/// };
///
/// let config = Config::from_env()?;
/// let session = Session::open(&config, SessionOptions::new("talker"))?;
/// let spec = EndpointSpec::new("/chatter", "std_msgs/msg/String", Qos::default());
/// let publisher = session.create_publisher(spec)?;
/// publisher.publish(b"hello")?;
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Clone, Debug)]
pub struct Session {
    handle: Arc<Handle>,
}

#[derive(Debug)]
struct Handle {
    shared: Arc<Shared>,
    thread: Option<JoinHandle<()>>,
    /// What carries its samples, where it shares no memory.
    relay: Option<Near>,
}

impl Session {
    /// Opens a session with the daemon of this user and domain, which is started when there is
    /// none and `AXON_DAEMON` is `spawn`. Under `off`, endpoints of the session reach each other
    /// and nobody else.
    ///
    /// # Errors
    /// When the daemon cannot be reached or started, or has other security settings: the error
    /// names the variable.
    pub fn open(config: &Config, options: SessionOptions) -> Result<Self, SessionError> {
        let id = SessionId::random();
        if config.daemon == DaemonPolicy::Off {
            let house = Start::House(Arc::default());
            let segment = SessionSegment::create(id)?;
            return Ok(Self::of(Self::start(config, options, segment, house)?));
        }
        let reason = if config.shm {
            let segment = SessionSegment::create(id)?;
            let caller = Caller {
                config,
                options: &options,
                id,
                segment: Some(&segment),
                relay: None,
                cancel: None,
            };
            match caller.connect() {
                Ok(daemon) => {
                    let start = Start::Daemon(daemon);
                    return Ok(Self::of(Self::start(config, options, segment, start)?));
                }
                Err(SessionError::NotShared(reason)) => reason,
                Err(error) => return Err(error),
            }
        } else {
            "AXON_SHM is off".to_owned()
        };
        Self::relayed(config, options, id, reason)
    }

    /// A session whose samples pass through the daemon. It has the world outside in its own process:
    /// a session that stands for it, and a registry that brings the two together.
    fn relayed(
        config: &Config,
        options: SessionOptions,
        id: SessionId,
        reason: String,
    ) -> Result<Self, SessionError> {
        tracing::info!(reason, "samples pass through the daemon");
        let caller = Caller {
            config,
            options: &options,
            id,
            segment: None,
            relay: Some(&reason),
            cancel: None,
        };
        let connected = caller.connect()?;
        let house = Arc::<House>::default();
        let segment = SessionSegment::create(id)?;
        let start = Start::House(Arc::clone(&house));
        let mut handle = Self::start(config, options, segment, start)?;
        let outside = SessionOptions::new("relay").role(SessionRole::Gateway);
        let segment = SessionSegment::create(SessionId::random())?;
        let start = Start::House(Arc::clone(&house));
        let outside = Self::of(Self::start(config, outside, segment, start)?);
        handle.relay =
            Some(Near::start(Arc::clone(&handle.shared), house, outside, connected, reason)?);
        Ok(Self::of(handle))
    }

    /// A session over a socket that is connected to a daemon. It ends with that connection.
    ///
    /// # Errors
    /// When the daemon refuses it.
    pub fn over(
        socket: OwnedFd,
        config: &Config,
        options: SessionOptions,
    ) -> Result<Self, SessionError> {
        Self::over_as(SessionId::random(), socket, config, options)
    }

    /// As [`over`](Self::over), under a given id: for the daemon, in whose memory the endpoints of a
    /// relayed session are.
    pub(crate) fn over_as(
        id: SessionId,
        socket: OwnedFd,
        config: &Config,
        options: SessionOptions,
    ) -> Result<Self, SessionError> {
        let segment = SessionSegment::create(id)?;
        let caller = Caller {
            config,
            options: &options,
            id,
            segment: Some(&segment),
            relay: None,
            cancel: None,
        };
        let connected = caller.greet_over(socket)?;
        Ok(Self::of(Self::start(config, options, segment, Start::Socket(connected))?))
    }

    /// Its id.
    pub fn id(&self) -> SessionId {
        self.shared().id
    }

    /// The domain that it is in.
    pub fn domain(&self) -> u32 {
        self.shared().config.domain
    }

    /// What it does about its daemon.
    pub fn daemon_policy(&self) -> DaemonPolicy {
        self.shared().config.daemon
    }

    /// The daemon it is connected to; `None` while there is none, and in a forked child.
    pub fn daemon(&self) -> Option<DaemonId> {
        if self.is_forked() { None } else { self.shared().state().daemon }
    }

    /// A publisher. It is matched with those readers that the graph shows, unless they take more
    /// than some milliseconds; others are matched later: see [`Publisher::wait_matched`].
    ///
    /// # Errors
    /// When the specification is out of bounds or there is no memory.
    pub fn create_publisher(&self, spec: EndpointSpec) -> Result<Publisher, SessionError> {
        let endpoint = self.endpoint(spec, EndpointKind::Publisher)?;
        let publisher = self.add_publisher(endpoint, EndpointRole::Application)?;
        let inner = &publisher.inner;
        self.await_pairs(&inner.endpoint, |other| inner.events.is_matched(other));
        Ok(publisher)
    }

    /// A subscription. It is matched with those publishers that the graph shows, unless they take
    /// more than some milliseconds; others are matched later: see [`Subscription::wait_matched`].
    ///
    /// # Errors
    /// When the specification is out of bounds.
    pub fn create_subscription(&self, spec: EndpointSpec) -> Result<Subscription, SessionError> {
        let ignores_local = spec.ignore_local;
        let endpoint = self.endpoint(spec, EndpointKind::Subscription)?;
        let mut inner = SubscriptionInner::new(endpoint, EndpointRole::Application, Vec::new());
        inner.ignores_local = ignores_local;
        let subscription = self.add_reader(inner);
        let inner = &subscription.inner;
        self.await_pairs(&inner.endpoint, |other| inner.events.is_matched(other));
        Ok(subscription)
    }

    /// A server of a service. Its clients are matched as a publisher's readers are.
    ///
    /// # Errors
    /// When the specification is out of bounds.
    pub fn create_server(&self, spec: EndpointSpec) -> Result<Server, SessionError> {
        let endpoint = self.endpoint(spec, EndpointKind::Server)?;
        let server = self.add_server(endpoint, EndpointRole::Application);
        server.await_clients();
        Ok(server)
    }

    /// A client of a service. Its servers are matched as a publisher's readers are; see
    /// [`Client::wait_available`].
    ///
    /// # Errors
    /// When the specification is out of bounds or there is no memory.
    pub fn create_client(&self, spec: EndpointSpec) -> Result<Client, SessionError> {
        let endpoint = self.endpoint(spec, EndpointKind::Client)?;
        let client = self.add_client(endpoint, EndpointRole::Application)?;
        client.await_servers();
        Ok(client)
    }

    /// A node, which is in the graph until it is dropped.
    ///
    /// # Errors
    /// When the name is empty, or a name is out of bounds.
    pub fn create_node(
        &self,
        name: &str,
        namespace: &str,
        enclave: &str,
    ) -> Result<Node, SessionError> {
        // What a node has no use for is as it is by default.
        let spec = EndpointSpec {
            node: name.to_owned(),
            namespace: namespace.to_owned(),
            ..EndpointSpec::new("", "", Qos::default())
        };
        let described =
            Endpoint { enclave: enclave.to_owned(), ..self.describe(spec, EndpointKind::Node)? };
        if !described.is_sane() {
            return Err(SessionError::Node { name: described.node });
        }
        Ok(self.adopt_node(described))
    }

    /// A condition that the program triggers itself, for wait sets of the session.
    pub fn create_guard_condition(&self) -> GuardCondition {
        GuardCondition::new(&self.handle.shared)
    }

    /// A local ring for a publisher on another host, under that publisher's own GID. For the
    /// gateway alone; a daemon refuses it from anybody else.
    ///
    /// # Errors
    /// When there is no memory.
    pub fn create_stand_in(&self, remote: Endpoint) -> Result<Publisher, SessionError> {
        self.add_publisher(remote, EndpointRole::StandIn)
    }

    /// A client of another host as the servers here see it, under its own GID. For the gateway alone.
    pub(crate) fn create_stand_in_client(&self, remote: Endpoint) -> Result<Client, SessionError> {
        self.add_client(remote, EndpointRole::StandIn)
    }

    /// A server of another host as the clients here see it, under its own GID. For the gateway alone.
    pub(crate) fn create_stand_in_server(&self, remote: Endpoint) -> Server {
        self.add_server(remote, EndpointRole::StandIn)
    }

    /// A publisher as another process of the session describes it, under its GID there.
    pub(crate) fn adopt_publisher(&self, endpoint: Endpoint) -> Result<Publisher, SessionError> {
        self.add_publisher(endpoint, EndpointRole::Application)
    }

    /// As [`adopt_publisher`](Self::adopt_publisher), a subscription.
    pub(crate) fn adopt_subscription(&self, endpoint: Endpoint) -> Subscription {
        self.add_subscription(endpoint, EndpointRole::Application, Vec::new())
    }

    /// As [`adopt_publisher`](Self::adopt_publisher), a node.
    pub(crate) fn adopt_node(&self, endpoint: Endpoint) -> Node {
        let gid = endpoint.gid;
        let changed = self.create_guard_condition();
        {
            let mut state = self.shared().state();
            state.nodes.insert(gid, (endpoint.clone(), changed.clone()));
            // Who makes a node finds it in the graph, whatever the daemon does meanwhile.
            let entry = GraphEntry { endpoint: Arc::new(endpoint.clone()), daemon: None };
            Arc::make_mut(&mut state.graph).endpoints.insert(gid, entry);
        }
        self.shared().tell(Outgoing::Announce(gid));
        Node::new(endpoint, changed, self.clone())
    }

    /// A local reader that carries samples to subscriptions on another host, `stands_for`. For the
    /// gateway alone; a daemon refuses it from anybody else.
    ///
    /// # Errors
    /// When the specification is out of bounds.
    pub fn create_relay(
        &self,
        spec: EndpointSpec,
        stands_for: Vec<Gid>,
    ) -> Result<Subscription, SessionError> {
        let endpoint = self.endpoint(spec, EndpointKind::Subscription)?;
        Ok(self.add_subscription(endpoint, EndpointRole::Relay, stands_for))
    }

    /// The graph as the daemon last described it; empty in a forked child.
    pub fn graph(&self) -> Arc<GraphView> {
        if self.is_forked() { Arc::default() } else { self.shared().state().graph.clone() }
    }

    /// Waits until the graph is as `reached` wants it; whether it is.
    pub fn wait_graph(
        &self,
        timeout: Duration,
        mut reached: impl FnMut(&GraphView) -> bool,
    ) -> bool {
        self.wait_changed(timeout, || reached(&self.graph()))
    }

    /// Sleeps until `ready`, which is evaluated again whenever a sample arrives, or the timeout.
    /// Returns its last value.
    pub fn wait(&self, ready: impl FnMut() -> bool, timeout: Option<Duration>) -> bool {
        self.shared().segment.wait(ready, timeout)
    }

    /// The session's segment, for waiting in other ways.
    pub fn segment(&self) -> &Arc<SessionSegment> {
        &self.shared().segment
    }

    /// Has `listener` called on the control thread for every event. It must not block, and must
    /// not hold the session, which would otherwise never end.
    pub fn set_listener(&self, listener: impl Fn(&SessionEvent) + Send + Sync + 'static) {
        if self.is_forked() {
            return;
        }
        let mut slot = self.shared().listener.lock().unwrap_or_else(PoisonError::into_inner);
        *slot = Some(Arc::new(listener));
    }

    /// The daemon's status: the JSON of [`Status`](crate::daemon::status::Status).
    ///
    /// # Errors
    /// When there is no daemon or it does not answer in time.
    pub fn status_json(&self) -> Result<String, SessionError> {
        let shared = self.shared();
        if self.is_forked() {
            return Err(ShmError::Forked.into());
        }
        let _asking = shared.asking.lock().unwrap_or_else(PoisonError::into_inner);
        if shared.config.daemon == DaemonPolicy::Off {
            return Err(SessionError::Off);
        }
        if self.handle.relay.is_some() {
            return daemon_status(&shared.config);
        }
        {
            let mut state = shared.state();
            if state.daemon.is_none() {
                return Err(SessionError::Disconnected);
            }
            state.status = StatusAnswer::Parts(Default::default());
        }
        shared.tell(Outgoing::Message(Box::new(Message::StatusRequest)));
        shared.wait_changed(ANSWER, || !matches!(shared.state().status, StatusAnswer::Parts(_)));
        let answer = std::mem::take(&mut shared.state().status);
        match answer {
            StatusAnswer::Whole(bytes) => status_text(bytes),
            StatusAnswer::Lost => Err(SessionError::Disconnected),
            StatusAnswer::None | StatusAnswer::Parts(_) => Err(SessionError::Silent {
                address: address::Address::of(&shared.config).to_string(),
            }),
        }
    }

    fn start(
        config: &Config,
        options: SessionOptions,
        segment: Arc<SessionSegment>,
        start: Start,
    ) -> Result<Handle, SessionError> {
        let flags = rustix::event::EventfdFlags::CLOEXEC | rustix::event::EventfdFlags::NONBLOCK;
        let system = |what| move |source: std::io::Error| SessionError::System { what, source };
        let wake = rustix::event::eventfd(0, flags)
            .map_err(|e| system("creating an eventfd")(e.into()))?;
        let shared = Arc::new(Shared::new(config.clone(), options, segment, wake));
        let control = Control::new(shared.clone(), start)?;
        let blocked = signals::Blocked::all();
        let thread = std::thread::Builder::new()
            .name("axon-ctl".into())
            .spawn(move || control.run())
            .map_err(system("starting the control thread"))?;
        drop(blocked);
        Ok(Handle { shared, thread: Some(thread), relay: None })
    }

    fn of(handle: Handle) -> Self {
        Self { handle: Arc::new(handle) }
    }

    fn shared(&self) -> &Arc<Shared> {
        &self.handle.shared
    }

    /// Whether this is a forked child of the session's process. Of its locks some may be held for
    /// ever then, by threads that were not forked with it.
    fn is_forked(&self) -> bool {
        self.shared().segment.is_forked()
    }

    fn wait_changed(&self, timeout: Duration, mut reached: impl FnMut() -> bool) -> bool {
        if self.is_forked() {
            return reached();
        }
        self.shared().wait_changed(timeout, reached)
    }
}

impl Drop for Handle {
    fn drop(&mut self) {
        // The thread, and what it has to say, stay with the parent of a forked child.
        if self.shared.segment.is_forked() {
            std::mem::forget(self.thread.take());
            std::mem::forget(self.relay.take());
            return;
        }
        // First: it carries on what the session's publishers left.
        drop(self.relay.take());
        self.shared.stop();
        if let Some(thread) = self.thread.take() {
            // A listener may hold the last handle.
            if thread.thread().id() != std::thread::current().id() {
                let _ = thread.join();
            }
        }
    }
}

/// The status of the daemon of this user and domain. Starts none, and is answered whatever the
/// security settings.
///
/// # Errors
/// [`SessionError::NoDaemon`] when there is none.
pub fn daemon_status(config: &Config) -> Result<String, SessionError> {
    let config = Config { daemon: DaemonPolicy::Require, ..config.clone() };
    let options = SessionOptions::new("status").role(SessionRole::Tool);
    let caller = Caller {
        config: &config,
        options: &options,
        id: SessionId::random(),
        segment: None,
        relay: None,
        cancel: None,
    };
    let connected = caller.connect()?;
    let address = address::Address::of(&config).to_string();
    status_text(status::ask(&connected.socket, &address, ANSWER)?)
}

fn status_text(bytes: Vec<u8>) -> Result<String, SessionError> {
    String::from_utf8(bytes).map_err(|e| SessionError::Protocol(format!("status: {e}")))
}
