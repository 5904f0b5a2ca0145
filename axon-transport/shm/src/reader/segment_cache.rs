//! The segments of a reader's recent samples, which the reader finds without a lock.

use std::sync::{Arc, Weak};

use crate::{
    memory::segment::Map,
    session::peer::{RingPeer, SegmentLookup},
};

/// Maximum number of segments in the cache. A ring uses few at a time.
const CAPACITY: usize = 4;

/// Maps of segments, by number. It keeps no map alive: its peer does.
#[derive(Default)]
pub(super) struct SegmentCache(Vec<(u32, Weak<Map>)>);

impl SegmentCache {
    /// Returns the segment of this number, from the cache or from `peer`.
    #[inline]
    pub(super) fn find(&mut self, peer: &RingPeer, number: u32) -> SegmentLookup {
        let known = self.0.iter().find(|(known, _)| *known == number);
        if let Some(map) = known.and_then(|(_, map)| map.upgrade()) {
            return SegmentLookup::Map(map);
        }
        let found = peer.find(number);
        if let SegmentLookup::Map(map) = &found {
            self.keep(number, map);
        }
        found
    }

    fn keep(&mut self, number: u32, map: &Arc<Map>) {
        self.0.retain(|(known, _)| *known != number);
        if self.0.len() >= CAPACITY {
            self.0.remove(0);
        }
        self.0.push((number, Arc::downgrade(map)));
    }
}
