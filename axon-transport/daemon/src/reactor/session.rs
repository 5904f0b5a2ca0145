//! The gateway's own session, and the graph of this host as the session sees it.

use std::{
    os::fd::OwnedFd,
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
};

use axon_shm::internal::KnownPeers;
use axon_transport::{
    Session, SessionError, SessionEvent, SessionOptions,
    config::Config,
    internal::{graph::reach_of, wire::session::SessionRole},
};
use tokio::sync::Notify;

use crate::engine::peer::LocalEndpoints;

/// Events of the session, which its own thread reports.
#[derive(Debug, Default)]
pub(super) struct Notices {
    graph: AtomicBool,
    lost: AtomicBool,
    wake: Notify,
}

impl Notices {
    fn note(&self, what: &AtomicBool) {
        what.store(true, Ordering::Release);
        self.wake.notify_one();
    }

    /// Returns whether the graph changed since it was taken.
    pub(super) fn has_graph(&self) -> bool {
        self.graph.load(Ordering::Acquire)
    }

    /// Returns whether the graph changed since the last call, and clears the flag.
    pub(super) fn take_graph(&self) -> bool {
        self.graph.swap(false, Ordering::AcqRel)
    }

    /// Returns whether the control plane dropped the session.
    pub(super) fn is_lost(&self) -> bool {
        self.lost.load(Ordering::Acquire)
    }

    /// Waits for an event.
    pub(super) async fn wait(&self) {
        self.wake.notified().await;
    }
}

/// Opens the gateway's session. Waits for the control plane.
///
/// # Errors
/// The control plane refuses it.
pub(super) fn open(
    socket: OwnedFd,
    config: &Config,
    known: Arc<KnownPeers>,
) -> Result<(Session, Arc<Notices>), SessionError> {
    let options = SessionOptions::new("gateway").role(SessionRole::Gateway).known_peers(known);
    let session = Session::over(socket, config, options)?;
    let notices = Arc::new(Notices::default());
    let noted = Arc::clone(&notices);
    session.set_listener(move |event| match event {
        SessionEvent::Graph => noted.note(&noted.graph),
        SessionEvent::DaemonLost => noted.note(&noted.lost),
        _ => {}
    });
    Ok((session, notices))
}

/// Returns the endpoints of applications on this host whose discovery range is known.
pub(super) fn local_graph(session: &Session) -> LocalEndpoints {
    let view = session.graph();
    let local = view.endpoints.values().filter(|e| e.daemon.is_none());
    let local = local
        .filter_map(|e| Some((e.endpoint.gid, (Arc::clone(&e.endpoint), reach_of(e).cloned()?))));
    local.collect()
}
