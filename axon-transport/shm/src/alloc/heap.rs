//! A session's memory for objects: lanes, rings, their descriptors, and samples of up to 4 KiB. Objects are in the
//! session's first segment while it has room, then in further segments.
//!
//! The session allocates objects when an endpoint attaches or a ring grows, not for a publish in steady state.

use std::{
    sync::{Arc, Mutex, MutexGuard, PoisonError, atomic::AtomicU64},
    time::{Duration, Instant},
};

use crate::{
    alloc::{
        area::Area,
        segments::{OwnSegment, Segments},
    },
    error::ShmError,
    memory::segment::Map,
    ring::{
        layout::{
            self, FIRST_AT, HEAP_AT, HEAP_BYTES, HEAP_BYTES_MAX, LANES_AT, Location, SegmentKind,
        },
        protocol::about_to_write,
    },
};

/// The time that readers have to map a segment before objects that they read move there without them: a stopped reader
/// must not keep a ring small.
const MAP_TIMEOUT: Duration = Duration::from_secs(1);

/// The memory of one object.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Block {
    pub(crate) at: Location,
    pub(crate) len: u64,
}

/// A block and the map that contains it. Dropping it does not free the block.
#[derive(Clone)]
pub(crate) struct HeapObject {
    pub(crate) block: Block,
    pub(crate) map: Arc<Map>,
}

impl HeapObject {
    #[inline]
    pub(crate) fn words(&self) -> &[AtomicU64] {
        let start = self.block.at.offset as usize / 8;
        &self.map.words()[start..start + self.block.len as usize / 8]
    }
}

/// Tells whether an object may be in a segment that its readers have not mapped.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Need {
    /// It may, if there is no space elsewhere.
    Now,
    /// It may not; the allocation returns `None` instead.
    Mapped,
}

/// The segments that hold objects, and their free ranges.
pub(crate) struct Heap(Mutex<Vec<HeapPart>>);

struct HeapPart {
    segment: Arc<OwnSegment>,
    area: Area,
    /// End of the range for objects other than lanes.
    limit: u64,
    /// Bytes from the segment's start that are backed by memory.
    committed: u64,
    since: Instant,
}

impl HeapPart {
    fn new(segment: Arc<OwnSegment>) -> Self {
        let bytes = segment.memory.bytes();
        let (start, limit) =
            if segment.number() == 0 { (FIRST_AT, LANES_AT) } else { (HEAP_AT, bytes) };
        let area = Area::new(start..bytes, 16);
        Self { segment, area, limit, committed: layout::ALIGN, since: Instant::now() }
    }

    fn fits(&self, len: u64) -> bool {
        self.area.fits_below(self.limit, len)
    }

    /// Like [`allocate`](Self::allocate), but stores the first error in `short`.
    fn give(&mut self, len: u64, short: &mut Option<ShmError>) -> Option<HeapObject> {
        self.allocate(len).unwrap_or_else(|error| {
            short.get_or_insert(error);
            None
        })
    }

    fn allocate(&mut self, len: u64) -> Result<Option<HeapObject>, ShmError> {
        self.allocate_below(self.limit, len)
    }

    fn allocate_below(&mut self, limit: u64, len: u64) -> Result<Option<HeapObject>, ShmError> {
        let Some(offset) = self.area.allocate_below(limit, len) else { return Ok(None) };
        let end = offset + len;
        if end > self.committed {
            let upto = end.next_multiple_of(layout::ALIGN);
            if let Err(error) = self.segment.memory.commit(self.committed, upto) {
                self.area.release(offset, len);
                return Err(error);
            }
            self.committed = upto;
        }
        let at = Location { segment: self.segment.number(), offset };
        Ok(Some(HeapObject { block: Block { at, len }, map: Arc::clone(self.segment.map()) }))
    }
}

impl Heap {
    /// Creates a heap in a session's first segment.
    pub(crate) fn new(first: Arc<OwnSegment>) -> Self {
        Self(Mutex::new(vec![HeapPart::new(first)]))
    }

    /// Allocates `len` bytes, preferably in a segment that is `mapped` by its readers. Returns `None` if there is space
    /// only in another segment and `need` forbids that; the caller tries again later.
    ///
    /// The memory may hold the content of an earlier object. A reader may still read that content, only to detect that
    /// it is stale. So the memory must be written in atomic words.
    pub(crate) fn allocate(
        &self,
        segments: &Segments,
        len: u64,
        need: Need,
        mapped: impl Fn(u32) -> bool,
    ) -> Result<Option<HeapObject>, ShmError> {
        let len = Area::rounded(len);
        let mut parts = self.parts();
        let usable = |part: &HeapPart| {
            let number = part.segment.number();
            number == 0 || mapped(number) || part.since.elapsed() >= MAP_TIMEOUT
        };
        let mut found = None;
        let mut elsewhere = false;
        // If one segment lacks memory, another may have some.
        let mut short = None;
        for part in &mut *parts {
            if usable(part) {
                found = part.give(len, &mut short);
            } else {
                elsewhere |= part.fits(len);
            }
            if found.is_some() {
                break;
            }
        }
        if found.is_none() && !elsewhere && short.is_none() {
            let mut part = Self::another(segments, len)?;
            if usable(&part) {
                found = part.give(len, &mut short);
            }
            parts.push(part);
        }
        if found.is_none() && need == Need::Now {
            found = parts.iter_mut().find_map(|part| part.give(len, &mut short));
        }
        drop(parts);
        // The thread that freed this memory did so after it had raised a tail or replaced an array, and under the lock.
        // So readers that see the new content also see that tail or array.
        about_to_write::<AtomicU64>();
        match (found, short) {
            (None, Some(error)) => Err(error),
            (found, _) => Ok(found),
        }
    }

    /// Opens a segment if none has space for `len` bytes, so that other sessions have it by the time that it is needed.
    pub(crate) fn foresee(&self, segments: &Segments, len: u64) {
        let len = Area::rounded(len);
        let mut parts = self.parts();
        if !parts.iter().any(|part| part.fits(len))
            // An error is ignored here: the allocation that needs the memory reports it.
            && let Ok(part) = Self::another(segments, len)
        {
            parts.push(part);
        }
    }

    fn another(segments: &Segments, len: u64) -> Result<HeapPart, ShmError> {
        if len > HEAP_BYTES_MAX - HEAP_AT {
            return Err(ShmError::NoMemory { needed: len, available: HEAP_BYTES_MAX });
        }
        let bytes = (HEAP_AT + len).next_multiple_of(HEAP_BYTES);
        Ok(HeapPart::new(segments.open(SegmentKind::Heap, bytes)?))
    }

    /// Allocates a lane, always in the first segment: a reader's first request arrives before other segments are
    /// mapped.
    pub(crate) fn allocate_lane(&self) -> Result<HeapObject, ShmError> {
        let object = self.parts()[0].allocate_below(layout::SESSION_BYTES, layout::LANE)?;
        // As in `allocate`: another object may have been there.
        about_to_write::<AtomicU64>();
        Ok(object.expect("there is room for all lanes"))
    }

    /// Frees a block. The caller must first have shown its readers that the object is gone.
    pub(crate) fn release(&self, block: Block) {
        let mut parts = self.parts();
        if let Some(part) = parts.iter_mut().find(|p| p.segment.number() == block.at.segment) {
            part.area.release(block.at.offset, block.len);
        }
    }

    fn parts(&self) -> MutexGuard<'_, Vec<HeapPart>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ids::SessionId;

    fn heap() -> (Segments, Heap) {
        let segments = Segments::new(SessionId::random());
        let first = segments.open(SegmentKind::Session, layout::SESSION_BYTES).unwrap();
        (segments, Heap::new(first))
    }

    #[test]
    fn another_segment_is_used_once_it_is_mapped_or_nothing_else_will_do() {
        let (segments, heap) = heap();
        let nobody = |_| false;
        let first = heap.allocate(&segments, 400 << 10, Need::Mapped, nobody).unwrap().unwrap();
        assert_eq!(first.block.at.segment, 0);
        for _ in 0..2 {
            let none = heap.allocate(&segments, 400 << 10, Need::Mapped, nobody).unwrap();
            assert!(none.is_none());
        }
        let now = heap.allocate(&segments, 400 << 10, Need::Now, nobody).unwrap().unwrap();
        assert_eq!(now.block.at.segment, 1);
        let small = heap.allocate(&segments, 1, Need::Now, nobody).unwrap().unwrap();
        assert_eq!((small.block.at.segment, small.block.len), (0, 128));
        let mapped = heap.allocate(&segments, 400 << 10, Need::Mapped, |_| true).unwrap().unwrap();
        assert_eq!(mapped.block.at.segment, 1);
        assert_eq!(segments.further().len(), 1);
        heap.release(first.block);
        let again = heap.allocate(&segments, 400 << 10, Need::Mapped, nobody).unwrap().unwrap();
        assert_eq!(again.block, first.block);
    }

    #[test]
    fn a_segment_that_lacks_memory_is_passed_over() {
        let (segments, heap) = heap();
        let most = HEAP_BYTES - HEAP_AT;
        let second = heap.allocate(&segments, most, Need::Now, |_| true).unwrap().unwrap();
        heap.release(second.block);
        // No byte of the range that is free here can be backed by memory.
        let end = layout::SESSION_BYTES;
        heap.parts()[0].area = Area::new(end..2 * end, 16);
        heap.parts()[0].committed = end;
        heap.parts()[0].limit = 2 * end;
        for mapped in [true, false] {
            let object = heap.allocate(&segments, 128, Need::Now, |_| mapped).unwrap().unwrap();
            assert_eq!(object.block.at.segment, 1);
        }
        heap.parts()[1].area = Area::new(HEAP_BYTES..2 * HEAP_BYTES, 16);
        heap.parts()[1].committed = HEAP_BYTES;
        heap.parts()[1].limit = 2 * HEAP_BYTES;
        let error = heap.allocate(&segments, 128, Need::Now, |_| true).err();
        assert!(matches!(error, Some(ShmError::System { .. })), "{error:?}");
        assert_eq!(segments.further().len(), 1, "a third would lack it, too");
    }

    #[test]
    fn the_first_segment_reserves_room_for_all_lanes() {
        let (segments, heap) = heap();
        let allocate = || heap.allocate(&segments, 1, Need::Now, |_| true).unwrap().unwrap().block;
        let mut last = allocate();
        while last.at.segment == 0 {
            last = allocate();
        }
        for _ in 0..layout::LANES {
            let lane = heap.allocate_lane().unwrap().block;
            assert_eq!((lane.at.segment, lane.len), (0, layout::LANE));
        }
    }

    #[test]
    fn heap_refuses_an_allocation_beyond_its_limit() {
        let (segments, heap) = heap();
        let error = heap.allocate(&segments, HEAP_BYTES_MAX, Need::Now, |_| true).err();
        assert!(matches!(error, Some(ShmError::NoMemory { .. })), "{error:?}");
        assert!(segments.further().is_empty());
        heap.foresee(&segments, HEAP_BYTES_MAX - HEAP_AT);
        assert_eq!(segments.further()[0].memory.bytes(), HEAP_BYTES_MAX);
    }
}
