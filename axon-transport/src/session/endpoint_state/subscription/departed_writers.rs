//! The last numbers of writers that are gone.

use std::collections::HashMap;

use crate::ids::Gid;

/// Number of departed writers that are always remembered; there may be up to twice as many.
pub(super) const REMEMBERED_WRITERS: usize = 2048;

/// The last sequence number taken of each writer that is gone, so that samples which a returning writer sends again are
/// not taken twice. A remote writer comes back with its link, a client with the next daemon. The writers that left
/// longest ago are forgotten first.
#[derive(Default)]
pub(super) struct DepartedWriters {
    newer: HashMap<Gid, u64>,
    older: HashMap<Gid, u64>,
}

impl DepartedWriters {
    /// Remembers the last number of a writer that is gone.
    pub(super) fn add(&mut self, writer: Gid, last: u64) {
        if self.newer.len() >= REMEMBERED_WRITERS {
            self.older = std::mem::take(&mut self.newer);
        }
        self.newer.insert(writer, last);
    }

    /// Returns the last number of a writer that was here before.
    pub(super) fn get(&self, writer: &Gid) -> Option<u64> {
        self.newer.get(writer).or_else(|| self.older.get(writer)).copied()
    }

    /// Like [`get`](Self::get), and forgets the writer, since it is back.
    pub(super) fn remove(&mut self, writer: &Gid) -> Option<u64> {
        let older = self.older.remove(writer);
        self.newer.remove(writer).or(older)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn writers_that_were_there_last_are_remembered_and_the_newest_number_counts() {
        let gid = |number: u64| Gid((u128::from(number)).to_be_bytes());
        let mut remembered = DepartedWriters::default();
        remembered.add(gid(0), 1);
        (1..5 * REMEMBERED_WRITERS as u64).for_each(|number| remembered.add(gid(number), number));
        assert!(remembered.newer.len() + remembered.older.len() <= 2 * REMEMBERED_WRITERS);
        let newest = 5 * REMEMBERED_WRITERS as u64 - 1;
        for number in newest - REMEMBERED_WRITERS as u64 + 1..=newest {
            assert_eq!(remembered.get(&gid(number)), Some(number));
        }
        assert_eq!(remembered.get(&gid(0)), None);
        // A writer that is in both maps.
        let twice = newest - REMEMBERED_WRITERS as u64 + 1;
        remembered.add(gid(twice), 7);
        (0..10).for_each(|number| remembered.add(gid(1 << 40 | number), number));
        assert_eq!(remembered.get(&gid(twice)), Some(7));
        assert_eq!((remembered.remove(&gid(twice)), remembered.get(&gid(twice))), (Some(7), None));
    }
}
