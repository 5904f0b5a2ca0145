//! The dials under way, and for each connection that is being opened, the dial that it belongs to.

use std::{
    collections::{HashMap, HashSet},
    net::SocketAddr,
    time::Duration,
};

use axon_shm::ids::DaemonId;
use quinn_proto::ConnectionError;

use super::events::LinkReport;
use crate::{
    discovery::AddressConfidence,
    engine::{
        keyring::Keyring,
        link::{
            dialling::{DialAction, Dialling},
            target::DialTarget,
        },
    },
};

/// The dials of this host. Each has a number.
#[derive(Default)]
pub(super) struct Dials {
    under_way: HashMap<u64, LinkDial>,
    next_number: u64,
    /// Dials that may continue.
    stirred: HashSet<u64>,
    /// The daemon that a dial looked for, by the connection that is being opened.
    opening: HashMap<u64, (DaemonId, AddressConfidence)>,
}

/// One dial.
pub(super) struct LinkDial {
    pub(super) dialling: Dialling,
    /// The connection whose handshake is under way.
    pub(super) connection: Option<u64>,
}

impl Dials {
    /// Begins to dial a peer.
    pub(super) fn begin(&mut self, target: DialTarget, keyring: Option<&Keyring>, now: Duration) {
        let dialling = Dialling::new(now, target, keyring);
        let number = self.next_number;
        self.next_number += 1;
        self.under_way.insert(number, LinkDial { dialling, connection: None });
        self.stirred.insert(number);
    }

    /// Returns the number of dials.
    #[cfg(test)]
    pub(super) fn len(&self) -> usize {
        self.under_way.len()
    }

    /// Returns the number of dials that began.
    #[cfg(test)]
    pub(super) fn begun(&self) -> u64 {
        self.next_number
    }

    /// Returns a dial.
    pub(super) fn get_mut(&mut self, number: u64) -> Option<&mut LinkDial> {
        self.under_way.get_mut(&number)
    }

    /// Ends a dial.
    pub(super) fn remove(&mut self, number: u64) -> Option<LinkDial> {
        self.under_way.remove(&number)
    }

    /// Ends all dials.
    pub(super) fn clear(&mut self) {
        self.under_way.clear();
    }

    /// Handles that the handshake of a dial's connection is complete.
    pub(super) fn handle_connected(&mut self, number: u64) {
        if let Some(dial) = self.under_way.get_mut(&number) {
            dial.dialling.handle_connected();
            self.stirred.insert(number);
        }
    }

    /// Handles that a dial's connection ended before its handshake was complete.
    pub(super) fn handle_failed(&mut self, number: u64, error: &ConnectionError) {
        if let Some(dial) = self.under_way.get_mut(&number) {
            dial.dialling.handle_failed(error);
            self.stirred.insert(number);
        }
    }

    /// Handles an answer of the KME: dials that wait for a key ask for it again.
    pub(super) fn handle_key(&mut self) {
        for (number, dial) in &mut self.under_way {
            dial.dialling.handle_key();
            self.stirred.insert(*number);
        }
    }

    /// Takes the numbers of the dials that may continue.
    pub(super) fn take_stirred(&mut self) -> HashSet<u64> {
        std::mem::take(&mut self.stirred)
    }

    /// Returns a dial's next action.
    pub(super) fn poll_action(
        &mut self,
        number: u64,
        now: Duration,
        keyring: Option<&mut Keyring>,
    ) -> Option<DialAction> {
        self.under_way.get_mut(&number)?.dialling.poll_action(now, keyring)
    }

    /// Returns when [`handle_timeout`](Self::handle_timeout) is due.
    pub(super) fn poll_timeout(&self) -> Option<Duration> {
        self.under_way.values().filter_map(|dial| dial.dialling.poll_timeout()).min()
    }

    /// Continues the dials that are due.
    pub(super) fn handle_timeout(&mut self, now: Duration) {
        let due = self
            .under_way
            .iter()
            .filter(|(_, dial)| dial.dialling.poll_timeout().is_some_and(|due| due <= now));
        self.stirred.extend(due.map(|(number, _)| *number));
    }

    /// Records which daemon a dial looked for, in case the connection cannot be opened.
    pub(super) fn note_opening(
        &mut self,
        connection: u64,
        of: Option<(DaemonId, AddressConfidence)>,
    ) {
        self.opening.extend(of.map(|of| (connection, of)));
    }

    /// Returns whether a dial to this daemon is under way.
    pub(super) fn is_dialling(&self, daemon: DaemonId) -> bool {
        self.under_way.values().any(|dial| dial.dialling.target().daemon == Some(daemon))
    }

    /// Records that the opening of a dialled connection succeeded.
    pub(super) fn opened(&mut self, connection: u64) {
        self.opening.remove(&connection);
    }

    /// Records that the opening of a connection failed. Returns the report if the connection was dialled. `absent_at`:
    /// the peer at this address is another daemon than the dialled one.
    pub(super) fn opening_failed(
        &mut self,
        connection: u64,
        absent_at: Option<SocketAddr>,
    ) -> Option<LinkReport> {
        let (daemon, standing) = self.opening.remove(&connection)?;
        Some(LinkReport::DialFailed { daemon, standing, absent_at })
    }
}
