//! The errors of sessions and of waits for messages.

use std::{fmt, path::PathBuf};

use axon_shm::{ShmError, internal::OwnLimit};

#[cfg(feature = "sros2")]
use crate::sros2::{Denial, PermissionsError};
use crate::{config::ConfigError, ids::SessionId, wire::session::CodecError};

/// Why waiting for a message ended without one.
///
/// There is no variant for a session that is closed: an endpoint keeps its session open for as long as the
/// endpoint lives, and a call that waits borrows the endpoint. A publisher that ends is no error either:
/// another one may come.
///
/// ```
/// # use std::time::Duration;
/// use axon_transport::RecvError;
/// # use axon_transport::{
/// #     EndpointSpec, Session, SessionOptions,
/// #     config::{Config, DaemonPolicy},
/// #     qos::Qos,
/// # };
/// # let config = Config::builder().daemon(DaemonPolicy::Off).build()?;
/// # let session = Session::open(&config, SessionOptions::new("robot"))?;
/// # let spec = || EndpointSpec::new("/speed", "example/Speed", Qos::default());
/// let subscription = session.create_subscription(spec())?;
/// let nothing = subscription.recv(&mut Vec::new(), Some(Duration::from_millis(1)));
/// assert_eq!(nothing.unwrap_err(), RecvError::TimedOut);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum RecvError {
    /// No message came within the timeout.
    #[error("no message came within the timeout")]
    TimedOut,
    /// The process forked: the endpoint belongs to the parent.
    #[error("used after fork: a child process must open a session of its own")]
    Forked,
    /// An event loop of the program already listens (an [`ExternalLeader`](axon_shm::ExternalLeader)), so that the
    /// session cannot wake tasks. Waiting in a thread works nevertheless.
    #[error("session {0} already has an external leader of its waits, and cannot wake tasks")]
    AlreadyLed(SessionId),
}

impl RecvError {
    /// Returns the error for the reason why the control thread cannot listen.
    pub(in crate::session) fn of_listening(error: &ShmError) -> Self {
        match error {
            ShmError::AlreadyLed(session) => Self::AlreadyLed(*session),
            // This is the only other reason to refuse an external leader.
            _ => Self::Forked,
        }
    }
}

/// The reason why a session could not be opened or used.
///
/// `Debug` prints the same text as `Display`, because a `main` that returns the error prints it with `Debug`.
///
/// ```
/// use axon_transport::SessionError;
/// # use axon_transport::{
/// #     Session, SessionOptions,
/// #     config::{Config, DaemonPolicy},
/// # };
/// # let config = Config::builder().daemon(DaemonPolicy::Off).build()?;
/// # let session = Session::open(&config, SessionOptions::new("robot"))?;
/// let refused = session.create_node("", "/", "/");
/// assert!(matches!(refused, Err(SessionError::Node { .. })));
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(thiserror::Error)]
#[non_exhaustive]
pub enum SessionError {
    /// A publisher with different settings still uses this GID.
    #[error(
        "GID {0} is still in use by a publisher with different settings; retry when that publisher is gone"
    )]
    InUse(crate::ids::Gid),
    /// A node's name or namespace is empty or too long.
    #[error(
        "node {name:?}: its name is empty, or it, its namespace or its enclave is longer than {} bytes \
         or holds a NUL",
        crate::graph::LIMITS.name
    )]
    Node {
        /// The name.
        name: String,
    },
    /// A waitable belongs to another session, and that session is closed or led by an event loop.
    #[error(
        "cannot wait: a waitable's session is closed, or an event loop already waits on its doorbell"
    )]
    OtherSession,
    /// `AXON_DAEMON=require`, and there is none.
    #[error(
        "no daemon listens at {address}: a session starts one unless AXON_DAEMON is require or off; \
         `axon daemon` and `axon_daemon` start one by hand"
    )]
    NoDaemon {
        /// The address at which the session looked for it.
        address: String,
    },
    /// A call needs a daemon, but `AXON_DAEMON` is `off`.
    #[error("there is no daemon to ask: AXON_DAEMON is off")]
    Off,
    /// The program to start was not found.
    #[error(
        "no daemon runs, and none can be started: there is neither axon_daemon nor axon in {}{}; install \
         it with `cargo install --locked --git {} axon-cli`, or set AXON_DAEMON_PATH to the \
         daemon's program",
        list(tried),
        PassedOver(untrusted),
        // The crate is not on crates.io, where another project owns the name.
        env!("CARGO_PKG_REPOSITORY")
    )]
    NoProgram {
        /// The folders that were searched.
        tried: Vec<PathBuf>,
        /// Programs with the daemon's names that were not started: they belong to another user, or every user may
        /// replace them.
        untrusted: Vec<PathBuf>,
    },
    /// The daemon that was started gave up.
    #[error("the daemon {} did not start: {text}", program.display())]
    DaemonFailed {
        /// The program.
        program: PathBuf,
        /// The output of the program.
        text: String,
    },
    /// Memory cannot be shared, so that the session has to be relayed.
    #[error("memory cannot be shared with the daemon: {0}")]
    NotShared(String),
    /// The daemon's settings are not the session's.
    #[error(
        "{variable} is {ours} here but {theirs} in the daemon at {address} (pid {pid}); use the \
         same settings, another ROS_DOMAIN_ID, or end that daemon"
    )]
    Mismatch {
        /// The variable that differs.
        variable: String,
        /// The value or digest of the session.
        ours: String,
        /// The value or digest of the daemon.
        theirs: String,
        /// The address of the daemon.
        address: String,
        /// The daemon's process.
        pid: u32,
    },
    /// The daemon refuses the session for another reason.
    #[error("the daemon at {address} refuses the session: {text}")]
    Refused {
        /// The address of the daemon.
        address: String,
        /// The reason.
        text: String,
    },
    /// The process that listens at the daemon's address belongs to another user.
    #[error(
        "{address} belongs to uid {uid}, which is neither this process's nor in AXON_TRUSTED_UIDS; \
         set XDG_RUNTIME_DIR or AXON_RUNTIME_DIR to a directory of this user's own"
    )]
    Untrusted {
        /// The address.
        address: String,
        /// The user of the process that listens there.
        uid: u32,
    },
    /// Another process has bound the daemon's abstract name and serves no session.
    #[error(
        "{address} is bound by a process that serves no session, another user's perhaps; \
         set XDG_RUNTIME_DIR or AXON_RUNTIME_DIR to a directory of this user's own"
    )]
    Squatted {
        /// The address.
        address: String,
    },
    /// The daemon does not answer.
    #[error("the daemon at {address} does not answer")]
    Silent {
        /// The address of the daemon.
        address: String,
    },
    /// The connection to the daemon ended, and there is none yet in its place.
    #[error("the connection to the daemon is lost")]
    Disconnected,
    /// The daemon sent a message that breaks the protocol.
    #[error("the daemon broke the session protocol: {0}")]
    Protocol(String),
    /// A name, type hash or depth that no endpoint may have.
    #[error("endpoint {topic}: a name, type hash or depth is out of bounds")]
    Endpoint {
        /// The topic.
        topic: String,
    },
    /// The permissions of the session's enclave do not allow an endpoint.
    #[cfg(feature = "sros2")]
    #[error("{topic}: {denial}")]
    Permission {
        /// The topic or service.
        topic: String,
        /// The rule that denies the endpoint, its place, and the DDS name of the topic.
        denial: Denial,
    },
    /// The permissions of the session's enclave do not count now, or not in its domain.
    #[cfg(feature = "sros2")]
    #[error(transparent)]
    Permissions(Box<PermissionsError>),
    /// A setting or a file that it names.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// The address of the daemon cannot be used. The text says what is wrong with it, and where.
    #[error("{0}")]
    Address(String),
    /// Shared memory failed.
    #[error(transparent)]
    Memory(#[from] ShmError),
    /// A system call failed.
    #[error("{what}: {source}{}", OwnLimit(source))]
    System {
        /// The attempted operation.
        what: &'static str,
        /// The error of the system.
        source: std::io::Error,
    },
}

impl fmt::Debug for SessionError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}

#[cfg(feature = "sros2")]
impl From<PermissionsError> for SessionError {
    fn from(error: PermissionsError) -> Self {
        Self::Permissions(Box::new(error))
    }
}

impl SessionError {
    /// Returns the error for a message that cannot be decoded.
    pub(in crate::session) fn of_codec(error: CodecError) -> Self {
        Self::Protocol(error.to_string())
    }
}

fn list(paths: &[PathBuf]) -> String {
    paths.iter().map(|path| path.display().to_string()).collect::<Vec<_>>().join(", ")
}

/// Names the programs that were not started, if there are any.
struct PassedOver<'a>(&'a [PathBuf]);

impl fmt::Display for PassedOver<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.0.is_empty() {
            return Ok(());
        }
        let programs = list(self.0);
        write!(
            f,
            " (passed over, since another user owns it or every user may write it: {programs})"
        )
    }
}
