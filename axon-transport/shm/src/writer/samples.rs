//! The memory of a publisher's large samples, which readers read in place. The publisher has separate segments for
//! it, opens them with the first such sample, and closes them when it no longer needs them.

use std::{
    sync::{Arc, atomic::AtomicU64},
    time::Instant,
};

use crate::{
    alloc::{
        budget::Holding,
        pin_limit::samples_bytes,
        retention::Retention,
        segments::{OwnSegment, SegmentEvent},
        slots::TURNS,
    },
    error::{PublishError, ShmError},
    ring::{
        layout::{self, COPIED_ALWAYS, Location, SLOTS_AT},
        pins::{self, RECORDS},
        protocol,
    },
    session::pin_lanes::PinningReader,
    writer::{
        LOOKS, Writer, WriterState,
        header::Dropped,
        history::OldestInUse,
        loan::LoanLocation,
        reclaim::{PinnedMemory, PublishObstacle, least_kept, no_memory},
    },
};

/// Maximum number of segments of one publisher: while readers keep all samples of one segment, another takes over.
const SEGMENTS: usize = 4;
/// Maximum number of bytes that are committed beyond the need.
const AHEAD: u64 = 1 << 20;

/// The segment that takes new samples.
pub(crate) struct Samples {
    segment: Arc<OwnSegment>,
    retention: Retention,
    /// The length in bytes of the last sample, when no slot is ready for another like it.
    ahead: Option<u64>,
    /// Number of slots that may be taken before the readers are checked again.
    turns: u32,
}

/// Backs a segment with memory up to `end`, and a little further if it keeps growing. Returns the new end of the backed
/// memory.
fn back(
    segment: &OwnSegment,
    holding: &mut Holding,
    backed: u64,
    end: u64,
) -> Result<u64, PublishError> {
    let ahead = backed + ((backed - SLOTS_AT) / 8).min(AHEAD);
    let memory = &segment.memory;
    let upto = end.max(ahead).next_multiple_of(layout::ALIGN).min(memory.bytes());
    holding.take(upto - backed).map_err(no_memory)?;
    let committed = memory.commit(backed, upto);
    committed.inspect_err(|_| holding.give_back(upto - backed)).map_err(no_memory)?;
    memory.touch(backed, upto);
    Ok(upto)
}

impl Writer {
    /// Prepares memory for one more sample like the last large one, so that publishing it does not wait for memory: for
    /// a caller that has time between samples. [`SegmentEvent::Low`] reports when to call it.
    ///
    /// # Errors
    /// There is no memory, or the process forked.
    pub fn prepare(&self) -> Result<(), ShmError> {
        if self.is_forked() {
            return Err(ShmError::Forked);
        }
        let (segment, at, len, from, end) = {
            let mut state = self.lock();
            let Some(samples) = &mut state.samples else { return Ok(()) };
            let Some(len) = samples.ahead.take() else { return Ok(()) };
            let segment = Arc::clone(&samples.segment);
            let pinned = state.history.pinned();
            let Some(at) = pinned.take(len) else { return Ok(()) };
            let slots = pinned.slots(at);
            let (from, end) = (slots.backed(), slots.end(at.offset, len));
            if end <= from {
                pinned.put_back(at, len);
                return Ok(());
            }
            let end = end.next_multiple_of(layout::ALIGN).min(segment.memory.bytes());
            if let Err(error) = state.holding.take(end - from) {
                state.history.pinned().release_unbacked(at, len);
                return Err(error);
            }
            (segment, at, len, from, end)
        };
        // The memory belongs to this call meanwhile, so this needs no lock. If a publish backs some of it, too, that
        // does no harm.
        let committed = segment.memory.commit(from, end);
        if committed.is_ok() {
            segment.memory.touch(from, end);
        }
        let mut state = self.lock();
        let WriterState { history, holding, .. } = &mut *state;
        let pinned = history.pinned();
        match committed {
            Ok(()) => {
                let slots = pinned.slots(at);
                // A publish that backed some of it meanwhile has taken it from the budget, too.
                holding.give_back(slots.backed().min(end) - from);
                slots.back(end);
                pinned.put_back(at, len);
            }
            Err(_) => {
                holding.give_back(end - from);
                pinned.release_unbacked(at, len);
            }
        }
        committed
    }

    /// Gives memory of large samples back that is not needed any more: all of it if there was no such sample for ten
    /// seconds and none is wanted, or else the part far above the need of the last ten seconds. Returns whether
    /// memory of large samples is left. To be called about once a second while it returns true.
    pub fn reclaim_idle(&self, now: Instant) -> bool {
        if self.is_forked() {
            return false;
        }
        let mut state = self.lock();
        let WriterState { history, reader_set, .. } = &mut *state;
        if history.pinned().segments().len() == 0 {
            return false;
        }
        reader_set.sweep();
        let floors = reader_set.floors(history.head());
        history.release_below(floors.retained.max(reader_set.consumed(history.head())));
        self.reclaim(&mut state);
        let WriterState { history, samples, holding, .. } = &mut *state;
        // If other rings are short of memory, unused memory goes to them at once.
        let short = holding.is_short();
        if let (Some(open), Some((used, backed))) = (samples.as_mut(), history.pinned().extent())
            && (open.retention.is_over(now, used, backed - SLOTS_AT) || short && used == 0)
        {
            history.pinned().leave();
            *samples = None;
        }
        self.close_vacated(&mut state);
        state.history.pinned().segments().len() > 0
    }

    /// Makes sure that there is a segment that takes new samples.
    pub(crate) fn open_samples(&self, state: &mut WriterState) -> Result<(), ShmError> {
        if state.samples.is_none() { self.open_another(state) } else { Ok(()) }
    }

    /// Opens a new segment for new samples. The samples in the last segment stay there.
    fn open_another(&self, state: &mut WriterState) -> Result<(), ShmError> {
        let options = self.options();
        let bytes = samples_bytes(options.budget, options.max_message, RECORDS as u64);
        state.holding.take(SLOTS_AT)?;
        let opened = self.session.open_samples(options.gid, bytes);
        let segment = opened.inspect_err(|_| state.holding.give_back(SLOTS_AT))?;
        state.history.pinned().open(segment.number(), SLOTS_AT..bytes);
        let retention = Retention::begin(Instant::now());
        state.samples = Some(Samples { segment, retention, ahead: None, turns: 0 });
        Ok(())
    }

    /// Lends `bytes`, more than [`COPIED_ALWAYS`], that no reader reads.
    pub(crate) fn lend(
        &self,
        state: &mut WriterState,
        bytes: u64,
    ) -> Result<LoanLocation, PublishObstacle> {
        debug_assert!(bytes > COPIED_ALWAYS);
        self.open_samples(state).map_err(no_memory)?;
        if let Some(place) = self.next_turn(state, bytes) {
            return Ok(place);
        }
        let floors = state.reader_set.floors(state.history.head());
        let may_go = |position| position < floors.held;
        // Samples that all readers have taken go first: their memory is the warmest.
        let consumed = state.reader_set.consumed(state.history.head());
        state.history.release_below(floors.retained.max(consumed));
        let mut short = None;
        if state.history.is_short_of(bytes) {
            // This sample takes more memory in any case, so the memory is allocated before anything is given up for it.
            self.reclaim(state);
            match self.place(state, bytes, true) {
                Ok(Some(place)) => {
                    return match state.history.make_room(0, may_go) {
                        Ok(()) => Ok(place),
                        Err(held) => {
                            let at = Location { segment: place.segment.number(), offset: place.at };
                            state.history.give_back(at, bytes);
                            Err(held.into())
                        }
                    };
                }
                Ok(None) => {}
                Err(error) => short = Some(error),
            }
        }
        if short.is_none() {
            state.history.make_room(bytes, may_go)?;
        }
        let mut worthwhile = None;
        for look in 0.. {
            self.reclaim(state);
            // More memory is requested once: after that, only existing memory is used.
            match self.place(state, bytes, short.is_none()) {
                Ok(Some(place)) => return Ok(place),
                Ok(None) => {}
                Err(error) => {
                    short = Some(error);
                    worthwhile = None;
                }
            }
            let kept: Vec<u64> = state.history.pinned().retired().collect();
            // Readers may keep all samples of a segment; another segment then takes over.
            let segments = state.history.pinned().segments().len();
            if short.is_none() && !kept.is_empty() && segments < SEGMENTS {
                match self.open_another(state).map_err(no_memory) {
                    Ok(()) => {}
                    Err(error) => short = Some(error),
                }
                continue;
            }
            // Older samples may be large enough, or backed already. But nothing is given up for a sample that does not
            // fit even after that.
            let history = &mut state.history;
            let stay = short.as_ref().map_or(1, least_kept);
            let would_hold = || history.would_hold(bytes, stay, short.is_none());
            if *worthwhile.get_or_insert_with(would_hold) {
                match history.shrink(stay, may_go) {
                    Ok(true) => {
                        if short.is_some() {
                            self.header.count(Dropped::NoMemory);
                        }
                        continue;
                    }
                    // Space that the reader frees is enough, whether or not there is memory.
                    Err(OldestInUse) => return Err(PublishObstacle::OldestInUse { short }),
                    Ok(false) => {}
                }
            }
            if kept.is_empty() {
                let loans = state.history.pinned().loans();
                return Err(short.unwrap_or(PublishError::Loaned { loans }).into());
            }
            match state.reader_set.holder(&kept) {
                // The reader that pinned them has just released them, or died. A reader that keeps
                // doing this is misbehaving.
                None if look < LOOKS => {}
                holder => {
                    let holder = holder.unwrap_or(PinningReader { reader: self.gid(), peer: None });
                    return Err(PublishObstacle::Pinned(PinnedMemory {
                        holder,
                        samples: kept.len(),
                        short,
                    }));
                }
            }
        }
        unreachable!("the looks are counted")
    }

    /// Returns a free slot while slots take turns: finding out which samples readers have taken costs cache lines that
    /// they have just written, and is not necessary for each sample.
    fn next_turn(&self, state: &mut WriterState, bytes: u64) -> Option<LoanLocation> {
        let WriterState { history, samples: Some(samples), .. } = state else { return None };
        let Some(turns) = samples.turns.checked_sub(1) else {
            samples.turns = TURNS - 1;
            return None;
        };
        let at = history.lend_turn(bytes)?;
        samples.turns = turns;
        // If there is no memory for it, only the turns end.
        self.settled(state, at, bytes, true).ok().flatten()
    }

    /// Returns a place in the segment that takes new samples; `None` if it is full, or if it has no backed place and
    /// must not `grow`.
    fn place(
        &self,
        state: &mut WriterState,
        bytes: u64,
        grow: bool,
    ) -> Result<Option<LoanLocation>, PublishError> {
        match state.history.lend(bytes) {
            Some(at) => self.settled(state, at, bytes, grow),
            None => Ok(None),
        }
    }

    /// Backs the lent place with memory, and returns it. Returns `None`, and withdraws the loan, if memory has to be
    /// added and must not `grow`.
    fn settled(
        &self,
        state: &mut WriterState,
        at: Location,
        bytes: u64,
        grow: bool,
    ) -> Result<Option<LoanLocation>, PublishError> {
        let WriterState { history, samples: Some(samples), holding, .. } = state else {
            return Ok(None);
        };
        let slots = history.pinned().slots(at);
        let end = slots.end(at.offset, bytes);
        let is_open = at.segment == samples.segment.number();
        let segment = match is_open {
            true => Arc::clone(&samples.segment),
            false => self.session.own(at.segment).expect("a segment that was left is not closed"),
        };
        if end > slots.backed() {
            let backed = match grow {
                true => back(&segment, holding, slots.backed(), end).map(Some),
                false => Ok(None),
            };
            match backed {
                Ok(Some(upto)) => slots.back(upto),
                other => {
                    history.withdraw(at, bytes);
                    return other.map(|_| None);
                }
            }
        }
        if is_open {
            samples.retention.used(slots.used());
            if samples.ahead.is_none() && !slots.has_another(bytes) {
                samples.ahead = Some(bytes);
                self.session.tell(SegmentEvent::Low(self.gid()));
            }
        }
        // Readers that copy without a pin detect by this that the memory is overwritten.
        protocol::about_to_write::<AtomicU64>();
        Ok(Some(LoanLocation { segment, at: at.offset }))
    }

    /// Frees samples that were given up and that no reader reads.
    pub(crate) fn reclaim(&self, state: &mut WriterState) {
        if state.history.pinned().retired().len() > 0 {
            self.show_tail(state);
            pins::about_to_scan::<AtomicU64>();
            let WriterState { history, reader_set, pinned, .. } = state;
            pinned.refresh(|pinned| reader_set.scan(pinned));
            history.pinned().reclaim(|position, len| pinned.keeps(position, len));
        }
        self.close_vacated(state);
    }

    /// Closes segments that take no new samples and that no reader reads any more.
    fn close_vacated(&self, state: &mut WriterState) {
        for (number, backed) in state.history.pinned().vacated() {
            state.holding.give_back(backed);
            self.session.close_samples(number);
        }
    }
}
