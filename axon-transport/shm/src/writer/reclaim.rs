//! Makes space for the next sample: finds a descriptor and a block, and drops old samples for them. Large samples have
//! [memory of their own](super::samples).

use std::sync::{Arc, atomic::AtomicU64};

use crate::{
    alloc::{
        area::Area,
        heap::{Block, HeapObject, Need},
    },
    error::{PinHolder, PublishError, ShmError},
    memory::segment::Map,
    ring::{
        layout::{self, Array, COPIED},
        protocol,
    },
    session::pin_lanes::PinningReader,
    writer::{Writer, WriterState, header::Dropped, history::OldestInUse},
};

/// The reason why an attempt to publish did not succeed.
pub(crate) enum PublishObstacle {
    /// A KEEP_ALL reader holds the oldest sample.
    OldestInUse {
        /// The reason why there is no space beside the held samples, if memory is short.
        short: Option<PublishError>,
    },
    Error(PublishError),
    /// Readers pin the memory that samples could use.
    Pinned(PinnedMemory),
}

/// The reader that pins most of a publisher's memory.
pub(crate) struct PinnedMemory {
    pub(crate) holder: PinningReader,
    pub(crate) samples: usize,
    /// The reason why no further memory is available, unless the segments are full.
    pub(crate) short: Option<PublishError>,
}

impl PinnedMemory {
    /// Returns the error for the caller of a publish. It looks up the process, so it must not be called under a lock.
    pub(crate) fn into_error(self) -> PublishError {
        let Self { holder, samples, short } = self;
        let keeper = PinHolder { reader: holder.reader, process: holder.process(), samples };
        match short {
            Some(PublishError::NoMemory { needed, available, .. }) => {
                PublishError::NoMemory { needed, available, keeper: Some(keeper) }
            }
            Some(other) => other,
            None => PublishError::Pinned { keeper },
        }
    }
}

impl From<PublishError> for PublishObstacle {
    fn from(error: PublishError) -> Self {
        Self::Error(error)
    }
}

impl From<OldestInUse> for PublishObstacle {
    fn from(OldestInUse: OldestInUse) -> Self {
        Self::OldestInUse { short: None }
    }
}

/// The maps of the few segments that contain a ring's blocks.
#[derive(Default)]
pub(crate) struct Maps(Vec<(u32, Arc<Map>)>);

impl Maps {
    fn add(&mut self, object: &HeapObject) {
        let number = object.block.at.segment;
        if self.0.iter().all(|(known, _)| *known != number) {
            self.0.push((number, Arc::clone(&object.map)));
        }
    }

    fn words(&self, block: &Block) -> &[AtomicU64] {
        let (_, map) = self
            .0
            .iter()
            .find(|(number, _)| *number == block.at.segment)
            .expect("the segment of each block was added");
        let start = block.at.offset as usize / 8;
        &map.words()[start..start + block.len as usize / 8]
    }
}

/// Returns the error for the caller of a publish.
pub(crate) fn no_memory(error: ShmError) -> PublishError {
    match error {
        ShmError::NoMemory { needed, available } => {
            PublishError::NoMemory { needed, available, keeper: None }
        }
        ShmError::MemoryBudget { needed, available, most } => {
            PublishError::MemoryBudget { needed, available, most }
        }
        other => PublishError::Segment { reason: other.to_string() },
    }
}

/// Returns how many samples stay in a ring that cannot get more memory: one, so that later readers find it; but a ring
/// that has used up its budget prefers its newest sample to an old one.
pub(crate) fn least_kept(short: &PublishError) -> u64 {
    u64::from(!matches!(short, PublishError::MemoryBudget { .. }))
}

impl Writer {
    /// Makes sure that the next position has a descriptor.
    pub(crate) fn make_place(&self, state: &mut WriterState) -> Result<(), PublishObstacle> {
        if state.history.is_full() {
            let floors = state.reader_set.floors(state.history.head());
            // Samples are kept a little longer than the window requires, so that the tail moves seldom and readers keep
            // it in their caches.
            let window = state.reader_set.window();
            let surplus = floors.retained.saturating_sub(state.history.tail());
            let wanted = window.saturating_add((window / 4).max(4));
            let mut short = None;
            if self.may_grow(state) && (surplus == 0 || state.history.capacity() < wanted) {
                // A publish that waits for readers leaves them the time to map missing memory. A publisher that keeps
                // samples for later readers does not give them up because one reader lacks the memory. And a reader
                // that wants the oldest sample gets it late rather than never, once it maps the memory.
                let now = floors.held < u64::MAX
                    || state.reader_set.keeps_all()
                    || (surplus == 0 && state.is_oldest_wanted());
                let need = if now { Need::Now } else { Need::Mapped };
                short = self.grow(state, need).err().map(no_memory);
            }
            let consumed = if short.is_some() { state.consumed() } else { 0 };
            let history = &mut state.history;
            if history.is_full() && surplus > 0 {
                history.release_below(history.tail() + surplus.div_ceil(2));
            }
            // Dropping a sample that all readers have taken is no loss.
            let is_lost = history.is_full() && short.is_some() && history.tail() >= consumed;
            let made = history.make_place(|position| position < floors.held);
            made.map_err(|OldestInUse| PublishObstacle::OldestInUse { short })?;
            if is_lost {
                self.header.count(Dropped::NoMemory);
            }
        }
        if !state.history.has_room_for_descriptor() {
            let floors = state.reader_set.floors(state.history.head());
            state.history.make_room(0, |position| position < floors.held)?;
        }
        self.show_tail(state);
        Ok(())
    }

    /// Returns whether twice as many descriptors are within the limit of the ring.
    fn may_grow(&self, state: &WriterState) -> bool {
        2 * (state.history.capacity() + 1) <= self.limit
    }

    /// Moves to twice as many descriptors, if the required memory is available. If not, the oldest samples go, and the
    /// next publish tries again.
    ///
    /// # Errors
    /// There is no memory for the descriptors.
    fn grow(&self, state: &mut WriterState, need: Need) -> Result<(), ShmError> {
        debug_assert!(self.may_grow(state));
        let descriptors = 2 * (state.history.capacity() + 1);
        let bytes = descriptors * layout::DESCRIPTOR;
        let more = bytes - state.array.block.len;
        state.holding.take(more)?;
        let reader_set = &state.reader_set;
        let mapped = |number| reader_set.has_mapped(number);
        let array = match self.session.allocate(bytes, need, mapped) {
            Ok(Some(array)) => array,
            other => {
                state.holding.give_back(more);
                return other.map(drop);
            }
        };
        // Only kept samples move, so readers must not count more samples as kept.
        self.show_tail(state);
        let history = &mut state.history;
        let (tail, head) = (history.tail(), history.head());
        protocol::copy_descriptors(state.array.words(), array.words(), tail, head);
        let word = Array { at: array.block.at, descriptors }.word();
        protocol::replace(self.header.words(), word);
        history.grow();
        let old = std::mem::replace(&mut state.array, array);
        self.header.add_bytes(bytes);
        self.header.subtract_bytes(old.block.len);
        self.session.release(old.block);
        if 2 * descriptors <= self.limit {
            self.session.foresee(2 * bytes);
        }
        Ok(())
    }

    /// Copies at most [`COPIED`] bytes in for the next position, which has a descriptor.
    pub(crate) fn copy_in(
        &self,
        state: &mut WriterState,
        payload: &[u8],
    ) -> Result<Block, PublishObstacle> {
        debug_assert!(payload.len() as u64 <= COPIED);
        let bytes = Area::rounded(payload.len() as u64);
        // The readers' positions are read only if necessary: they are in cache lines of their own.
        let at_hand =
            if state.history.has_room(bytes) { state.history.blocks().take(bytes) } else { None };
        let block = match at_hand {
            Some(block) => block,
            None => self.block_with_room(state, bytes)?,
        };
        self.show_tail(state);
        protocol::about_to_write::<AtomicU64>();
        protocol::copy_in(state.maps.words(&block), payload);
        Ok(block)
    }

    /// Returns a block for a sample. The oldest samples are given up for it if necessary.
    fn block_with_room(
        &self,
        state: &mut WriterState,
        bytes: u64,
    ) -> Result<Block, PublishObstacle> {
        let floors = state.reader_set.floors(state.history.head());
        let may_go = |position| position < floors.held;
        state.history.make_room(bytes, may_go)?;
        loop {
            if let Some(block) = state.history.blocks().take(bytes) {
                return Ok(block);
            }
            match self.block(state, bytes) {
                Ok(block) => return Ok(block),
                Err(error) => {
                    let tail = state.history.tail();
                    let was_kept = tail >= floors.retained && tail >= state.consumed();
                    match state.history.shrink(least_kept(&error), may_go) {
                        Ok(false) => return Err(error.into()),
                        Ok(true) if was_kept => self.header.count(Dropped::NoMemory),
                        Ok(true) => {}
                        Err(OldestInUse) => {
                            return Err(PublishObstacle::OldestInUse { short: Some(error) });
                        }
                    }
                    self.give_blocks_back(state);
                }
            }
        }
    }

    /// Allocates a new block of the session's memory.
    fn block(&self, state: &mut WriterState, bytes: u64) -> Result<Block, PublishError> {
        if state.history.blocks().are_many() {
            self.give_blocks_back(state);
        }
        state.holding.take(bytes).map_err(no_memory)?;
        let reader_set = &state.reader_set;
        let mapped = |number| reader_set.has_mapped(number);
        let allocated = self.session.allocate(bytes, Need::Now, mapped);
        let object = allocated
            .inspect_err(|_| state.holding.give_back(bytes))
            .map_err(no_memory)?
            .expect("there is always one that will do");
        state.maps.add(&object);
        self.header.add_bytes(object.block.len);
        Ok(object.block)
    }

    fn give_blocks_back(&self, state: &mut WriterState) {
        // Other rings write there from now on.
        self.show_tail(state);
        for block in state.history.blocks().drain() {
            self.header.subtract_bytes(block.len);
            state.holding.give_back(block.len);
            self.session.release(block);
        }
    }

    /// Shows readers which samples have been given up. It must be called before any of their memory is overwritten.
    pub(crate) fn show_tail(&self, state: &mut WriterState) {
        if state.shown_tail != state.history.tail() {
            state.shown_tail = state.history.tail();
            protocol::retire(self.header.words(), state.shown_tail);
        }
    }
}
