//! The handle of a session.

use std::{sync::Arc, thread::JoinHandle, time::Duration};

use super::{
    core::{Outgoing, SessionCore, SessionEvent},
    relay_thread::RelayThread,
    state::SessionShared,
};
use crate::{
    config::DaemonPolicy,
    graph::GraphView,
    ids::{DaemonId, Gid, SessionId},
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
pub(super) struct Handle {
    /// The core of `shared`: a take and a publish need nothing else.
    pub(super) core: Arc<SessionCore>,
    pub(super) shared: Arc<SessionShared>,
    pub(super) thread: Option<JoinHandle<()>>,
    /// The thread that carries the session's samples, if the session shares no memory.
    pub(super) relay: Option<RelayThread>,
}

impl Session {
    pub(super) fn of(handle: Handle) -> Self {
        Self { handle: Arc::new(handle) }
    }

    /// Returns the session's id.
    pub fn id(&self) -> SessionId {
        self.core().id
    }

    /// Returns the session's domain.
    pub fn domain(&self) -> u32 {
        self.core().config.domain
    }

    /// Returns the session's policy for its daemon.
    pub fn daemon_policy(&self) -> DaemonPolicy {
        self.core().config.daemon
    }

    /// Returns the connected daemon; `None` while there is none, and in a forked child.
    pub fn daemon(&self) -> Option<DaemonId> {
        if self.is_forked() { None } else { self.core().link.daemon() }
    }

    /// Returns the graph as the daemon last described it; empty in a forked child.
    pub fn graph(&self) -> Arc<GraphView> {
        if self.is_forked() { Arc::default() } else { self.shared().state().graph.indexed.view() }
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
        self.core().segment.wait(ready, timeout)
    }

    /// Sets `listener`, which the control thread calls for every event. The listener must not block. It must not hold
    /// the session, which would otherwise never end.
    pub fn set_listener(&self, listener: impl Fn(&SessionEvent) + Send + Sync + 'static) {
        if self.is_forked() {
            return;
        }
        self.core().changes.set_listener(listener);
    }

    pub(in crate::session) fn shared(&self) -> &Arc<SessionShared> {
        &self.handle.shared
    }

    pub(in crate::session) fn core(&self) -> &Arc<SessionCore> {
        &self.handle.core
    }

    /// Returns whether the session's samples pass through the daemon.
    pub(in crate::session) fn is_relayed(&self) -> bool {
        self.handle.relay.is_some()
    }

    /// Returns whether this is a forked child of the session's process. Threads that were not forked with it may then
    /// hold some of the session's locks for ever.
    pub(in crate::session) fn is_forked(&self) -> bool {
        self.core().is_forked()
    }

    pub(in crate::session) fn wait_changed(
        &self,
        timeout: Duration,
        mut reached: impl FnMut() -> bool,
    ) -> bool {
        if self.is_forked() {
            return reached();
        }
        self.shared().wait_changed(timeout, reached)
    }

    /// Handles the end of an endpoint's or a node's handle.
    pub(in crate::session) fn forget_endpoint(&self, gid: &Gid) {
        // In a forked child the endpoint still belongs to the parent, and its locks may be held.
        if self.is_forked() {
            return;
        }
        self.shared().part(gid);
        self.core().wake();
    }

    /// Announces that a relay stands for other subscriptions than before, to its writers and the daemon.
    pub(in crate::session) fn renew(&self, gid: Gid) {
        if self.is_forked() {
            return;
        }
        self.core().tell(Outgoing::Announce(gid));
    }
}

/// Ends the session's threads.
impl Drop for Handle {
    fn drop(&mut self) {
        // The threads and their last messages stay with the parent of a forked child.
        if self.core.is_forked() {
            std::mem::forget(self.thread.take());
            std::mem::forget(self.relay.take());
            return;
        }
        // The relay thread ends first: it carries the remaining samples of the session's publishers.
        drop(self.relay.take());
        self.core.stop();
        if let Some(thread) = self.thread.take() {
            // A listener may hold the last handle.
            if thread.thread().id() != std::thread::current().id() {
                let _ = thread.join();
            }
        }
    }
}
