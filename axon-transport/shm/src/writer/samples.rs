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

/// Segments of one publisher at most: while readers keep all that one holds, another takes over.
const SEGMENTS: usize = 4;
/// Bytes that are committed at most beyond what is needed.
const AHEAD: u64 = 1 << 20;

/// The segment that takes samples in.
pub(crate) struct Samples {
    segment: Arc<OwnSegment>,
    retention: Retention,
    /// The length in bytes of the last sample, when no slot is ready for another like it.
    ahead: Option<u64>,
    /// Slots that may be taken before readers are looked at again.
    turns: u32,
}

/// Backs a segment with memory up to `end`, a little further when it keeps growing. Up to where.
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
    /// Has memory ready for one more sample like the last large one, so that publishing it waits
    /// for none: for a caller that has time between samples. [`SegmentEvent::Low`] tells when to.
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
        // It is nobody else's meanwhile, so this needs no lock. That a publish backs some of it,
        // too, does no harm.
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
                // What a publish backed meanwhile it took, too.
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

    /// Gives memory of large samples back that is not needed any more: all of it once there was
    /// no such sample for ten seconds and none is wanted, else what is far more than was needed
    /// for as long. To be called about once a second for as long as it says that there is any.
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
        // Where other rings want for memory, what is not in use goes to them at once.
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

    /// Has a segment that takes samples in.
    pub(crate) fn open_samples(&self, state: &mut WriterState) -> Result<(), ShmError> {
        if state.samples.is_none() { self.open_another(state) } else { Ok(()) }
    }

    /// Has a new segment take samples in. What is in the last one stays there.
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

    /// Takes `bytes`, more than [`COPIED_ALWAYS`], that no reader reads.
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
        // What all readers have taken goes first: its memory is the warmest.
        let consumed = state.reader_set.consumed(state.history.head());
        state.history.release_below(floors.retained.max(consumed));
        let mut short = None;
        if state.history.is_short_of(bytes) {
            // It takes more memory in any case, so that is had before anything is given up for it.
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
            // Asked once: from then on only memory that there is.
            match self.place(state, bytes, short.is_none()) {
                Ok(Some(place)) => return Ok(place),
                Ok(None) => {}
                Err(error) => {
                    short = Some(error);
                    worthwhile = None;
                }
            }
            let kept: Vec<u64> = state.history.pinned().retired().collect();
            // Readers keep what there is of it, which is their right.
            let segments = state.history.pinned().segments().len();
            if short.is_none() && !kept.is_empty() && segments < SEGMENTS {
                match self.open_another(state).map_err(no_memory) {
                    Ok(()) => {}
                    Err(error) => short = Some(error),
                }
                continue;
            }
            // What stands lower may be large enough, or backed already. But nothing is given up for
            // a sample that not even all of it makes room for.
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
                    // Room that the reader makes will do, whether or not there is memory.
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

    /// A slot at hand, as long as slots take turns: to find out what readers have taken costs lines
    /// that they have just written to, and need not be done for each sample.
    fn next_turn(&self, state: &mut WriterState, bytes: u64) -> Option<LoanLocation> {
        let WriterState { history, samples: Some(samples), .. } = state else { return None };
        let Some(turns) = samples.turns.checked_sub(1) else {
            samples.turns = TURNS - 1;
            return None;
        };
        let at = history.lend_turn(bytes)?;
        samples.turns = turns;
        // That there is no memory for it only ends the turns.
        self.settled(state, at, bytes, true).ok().flatten()
    }

    /// A place in the segment that takes samples in; `None` when that is full, or has none that is
    /// backed and must not `grow`.
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

    /// What was lent, in memory that there is.
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
        // Readers that copy without a pin find out by this that it is written over.
        protocol::about_to_write::<AtomicU64>();
        Ok(Some(LoanLocation { segment, at: at.offset }))
    }

    /// Frees what was given up and is not read by anybody.
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

    /// Gives segments up that were left and that nobody reads any more.
    fn close_vacated(&self, state: &mut WriterState) {
        for (number, backed) in state.history.pinned().vacated() {
            state.holding.give_back(backed);
            self.session.close_samples(number);
        }
    }
}
