//! The time of the keys that a TLS handshake asks for.

use std::{
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
    },
    time::Duration,
};

/// The engine's time, for the acceptor's keys: TLS looks them up in the middle of a handshake and passes no time. The
/// engine sets it before it handles a datagram. Clones share it.
#[derive(Clone, Debug, Default)]
pub struct Clock(
    /// Nanoseconds.
    Arc<AtomicU64>,
);

impl Clock {
    /// Returns the time.
    pub fn now(&self) -> Duration {
        Duration::from_nanos(self.0.load(Ordering::Relaxed))
    }

    /// Moves the time on. Relaxed: the time orders no other memory.
    pub fn advance(&self, by: Duration) {
        self.0.fetch_add(by.as_nanos().try_into().unwrap_or(u64::MAX), Ordering::Relaxed);
    }
}
