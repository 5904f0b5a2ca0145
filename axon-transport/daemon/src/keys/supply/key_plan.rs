//! Decides how many keys a sender holds ahead for messages, and how many for copies of them.

use std::time::Duration;

use super::{
    SupplyWarning,
    connection_keys::ConnectionKeys,
    demand::{self, Demand},
    pool::KeyStock,
    sender_connections::SenderConnections,
};

/// The longest wait for the answer for a key of copies, after which their connection counts as silent.
const COPY_ANSWER_WITHIN: Duration = Duration::from_secs(10);

/// The demand for keys, and how the keys ahead are shared.
pub(super) struct KeyPlan {
    messages: Demand,
    copies: Demand,
    /// The numbers of keys ahead, within the KME's stock, as last planned.
    share: KeyShare,
}

/// Numbers of keys that are held ahead.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct KeyShare {
    pub(super) messages: usize,
    pub(super) copies: usize,
}

impl KeyPlan {
    /// Creates the plan of a sender that has sent nothing.
    pub(super) fn new() -> Self {
        Self { messages: Demand::new(), copies: Demand::new(), share: KeyShare::default() }
    }

    /// Counts messages that are to be sent.
    pub(super) fn messages(&mut self, now: Duration, messages: u32) {
        self.messages.messages(now, messages);
    }

    /// Counts messages whose copies are to be sent.
    pub(super) fn copies(&mut self, now: Duration, messages: u32) {
        self.copies.messages(now, messages);
    }

    /// Records that a key became READY this time after its request.
    pub(super) fn ready(&mut self, lead: Duration) {
        self.messages.ready(lead);
        self.copies.ready(lead);
    }

    /// Reports to the pool the number of keys to hold ahead, and the number of them that left it.
    pub(super) fn update(
        &mut self,
        now: Duration,
        connections: &SenderConnections,
        pool: &mut KeyStock,
    ) {
        let (messages, copies) = (self.messages.ahead(now), self.copies_ahead(now, connections));
        let target = pool.set_ahead(messages + copies);
        // The messages have their share first, however small the stock is.
        let messages = messages.min(target);
        let copies = copies.min(target - messages);
        let ahead = |keys: &Option<ConnectionKeys>| keys.as_ref().map_or(0, ConnectionKeys::ahead);
        // Surplus keys of one connection do not serve the other one.
        let of_messages = ahead(&connections.in_use).min(messages);
        pool.set_elsewhere(of_messages + ahead(&connections.standby).min(copies));
        self.share = KeyShare { messages, copies };
    }

    /// Returns the numbers of keys ahead, as last planned.
    pub(super) fn share(&self) -> KeyShare {
        self.share
    }

    /// Returns the number of READY keys that are reserved for RELIABLE and services, as last planned.
    pub(super) fn reserve(&self) -> usize {
        demand::reserve(self.share.messages)
    }

    /// Returns the number of keys to hold ahead for copies: none if no copies are sent, or the second path is silent.
    pub(super) fn copies_ahead(&self, now: Duration, connections: &SenderConnections) -> usize {
        let Some(standby) = &connections.standby else { return 0 };
        let is_silent = silent_at(standby).is_some_and(|at| at <= now);
        if is_silent { 0 } else { self.copies.ahead_of_copies(now) }
    }

    /// Returns when the keys ahead for copies change without other cause.
    pub(super) fn poll_timeout(&self, connections: &SenderConnections) -> Option<Duration> {
        connections.standby.as_ref().and_then(silent_at)
    }

    /// Returns the time from the request for a key to READY.
    pub(super) fn lead_time(&self) -> Duration {
        self.messages.lead_time()
    }

    /// Returns the keys per second that messages and copies need.
    pub(super) fn needed(&self, now: Duration) -> f64 {
        self.messages.demand(now) + self.copies.demand(now)
    }

    /// Returns a warning if the need comes close to `supply`, the keys per second that the KME gives; at most every ten
    /// seconds.
    pub(super) fn warning(&mut self, now: Duration, supply: f64) -> Option<SupplyWarning> {
        let needed = self.needed(now);
        self.messages.warning(now, needed, supply)
    }
}

/// Returns when a connection counts as silent, because the peer owes an answer for a key.
fn silent_at(standby: &ConnectionKeys) -> Option<Duration> {
    standby.unanswered_since().map(|since| since + COPY_ANSWER_WITHIN)
}
