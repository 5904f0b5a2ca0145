//! Limits the address space that the memory of other processes may take in this process. A peer's segment is
//! mapped before it is used, and a process without free address space cannot continue.

use std::sync::{
    Arc,
    atomic::{AtomicU64, Ordering},
};

use crate::error::ShmError;

/// A number of maps and their total bytes.
#[derive(Clone, Copy, Debug)]
struct Amount {
    maps: u64,
    bytes: u64,
}

/// The limit for one process: the memory of a thousand publishers of large samples with the usual options.
const OF_PROCESS: Amount = Amount { maps: 1 << 10, bytes: 4 << 40 };
/// The limit for all processes: a quarter of the maps that Linux allows a process (vm.max_map_count), and of an address
/// space of 47 bits.
const OF_ALL: Amount = Amount { maps: 16 << 10, bytes: 32 << 40 };

/// Returns the limits for all processes and for one, in an address space of `space` bytes. All processes get at most
/// half of it, and one process a quarter of that. Some small machines have 39 bits, which are 512 GiB.
fn bounds(space: u64) -> (Amount, Amount) {
    let all = OF_ALL.bytes.min(space / 2);
    let process = OF_PROCESS.bytes.min(all / 4);
    (Amount { bytes: all, ..OF_ALL }, Amount { bytes: process, ..OF_PROCESS })
}

/// Returns the size of this process's address space, from the address of a stack variable: stacks are in its upper
/// half.
fn space() -> u64 {
    let here = 0u8;
    (&raw const here as u64).next_power_of_two()
}

/// A limit on maps, and the part that is taken.
pub(crate) struct Quota {
    whose: &'static str,
    most: Amount,
    maps: AtomicU64,
    bytes: AtomicU64,
}

/// The quota of all other processes together.
static ALL: Quota = Quota::new("all other processes", OF_ALL);

impl Quota {
    const fn new(whose: &'static str, most: Amount) -> Self {
        Self { whose, most, maps: AtomicU64::new(0), bytes: AtomicU64::new(0) }
    }

    /// Creates the quota for the memory of one process.
    pub(crate) fn of_process() -> Arc<Self> {
        Arc::new(Self::new("another process", bounds(space()).1))
    }

    /// Takes one map of `bytes` bytes.
    pub(crate) fn take(self: &Arc<Self>, bytes: u64) -> Result<Share, ShmError> {
        self.reserve(bytes, self.most)?;
        if let Err(error) = ALL.reserve(bytes, bounds(space()).0) {
            self.give_back(bytes);
            return Err(error);
        }
        Ok(Share { of: Arc::clone(self), bytes })
    }

    fn reserve(&self, bytes: u64, most: Amount) -> Result<(), ShmError> {
        let whose = self.whose;
        let full = || ShmError::AddressSpace { whose, maps: most.maps, bytes: most.bytes };
        // Relaxed: these are only counters, which guard no other memory.
        let add = |count: &AtomicU64, more: u64, most: u64| {
            let sum = |count: u64| count.checked_add(more).filter(|sum| *sum <= most);
            count.fetch_update(Ordering::Relaxed, Ordering::Relaxed, sum).map_err(|_| full())
        };
        add(&self.maps, 1, most.maps)?;
        add(&self.bytes, bytes, most.bytes).inspect_err(|_| {
            self.maps.fetch_sub(1, Ordering::Relaxed);
        })?;
        Ok(())
    }

    fn give_back(&self, bytes: u64) {
        self.maps.fetch_sub(1, Ordering::Relaxed);
        self.bytes.fetch_sub(bytes, Ordering::Relaxed);
    }
}

/// The share of one map, until it is dropped.
pub(crate) struct Share {
    of: Arc<Quota>,
    bytes: u64,
}

impl Drop for Share {
    fn drop(&mut self) {
        self.of.give_back(self.bytes);
        ALL.give_back(self.bytes);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn quota(maps: u64, bytes: u64) -> Arc<Quota> {
        Arc::new(Quota::new("a test", Amount { maps, bytes }))
    }

    fn is_full(share: Result<Share, ShmError>) -> bool {
        matches!(share, Err(ShmError::AddressSpace { whose: "a test", .. }))
    }

    #[test]
    fn neither_more_maps_nor_more_bytes_than_may_be() {
        let quota = quota(2, 100);
        assert!(is_full(quota.take(101)) && is_full(quota.take(u64::MAX)));
        let half = quota.take(50).unwrap();
        assert!(is_full(quota.take(51)));
        let rest = quota.take(50).unwrap();
        assert!(is_full(quota.take(0)), "a third map");
        drop(half);
        assert!(is_full(quota.take(51)));
        drop((rest, quota.take(50).unwrap()));
        assert!(quota.take(100).is_ok(), "what was refused took nothing");
    }

    #[test]
    fn a_small_address_space_is_shared_out_too() {
        let bytes = |bits: u32| {
            let (all, process) = bounds(1 << bits);
            (all.bytes >> 30, process.bytes >> 30)
        };
        assert_eq!(bytes(39), (256, 64));
        assert_eq!([bytes(47), bytes(48), bytes(57)], [(32 << 10, 4 << 10); 3]);
        assert!(space() >= 1 << 38, "{:x}", space());
    }

    #[test]
    fn the_whole_process_has_its_bound_too() {
        let (one, other) = (quota(u64::MAX, u64::MAX), quota(u64::MAX, u64::MAX));
        let all = [&one, &other].map(|quota| quota.take(OF_ALL.bytes / 2 + 1));
        assert!(all[0].is_ok());
        let Err(error) = &all[1] else { panic!("more than there may be") };
        assert!(error.to_string().contains("all other processes"), "{error}");
        drop(all);
        assert!(other.take(OF_ALL.bytes / 2 + 1).is_ok(), "the other took nothing");
    }
}
