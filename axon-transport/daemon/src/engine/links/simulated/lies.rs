//! Lies of a daemon that is otherwise honest. It completes real handshakes in each mode, and then sends what a test
//! demands over any of its links.

use std::{net::SocketAddr, sync::Arc, time::Duration};

use axon_shm::ids::DaemonId;
use bytes::Bytes;
use quinn_proto::Dir;

use crate::{
    daemon_key::DaemonKey,
    engine::{
        link::target::DialTarget,
        links::{Links, link::LinkPhase},
    },
    link::{CloseCode, LinkMessage},
};

/// What the HELLO of a dialled connection states.
#[derive(Clone, Copy, Debug, Default)]
pub(in crate::engine) struct LieAbout {
    /// The link beside which it is to stand by.
    pub(in crate::engine) beside: Option<[u8; 16]>,
    /// The link that it replaces.
    pub(in crate::engine) replaces: Option<[u8; 16]>,
}

impl Links {
    /// Returns the links with a daemon: the one in use, the one that stands by, then the others.
    pub(in crate::engine) fn with_daemon(&self, daemon: DaemonId) -> [Vec<u64>; 3] {
        let (in_use, standby) = (self.table.current(daemon), self.table.standby(daemon));
        let all = self.table.iter().filter(|(_, link)| {
            link.peer.as_ref().is_some_and(|peer| peer.summary.hello.daemon == daemon)
        });
        let mut others: Vec<_> = all
            .map(|(number, _)| number)
            .filter(|number| Some(*number) != in_use && Some(*number) != standby)
            .collect();
        others.sort_unstable();
        [in_use.into_iter().collect(), standby.into_iter().collect(), others]
    }

    /// Returns the name of an elected link.
    pub(in crate::engine) fn name_of(&self, number: u64) -> Option<[u8; 16]> {
        Some(self.table.peer(number)?.elected?.link)
    }

    /// Returns the number of the next election.
    pub(in crate::engine) fn next_election(&self) -> u64 {
        self.next_election
    }

    /// Sends a message over a link, whatever its phase.
    pub(in crate::engine) fn lie(&mut self, number: u64, message: &LinkMessage) {
        if let Some(connection) = self.connections.get_mut(number) {
            let _ = connection.control.send(message);
            self.connections.touch(number);
        }
    }

    /// Opens a data stream with these bytes. With `ends` it ends behind them.
    pub(in crate::engine) fn open_data(&mut self, number: u64, bytes: &Bytes, ends: bool) {
        let Some(connection) = self.connections.get_mut(number) else { return };
        let Some(stream) = connection.quic.streams().open(Dir::Uni) else { return };
        let _ = connection.quic.send_stream(stream).write(bytes);
        if ends {
            let _ = connection.quic.send_stream(stream).finish();
        }
        self.connections.touch(number);
    }

    /// Closes a connection. This side's link ends, too.
    pub(in crate::engine) fn end(&mut self, number: u64, now: Duration) {
        self.close_connection(number, CloseCode::Goodbye, "a test ends it", now);
        self.end_link(number, "a test ends it", None, now);
    }

    /// Dials a daemon.
    pub(in crate::engine) fn dial_lying(
        &mut self,
        daemon: DaemonId,
        (sae, address): (Option<String>, SocketAddr),
        about: LieAbout,
        now: Duration,
    ) {
        let LieAbout { beside, replaces } = about;
        let (addresses, standing) = (vec![address], None);
        let daemon = Some(daemon);
        let target =
            DialTarget { daemon, sae, addresses, listed: false, standing, replaces, beside };
        self.dial(target, now);
    }

    /// Makes the HELLO of later connections name another daemon, with this key. Returns what it had before.
    pub(in crate::engine) fn pose_as(
        &mut self,
        daemon: DaemonId,
        key: Option<Arc<DaemonKey>>,
    ) -> (DaemonId, Option<Arc<DaemonKey>>) {
        let daemon = std::mem::replace(&mut self.hello.daemon, daemon);
        (daemon, std::mem::replace(&mut self.daemon_key, key))
    }

    /// Puts the link that stands by in use as an honest daemon does: elects it, or asks for its election.
    pub(in crate::engine) fn switch_now(&mut self, daemon: DaemonId, now: Duration) -> bool {
        let standby = self.table.standby(daemon);
        if let Some(standby) = standby {
            self.switch_over(daemon, standby, now);
        }
        standby.is_some()
    }

    /// Returns the numbers of connections and of dials that began.
    pub(in crate::engine) fn begun(&self) -> (u64, u64) {
        (self.connections.begun(), self.dials.begun())
    }

    /// Returns whether no link waits for its opening, its election or its end.
    pub(in crate::engine) fn is_settled(&self) -> bool {
        self.dials.len() == 0
            && self
                .table
                .iter()
                .all(|(_, link)| matches!(link.phase, LinkPhase::Standby | LinkPhase::Open))
    }
}
