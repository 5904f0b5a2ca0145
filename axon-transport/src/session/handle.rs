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
    /// That of `shared`: a take and a publish need nothing else.
    pub(super) core: Arc<SessionCore>,
    pub(super) shared: Arc<SessionShared>,
    pub(super) thread: Option<JoinHandle<()>>,
    /// What carries its samples, where it shares no memory.
    pub(super) relay: Option<RelayThread>,
}

impl Session {
    pub(super) fn of(handle: Handle) -> Self {
        Self { handle: Arc::new(handle) }
    }

    /// Its id.
    pub fn id(&self) -> SessionId {
        self.core().id
    }

    /// The domain that it is in.
    pub fn domain(&self) -> u32 {
        self.core().config.domain
    }

    /// What it does about its daemon.
    pub fn daemon_policy(&self) -> DaemonPolicy {
        self.core().config.daemon
    }

    /// The daemon it is connected to; `None` while there is none, and in a forked child.
    pub fn daemon(&self) -> Option<DaemonId> {
        if self.is_forked() { None } else { self.core().link.daemon() }
    }

    /// The graph as the daemon last described it; empty in a forked child.
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

    /// Has `listener` called on the control thread for every event. It must not block, and must
    /// not hold the session, which would otherwise never end.
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

    /// Whether its samples pass through the daemon.
    pub(in crate::session) fn is_relayed(&self) -> bool {
        self.handle.relay.is_some()
    }

    /// Whether this is a forked child of the session's process. Of its locks some may be held for
    /// ever then, by threads that were not forked with it.
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

    /// An endpoint's or a node's handle is dropped.
    pub(in crate::session) fn forget_endpoint(&self, gid: &Gid) {
        // In a forked child it is the parent's still, and its locks may be held.
        if self.is_forked() {
            return;
        }
        self.shared().part(gid);
        self.core().wake();
    }

    /// A relay stands for others than before: its writers and the daemon hear of it.
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
        // The thread, and what it has to say, stay with the parent of a forked child.
        if self.core.is_forked() {
            std::mem::forget(self.thread.take());
            std::mem::forget(self.relay.take());
            return;
        }
        // First: it carries on what the session's publishers left.
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
