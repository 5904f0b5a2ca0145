//! Limits the bytes of samples that wait for RELIABLE delivery: `AXON_RELIABLE_QUEUE_MB` in all, a quarter of it
//! towards one peer, and a thirty-second for one publisher towards one peer.

use std::{cell::Cell, rc::Rc};

const PEER: usize = 4;
const FLOW: usize = 32;

/// The bytes that the queues of a daemon, or those towards one peer, may hold.
#[derive(Debug)]
pub(crate) struct Budget {
    most: usize,
    of_flow: usize,
    taken: Cell<usize>,
    /// Bytes given back since the start.
    released: Cell<usize>,
    parent: Option<Rc<Budget>>,
}

impl Budget {
    /// Creates the budget of a daemon.
    pub(crate) fn new(bytes: u64) -> Rc<Self> {
        let most = usize::try_from(bytes).unwrap_or(usize::MAX);
        Rc::new(Self {
            most,
            of_flow: most / FLOW,
            taken: Cell::new(0),
            released: Cell::new(0),
            parent: None,
        })
    }

    /// Creates the share of one peer.
    pub(crate) fn of_peer(self: &Rc<Self>) -> Rc<Self> {
        Rc::new(Self {
            most: self.most / PEER,
            of_flow: self.of_flow,
            taken: Cell::new(0),
            released: Cell::new(0),
            parent: Some(Rc::clone(self)),
        })
    }

    /// Returns the bytes that all queues of the daemon may hold.
    pub(super) fn of_daemon(&self) -> u64 {
        self.parent.as_ref().map_or(self.most as u64, |parent| parent.of_daemon())
    }

    /// Returns the bytes that one flow may hold.
    pub(super) fn of_flow(&self) -> usize {
        self.of_flow
    }

    /// Returns the bytes that are free here and in the whole daemon.
    pub(super) fn free(&self) -> usize {
        let free = self.most.saturating_sub(self.taken.get());
        self.parent.as_ref().map_or(free, |parent| free.min(parent.free()))
    }

    /// Takes these bytes if they are free here and in the whole daemon.
    pub(super) fn try_take(&self, bytes: usize) -> bool {
        let fits = self.taken.get().saturating_add(bytes) <= self.most;
        if !fits || self.parent.as_ref().is_some_and(|parent| !parent.try_take(bytes)) {
            return false;
        }
        self.taken.set(self.taken.get() + bytes);
        true
    }

    /// Takes these bytes even if they are not free: one sample may always wait.
    pub(in crate::engine) fn overtake(&self, bytes: usize) {
        self.taken.set(self.taken.get() + bytes);
        if let Some(parent) = &self.parent {
            parent.overtake(bytes);
        }
    }

    /// Gives bytes back.
    pub(in crate::engine) fn release(&self, bytes: usize) {
        self.taken.set(self.taken.get() - bytes);
        self.released.set(self.released.get().wrapping_add(bytes));
        if let Some(parent) = &self.parent {
            parent.release(bytes);
        }
    }

    /// Returns the bytes that are taken now.
    pub(crate) fn taken(&self) -> usize {
        self.taken.get()
    }

    /// Returns the bytes given back since the start, in the whole daemon. If it changes, a flow that found no space may
    /// try again.
    pub(crate) fn released(&self) -> usize {
        self.parent.as_ref().map_or(self.released.get(), |parent| parent.released())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_peer_takes_a_quarter_and_all_peers_no_more_than_there_is() {
        let daemon = Budget::new(1024);
        let peers: Vec<_> = (0..5).map(|_| daemon.of_peer()).collect();
        assert_eq!((peers[0].of_flow(), peers[0].free()), (32, 256));
        assert!(!peers[0].try_take(257));
        for peer in &peers[..4] {
            assert!(peer.try_take(256));
            assert!(!peer.try_take(1));
        }
        assert!(!peers[4].try_take(1), "the daemon has no more");
        assert_eq!(peers[4].free(), 0);
        let before = peers[4].released();
        peers[0].release(256);
        assert_ne!(peers[4].released(), before, "every peer sees that bytes were given back");
        assert!(peers[4].try_take(256));
        assert_eq!(daemon.taken(), 1024);
    }

    #[test]
    fn a_refused_take_takes_nothing() {
        let daemon = Budget::new(400);
        let (one, other) = (daemon.of_peer(), daemon.of_peer());
        one.overtake(390);
        assert!(!other.try_take(50));
        assert_eq!((other.taken(), daemon.taken()), (0, 390));
        one.release(390);
        assert_eq!(daemon.taken(), 0);
    }
}
