//! Acknowledges received samples to the peer: up to which number they are in their ring.

use std::{
    collections::HashMap,
    sync::{
        Arc, Mutex,
        atomic::{AtomicU64, Ordering},
    },
    time::Duration,
};

use axon_shm::ids::Gid;
use tokio::sync::Notify;

use super::{control::Outbox, keyring::lock};
use crate::link::{Message, Received, ReceivedOf};

/// A sample is acknowledged after so long at the latest, and when so many samples or bytes came since.
const DELAY: Duration = Duration::from_millis(10);
const SAMPLES: u64 = 64;
const BYTES: u64 = 256 << 10;
/// Flows that one message names.
const FLOWS: usize = 4096;

/// What came from one peer and was not acknowledged yet.
pub(super) struct Receipts {
    due: Mutex<HashMap<(u32, Gid), Due>>,
    outbox: Mutex<Outbox>,
    samples: AtomicU64,
    bytes: AtomicU64,
    some: Notify,
    many: Notify,
}

#[derive(Default)]
struct Due {
    sequence: u64,
    dropped: u64,
}

impl Receipts {
    pub(super) fn new(outbox: Outbox) -> Arc<Self> {
        Arc::new(Self {
            due: Mutex::default(),
            outbox: Mutex::new(outbox),
            samples: AtomicU64::new(0),
            bytes: AtomicU64::new(0),
            some: Notify::new(),
            many: Notify::new(),
        })
    }

    /// They are told over this link from now on.
    pub(super) fn succeed(&self, outbox: Outbox) {
        *lock(&self.outbox) = outbox;
    }

    /// A sample of so many bytes is in its ring.
    pub(super) fn came(&self, route: u32, publisher: Gid, sequence: u64, bytes: usize) {
        self.note(route, publisher, sequence, 0, bytes);
    }

    /// A sample could not be written to its ring.
    pub(super) fn dropped(&self, route: u32, publisher: Gid, sequence: u64) {
        self.note(route, publisher, sequence, 1, 0);
    }

    fn note(&self, route: u32, publisher: Gid, sequence: u64, dropped: u64, bytes: usize) {
        let first = {
            let mut all = lock(&self.due);
            let first = all.is_empty();
            let due = all.entry((route, publisher)).or_default();
            due.sequence = due.sequence.max(sequence);
            due.dropped += dropped;
            first
        };
        // Relaxed, here and below: how soon it is told, and nothing else.
        let samples = self.samples.fetch_add(1, Ordering::Relaxed) + 1;
        let bytes = self.bytes.fetch_add(bytes as u64, Ordering::Relaxed) + bytes as u64;
        if first {
            self.some.notify_one();
        }
        if samples >= SAMPLES || bytes >= BYTES {
            self.many.notify_one();
        }
    }

    /// Tells the peer, for as long as it is not dropped.
    pub(super) async fn run(self: Arc<Self>) {
        loop {
            self.some.notified().await;
            let _ = tokio::time::timeout(DELAY, self.many.notified()).await;
            self.samples.store(0, Ordering::Relaxed);
            self.bytes.store(0, Ordering::Relaxed);
            let due = std::mem::take(&mut *lock(&self.due));
            let flows: Vec<_> = due
                .into_iter()
                .map(|((route, publisher), Due { sequence, dropped })| ReceivedOf {
                    route,
                    publisher,
                    sequence,
                    dropped,
                })
                .collect();
            let outbox = lock(&self.outbox).clone();
            for flows in flows.chunks(FLOWS) {
                outbox.send(Message::Received(Received { flows: flows.to_vec() }));
            }
        }
    }
}
