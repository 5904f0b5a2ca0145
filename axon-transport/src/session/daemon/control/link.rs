//! The connection to a daemon, and the search for a new daemon.

use std::{collections::BTreeSet, sync::mpsc::TryRecvError, time::Instant};

use axon_shm::internal::descriptors::PassedFd;

use super::{
    Control, Link,
    search::Search,
    told::{ToldPairs, ToldSegments},
};
use crate::{
    ids::Gid,
    session::{
        daemon::{connect::Connected, memory_changes::SegmentChange, status_text::StatusAnswer},
        state::{Outgoing, SessionEvent},
    },
    wire::session::{Gone, Message},
};

impl Control {
    pub(super) fn connected(&mut self, connected: Connected) {
        self.outbox.clear();
        self.building = None;
        self.pairs = ToldPairs::default();
        self.segments = ToldSegments::default();
        self.pause.handle_connected(Instant::now());
        self.retry = None;
        let daemon = connected.welcome.daemon;
        {
            let mut state = self.shared.state();
            state.daemon = Some(daemon);
            state.forget_refusals();
            state.outgoing.clear();
            let endpoints = state.publishers.keys().chain(state.subscriptions.keys());
            let gids: BTreeSet<Gid> = state.nodes.keys().chain(endpoints).copied().collect();
            let gone: Vec<Gid> = state.tombstones.iter().copied().collect();
            state.outgoing.extend(gids.into_iter().map(Outgoing::Announce));
            // Behind the announcements, and the memory that they name.
            let pledged: Vec<_> =
                state.publishers.values().flat_map(|p| p.pledged(self.shared.id)).collect();
            let pledged =
                pledged.into_iter().map(|g| Outgoing::Message(Box::new(Message::Grant(g))));
            state.outgoing.extend(pledged);
            // Before their ends.
            let unmet: Vec<_> = state.unmet.iter().collect();
            unmet.into_iter().for_each(|unmet| state.tell_unmet(unmet));
            let gone = gone.into_iter().map(|gid| Message::EndpointGone(Gone { gid }));
            state.outgoing.extend(gone.map(|m| Outgoing::Message(Box::new(m))));
        }
        self.link = Link::Socket(PassedFd::connection(connected.socket).trusted());
        self.shared.memory.begins_anew();
        for info in self.shared.segment.segments() {
            self.tell_segment(SegmentChange::Opened(info.number));
        }
        tracing::debug!(%daemon, "a daemon took the session");
        self.shared.notify(Some(&SessionEvent::DaemonFound(daemon)));
    }

    pub(super) fn lost(&mut self, why: &dyn std::fmt::Display) {
        tracing::warn!(%why, "the connection to the daemon is lost");
        self.outbox.clear();
        {
            let mut state = self.shared.state();
            state.daemon = None;
            if matches!(state.status, StatusAnswer::Parts(_)) {
                state.status = StatusAnswer::Lost;
            }
        }
        let pause = self.pause.handle_lost(Instant::now());
        let search = self.reconnects.then(|| Search::begin(self.shared.clone(), pause)).flatten();
        self.link = search.map_or(Link::Ended, Link::Reconnecting);
        self.shared.notify(Some(&SessionEvent::DaemonLost));
    }

    pub(super) fn try_reconnected(&mut self) {
        let Link::Reconnecting(search) = &self.link else { return };
        match search.try_found() {
            Ok(connected) => self.connected(connected),
            Err(TryRecvError::Empty) => {}
            Err(TryRecvError::Disconnected) => self.link = Link::Ended,
        }
    }

    /// Whether there is a daemon, or may be one.
    pub(super) fn is_served(&self) -> bool {
        matches!(self.link, Link::Socket(_) | Link::Reconnecting(_))
    }

    pub(super) fn is_linked(&self) -> bool {
        matches!(self.link, Link::Socket(_) | Link::Local(_))
    }
}
