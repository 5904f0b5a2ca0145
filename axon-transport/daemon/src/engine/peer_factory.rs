//! Creates the peers of this daemon. They share its memory for samples, its response numbers, and its compressed
//! samples.

use std::{rc::Rc, sync::Arc, time::Duration};

use axon_shm::ids::DaemonId;
use axon_transport::{access::Permissions, config::Config};

use super::{
    account::Account,
    compression::{Compression, PeerCompression},
    counters::Counters,
    inbound::Inbound,
    outbound::{Outbound, ResponseNumbers, budget::Budget},
    peer::{Peer, PeerParts, ROUTES_UNSAID},
    peer_graph::owners::Prover,
};
use crate::owner::{ChannelBinding, SessionKeys};

/// The state that all peers share.
pub(super) struct PeerFactory {
    config: Arc<Config>,
    daemon: DaemonId,
    session_keys: Arc<SessionKeys>,
    /// CLOCK_MONOTONIC in nanoseconds at the engine's time zero.
    epoch_nanos: u64,
    budget: Rc<Budget>,
    responses: ResponseNumbers,
    compression: Rc<Compression>,
}

/// The first link of a peer.
pub(super) struct FirstLink {
    pub(super) number: u64,
    /// The peer's daemon.
    pub(super) daemon: DaemonId,
    /// The identity that the peer proved.
    pub(super) identity: String,
    pub(super) account: Rc<Account>,
    /// The peer's rights by the access rules.
    pub(super) permissions: Permissions,
    pub(super) binding: Option<ChannelBinding>,
    /// Most routes that the peer serves, as its HELLO states.
    pub(super) routes: Option<u32>,
    /// True if sessions prove that they belong to their host.
    pub(super) needs_proofs: bool,
}

impl PeerFactory {
    /// Creates the factory of the peers of `daemon`, which is this host's daemon.
    pub(super) fn new(
        config: Arc<Config>,
        daemon: DaemonId,
        session_keys: Arc<SessionKeys>,
        epoch_nanos: u64,
    ) -> Self {
        let (budget, responses) = (Budget::new(config.reliable_queue), ResponseNumbers::default());
        let compression = Rc::new(Compression::new());
        Self { config, daemon, session_keys, epoch_nanos, budget, responses, compression }
    }

    /// Creates a peer with this link and without a graph.
    pub(super) fn make(&self, link: FirstLink, now: Duration) -> Peer {
        let FirstLink {
            number,
            daemon,
            identity,
            account,
            permissions,
            binding,
            routes,
            needs_proofs,
        } = link;
        let counters = Rc::<Counters>::default();
        let inbound = Inbound::new(
            Rc::clone(&counters),
            account.messages.clone(),
            self.config.max_message,
            self.epoch_nanos,
        );
        let outbound = Outbound::new(
            self.budget.of_peer(),
            Rc::clone(&counters),
            self.responses.clone(),
            PeerCompression::new(Rc::clone(&self.compression), daemon),
            self.config.link.stalled,
            now,
        );
        Peer::new(PeerParts {
            daemon,
            link: number,
            identity,
            account,
            prover: Prover::new(&self.session_keys, self.daemon, needs_proofs, binding),
            permissions,
            counters,
            inbound,
            outbound,
            serves: routes.map_or(ROUTES_UNSAID, |routes| routes as usize),
        })
    }

    /// Returns the compression that all peers share.
    pub(super) fn compression(&self) -> &Compression {
        &self.compression
    }

    /// Returns the bytes of samples that wait for all peers, and the bytes that have left their queues since the start.
    pub(super) fn backlog(&self) -> (usize, usize) {
        (self.budget.taken(), self.budget.released())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::account::Accounts;

    #[test]
    fn peers_share_the_memory_of_the_daemon_and_nothing_else() {
        let config = Arc::new(Config::default());
        let factory = PeerFactory::new(Arc::clone(&config), DaemonId([1; 16]), Arc::default(), 0);
        let mut accounts = Accounts::new(config.link.graph, config.link.held);
        let mut make = |number: u8| {
            let link = FirstLink {
                number: number.into(),
                daemon: DaemonId([number; 16]),
                identity: number.to_string(),
                account: accounts.of_one(&number.to_string()),
                permissions: Permissions::default(),
                binding: None,
                routes: None,
                needs_proofs: false,
            };
            factory.make(link, Duration::ZERO)
        };
        let (one, two) = (make(2), make(3));
        assert_eq!((one.link, two.link), (2, 3));
        assert!(!Rc::ptr_eq(&one.counters, &two.counters));
        // The share of each peer holds a reference to the whole.
        assert_eq!(Rc::strong_count(&factory.budget), 3);
        factory.budget.overtake(100);
        factory.budget.release(30);
        assert_eq!(factory.backlog(), (70, 30));
        drop(one);
        assert_eq!(Rc::strong_count(&factory.budget), 2);
    }
}
