//! Limits the bytes of samples that wait for RELIABLE delivery: `AXON_RELIABLE_QUEUE_MB` in all, a quarter
//! of it towards one peer, and a thirty-second for one publisher towards one peer.

use std::sync::{
    Arc,
    atomic::{AtomicBool, AtomicUsize, Ordering},
};

use tokio::sync::{Notify, futures::Notified};

const PEER: usize = 4;
const QUEUE: usize = 32;

/// What all queues share, or of that those towards one peer.
#[derive(Debug)]
pub(super) struct QueueBudget {
    most: usize,
    taken: AtomicUsize,
    /// Bytes that were given back in all.
    released: AtomicUsize,
    /// One queue alone.
    queue: usize,
    /// Somebody found too little.
    awaited: AtomicBool,
    freed: Notify,
    of: Option<Arc<QueueBudget>>,
}

impl QueueBudget {
    /// That of a daemon.
    pub(super) fn new(bytes: u64) -> Arc<Self> {
        let most = usize::try_from(bytes).unwrap_or(usize::MAX);
        Arc::new(Self::with(most, most / QUEUE, None))
    }

    /// That of one peer.
    pub(super) fn of_peer(self: &Arc<Self>) -> Arc<Self> {
        Arc::new(Self::with(self.most / PEER, self.queue, Some(Arc::clone(self))))
    }

    fn with(most: usize, queue: usize, of: Option<Arc<QueueBudget>>) -> Self {
        let (taken, released) = (AtomicUsize::new(0), AtomicUsize::new(0));
        let awaited = AtomicBool::new(false);
        Self { most, taken, released, queue, awaited, freed: Notify::new(), of }
    }

    /// Most that one queue may take.
    pub(super) fn of_queue(&self) -> usize {
        self.queue
    }

    /// Whether there was room for so many bytes, which are taken then.
    pub(super) fn take(&self, bytes: usize) -> bool {
        if !self.try_take(bytes) {
            // SeqCst, with those in `release`: either room that is made now is found by the second
            // look, or whoever made it finds that it is awaited.
            self.awaited.store(true, Ordering::SeqCst);
            if !self.try_take(bytes) {
                return false;
            }
        }
        if self.of.as_ref().is_none_or(|of| of.take(bytes)) {
            return true;
        }
        self.release(bytes);
        false
    }

    /// Takes them though there may be no room: one sample may always wait.
    pub(super) fn overtake(&self, bytes: usize) {
        // SeqCst as in `take`.
        self.taken.fetch_add(bytes, Ordering::SeqCst);
        if let Some(of) = &self.of {
            of.overtake(bytes);
        }
    }

    /// They are free again.
    pub(super) fn give_back(&self, bytes: usize) {
        self.release(bytes);
        if let Some(of) = &self.of {
            of.give_back(bytes);
        }
    }

    /// Bytes that wait.
    pub(super) fn taken(&self) -> usize {
        self.taken.load(Ordering::SeqCst)
    }

    /// When there is more room for all after somebody found too little. Those of one peer are told of
    /// what is freed there.
    pub(super) fn freed(&self) -> Notified<'_> {
        self.of.as_ref().map_or(&self.freed, |of| &of.freed).notified()
    }

    fn try_take(&self, bytes: usize) -> bool {
        let more = |taken: usize| taken.checked_add(bytes).filter(|sum| *sum <= self.most);
        self.taken.fetch_update(Ordering::SeqCst, Ordering::SeqCst, more).is_ok()
    }

    /// Bytes that were given back since the daemon began; it may begin anew with 0.
    pub(super) fn released(&self) -> usize {
        // Relaxed: it is compared with itself.
        self.released.load(Ordering::Relaxed)
    }

    fn release(&self, bytes: usize) {
        // Relaxed: as above.
        self.released.fetch_add(bytes, Ordering::Relaxed);
        self.taken.fetch_sub(bytes, Ordering::SeqCst);
        if self.awaited.swap(false, Ordering::SeqCst) {
            self.freed.notify_waiters();
        }
    }
}

#[cfg(test)]
mod tests {
    use std::task::{Context, Waker};

    use super::*;

    #[test]
    fn a_peer_leaves_room_for_the_others() {
        let daemon = QueueBudget::new(3200);
        let peers: Vec<_> = (0..5).map(|_| daemon.of_peer()).collect();
        assert_eq!((daemon.of_queue(), peers[0].of_queue()), (100, 100));
        for peer in &peers[..4] {
            assert!(peer.take(800) && !peer.take(1));
        }
        assert!(!peers[4].take(1), "the daemon has no more");
        peers[0].give_back(10);
        assert!(!peers[1].take(10), "it is not this peer's");
        assert!(peers[4].take(10) && !peers[0].take(1));
        // What failed took nothing.
        peers[4].give_back(10);
        for (peer, bytes) in peers.iter().zip([790, 800, 800, 800]) {
            peer.give_back(bytes);
        }
        assert_eq!(daemon.taken.load(Ordering::SeqCst), 0);
    }

    #[test]
    fn one_more_than_there_is_room_for_is_counted() {
        let daemon = QueueBudget::new(100);
        let peer = daemon.of_peer();
        peer.overtake(1000);
        assert!(!peer.take(1));
        peer.give_back(1000);
        assert!(peer.take(25));
    }

    #[test]
    fn whoever_found_no_room_hears_of_what_another_peer_makes() {
        let daemon = QueueBudget::new(400);
        let (slow, waiting) = (daemon.of_peer(), daemon.of_peer());
        slow.overtake(400);
        let freed = waiting.freed();
        let mut freed = std::pin::pin!(freed);
        freed.as_mut().enable();
        assert!(!waiting.take(1));
        let mut context = Context::from_waker(Waker::noop());
        assert!(freed.as_mut().poll(&mut context).is_pending());
        slow.give_back(1);
        assert!(freed.as_mut().poll(&mut context).is_ready());
        assert!(waiting.take(1));
    }
}
