//! The two clocks: one for what people read, one for what is waited for.

use std::time::SystemTime;

use rustix::time::{ClockId, clock_gettime};

/// Nanoseconds since the Unix epoch.
pub(super) fn wall() -> i64 {
    SystemTime::now()
        .duration_since(SystemTime::UNIX_EPOCH)
        .map_or(0, |d| i64::try_from(d.as_nanos()).unwrap_or(i64::MAX))
}

/// Nanoseconds of the monotonic clock, which is the same in all processes of a host.
pub(super) fn monotonic() -> u64 {
    let now = clock_gettime(ClockId::Monotonic);
    now.tv_sec as u64 * 1_000_000_000 + now.tv_nsec as u64
}
