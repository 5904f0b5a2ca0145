//! How many descriptors this process can hold, and whether more may come.

use std::sync::atomic::Ordering;

use rustix::{
    fs::stat,
    process::{Resource, getrlimit},
};

use crate::os::closer::{FdClass, OPEN};

/// Maximum number of descriptors in a packet that [`receive_few`](super::receive_few) receives.
pub const FEW_DESCRIPTORS: usize = 16;
/// Number of descriptors to keep free: more than a packet can carry, with other descriptors that a process opens
/// meanwhile. If this is more than half of the limit, half of the limit applies.
const RESERVE: u64 = 400;

/// Returns whether there may be too few free descriptors for a packet, so that only [`receive_few`](super::receive_few) should receive it.
/// The kernel closes descriptors that do not fit in the receiving thread.
pub fn is_tight() -> bool {
    let open = OPEN.load(Ordering::Relaxed);
    limit().is_some_and(|limit| open + RESERVE > limit)
}

/// Returns the maximum number of descriptors of this process: its soft RLIMIT_NOFILE. `None`: any number.
pub fn limit() -> Option<u64> {
    getrlimit(Resource::Nofile).current
}

/// Returns the number of open descriptors of this process, including those of its other threads.
pub fn open() -> u64 {
    const TABLE: &str = "/proc/self/fd";
    // Linux 6.2 and later return it without opening a descriptor.
    if let Ok(Ok(open @ 1..)) = stat(TABLE).map(|found| u64::try_from(found.st_size)) {
        return open;
    }
    // The listing includes its own descriptor.
    let listed = std::fs::read_dir(TABLE).map(|all| all.count() as u64);
    // If nothing can be opened, no descriptor is left.
    listed.unwrap_or_else(|_| limit().unwrap_or_else(|| OPEN.load(Ordering::Relaxed)))
}

fn reserve(limit: u64) -> u64 {
    RESERVE.min(limit / 2)
}

/// Returns whether so many descriptors from sessions wait to be closed that no more should be accepted.
pub fn is_clogged() -> bool {
    FdClass::Session.is_full()
}

/// Returns whether `limit`, the maximum number of open descriptors of this process, leaves no space for all that a
/// packet can carry: a peer that sends descriptors which are slow to close can then block this process.
pub fn is_scarce(limit: u64) -> bool {
    reserve(limit) < RESERVE
}

/// Returns whether so many connections of strangers wait to be closed that no connection should be accepted. If
/// descriptors are short, a few are too many, and descriptors from sessions count as well: waiting descriptors are
/// open.
pub fn close_queue_is_full() -> bool {
    let waits = || FdClass::Stranger.waiting().max(FdClass::Session.waiting());
    FdClass::Stranger.is_full() || (is_tight() && waits() >= FEW_DESCRIPTORS)
}

/// Returns half of the number of descriptors from other processes that this process can hold.
pub fn share() -> usize {
    let limit = limit().unwrap_or(u64::MAX);
    usize::try_from((limit - reserve(limit)) / 2).unwrap_or(usize::MAX)
}
