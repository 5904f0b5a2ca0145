//! Links that a successor took over from: they deliver their data in flight, and close.

use std::time::Duration;

use axon_shm::ids::DaemonId;

use super::{
    LinkEvent, Links,
    link::{
        Link, LinkPhase,
        hand_over::{DrainingLink, HandOverProgress, HandOverStep},
    },
    silence::Traffic,
};
use crate::link::{CloseCode, LinkClosed};

/// Maximum number of superseded links of one identity. The oldest closes for another one.
const MAX_LEAVING: usize = 8;
const SUPERSEDED: &str = "a successor took over";

impl Links {
    /// Handles that a successor took over from a link. Returns the message for the peer if the link is silent.
    pub(super) fn hand_over(&mut self, old: u64, now: Duration) -> Option<LinkClosed> {
        let ours = self.hello.daemon;
        let connection = self.connections.get_mut(old)?;
        connection.watch = None;
        let stats = connection.quic.stats();
        let link = self.table.get_mut(old)?;
        let peer = link.peer.as_mut()?;
        let silent = peer.silence.handle_superseded(Traffic::from(&stats));
        let succeeded = ours > peer.summary.hello.daemon;
        let (who, elected) = (peer.summary.who.clone(), peer.elected);
        link.phase = LinkPhase::Leaving(DrainingLink::new(peer.age.until(), succeeded, now));
        self.nonces.retain(|_, number| *number != old);
        tracing::debug!(link = old, silent, "the link is superseded");
        let of_identity = self.table.leaving().filter(|(_, peer)| peer.summary.who.is(&who));
        let of_identity: Vec<u64> = of_identity.map(|(number, _)| number).collect();
        if of_identity.len() > MAX_LEAVING
            && let Some(oldest) = of_identity.iter().min()
        {
            self.close_leaving(*oldest, now);
        }
        elected.filter(|_| silent).map(|elected| LinkClosed { link: elected.link })
    }

    /// Gives up superseded links over which nothing arrives although their peers are heard over the links in use. Data
    /// that is sent again there waits for the streams of these links.
    pub(super) fn look_for_silent_leaving(&mut self) {
        for (number, daemon) in self.leaving() {
            let current = self.table.current_peer(daemon);
            let Some(heard_at) = current.map(|peer| peer.silence.heard_at()) else { continue };
            let (Some(connection), Some(peer)) =
                (self.connections.get_mut(number), self.table.peer_mut(number))
            else {
                continue;
            };
            if !all_is_sent(&mut connection.quic) && peer.silence.handle_second_superseded(heard_at)
            {
                tracing::debug!(link = number, "nothing comes over the superseded link");
                if let Some(elected) = peer.elected {
                    let closed = LinkClosed { link: elected.link };
                    self.outbox.event(LinkEvent::Closed(daemon, closed));
                }
                self.connections.touch(number);
            }
        }
    }

    fn leaving_of(&mut self, daemon: DaemonId) -> impl Iterator<Item = (u64, &mut Link)> {
        self.table.iter_mut().filter(move |(_, link)| {
            let of_peer =
                link.peer.as_ref().is_some_and(|peer| peer.summary.hello.daemon == daemon);
            of_peer && matches!(link.phase, LinkPhase::Leaving(_))
        })
    }

    /// Records that the peer sends over the successor.
    pub(super) fn succeeded(&mut self, daemon: DaemonId) {
        for (_, link) in self.leaving_of(daemon) {
            if let LinkPhase::Leaving(leaving) = &mut link.phase {
                leaving.handle_succeeded();
            }
        }
    }

    /// Handles the peer's message that it closed a link, whose packets do not arrive.
    pub(super) fn closed_by_peer(&mut self, daemon: DaemonId, closed: LinkClosed) {
        for (_, link) in self.leaving_of(daemon) {
            let elected = link.peer.as_ref().and_then(|peer| peer.elected);
            if elected.is_some_and(|elected| elected.link == closed.link)
                && let LinkPhase::Leaving(leaving) = &mut link.phase
            {
                leaving.handle_closed();
            }
        }
    }

    /// Closes the superseded links of a peer whose last link is over: nothing more is waited for.
    pub(super) fn abandon_leaving(&mut self, daemon: DaemonId, now: Duration) {
        let numbers: Vec<u64> = self.leaving_of(daemon).map(|(number, _)| number).collect();
        numbers.into_iter().for_each(|number| self.close_leaving(number, now));
    }

    /// Records that the peer's control stream of a superseded link ended.
    pub(super) fn leaving_ended(&mut self, number: u64) {
        if let Some(Link { phase: LinkPhase::Leaving(leaving), .. }) = self.table.get_mut(number) {
            leaving.handle_ended();
        }
    }

    /// Returns the superseded links.
    pub(in crate::engine) fn leaving(&self) -> Vec<(u64, DaemonId)> {
        self.table.leaving().map(|(number, peer)| (number, peer.summary.hello.daemon)).collect()
    }

    /// Closes a superseded link once everything has arrived in both directions. `reading` is the number of its streams
    /// that are being read.
    pub(in crate::engine) fn look_at_leaving(
        &mut self,
        number: u64,
        reading: usize,
        now: Duration,
    ) {
        let (Some(connection), Some(link)) =
            (self.connections.get_mut(number), self.table.get_mut(number))
        else {
            return;
        };
        let silent = link.peer.as_ref().is_some_and(|peer| peer.silence.is_silent());
        let LinkPhase::Leaving(leaving) = &mut link.phase else { return };
        let sent = all_is_sent(&mut connection.quic);
        match leaving.handle_progress(now, HandOverProgress { silent, sent, reading }) {
            HandOverStep::Wait => {}
            HandOverStep::Finish => {
                connection.control.finish();
                self.connections.touch(number);
            }
            HandOverStep::Close => self.close_leaving(number, now),
        }
    }

    /// Closes a superseded link if its time is over.
    pub(super) fn leaving_timeout(&mut self, number: u64, now: Duration) {
        let Some(Link { phase: LinkPhase::Leaving(leaving), .. }) = self.table.get(number) else {
            return;
        };
        if leaving.is_over(now) {
            self.close_leaving(number, now);
        }
    }

    fn close_leaving(&mut self, number: u64, now: Duration) {
        let Some(link) = self.table.remove(number) else { return };
        tracing::debug!(link = number, "the superseded link ends");
        self.close_connection(number, CloseCode::Replaced, SUPERSEDED, now);
        if let Some(peer) = link.peer {
            self.outbox.event(LinkEvent::Gone(number, peer.summary.hello.daemon));
        }
    }
}

/// Returns whether the peer has acknowledged all streams of this side except the control stream.
fn all_is_sent(quic: &mut quinn_proto::Connection) -> bool {
    quic.streams().send_streams() <= 1
}
