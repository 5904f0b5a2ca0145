//! The requests of a relayed session that have no response yet. The session sends them again when a server is reached
//! through another daemon; the server drops a request that it had.

use std::{
    collections::{BTreeMap, BTreeSet},
    ops::RangeInclusive,
    sync::Arc,
};

use axon_shm::Meta;

use super::flow::{OutboundSample, SamplePayload};
use crate::ids::Gid;

/// Maximum number of requests that are kept.
const MAX_REQUESTS: usize = 4096;
/// Maximum number of bytes of the kept requests; a single request may be longer.
const MAX_BYTES: usize = 32 << 20;

/// The requests of all clients of a session.
#[derive(Debug, Default)]
pub(crate) struct Unanswered {
    /// The requests by client and number.
    requests: BTreeMap<(Gid, u64), Request>,
    bytes: usize,
    /// Number of requests that were not kept since the last call of `take_unkept`, because there were too many.
    unkept: u64,
}

#[derive(Debug)]
struct Request {
    meta: Meta,
    payload: Arc<[u8]>,
    /// The servers that have not answered it.
    awaits: BTreeSet<Gid>,
    /// True if it is to be sent again.
    due: bool,
}

impl Unanswered {
    /// Keeps a request that was sent to these servers.
    pub(crate) fn add(&mut self, client: Gid, meta: Meta, payload: Vec<u8>, awaits: BTreeSet<Gid>) {
        if awaits.is_empty() {
            return;
        }
        let payload = Arc::<[u8]>::from(payload);
        self.bytes += payload.len();
        let request = Request { meta, payload, awaits, due: false };
        if let Some(before) = self.requests.insert((client, meta.sequence), request) {
            self.bytes -= before.payload.len();
        }
        while self.requests.len() > MAX_REQUESTS
            || self.bytes > MAX_BYTES && self.requests.len() > 1
        {
            // The oldest request of this client is forgotten, or of any client if this one has no older request.
            let of = (client, 0)..(client, meta.sequence);
            let oldest = self.requests.range(of).next().or_else(|| self.requests.iter().next());
            let Some(oldest) = oldest.map(|(key, _)| *key) else { break };
            self.remove(&oldest);
            self.unkept += 1;
        }
    }

    /// Records that a server answered a request.
    pub(crate) fn answered(&mut self, client: Gid, server: &Gid, number: u64) {
        let Some(request) = self.requests.get_mut(&(client, number)) else { return };
        request.awaits.remove(server);
        if request.awaits.is_empty() {
            self.remove(&(client, number));
        }
    }

    /// Marks the requests of `client` that these servers have not answered as due, because the servers are matched
    /// again.
    pub(crate) fn resend(&mut self, client: &Gid, servers: &BTreeSet<Gid>) {
        for request in self.of(client) {
            request.due |= !request.awaits.is_disjoint(servers);
        }
    }

    /// Returns the next request of `client` that is due to be sent again.
    pub(crate) fn next_due(&mut self, client: &Gid) -> Option<OutboundSample<SamplePayload>> {
        let request = self.of(client).find(|request| request.due)?;
        request.due = false;
        let content = SamplePayload::Kept(Arc::clone(&request.payload));
        Some(OutboundSample { meta: request.meta, lost: 0, content })
    }

    /// Returns whether a request of `client` is to be sent again.
    pub(crate) fn is_due(&self, client: &Gid) -> bool {
        self.requests.range(all_of(client)).any(|(_, request)| request.due)
    }

    /// Forgets a server that does not answer any more. Returns the number of requests that no other server will answer.
    pub(crate) fn forget_server(&mut self, server: &Gid) -> usize {
        let before = self.requests.len();
        for request in self.requests.values_mut() {
            request.awaits.remove(server);
        }
        self.retain(|_, request| !request.awaits.is_empty());
        before - self.requests.len()
    }

    /// Forgets a client that is gone.
    pub(crate) fn forget_client(&mut self, client: &Gid) {
        self.retain(|of, _| of != client);
    }

    /// Forgets the clients for which `are_there` returns false.
    pub(crate) fn keep_clients(&mut self, are_there: impl Fn(&Gid) -> bool) {
        self.retain(|client, _| are_there(client));
    }

    /// Returns the number of requests that were not kept since the last call.
    pub(crate) fn take_unkept(&mut self) -> u64 {
        std::mem::take(&mut self.unkept)
    }

    fn of(&mut self, client: &Gid) -> impl Iterator<Item = &mut Request> {
        self.requests.range_mut(all_of(client)).map(|(_, request)| request)
    }

    fn retain(&mut self, keep: impl Fn(&Gid, &Request) -> bool) {
        self.requests.retain(|(client, _), request| keep(client, request));
        self.bytes = self.requests.values().map(|request| request.payload.len()).sum();
    }

    fn remove(&mut self, key: &(Gid, u64)) {
        if let Some(request) = self.requests.remove(key) {
            self.bytes -= request.payload.len();
        }
    }
}

fn all_of(client: &Gid) -> RangeInclusive<(Gid, u64)> {
    (*client, 0)..=(*client, u64::MAX)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn gid(byte: u8) -> Gid {
        Gid([byte; 16])
    }

    fn all(servers: &[u8]) -> BTreeSet<Gid> {
        servers.iter().map(|server| gid(*server)).collect()
    }

    fn add(unanswered: &mut Unanswered, number: u64, len: usize, servers: &[u8]) {
        unanswered.add(gid(1), Meta::at_nanos(number, 0), vec![0; len], all(servers));
    }

    fn due(unanswered: &mut Unanswered) -> Vec<u64> {
        std::iter::from_fn(|| unanswered.next_due(&gid(1))).map(|due| due.meta.sequence).collect()
    }

    #[test]
    fn unanswered_requests_are_resent_in_order_when_a_server_returns() {
        let mut unanswered = Unanswered::default();
        for number in 1..=4 {
            add(&mut unanswered, number, 10, &[8, 9]);
        }
        unanswered.answered(gid(1), &gid(8), 2);
        unanswered.answered(gid(1), &gid(9), 3);
        unanswered.answered(gid(1), &gid(8), 3);
        assert!(!unanswered.is_due(&gid(1)));
        unanswered.resend(&gid(1), &all(&[8]));
        assert!(unanswered.is_due(&gid(1)) && !unanswered.is_due(&gid(2)));
        assert_eq!(due(&mut unanswered), [1, 4]);
        unanswered.resend(&gid(1), &all(&[9, 7]));
        assert_eq!(due(&mut unanswered), [1, 2, 4]);
        assert_eq!(unanswered.forget_server(&gid(9)), 1, "the other one answered it");
        assert_eq!(unanswered.forget_server(&gid(8)), 2);
        assert_eq!((unanswered.requests.len(), unanswered.bytes), (0, 0));
    }

    #[test]
    fn requests_without_a_server_or_of_an_ended_client_are_not_kept() {
        let mut unanswered = Unanswered::default();
        add(&mut unanswered, 1, 10, &[]);
        assert!(unanswered.requests.is_empty());
        add(&mut unanswered, 2, 10, &[8]);
        unanswered.keep_clients(|client| *client == gid(1));
        assert_eq!(unanswered.requests.len(), 1);
        unanswered.forget_client(&gid(1));
        assert_eq!((unanswered.requests.len(), unanswered.bytes), (0, 0));
    }

    #[test]
    fn no_more_than_the_newest_are_kept() {
        let mut unanswered = Unanswered::default();
        for number in 1..=MAX_REQUESTS as u64 + 3 {
            add(&mut unanswered, number, 0, &[8]);
        }
        assert_eq!((unanswered.requests.len(), unanswered.take_unkept()), (MAX_REQUESTS, 3));
        add(&mut unanswered, 100_000, MAX_BYTES + 1, &[8]);
        assert_eq!(unanswered.requests.len(), 1, "one may be longer");
        unanswered.resend(&gid(1), &all(&[8]));
        assert_eq!(due(&mut unanswered), [100_000]);
        assert_eq!(
            (unanswered.take_unkept(), unanswered.bytes),
            (MAX_REQUESTS as u64, MAX_BYTES + 1)
        );
    }
}
