//! How a publisher gets room for the next sample: slots, memory, and what it gives up for them.

use std::sync::atomic::AtomicU64;

use super::{
    PublishError, ShmError, Writer,
    area::Area,
    headroom,
    history::Held,
    layout::{self, COPIED, RingLayout},
    pins, ring,
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

/// What of a segment is backed by memory, besides its first [`layout::ALIGN`] bytes.
pub(super) struct Committed {
    slots: Part,
    copied: Part,
    pinned: Part,
}

/// A part of a segment that is backed from its start up to `end`. In bytes of the segment.
struct Part {
    start: u64,
    end: u64,
    limit: u64,
}

impl Committed {
    /// Of a new ring.
    pub(super) fn new(layout: &RingLayout) -> Self {
        let part = |start, limit| Part { start, end: start, limit };
        let payload = layout.payload_at();
        let pinned = payload + layout.copied_bytes();
        Self {
            slots: part(layout::ALIGN, payload),
            copied: part(payload, pinned),
            pinned: part(pinned, layout.bytes()),
        }
    }
}

impl Writer {
    /// Makes sure that the next position has a slot.
    pub(super) fn slot(&self, state: &mut State) -> Result<(), Refusal> {
        let State { history, audience, .. } = state;
        let floors = audience.floors(history.head());
        history.release_below(floors.retained);
        history.slot(|position| position < floors.held)?;
        let end = self.layout.slot_end(history.head());
        self.back(&mut state.committed.slots, end)?;
        self.show_tail(state);
        Ok(())
    }

    /// Copies at most [`COPIED`] bytes in for the next position, which has a slot.
    pub(super) fn copy_in(&self, state: &mut State, payload: &[u8]) -> Result<u64, Refusal> {
        debug_assert!(payload.len() as u64 <= COPIED);
        let bytes = Area::rounded(payload.len() as u64);
        let State { history, audience, .. } = state;
        let floors = audience.floors(history.head());
        let at = history.place(bytes, |position| position < floors.held)?;
        let end = self.layout.payload_at() + at + bytes;
        if let Err(error) = self.back(&mut state.committed.copied, end) {
            state.history.displace(at, bytes);
            return Err(error.into());
        }
        self.show_tail(state);
        ring::about_to_write::<AtomicU64>();
        let words = self.layout.geometry().payload(self.segment.words(), at, bytes);
        ring::copy_in(words.expect("what was allocated lies inside the area"), payload);
        Ok(at)
    }

    /// Takes `bytes`, more than [`COPIED`], that no reader reads.
    pub(super) fn lend(&self, state: &mut State, bytes: u64) -> Result<u64, Refusal> {
        debug_assert!(bytes > COPIED);
        let floors = state.audience.floors(state.history.head());
        let may_go = |position| position < floors.held;
        state.history.release_below(floors.retained);
        state.history.make_room(bytes, may_go)?;
        let mut short = None;
        for look in 0.. {
            self.reclaim(state);
            if let Some(at) = state.history.lend(bytes) {
                let end = self.layout.payload_at() + at + bytes;
                match self.back(&mut state.committed.pinned, end) {
                    Ok(()) => return Ok(at),
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
    fn reclaim(&self, state: &mut State) {
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

    /// Backs a part with memory up to `end`, a little further when it keeps growing.
    fn back(&self, part: &mut Part, end: u64) -> Result<(), PublishError> {
        if end <= part.end {
            return Ok(());
        }
        let ahead = part.end + (part.end - part.start) / 8;
        let upto = end.max(ahead).next_multiple_of(layout::ALIGN).min(part.limit);
        self.segment.commit(part.end, upto).map_err(|error| match error {
            ShmError::NoMemory { needed, available } => {
                PublishError::NoMemory { needed, available }
            }
            _ => PublishError::NoMemory {
                needed: upto - part.end,
                available: headroom::available().unwrap_or(0),
            },
        })?;
        part.end = upto;
        Ok(())
    }

    /// Tells readers what has been given up. Before any of it is written over.
    fn show_tail(&self, state: &mut State) {
        if state.shown_tail != state.history.tail() {
            state.shown_tail = state.history.tail();
            ring::retire(self.segment.words(), &self.layout.geometry(), state.shown_tail);
        }
    }
}
