//! How a publisher gets room for the next sample: descriptors, memory, and what it gives up for
//! them.

use std::sync::{Arc, atomic::AtomicU64};

use super::{
    PublishError, ShmError, Writer,
    area::Area,
    headroom,
    heap::{Block, Need, Object},
    history::Held,
    layout::{self, Array, COPIED, SLOTS_AT},
    loan::Place,
    memory::Map,
    pins::{self, RECORDS},
    ring,
    segments::OwnSegment,
    writer::{LOOKS, State},
};

/// Why an attempt to publish did not succeed.
pub(super) enum Refusal {
    /// A KEEP_ALL reader holds the oldest sample.
    Held,
    Error(PublishError),
}

impl From<PublishError> for Refusal {
    fn from(error: PublishError) -> Self {
        Self::Error(error)
    }
}

impl From<Held> for Refusal {
    fn from(Held: Held) -> Self {
        Self::Held
    }
}

/// The maps of the segments that a ring's blocks are in: few.
#[derive(Default)]
pub(super) struct Maps(Vec<(u32, Arc<Map>)>);

impl Maps {
    fn add(&mut self, object: &Object) {
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

/// The segment of a publisher's samples that readers pin.
pub(super) struct Samples {
    segment: Arc<OwnSegment>,
    /// Bytes from its start that are backed by memory.
    committed: u64,
}

impl Samples {
    pub(super) fn number(&self) -> u32 {
        self.segment.number()
    }

    /// Backs it with memory up to `end`, a little further when it keeps growing.
    fn back(&mut self, end: u64) -> Result<(), PublishError> {
        if end <= self.committed {
            return Ok(());
        }
        let ahead = self.committed + (self.committed - SLOTS_AT) / 8;
        let limit = self.segment.memory.bytes();
        let upto = end.max(ahead).next_multiple_of(layout::ALIGN).min(limit);
        let needed = upto - self.committed;
        self.segment.memory.commit(self.committed, upto).map_err(|e| no_memory(e, needed))?;
        self.committed = upto;
        Ok(())
    }
}

fn no_memory(error: ShmError, needed: u64) -> PublishError {
    match error {
        ShmError::NoMemory { needed, available } => PublishError::NoMemory { needed, available },
        _ => PublishError::NoMemory { needed, available: headroom::available().unwrap_or(0) },
    }
}

impl Writer {
    /// Makes sure that the next position has a descriptor.
    pub(super) fn make_place(&self, state: &mut State) -> Result<(), Refusal> {
        if state.history.is_full() {
            let floors = state.audience.floors(state.history.head());
            // What has been taken in is kept a little longer than the window asks for, so that the
            // tail moves seldom and readers keep it in their caches.
            let window = state.audience.window();
            let surplus = floors.retained.saturating_sub(state.history.tail());
            let wanted = window.saturating_add((window / 4).max(4));
            if surplus == 0 || state.history.capacity() < wanted {
                self.grow(state);
            }
            let history = &mut state.history;
            if history.is_full() && surplus > 0 {
                history.release_below(history.tail() + surplus.div_ceil(2));
            }
            history.make_place(|position| position < floors.held)?;
        }
        self.show_tail(state);
        Ok(())
    }

    /// Moves to twice as many descriptors, if they are to be had where all readers look. If not, the
    /// oldest samples go, and the next publish tries again.
    fn grow(&self, state: &mut State) {
        let descriptors = 2 * (state.history.capacity() + 1);
        if descriptors > self.limit {
            return;
        }
        let audience = &state.audience;
        let bytes = descriptors * layout::DESCRIPTOR;
        let mapped = |number| audience.has_mapped(number);
        let Ok(Some(array)) = self.session.allocate(bytes, Need::Mapped, mapped) else { return };
        // Only what stands moves, so readers must not take more for standing.
        self.show_tail(state);
        let history = &mut state.history;
        let (tail, head) = (history.tail(), history.head());
        ring::copy_descriptors(state.array.words(), array.words(), tail, head);
        let word = Array { at: array.block.at, descriptors }.word();
        ring::replace(self.ring.words(), word);
        history.grow();
        let old = std::mem::replace(&mut state.array, array);
        self.session.release(old.block);
    }

    /// Copies at most [`COPIED`] bytes in for the next position, which has a descriptor.
    pub(super) fn copy_in(&self, state: &mut State, payload: &[u8]) -> Result<Block, Refusal> {
        debug_assert!(payload.len() as u64 <= COPIED);
        let bytes = Area::rounded(payload.len() as u64);
        let floors = state.audience.floors(state.history.head());
        let may_go = |position| position < floors.held;
        state.history.make_room(bytes, may_go)?;
        let block = loop {
            if let Some(block) = state.history.blocks().take(bytes) {
                break block;
            }
            match self.block(state, bytes) {
                Ok(block) => break block,
                Err(error) if !state.history.shrink(may_go)? => return Err(error.into()),
                Err(_) => self.give_blocks_back(state),
            }
        };
        self.show_tail(state);
        ring::about_to_write::<AtomicU64>();
        ring::copy_in(state.maps.words(&block), payload);
        Ok(block)
    }

    /// A new block of the session's memory.
    fn block(&self, state: &mut State, bytes: u64) -> Result<Block, PublishError> {
        if state.history.blocks().are_many() {
            self.give_blocks_back(state);
        }
        let audience = &state.audience;
        let mapped = |number| audience.has_mapped(number);
        let object = self
            .session
            .allocate(bytes, Need::Now, mapped)
            .map_err(|error| no_memory(error, bytes))?
            .expect("there is always one that will do");
        state.maps.add(&object);
        Ok(object.block)
    }

    fn give_blocks_back(&self, state: &mut State) {
        // Others write there from now on.
        self.show_tail(state);
        state.history.blocks().drain().for_each(|block| self.session.release(block));
    }

    /// Has a segment for samples that readers pin.
    pub(super) fn open_samples(&self, state: &mut State) -> Result<(), ShmError> {
        if state.samples.is_none() {
            let options = self.options();
            let bytes = layout::samples_bytes(options.budget, options.max_message, RECORDS as u64);
            let segment = self.session.open_samples(options.gid, bytes)?;
            state.history.pinned().open(SLOTS_AT..bytes);
            state.samples = Some(Samples { segment, committed: SLOTS_AT });
        }
        Ok(())
    }

    /// Takes `bytes`, more than [`COPIED`], that no reader reads.
    pub(super) fn lend(&self, state: &mut State, bytes: u64) -> Result<Place, Refusal> {
        debug_assert!(bytes > COPIED);
        self.open_samples(state).map_err(|error| no_memory(error, bytes))?;
        let floors = state.audience.floors(state.history.head());
        let may_go = |position| position < floors.held;
        state.history.release_below(floors.retained);
        state.history.make_room(bytes, may_go)?;
        let mut short = None;
        for look in 0.. {
            self.reclaim(state);
            if let (Some(at), Some(samples)) = (state.history.lend(bytes), &mut state.samples) {
                match samples.back(at + bytes) {
                    Ok(()) => return Ok(Place { segment: Arc::clone(&samples.segment), at }),
                    Err(error) => {
                        state.history.give_back(at, bytes);
                        short = Some(error);
                    }
                }
            }
            // What stands lower may be large enough, or backed already.
            match (state.history.shrink(may_go), short.take()) {
                (Ok(true), _) => continue,
                (_, Some(error)) => return Err(error.into()),
                (Err(Held), None) => return Err(Refusal::Held),
                (Ok(false), None) => {}
            }
            let retired: Vec<u64> = state.history.pinned().retired().collect();
            if retired.is_empty() {
                let loans = state.history.pinned().loans();
                return Err(PublishError::Loaned { loans }.into());
            }
            let samples = retired.len();
            match state.audience.holder(&retired) {
                Some(reader) => return Err(PublishError::Pinned { reader, samples }.into()),
                // Whoever pinned them has let go, or died, just now. One that does so for ever is
                // out for trouble.
                None if look < LOOKS => {}
                None => return Err(PublishError::Pinned { reader: self.gid(), samples }.into()),
            }
        }
        unreachable!("the looks are counted")
    }

    /// Frees what was given up and is not read by anybody.
    pub(super) fn reclaim(&self, state: &mut State) {
        if state.history.pinned().retired().len() == 0 {
            return;
        }
        self.show_tail(state);
        pins::about_to_scan::<AtomicU64>();
        let State { history, audience, found, .. } = state;
        found.clear();
        audience.scan(found);
        history.pinned().reclaim(|position| found.contains(&position));
    }

    /// Tells readers what has been given up. Before any of it is written over.
    fn show_tail(&self, state: &mut State) {
        if state.shown_tail != state.history.tail() {
            state.shown_tail = state.history.tail();
            ring::retire(self.ring.words(), state.shown_tail);
        }
    }
}
