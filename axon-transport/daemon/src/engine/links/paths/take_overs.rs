//! Take-overs: another link comes in use. A peer may cause a bounded number of them.

use std::time::Duration;

use axon_shm::ids::DaemonId;

use super::failover;
use crate::{
    engine::{
        links::{Links, link::take_over::TakeOver, silence::Traffic},
        quic::answers::AnswerWatch,
    },
    link::{CloseCode, Elected, LinkMessage},
};

impl Links {
    /// Handles that a peer causes a link to come in use. If the peer caused too many take-overs, the link waits: no further
    /// control message of it is read.
    pub(in crate::engine::links) fn handle_take_over(
        &mut self,
        number: u64,
        reason: TakeOver,
        now: Duration,
    ) {
        let Some(daemon) = self.table.daemon(number) else { return };
        let takes_over = match reason {
            TakeOver::Elected(elected) => elected.standby != Some(true),
            TakeOver::SwitchOver => self.table.standby(daemon) == Some(number),
            TakeOver::Dialled => true,
        };
        if takes_over
            && let Err(due) = self.begin_take_over(daemon, now)
            && let Some(link) = self.table.get_mut(number)
        {
            tracing::debug!(peer = %daemon, "too many links took over: the next one waits");
            link.postponed = Some((due, reason));
            return;
        }
        match reason {
            TakeOver::Elected(elected) => self.handle_elected(number, elected, now),
            TakeOver::SwitchOver => self.handle_switch_over(number, daemon, now),
            TakeOver::Dialled => self.elect_dialled(number, now),
        }
    }

    /// Records that a peer causes a link to come in use. Whether another one is in use makes no difference: the peer may
    /// end that one at any time.
    ///
    /// # Errors
    /// The peer caused too many take-overs. The time of the next one that is permitted.
    fn begin_take_over(&mut self, daemon: DaemonId, now: Duration) -> Result<(), Duration> {
        // The link in use was silent for seconds.
        if self.table.current_peer(daemon).is_some_and(|peer| peer.silence.is_gone()) {
            return Ok(());
        }
        self.paths.take_overs.begin(daemon, now)
    }

    /// Handles the peer's request to put the link that stands by in use.
    fn handle_switch_over(&mut self, number: u64, daemon: DaemonId, now: Duration) {
        if self.table.standby(daemon) == Some(number) {
            self.put_standby_in_use(number, now);
        }
    }

    /// Handles ELECTED for a link that stands by: it takes over from the link in use.
    pub(in crate::engine::links) fn handle_elected(
        &mut self,
        number: u64,
        elected: Elected,
        now: Duration,
    ) {
        if elected.standby == Some(true) {
            return self.stand_by(number, elected, now);
        }
        let Some(link) = self.table.get(number) else { return };
        let Some(peer) = &link.peer else { return };
        let (daemon, before) = (peer.summary.hello.daemon, peer.elected);
        let (who, proven) = (peer.summary.who.clone(), peer.proven);
        let stands_by = self.table.standby(daemon) == Some(number);
        let is_another = before.is_some_and(|before| before.link != elected.link);
        if is_another || (link.beside.is_some() && !stands_by) {
            let why = "ELECTED puts a link in use that does not stand by";
            return self.violation(number, CloseCode::OutOfOrder, why, now);
        }
        // [`open`](Self::open) refuses a link under another host's id, and a link that is older than the one in use.
        let current = self.table.current_peer(daemon).and_then(|current| current.elected);
        let is_newest = current.is_none_or(|current| current.election < elected.election);
        if stands_by && is_newest && self.claim(daemon, &who, proven, now).is_ok() {
            self.give_up_silent(daemon, now);
        }
        if stands_by {
            self.table.take_standby(daemon);
            if let Some(connection) = self.connections.get_mut(number) {
                connection.copies.give_up(&mut connection.quic);
            }
            if let Some(paths) = self.paths.all.get_mut(&daemon) {
                paths.search.handle_lost(now);
            }
        }
        if let Some(peer) = self.table.peer_mut(number) {
            peer.order.elected();
        }
        self.open(number, elected, now);
    }

    /// Elects the link that stands by.
    fn put_standby_in_use(&mut self, number: u64, now: Duration) {
        let Some(before) = self.table.peer(number).and_then(|peer| peer.elected) else { return };
        let elected = self.next_elected(Some(before.link), None);
        self.send(number, &LinkMessage::Elected(elected), now);
        self.handle_elected(number, elected, now);
    }

    /// Takes the link in use for silent if it does not answer: nothing is expected over it when another one takes over. A
    /// link that answers delivers what is in flight.
    fn give_up_silent(&mut self, daemon: DaemonId, now: Duration) {
        let Some(number) = self.table.current(daemon) else { return };
        let (Some(connection), Some(peer)) =
            (self.connections.get(number), self.table.peer_mut(number))
        else {
            return;
        };
        let since = connection.watch.as_ref().and_then(AnswerWatch::since);
        if since
            .is_some_and(|since| since + failover::silent_after(connection.quic.rtt()) / 2 <= now)
        {
            peer.silence.handle_failover(Traffic::from(&connection.quic.stats()));
        }
    }

    /// Puts the link that stands by in use, or asks the side that elects links for it.
    pub(in crate::engine::links) fn switch_over(
        &mut self,
        daemon: DaemonId,
        standby: u64,
        now: Duration,
    ) {
        if self.hello.daemon < daemon {
            self.put_standby_in_use(standby, now);
        } else {
            self.send(standby, &LinkMessage::SwitchOver, now);
        }
    }
}
