//! The clock that all key state machines share.

use std::{
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
    },
    time::{Duration, Instant},
};

/// Monotonic time since it was made. Clones show the same time.
#[derive(Clone, Debug)]
pub struct Clock(ClockSource);

#[derive(Clone, Debug)]
enum ClockSource {
    Monotonic(Instant),
    /// Nanoseconds.
    Manual(Arc<AtomicU64>),
}

impl Clock {
    /// The system's monotonic clock, zero now.
    pub fn start() -> Self {
        Self(ClockSource::Monotonic(Instant::now()))
    }

    /// A clock for tests, zero until [`advance`](Self::advance)d.
    pub fn manual() -> Self {
        Self(ClockSource::Manual(Arc::default()))
    }

    /// Time since the start.
    pub fn now(&self) -> Duration {
        match &self.0 {
            ClockSource::Monotonic(start) => start.elapsed(),
            ClockSource::Manual(nanos) => Duration::from_nanos(nanos.load(Ordering::Relaxed)),
        }
    }

    /// Moves a [`manual`](Self::manual) clock; the system's goes by itself.
    pub fn advance(&self, by: Duration) {
        if let ClockSource::Manual(nanos) = &self.0 {
            nanos.fetch_add(by.as_nanos().try_into().unwrap_or(u64::MAX), Ordering::Relaxed);
        }
    }
}
