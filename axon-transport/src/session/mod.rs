//! A process's access to AXON: publishers and subscriptions over shared memory, and the protocol with the daemon that
//! matches them.
//!
//! Samples never pass the daemon. The daemon announces readers and writers to each other and passes the descriptors
//! on. When the daemon dies, attached pairs continue. The control thread `axon-ctl` finds or starts another daemon
//! and repeats the announcements to it.

mod announce;
mod arrivals;
mod callback;
mod clock;
mod create;
pub mod daemon;
mod error;
mod events;
mod guard;
mod hidden;
pub(crate) mod local;
pub mod merge;
mod node;
mod open;
mod options;
mod own_pairs;
mod pair_waits;
mod peers;
#[cfg(feature = "sros2")]
mod permit;
mod publisher;
pub mod relayed;
mod remote_writer;
mod rings;
mod service;
mod state;
mod subscription;
mod tasks;
#[cfg(test)]
mod tests;
mod unmet;
mod waiting;

use std::{
    sync::{Arc, PoisonError},
    thread::JoinHandle,
    time::Duration,
};

pub use callback::OnNew;
pub use clock::{from_unix_nanos, unix_nanos};
pub use daemon::{daemon_check_access_at, daemon_reload_at, daemon_status, daemon_status_at};
pub use error::{RecvError, SessionError};
pub use events::Event;
pub use guard::GuardCondition;
pub use node::Node;
pub use options::{DaemonCommand, EndpointSpec, SessionOptions};
pub(crate) use publisher::OwnedLoan;
pub use publisher::{Loan, Publisher};
pub use remote_writer::{RemoteWriter, Written};
pub use service::{Client, Server};
pub use state::SessionEvent;
pub(crate) use state::SessionShared;
pub use subscription::{Lifetime, MessageInfo, Subscription, TakeLimit, TrustedSubscription};
pub use tasks::{CallError, Messages};
pub use waiting::{Ready, Waitable};

use crate::{
    config::DaemonPolicy,
    graph::GraphView,
    ids::{DaemonId, SessionId},
    session::relayed::near::SessionRelay,
};

/// A process's session. Cheap to clone; thread-safe. It ends when the last clone and the last of
/// its publishers and subscriptions are gone.
///
/// ```no_run
/// use axon_transport::{
///     EndpointSpec, Session, SessionOptions,
///     config::Config,
///     qos::Qos,
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
    shared: Arc<SessionShared>,
    thread: Option<JoinHandle<()>>,
    /// What carries its samples, where it shares no memory.
    relay: Option<SessionRelay>,
}

impl Session {
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

    /// Has `listener` called on the control thread for every event. It must not block, and must
    /// not hold the session, which would otherwise never end.
    pub fn set_listener(&self, listener: impl Fn(&SessionEvent) + Send + Sync + 'static) {
        if self.is_forked() {
            return;
        }
        let mut slot = self.shared().listener.lock().unwrap_or_else(PoisonError::into_inner);
        *slot = Some(Arc::new(listener));
    }

    fn shared(&self) -> &Arc<SessionShared> {
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
