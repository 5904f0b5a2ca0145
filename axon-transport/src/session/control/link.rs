//! The connection to a daemon, and the search for a new daemon.

use std::{sync::mpsc::TryRecvError, time::Instant};

use axon_shm::internal::descriptors::PassedFd;

use super::{ControlThread, DaemonConnection, announced::AnnouncedPairs, search::Search};
use crate::{
    session::{
        core::{Outgoing, SessionEvent},
        daemon::connect::Connected,
    },
    wire::session::SessionMessage,
};

impl ControlThread {
    pub(super) fn connected(&mut self, connected: Connected) {
        self.outbox.clear();
        self.graph.handle_connected();
        self.pairs = AnnouncedPairs::default();
        self.pause.handle_connected(Instant::now());
        self.retry = None;
        let daemon = connected.welcome.daemon;
        {
            let mut state = self.shared.state();
            state.forget_refusals();
            let gids = state.endpoints.gids();
            let mut outgoing: Vec<_> = gids.into_iter().map(Outgoing::Announce).collect();
            // Grants follow the announcements and the memory that they name.
            let untaken_grants = state
                .endpoints
                .publishers
                .values()
                .flat_map(|p| p.untaken_grants(self.shared.core.id));
            outgoing.extend(
                untaken_grants.map(|granted| Outgoing::message(SessionMessage::Grant(granted))),
            );
            // The reports precede the ends of the publishers.
            let unmet =
                state.unmet.iter().map(|unmet| Outgoing::message(SessionMessage::Unmet(unmet)));
            outgoing.extend(unmet);
            outgoing.extend(state.graph.tombstones.iter().map(|gid| Outgoing::gone(*gid)));
            self.shared.core.link.connected(daemon, outgoing);
        }
        self.link = DaemonConnection::Socket(PassedFd::connection(connected.socket).trusted());
        self.memory.handle_connected(&mut self.outbox, &self.peers);
        tracing::debug!(%daemon, "a daemon took the session");
        self.shared.notify(Some(&SessionEvent::DaemonFound(daemon)));
    }

    pub(super) fn lost(&mut self, why: &dyn std::fmt::Display) {
        tracing::warn!(%why, "the connection to the daemon is lost");
        self.outbox.clear();
        self.shared.core.link.lost();
        let pause = self.pause.handle_lost(Instant::now());
        let search =
            self.reconnects.then(|| Search::begin(self.shared.core.clone(), pause)).flatten();
        self.link = search.map_or(DaemonConnection::Ended, DaemonConnection::Reconnecting);
        self.shared.notify(Some(&SessionEvent::DaemonLost));
    }

    pub(super) fn try_reconnected(&mut self) {
        let DaemonConnection::Reconnecting(search) = &self.link else { return };
        match search.try_found() {
            Ok(connected) => self.connected(connected),
            Err(TryRecvError::Empty) => {}
            Err(TryRecvError::Disconnected) => self.link = DaemonConnection::Ended,
        }
    }

    /// Returns whether the session has a daemon or searches for one.
    pub(super) fn is_served(&self) -> bool {
        matches!(self.link, DaemonConnection::Socket(_) | DaemonConnection::Reconnecting(_))
    }

    pub(super) fn is_linked(&self) -> bool {
        matches!(self.link, DaemonConnection::Socket(_) | DaemonConnection::Local(_))
    }
}
