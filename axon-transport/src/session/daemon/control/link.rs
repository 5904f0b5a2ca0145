//! The connection to a daemon, and the search for a new daemon.

use std::{
    collections::BTreeSet,
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
        mpsc::{TryRecvError, sync_channel},
    },
    time::{Duration, Instant},
};

use axon_shm::internal::descriptors::PassedFd;

use super::{Control, Link, Search};
use crate::{
    ids::Gid,
    session::{
        daemon::connect::{Caller, Connected},
        error::SessionError,
        state::{Outgoing, SegmentChange, SessionEvent, StatusAnswer},
    },
    wire::session::{Gone, Message},
};

/// Between attempts to find a daemon.
const MIN_PAUSE: Duration = Duration::from_millis(100);
const MAX_PAUSE: Duration = Duration::from_secs(2);
/// A connection that lasted less was as good as refused.
const BRIEF: Duration = Duration::from_secs(1);

impl Control {
    pub(super) fn connected(&mut self, connected: Connected) {
        self.outbox.clear();
        self.building = None;
        self.repeated = None;
        self.spoken.clear();
        self.told = false;
        self.segments.clear();
        self.untold.clear();
        self.since = Instant::now();
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
        self.pause = if self.since.elapsed() < BRIEF {
            (self.pause * 2).clamp(MIN_PAUSE, MAX_PAUSE)
        } else {
            Duration::ZERO
        };
        self.link = if self.reconnects { self.reconnect() } else { Link::Ended };
        self.shared.notify(Some(&SessionEvent::DaemonLost));
    }

    /// Looks for a daemon on a thread of its own: meanwhile peers may die.
    pub(super) fn reconnect(&self) -> Link {
        let shared = self.shared.clone();
        let (found, receiver) = sync_channel(1);
        let first = self.pause;
        let over = Arc::new(AtomicBool::new(false));
        let search = Search { found: receiver, over: over.clone() };
        // Pairs with the release store in `Search::drop`.
        let is_over = move || over.load(Ordering::Acquire);
        let run = move || {
            std::thread::sleep(first);
            let mut pause = MIN_PAUSE;
            while !is_over() {
                let caller = Caller {
                    segment: Some(&shared.segment),
                    cancel: Some(&is_over),
                    ..Caller::new(&shared.config, &shared.options, shared.id)
                };
                match caller.connect() {
                    Ok(connected) => {
                        let _ = found.send(connected);
                        shared.wake();
                        return;
                    }
                    Err(SessionError::NoDaemon { .. }) => {}
                    Err(error) => tracing::error!(%error, "no daemon took the session"),
                }
                std::thread::sleep(pause);
                pause = (pause * 2).min(MAX_PAUSE);
            }
        };
        match std::thread::Builder::new().name("axon-connect".into()).spawn(run) {
            Ok(_) => Link::Reconnecting(search),
            Err(error) => {
                tracing::error!(%error, "no thread to look for a daemon with");
                Link::Ended
            }
        }
    }

    pub(super) fn try_reconnected(&mut self) {
        let Link::Reconnecting(search) = &self.link else { return };
        match search.found.try_recv() {
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
