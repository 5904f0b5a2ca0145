//! The options of a session and of its endpoints.

use std::{ffi::OsString, io, path::PathBuf, sync::Arc};

use axon_shm::internal::KnownPeers;

#[cfg(feature = "sros2")]
use crate::sros2::EnclavePermissions;
use crate::{qos::Qos, session_key::SessionKey, wire::session::SessionRole};

/// The options of a new session.
///
/// ```
/// # use axon_transport::{
/// #     Session, SessionOptions,
/// #     config::{Config, DaemonPolicy},
/// # };
/// # let config = Config::builder().daemon(DaemonPolicy::Off).build()?;
/// # let session = Session::open(&config, SessionOptions::new("robot"))?;
/// # drop(session);
/// let options = SessionOptions::new("camera");
/// let session = Session::open(&config, options)?;
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Clone, Debug)]
pub struct SessionOptions {
    pub(in crate::session) name: String,
    pub(in crate::session) role: SessionRole,
    pub(in crate::session) daemon_command: Option<DaemonCommand>,
    pub(in crate::session) callers: usize,
    /// True if the session keeps refusals that concern no particular endpoint, for the process that it relays.
    pub(in crate::session) keeps_refusals: bool,
    /// The descriptors of other sessions that this process holds already.
    pub(in crate::session) known_peers: Option<Arc<KnownPeers>>,
    /// The key that the session's id is derived from.
    pub(in crate::session) key: Option<Arc<SessionKey>>,
    #[cfg(feature = "sros2")]
    pub(in crate::session) permissions: Option<Arc<EnclavePermissions>>,
}

impl SessionOptions {
    /// Creates the options of an application's session. `name` is shown to users and identifies the process or node.
    /// It is truncated to 256 bytes.
    pub fn new(name: impl Into<String>) -> Self {
        let mut name: String = name.into();
        while name.len() > 256 {
            name.pop();
        }
        let role = SessionRole::Application;
        Self {
            name,
            role,
            daemon_command: None,
            callers: usize::MAX,
            keeps_refusals: false,
            known_peers: None,
            key: None,
            #[cfg(feature = "sros2")]
            permissions: None,
        }
    }

    /// Limits the session to the permissions of an enclave. The session creates no endpoint that they do not allow.
    /// The permissions do not limit what the graph shows. When they expire, existing endpoints stay, and no other one
    /// is created.
    #[cfg(feature = "sros2")]
    #[must_use]
    pub fn permissions(mut self, permissions: EnclavePermissions) -> Self {
        self.permissions = Some(Arc::new(permissions));
        self
    }

    /// Sets the command that starts a daemon, for a program that can itself be one. `AXON_DAEMON_PATH` wins.
    #[must_use]
    pub fn daemon_command(mut self, command: DaemonCommand) -> Self {
        self.daemon_command = Some(command);
        self
    }
}

/// A command that runs a daemon. The flags `--spawned` and `--detached` are added after the arguments. The program
/// passes them on to `axon_daemon::Start::from_arguments`.
///
/// ```
/// use axon_transport::{DaemonCommand, SessionOptions};
///
/// let daemon = DaemonCommand::new("/opt/axon/bin/axon", ["daemon"]);
/// let options = SessionOptions::new("camera").daemon_command(daemon);
/// # drop(options);
/// ```
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct DaemonCommand {
    /// The program.
    pub program: PathBuf,
    /// The arguments before the flags.
    pub arguments: Vec<OsString>,
}

impl DaemonCommand {
    /// Creates a command from a program and the arguments before the flags.
    pub fn new(
        program: impl Into<PathBuf>,
        arguments: impl IntoIterator<Item = impl Into<OsString>>,
    ) -> Self {
        let arguments = arguments.into_iter().map(Into::into).collect();
        Self { program: program.into(), arguments }
    }

    /// Creates a command from the current executable and the arguments that make it the daemon.
    ///
    /// # Errors
    /// The system does not report the path of the executable.
    pub fn current_executable(
        arguments: impl IntoIterator<Item = impl Into<OsString>>,
    ) -> io::Result<Self> {
        Ok(Self::new(std::env::current_exe()?, arguments))
    }
}

/// The description of an endpoint.
///
/// ```
/// use axon_transport::{EndpointSpec, qos::Qos};
///
/// let scan = EndpointSpec::new("/scan", "sensor_msgs/msg/LaserScan", Qos::sensor_data())
///     .node("lidar", "/front")
///     .ignore_local(true);
/// assert_eq!((&*scan.node, scan.ignore_local), ("lidar", true));
/// ```
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct EndpointSpec {
    /// The full topic name.
    pub topic: String,
    /// The type's name. Endpoints match on topic and type.
    pub type_name: String,
    /// The type's hash; empty if unknown.
    pub type_hash: Vec<u8>,
    /// QoS that is offered or requested.
    pub qos: Qos,
    /// The node's name; empty without a node.
    pub node: String,
    /// The node's namespace.
    pub namespace: String,
    /// For a subscription: true if it ignores publishers of its own session.
    pub ignore_local: bool,
    /// For a publisher: the length of most samples in bytes, as in
    /// [`PublisherOptions::expected_len`](axon_shm::PublisherOptions::expected_len); 0 if unknown.
    pub expected_len: u64,
}

impl EndpointSpec {
    /// Creates an endpoint without a node and without a hash of its type.
    pub fn new(topic: impl Into<String>, type_name: impl Into<String>, qos: Qos) -> Self {
        Self {
            topic: topic.into(),
            type_name: type_name.into(),
            type_hash: Vec::new(),
            qos,
            node: String::new(),
            namespace: String::new(),
            ignore_local: false,
            expected_len: 0,
        }
    }

    /// Sets the topic.
    #[must_use]
    pub fn topic(mut self, topic: impl Into<String>) -> Self {
        self.topic = topic.into();
        self
    }

    /// Sets the type.
    #[must_use]
    pub fn type_name(mut self, type_name: impl Into<String>) -> Self {
        self.type_name = type_name.into();
        self
    }

    /// Sets the hash of the type.
    #[must_use]
    pub fn type_hash(mut self, hash: impl Into<Vec<u8>>) -> Self {
        self.type_hash = hash.into();
        self
    }

    /// Sets the QoS that is offered or requested.
    #[must_use]
    pub fn qos(mut self, qos: Qos) -> Self {
        self.qos = qos;
        self
    }

    /// Sets the node and its namespace.
    #[must_use]
    pub fn node(mut self, name: impl Into<String>, namespace: impl Into<String>) -> Self {
        (self.node, self.namespace) = (name.into(), namespace.into());
        self
    }

    /// Sets whether a subscription ignores publishers of its own session.
    #[must_use]
    pub fn ignore_local(mut self, whether: bool) -> Self {
        self.ignore_local = whether;
        self
    }

    /// Sets the length of most samples of a publisher, in bytes.
    #[must_use]
    pub fn expected_len(mut self, len: u64) -> Self {
        self.expected_len = len;
        self
    }
}
