//! A registry inside the application's process, for a session that uses no daemon. With `AXON_DAEMON=off` the
//! process's one session finds its own endpoints in it. In a relayed session a second session in it represents
//! everything outside the process (`session::relayed`).

use std::{
    collections::HashMap,
    sync::{Arc, Mutex, MutexGuard, PoisonError},
};

use axon_shm::{ShmError, internal::descriptors::PassedFd};

use crate::{
    graph::Endpoint,
    ids::{DaemonId, Gid, SessionId},
    registry::Registry,
    session::core::{ControlWaker, SessionCore},
    wire::session::SessionMessage,
};

/// A registry that connects the sessions of one process.
#[derive(Debug, Default)]
pub(crate) struct LocalRegistry(Mutex<LocalRegistryState>);

#[derive(Debug, Default)]
struct LocalRegistryState {
    registry: Registry<Arc<PassedFd>>,
    /// The waker of each session's control thread.
    wakers: HashMap<SessionId, Arc<ControlWaker>>,
}

/// A session's connection to the registry.
#[derive(Debug)]
pub(in crate::session) struct InProcessDaemon {
    id: SessionId,
    local_registry: Arc<LocalRegistry>,
}

impl LocalRegistry {
    /// Updates the endpoints outside the process: adds new endpoints of `daemon`, and removes endpoints that ended.
    pub(crate) fn outside(&self, daemon: DaemonId, added: Vec<Endpoint>, removed: Vec<Gid>) {
        let mut inside = self.lock();
        inside.registry.remote_graph(daemon, false, added, removed);
        inside.settle(None);
    }

    /// Removes the endpoints outside the process that `daemon` reported.
    pub(crate) fn outside_gone(&self, daemon: &DaemonId) {
        let mut inside = self.lock();
        inside.registry.remote_gone(daemon);
        inside.settle(None);
    }

    fn lock(&self) -> MutexGuard<'_, LocalRegistryState> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl LocalRegistryState {
    /// Wakes the sessions that have messages, except the one that is about to receive.
    fn settle(&mut self, listening: Option<&SessionId>) {
        self.registry.flush();
        self.registry.answer_fences();
        for id in self.registry.take_ready() {
            if Some(&id) != listening
                && let Some(waker) = self.wakers.get(&id)
            {
                waker.wake();
            }
        }
    }
}

impl InProcessDaemon {
    /// Creates a registry for this session alone. It passes no descriptors.
    pub(in crate::session) fn alone(session: &SessionCore) -> Self {
        Self::enter(Arc::default(), session, None)
    }

    /// Joins `local_registry`.
    pub(in crate::session) fn join(
        local_registry: Arc<LocalRegistry>,
        session: &SessionCore,
    ) -> Result<Self, ShmError> {
        let handed = session.segment.descriptors()?;
        let handed = [handed.segment, handed.doorbell, handed.pidfd].map(Arc::new);
        Ok(Self::enter(local_registry, session, Some(handed)))
    }

    fn enter(
        local_registry: Arc<LocalRegistry>,
        session: &SessionCore,
        handed: Option<[Arc<PassedFd>; 3]>,
    ) -> Self {
        let (id, role, name) = (session.id, session.options.role, session.options.name.clone());
        let mut inside = local_registry.lock();
        inside.wakers.insert(id, session.waker.clone());
        // A registry has at most two sessions, which is never too many.
        let _ = inside.registry.handle_connect(id, role, name, std::process::id(), handed, None);
        drop(inside);
        Self { id, local_registry }
    }

    /// Passes a message, if any, to the registry, and returns the messages for this session.
    pub(in crate::session) fn exchange(
        &mut self,
        message: Option<(SessionMessage, Vec<PassedFd>)>,
    ) -> Vec<(SessionMessage, Vec<PassedFd>)> {
        let mut inside = self.local_registry.lock();
        if let Some((message, descriptors)) = message {
            let descriptors = descriptors.into_iter().map(Arc::new).collect();
            if let Err(violation) = inside.registry.handle_message(&self.id, message, descriptors) {
                tracing::error!(%violation, "the in-process registry rejected a message");
            }
        }
        inside.settle(Some(&self.id));
        let mut answers = Vec::new();
        while let Some(output) = inside.registry.poll_output(&self.id) {
            let descriptors: std::io::Result<Vec<PassedFd>> =
                output.descriptors.iter().map(|d| d.try_clone()).collect();
            match (SessionMessage::decode(&output.packet), descriptors) {
                (Ok(message), Ok(descriptors)) => answers.push((message, descriptors)),
                (message, descriptors) => {
                    tracing::error!(
                        ?message,
                        ?descriptors,
                        "the in-process registry's reply could not be decoded, or its descriptors could not be \
                         duplicated; reply dropped"
                    );
                }
            }
        }
        // Fences of other sessions may wait for the messages that this session has now received.
        inside.settle(None);
        answers
    }
}

impl Drop for InProcessDaemon {
    fn drop(&mut self) {
        let mut inside = self.local_registry.lock();
        inside.wakers.remove(&self.id);
        inside.registry.handle_disconnect(&self.id);
        inside.settle(None);
    }
}
