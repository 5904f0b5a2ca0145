//! The two connections of a sender: the one in use, and the one that stands by.

use std::time::Duration;

use axon_envelope::{KeyId, Retirement};

use super::connection_keys::ConnectionKeys;

/// The connections over which messages, and copies of them, leave.
#[derive(Default)]
pub(super) struct SenderConnections {
    /// The connection over which messages leave.
    pub(super) in_use: Option<ConnectionKeys>,
    /// The connection that stands by, over which copies of messages leave.
    pub(super) standby: Option<ConnectionKeys>,
}

impl SenderConnections {
    /// Iterates over both.
    pub(super) fn iter(&self) -> impl Iterator<Item = &ConnectionKeys> {
        self.in_use.iter().chain(&self.standby)
    }

    /// Returns the keys of a connection.
    pub(super) fn get_mut(&mut self, connection: u64) -> Option<&mut ConnectionKeys> {
        let mut both = self.in_use.iter_mut().chain(&mut self.standby);
        both.find(|keys| keys.connection() == connection)
    }

    /// Takes the keys of a connection, which is used no more.
    pub(super) fn take(&mut self, connection: u64) -> Option<ConnectionKeys> {
        let is_it = |keys: &mut ConnectionKeys| keys.connection() == connection;
        self.in_use.take_if(is_it).or_else(|| self.standby.take_if(is_it))
    }

    /// Returns the number of keys that are announced or READY.
    pub(super) fn held(&self) -> usize {
        self.iter().map(|keys| keys.ready() + keys.announced()).sum()
    }

    /// Returns the next key in use that is finished, and its connection.
    pub(super) fn poll_spent(&mut self, now: Duration) -> Option<(u64, Retirement)> {
        let both = self.in_use.iter_mut().chain(&mut self.standby);
        let mut spent = both.filter_map(|keys| Some((keys.connection(), keys.retire_spent(now)?)));
        spent.next()
    }

    /// Returns the keys that the peer has owed an answer for since this time or longer, each with its connection.
    pub(super) fn unanswered(&self, since: Option<Duration>) -> Vec<(u64, KeyId)> {
        let of = |keys: &ConnectionKeys| {
            let connection = keys.connection();
            keys.unanswered(since).into_iter().map(move |key_id| (connection, key_id))
        };
        self.iter().flat_map(of).collect()
    }
}
