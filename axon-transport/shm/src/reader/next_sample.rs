//! Finds a reader's next sample: passes skipped and lost samples, and handles segments that have not arrived yet.

use std::{
    ops::Range,
    sync::{Arc, atomic::AtomicU64},
    time::Instant,
};

use super::{ATTEMPTS, Attachment, Reader, awaited::Wait};
use crate::{
    error::TakeError,
    memory::{copy, segment::Map},
    reader::sample::MappedRange,
    ring::{
        layout::{self, Array, COPIED, COPIED_ALWAYS},
        protocol::{self, PayloadLocation, PositionState, Record, RecordRead, View},
    },
    session::peer::SegmentLookup,
};

/// The reason why a reader cannot read a sample.
pub(super) enum ReadObstacle {
    Missing(u32),
    Corrupt(&'static str),
}

/// The location of a ring's descriptors.
pub(super) struct Descriptors {
    /// The ring's word that describes the location.
    pub(super) word: u64,
    map: Arc<Map>,
    words: Range<usize>,
}

impl Descriptors {
    #[inline]
    pub(super) fn view<'a>(&'a self, attachment: &'a Attachment) -> View<'a, AtomicU64> {
        let array = &self.map.words()[self.words.clone()];
        View { ring: attachment.ring(), word: self.word, array }
    }
}

impl Reader {
    /// Returns the record at the cursor, after moving the cursor past all skipped and lost samples.
    pub(super) fn find(&mut self) -> Result<Option<Record>, TakeError> {
        if self.attachment.lane.is_forked() {
            return Err(TakeError::Forked);
        }
        if let Some(what) = self.corrupt {
            return Err(TakeError::Corrupt { writer: self.reads.writer, what });
        }
        if self.given_up {
            return Ok(None);
        }
        match self.find_sane() {
            Ok(found) => {
                if found.is_none() {
                    // Nothing at the cursor needs the segment.
                    self.awaited.clear();
                }
                Ok(found)
            }
            Err(ReadObstacle::Missing(segment)) if self.lacks(segment) => {
                // The descriptors will never be found, and so no sample.
                self.give_all_up().map_err(|what| self.corrupt(what)).map(|()| None)
            }
            // The head tells without the descriptors which samples are skipped. A reader that left them at its cursor
            // would have data and find none, again and again.
            Err(ReadObstacle::Missing(_)) => match self.count(0) {
                Err(ReadObstacle::Corrupt(what)) => Err(self.corrupt(what)),
                _ => Ok(None),
            },
            Err(ReadObstacle::Corrupt(what)) => Err(self.corrupt(what)),
        }
    }

    fn find_sane(&mut self) -> Result<Option<Record>, ReadObstacle> {
        for _ in 0..ATTEMPTS {
            let word = protocol::array(self.attachment.ring());
            if self.descriptors.as_ref().is_none_or(|known| known.word != word) {
                self.descriptors = None;
                self.descriptors = Some(self.resolve(word)?);
            }
            let Some(descriptors) = &self.descriptors else { return Ok(None) };
            let (cursor, depth) = (self.cursor, self.reads.depth);
            let view = descriptors.view(&self.attachment);
            match view.state(cursor) {
                PositionState::Ahead if cursor >= self.seen => return Ok(None),
                PositionState::Here => {
                    // One read tells whether more samples than the depth are unread, if that many are possible.
                    let descriptors = (view.array.len() / layout::DESCRIPTOR_WORDS) as u64;
                    let late =
                        depth < descriptors && view.state(cursor + depth) != PositionState::Ahead;
                    let mut head = 0;
                    if late {
                        // The head may not include it yet, or never, if the publisher died.
                        head = if view.stands(cursor) { cursor + depth + 1 } else { 0 };
                    } else {
                        match view.look(cursor) {
                            RecordRead::Sample(record) => return Ok(Some(record)),
                            RecordRead::Lapped => {}
                            RecordRead::Corrupt(what) => return Err(ReadObstacle::Corrupt(what)),
                        }
                    }
                    self.count(head)?;
                }
                PositionState::Ahead | PositionState::Gone => {
                    let wrong = view.stands(cursor);
                    self.count(0)?;
                    if wrong && self.cursor == cursor {
                        let what = "a descriptor that stands carries another position";
                        return Err(ReadObstacle::Corrupt(what));
                    }
                }
            }
        }
        Ok(None)
    }

    /// Counts the skipped and the lost samples, by the tail and by the head, which is at least `least`.
    fn count(&mut self, least: u64) -> Result<(), ReadObstacle> {
        let (tail, head) =
            protocol::bounds(self.attachment.ring()).map_err(ReadObstacle::Corrupt)?;
        let head = head.max(least);
        // A sample may be taken by its stamp before the head includes it.
        if head + 1 < self.cursor {
            return Err(ReadObstacle::Corrupt("its head went back"));
        }
        self.seen = head;
        let unread = head.saturating_sub(self.cursor);
        if unread > self.reads.depth {
            self.skipped += unread - self.reads.depth;
            self.advance(head - self.reads.depth);
        }
        if self.cursor < tail {
            self.lost += tail - self.cursor;
            self.advance(tail);
        }
        Ok(())
    }

    /// Skips all untaken samples but the newest `depth`, without reading their bytes. As if the subscription had that
    /// depth, they count as skipped; samples among the rest that were overwritten count as lost.
    pub fn skip_to_depth(&mut self, depth: u64) {
        if self.corrupt.is_some() || self.given_up || self.attachment.lane.is_forked() {
            return;
        }
        // The next take reports an error of the memory.
        let Ok((_, head)) = protocol::bounds(self.attachment.ring()) else { return };
        let unread = head.saturating_sub(self.cursor);
        if unread > depth {
            self.awaited.clear();
            self.skipped += unread - depth;
            self.advance(head - depth);
        }
    }

    /// Returns the location of the descriptors that the ring's word describes.
    pub(super) fn resolve(&self, word: u64) -> Result<Descriptors, ReadObstacle> {
        let wrong = ReadObstacle::Corrupt("its descriptors are nowhere");
        let Some(Array { at, descriptors }) = Array::from_word(word) else { return Err(wrong) };
        let map = match self.reads.peer.find(at.segment) {
            SegmentLookup::Map(map) => map,
            SegmentLookup::Refused => return Err(wrong),
            SegmentLookup::Absent => return Err(ReadObstacle::Missing(at.segment)),
        };
        match at.words(descriptors * layout::DESCRIPTOR, map.words().len()) {
            Some(words) => Ok(Descriptors { word, map, words }),
            None => Err(wrong),
        }
    }

    /// Like [`find`](Self::find), with the location of the sample's bytes. Samples that are longer than the
    /// subscription expects are skipped.
    pub(super) fn find_whole(&mut self) -> Result<Option<(Record, Bytes)>, TakeError> {
        for _ in 0..ATTEMPTS {
            let Some(record) = self.find()? else { return Ok(None) };
            let (len, max) = (u64::from(record.len), self.reads.max_message);
            if len > max {
                self.lose();
                return Err(TakeError::TooLarge { writer: self.reads.writer, len, max });
            }
            match self.locate(&record) {
                Ok(bytes) => {
                    self.awaited.clear();
                    return Ok(Some((record, bytes)));
                }
                Err(ReadObstacle::Missing(segment)) => {
                    if !self.lacks(segment) {
                        return Ok(None);
                    }
                    self.lose();
                }
                Err(ReadObstacle::Corrupt(what)) => return Err(self.corrupt(what)),
            }
        }
        Ok(None)
    }

    /// Returns the location of the bytes of a record that was valid when it was read.
    fn locate(&mut self, record: &Record) -> Result<Bytes, ReadObstacle> {
        let (at, slot) = match record.place {
            PayloadLocation::Inline => return Ok(Bytes::Inline),
            PayloadLocation::Block(at) => (at, false),
            PayloadLocation::Slot(at) => (at, true),
        };
        let len = u64::from(record.len);
        if slot && len <= COPIED_ALWAYS || !slot && len > COPIED {
            return Err(ReadObstacle::Corrupt("a sample is in the wrong kind of place"));
        }
        let map = match self.segments.find(&self.reads.peer, at.segment) {
            SegmentLookup::Map(map) => map,
            SegmentLookup::Refused => {
                return Err(ReadObstacle::Corrupt("a sample is in memory that was refused"));
            }
            SegmentLookup::Absent => return Err(ReadObstacle::Missing(at.segment)),
        };
        let outside = ReadObstacle::Corrupt("a sample lies outside its segment");
        let limit = map.words().len();
        if slot {
            let words = at.words_of(len, limit).ok_or(outside)?;
            let skip = (at.offset % 8) as usize;
            return Ok(Bytes::Slot(MappedRange { map, words, skip }));
        }
        let words = at.words(len, limit).ok_or(outside)?;
        Ok(Bytes::Block(MappedRange { map, words, skip: 0 }))
    }

    /// Returns whether a pin may keep the sample in place; otherwise it is copied like a sample in a block.
    pub(super) fn may_pin(&self, record: &Record) -> bool {
        u64::from(record.len) <= self.reads.in_place
    }

    /// Appends a copy of the payload at the cursor to `out`. Returns false if the publisher was faster; the appended
    /// bytes are then of no use.
    pub(super) fn copy_to(
        &self,
        record: &Record,
        bytes: &Bytes,
        out: &mut Vec<u8>,
    ) -> Result<bool, TakeError> {
        let len = record.len as usize;
        let Some(descriptors) = &self.descriptors else { return Ok(false) };
        let view = descriptors.view(&self.attachment);
        let mut copy = |words: &[AtomicU64], skip| {
            copy::append(words, skip, len, out).map_err(|_| TakeError::NoMemory { len: len as u64 })
        };
        match bytes {
            Bytes::Inline => copy(view.inline(self.cursor), 0)?,
            Bytes::Slot(there) if self.may_pin(record) => {
                let copy = || copy(there.words(), there.skip);
                let pinned = self.attachment.while_pinned(self.cursor, copy);
                return pinned.transpose().map(|copied| copied.is_some());
            }
            Bytes::Block(there) | Bytes::Slot(there) => copy(there.words(), there.skip)?,
        }
        Ok(view.stands(self.cursor))
    }

    /// Records that `segment` has not come, and requests it again from time to time. Returns true if it never will
    /// come: none of the samples in it can be read then.
    fn lacks(&mut self, segment: u32) -> bool {
        let peer = &self.reads.peer;
        let wait = self.awaited.handle_missing(segment, Instant::now(), || peer.is_dead());
        if wait == Wait::Ask
            && let Some(session) = peer.remote()
        {
            session.want(segment);
        }
        wait == Wait::InVain
    }

    /// Counts all published samples as lost, and gives up the ring.
    fn give_all_up(&mut self) -> Result<(), &'static str> {
        let (_, head) = protocol::bounds(self.attachment.ring())?;
        self.given_up = true;
        self.awaited.clear();
        self.lost += head.saturating_sub(self.cursor);
        self.advance(head.max(self.cursor));
        Ok(())
    }

    /// Counts the sample at the cursor as lost.
    fn lose(&mut self) {
        self.lost += 1;
        self.advance(self.cursor + 1);
    }
}

/// The location of a sample's bytes.
pub(super) enum Bytes {
    /// In the sample's descriptor.
    Inline,
    /// In a block: they are copied, and checked afterwards.
    Block(MappedRange),
    /// In a slot: they are pinned, if the reader [may](Reader::may_pin).
    Slot(MappedRange),
}
