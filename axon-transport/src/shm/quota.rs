//! How much address space the memory of other sessions may take: whatever they hand over is mapped
//! before anybody uses it, and a process that can map nothing more is at its end.

use std::sync::{
    Arc,
    atomic::{AtomicU64, Ordering},
};

use super::ShmError;

/// Maps, and their bytes.
#[derive(Clone, Copy, Debug)]
struct Amount {
    maps: u64,
    bytes: u64,
}

/// Of one session: the memory of a thousand publishers of large samples as they usually are.
const OF_SESSION: Amount = Amount { maps: 1 << 10, bytes: 4 << 40 };
/// Of all of them: a quarter of the maps that Linux gives to a process (vm.max_map_count), and of an
/// address space of 47 bits.
const OF_ALL: Amount = Amount { maps: 16 << 10, bytes: 32 << 40 };

/// What may be mapped, and what is.
pub(super) struct Quota {
    whose: &'static str,
    most: Amount,
    maps: AtomicU64,
    bytes: AtomicU64,
}

/// What all sessions take of this process.
static ALL: Quota = Quota::new("all other processes", OF_ALL);

impl Quota {
    const fn new(whose: &'static str, most: Amount) -> Self {
        Self { whose, most, maps: AtomicU64::new(0), bytes: AtomicU64::new(0) }
    }

    /// For the memory of one session.
    pub(super) fn of_session() -> Arc<Self> {
        Arc::new(Self::new("another process", OF_SESSION))
    }

    /// A map of `bytes` bytes.
    pub(super) fn take(self: &Arc<Self>, bytes: u64) -> Result<Share, ShmError> {
        self.reserve(bytes)?;
        if let Err(error) = ALL.reserve(bytes) {
            self.give_back(bytes);
            return Err(error);
        }
        Ok(Share { of: Arc::clone(self), bytes })
    }

    fn reserve(&self, bytes: u64) -> Result<(), ShmError> {
        let Self { whose, most, .. } = *self;
        let full = || ShmError::AddressSpace { whose, maps: most.maps, bytes: most.bytes };
        // Counters alone: nothing is reached by what they say.
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

/// What one map takes of it, until it is dropped.
pub(super) struct Share {
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
