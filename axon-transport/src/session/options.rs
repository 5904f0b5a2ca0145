//! The options of a session and of its endpoints.

use std::{ffi::OsString, io, path::PathBuf, sync::Arc};

use crate::{qos::Qos, session_key::SessionKey, wire::session::SessionRole};

/// How a session is opened.
#[derive(Clone, Debug)]
pub struct SessionOptions {
    pub(super) name: String,
    pub(super) role: SessionRole,
    pub(super) daemon_command: Option<DaemonCommand>,
    pub(super) callers: usize,
    /// What its id is made of.
    pub(super) key: Option<Arc<SessionKey>>,
}

impl SessionOptions {
    /// An application's session. `name` is shown to people; it names the process or node.
    pub fn new(name: impl Into<String>) -> Self {
        let mut name: String = name.into();
        while name.len() > 256 {
            name.pop();
        }
        let role = SessionRole::Application;
        Self { name, role, daemon_command: None, callers: usize::MAX, key: None }
    }

    /// How to start a daemon, for a program that can be one itself. `AXON_DAEMON_PATH` wins.
    #[must_use]
    pub fn daemon_command(mut self, command: DaemonCommand) -> Self {
        self.daemon_command = Some(command);
        self
    }
}

/// A command that runs a daemon: it passes the flags `--spawned` and `--detached`, which are added
/// after the arguments, on to [`daemon::main`](crate::daemon::main).
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct DaemonCommand {
    /// The program.
    pub program: PathBuf,
    /// What goes before the flag.
    pub arguments: Vec<OsString>,
}

impl DaemonCommand {
    /// This very program, with arguments that make it the daemon.
    ///
    /// # Errors
    /// When the system does not say which program this is.
    pub fn current_executable(
        arguments: impl IntoIterator<Item = impl Into<OsString>>,
    ) -> io::Result<Self> {
        Ok(Self {
            program: std::env::current_exe()?,
            arguments: arguments.into_iter().map(Into::into).collect(),
        })
    }
}

/// What an endpoint is.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct EndpointSpec {
    /// The full topic name.
    pub topic: String,
    /// The type's name. Endpoints match on topic and type.
    pub type_name: String,
    /// The type's hash; empty when unknown.
    pub type_hash: Vec<u8>,
    /// What the endpoint offers or requests.
    pub qos: Qos,
    /// The node it belongs to; may be empty.
    pub node: String,
    /// That node's namespace.
    pub namespace: String,
    /// A subscription: whether it receives nothing from publishers of its own session.
    pub ignore_local: bool,
    /// A publisher: the length of most samples in bytes, as in
    /// [`PublisherOptions::expected_len`](axon_shm::PublisherOptions::expected_len); 0 when unknown.
    pub expected_len: u64,
}

impl EndpointSpec {
    /// An endpoint of no node, of a type without a known hash.
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
}
