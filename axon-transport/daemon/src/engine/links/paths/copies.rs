//! Copies of small samples over the link that stands by, as long as its path answers.

use std::time::Duration;

use axon_shm::ids::DaemonId;

use crate::engine::{
    congestion::let_probe_through,
    links::Links,
    quic::{
        answers::AnswerWatch,
        copies::{CopyBatch, SampleCopy},
    },
};

impl Links {
    /// Returns an empty batch with room for the copies that the second path to a peer takes now.
    pub(in crate::engine) fn copy_batch(&self, daemon: DaemonId, now: Duration) -> CopyBatch {
        let Some((connection, standby)) = self
            .table
            .standby(daemon)
            .and_then(|number| Some((number, self.connections.get(number)?)))
        else {
            return CopyBatch::default();
        };
        let since = standby.watch.as_ref().and_then(AnswerWatch::since);
        standby.copies.batch(connection, &standby.quic, since, now)
    }

    /// Sends copies over the second path to a peer.
    pub(in crate::engine) fn send_copies(
        &mut self,
        daemon: DaemonId,
        mut copies: Vec<SampleCopy>,
        now: Duration,
    ) {
        let Some(number) = self.table.standby(daemon).filter(|_| !copies.is_empty()) else {
            return;
        };
        let in_use = self.table.current(daemon).and_then(|number| self.connections.get(number));
        let caps = in_use.map(|connection| connection.egress.peer());
        let Some(standby) = self.connections.get_mut(number) else { return };
        // The limits on what leaves for the peer hold for both links together.
        if let Some(caps) = caps {
            standby.egress.set_peer(caps);
        }
        for copy in &mut copies {
            standby.copies.send(&mut standby.quic, copy, now);
        }
        self.connections.touch(number);
    }

    /// Returns when [`look_at_copies`](Self::look_at_copies) is due for a link that stands by.
    pub(super) fn copies_timeout(&self, standby: u64) -> Option<Duration> {
        let connection = self.connections.get(standby)?;
        let since = connection.watch.as_ref().and_then(AnswerWatch::since);
        connection.copies.poll_timeout(since, connection.quic.rtt())
    }

    /// Gives up old copies, and asks for an answer over a second path that is silent.
    pub(super) fn look_at_copies(&mut self, standby: u64, now: Duration) {
        if self.copies_timeout(standby).is_none_or(|due| now < due) {
            return;
        }
        let Some(connection) = self.connections.get_mut(standby) else { return };
        let since = connection.watch.as_ref().and_then(AnswerWatch::since);
        if connection.copies.handle_timeout(&mut connection.quic, since, now) {
            connection.quic.ping();
            let_probe_through(&connection.quic);
        }
        self.connections.touch(standby);
    }
}
