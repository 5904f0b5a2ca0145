//! The connection to a daemon, and the search for a new daemon.

use std::{
    collections::BTreeSet,
    sync::{
        atomic::Ordering,
        mpsc::{TryRecvError, sync_channel},
    },
    time::{Duration, Instant},
};

use axon_shm::internal::descriptors::PassedFd;

use super::{
    Control, Link, pause,
    told::{ToldPairs, ToldSegments},
};
use crate::{
    ids::Gid,
    session::{
        daemon::connect::{Caller, Connected},
        error::SessionError,
        state::{Outgoing, SegmentChange, SessionEvent, StatusAnswer},
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
        self.link = if self.reconnects { self.reconnect(pause) } else { Link::Ended };
        self.shared.notify(Some(&SessionEvent::DaemonLost));
    }

    /// Looks for a daemon after a pause, on a thread of its own: meanwhile peers may die.
    fn reconnect(&self, first: Duration) -> Link {
        let shared = self.shared.clone();
        let (found, receiver) = sync_channel(1);
        let search = move || {
            std::thread::sleep(first);
            let mut pause = pause::next(Duration::ZERO);
            // Pairs with the release store in `SessionShared::stop`.
            while !shared.stopping.load(Ordering::Acquire) {
                let caller = Caller {
                    segment: Some(&shared.segment),
                    // Pairs with the release store in `SessionShared::stop`.
                    cancel: Some(&|| shared.stopping.load(Ordering::Acquire)),
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
                pause = pause::next(pause);
            }
        };
        match std::thread::Builder::new().name("axon-connect".into()).spawn(search) {
            Ok(_) => Link::Reconnecting(receiver),
            Err(error) => {
                tracing::error!(%error, "no thread to look for a daemon with");
                Link::Ended
            }
        }
    }

    pub(super) fn try_reconnected(&mut self) {
        let Link::Reconnecting(receiver) = &self.link else { return };
        match receiver.try_recv() {
            Ok(connected) => self.connected(connected),
            Err(TryRecvError::Empty) => {}
            Err(TryRecvError::Disconnected) => self.link = Link::Ended,
        }
    }

    pub(super) fn is_linked(&self) -> bool {
        matches!(self.link, Link::Socket(_) | Link::Local(_))
    }
}
