//! The two clocks: one for what people read, one for what is waited for.

use rustix::time::{ClockId, clock_gettime};

pub(super) use crate::shm::now as wall;

/// Nanoseconds of the monotonic clock, which is the same in all processes of a host.
pub(super) fn monotonic() -> u64 {
    let now = clock_gettime(ClockId::Monotonic);
    now.tv_sec as u64 * 1_000_000_000 + now.tv_nsec as u64
}
