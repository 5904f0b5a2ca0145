//! The taking end of a ring.

use std::{
    os::fd::AsFd,
    sync::{Arc, atomic::AtomicU64},
};

use super::{
    Grant, Lane, Meta, Peer, Sample, ShmError, TakeError, Taken,
    attachment::{Attachment, Pinning},
    audience::{depth, holds},
    layout::{COPIED, RingLayout},
    memory::Map,
    ring::{self, Look, Record},
};
use crate::{
    ids::Gid,
    qos::Qos,
    wait::{Purpose, settle},
};

/// How often a take follows a publisher that keeps overtaking it before it lets go.
const ATTEMPTS: u32 = 16;

/// What a reader must know of the ring that it is granted.
pub struct ReaderOptions {
    /// The subscription.
    pub reader: Gid,
    /// The publisher.
    pub writer: Gid,
    /// The publisher's session.
    pub peer: Peer,
    /// The lane by which the reader attached.
    pub lane: Lane,
    /// The publisher's answer.
    pub grant: Grant,
    /// What the subscription requests.
    pub qos: Qos,
    /// The largest sample to expect, in bytes.
    pub max_message: u64,
}

/// One subscription's view of one publisher's ring.
///
/// Goes on after the publisher's death until it is drained. Dropping it tells the publisher; the
/// samples that were taken from it stay.
pub struct Reader {
    reads: Reads,
    attachment: Arc<Attachment>,
    cursor: u64,
    received: u64,
    lost: u64,
    skipped: u64,
    corrupt: Option<&'static str>,
}

/// What does not change.
struct Reads {
    writer: Gid,
    peer: Peer,
    grant: Grant,
    depth: u64,
    max_message: u64,
    /// Whether a publisher may wait for it.
    holds: bool,
}

impl Reader {
    /// Checks and maps a ring, and opens the lane.
    ///
    /// # Errors
    /// The descriptor is not a ring, or not this publisher's.
    pub fn map(ring: impl AsFd, options: ReaderOptions) -> Result<Self, ShmError> {
        let ReaderOptions { reader, writer, peer, lane, grant, qos, max_message } = options;
        if lane.is_forked() {
            return Err(ShmError::Forked);
        }
        let map = Map::open(ring.as_fd())?;
        let layout = RingLayout::read(map.words(), writer)?;
        lane.open(grant, reader, writer);
        let holds = holds(&qos) && peer.remote().is_some();
        Ok(Self {
            attachment: Attachment::new(map, layout.geometry(), lane),
            cursor: grant.first,
            received: 0,
            lost: 0,
            skipped: 0,
            corrupt: None,
            reads: Reads { writer, peer, grant, depth: depth(&qos), max_message, holds },
        })
    }

    /// Whether there is something to take: two loads.
    pub fn has_data(&self) -> bool {
        self.unread() > 0
    }

    /// How many samples are to be taken; at most the subscription's depth.
    pub fn unread(&self) -> u64 {
        match (self.corrupt, ring::bounds(self.attachment.words(), &self.attachment.geometry)) {
            (None, Ok((tail, head))) => {
                head.saturating_sub(self.cursor.max(tail)).min(self.reads.depth)
            }
            // The next take says what is wrong.
            (None, Err(_)) => 1,
            (Some(_), _) => 0,
        }
    }

    /// What goes with the next sample, without taking it.
    ///
    /// # Errors
    /// The ring cannot be read.
    pub fn peek(&mut self) -> Result<Option<Meta>, TakeError> {
        Ok(self.find()?.map(|record| meta(&record)))
    }

    /// Takes the next sample, with its payload in place of what `out` held.
    ///
    /// Samples that are older than the subscription's depth are skipped; samples within it that
    /// the publisher has overwritten are lost. Both are counted. `None` when there is nothing, or
    /// when the publisher was faster time and again ([`has_data`](Self::has_data) then holds).
    ///
    /// # Errors
    /// The ring cannot be read, or the sample is longer than the subscription expects: that one is
    /// passed over and lost. Or memory for it is short: it can be taken later. `out` holds nothing
    /// useful.
    pub fn take(&mut self, out: &mut Vec<u8>) -> Result<Option<Taken>, TakeError> {
        for _ in 0..ATTEMPTS {
            let Some(record) = self.find_fitting()? else { break };
            if self.copy_out(&record, out)? {
                return Ok(Some(self.taken(&record)));
            }
        }
        out.clear();
        Ok(None)
    }

    /// As [`take`](Self::take), but a sample of more than 4 KiB stays where it is.
    ///
    /// # Errors
    /// As for [`take`](Self::take).
    pub fn take_sample(&mut self) -> Result<Option<Sample>, TakeError> {
        for _ in 0..ATTEMPTS {
            let Some(record) = self.find_fitting()? else { break };
            if u64::from(record.len) > COPIED {
                let words = self.attachment.placed(&record).ok_or_else(|| self.outside())?;
                match self.attachment.pin(self.cursor) {
                    Pinning::Pinned(pin) => {
                        let len = record.len as usize;
                        return Ok(Some(Sample::pinned(self.taken(&record), len, words, pin)));
                    }
                    Pinning::Overtaken => continue,
                    Pinning::NoRecord => {}
                }
            }
            let mut out = Vec::new();
            if self.copy_out(&record, &mut out)? {
                return Ok(Some(Sample::copied(self.taken(&record), out)));
            }
        }
        Ok(None)
    }

    /// As [`take_sample`](Self::take_sample), but always a copy.
    ///
    /// # Errors
    /// As for [`take`](Self::take).
    pub fn take_copy(&mut self) -> Result<Option<Sample>, TakeError> {
        let mut out = Vec::new();
        Ok(self.take(&mut out)?.map(|taken| Sample::copied(taken, out)))
    }

    /// Drops the oldest sample that is to be taken, as one skipped rather than lost: for a
    /// subscription whose depth is shared by several publishers. False when there is none.
    pub fn skip(&mut self) -> bool {
        match self.find() {
            Ok(Some(_)) => {
                self.skipped += 1;
                self.advance(self.cursor + 1);
                true
            }
            _ => false,
        }
    }

    /// Samples taken.
    pub fn received(&self) -> u64 {
        self.received
    }

    /// Samples overwritten before they could be taken, within the subscription's depth.
    pub fn lost(&self) -> u64 {
        self.lost
    }

    /// Samples passed over because more recent ones fill the subscription's depth.
    pub fn skipped(&self) -> u64 {
        self.skipped
    }

    /// The publisher.
    pub fn writer(&self) -> Gid {
        self.reads.writer
    }

    /// The grant by which it reads.
    pub fn grant(&self) -> Grant {
        self.reads.grant
    }

    /// Its lane's number.
    pub fn lane(&self) -> u32 {
        self.attachment.lane.index()
    }

    /// Whether the publisher's process has ended: a system call. Drain before dropping.
    pub fn writer_dead(&self) -> bool {
        self.reads.peer.is_dead()
    }

    /// The record at the cursor, once that is past all that is skipped or lost.
    fn find(&mut self) -> Result<Option<Record>, TakeError> {
        if self.attachment.lane.is_forked() {
            return Err(TakeError::Forked);
        }
        if let Some(what) = self.corrupt {
            return Err(TakeError::Corrupt { writer: self.reads.writer, what });
        }
        match self.find_sane() {
            Ok(found) => Ok(found),
            Err(what) => {
                self.corrupt = Some(what);
                Err(TakeError::Corrupt { writer: self.reads.writer, what })
            }
        }
    }

    fn find_sane(&mut self) -> Result<Option<Record>, &'static str> {
        for _ in 0..ATTEMPTS {
            let (tail, head) = ring::bounds(self.attachment.words(), &self.attachment.geometry)?;
            let Some(unread) = head.checked_sub(self.cursor) else {
                return Err("its head went back");
            };
            if unread > self.reads.depth {
                self.skipped += unread - self.reads.depth;
                self.advance(head - self.reads.depth);
            }
            if self.cursor < tail {
                self.lost += tail - self.cursor;
                self.advance(tail);
            }
            if self.cursor == head {
                return Ok(None);
            }
            match ring::look(self.attachment.words(), &self.attachment.geometry, self.cursor) {
                Look::Sample(record) => return Ok(Some(record)),
                Look::Lapped => {}
                Look::Corrupt(what) => return Err(what),
            }
        }
        Ok(None)
    }

    /// As [`find`](Self::find), without what is longer than the subscription expects.
    fn find_fitting(&mut self) -> Result<Option<Record>, TakeError> {
        let Some(record) = self.find()? else { return Ok(None) };
        let (len, max) = (u64::from(record.len), self.reads.max_message);
        if len > max {
            self.lost += 1;
            self.advance(self.cursor + 1);
            return Err(TakeError::TooLarge { writer: self.reads.writer, len, max });
        }
        Ok(Some(record))
    }

    /// Copies the payload at the cursor; false when the publisher was faster.
    fn copy_out(&self, record: &Record, out: &mut Vec<u8>) -> Result<bool, TakeError> {
        let Attachment { geometry, .. } = &*self.attachment;
        let words = self.attachment.words();
        let data =
            ring::data(words, geometry, self.cursor, record).ok_or_else(|| self.outside())?;
        let len = record.len as usize;
        let mut copy =
            || ring::copy_out(data, len, out).map_err(|_| TakeError::NoMemory { len: len as u64 });
        if len as u64 > COPIED {
            return self
                .attachment
                .while_pinned(self.cursor, copy)
                .transpose()
                .map(|c| c.is_some());
        }
        copy()?;
        Ok(ring::stands(words, geometry, self.cursor))
    }

    /// The sample at the cursor is the caller's.
    fn taken(&mut self, record: &Record) -> Taken {
        let taken = Taken { meta: meta(record), position: self.cursor };
        self.received += 1;
        self.advance(self.cursor + 1);
        taken
    }

    fn advance(&mut self, cursor: u64) {
        self.cursor = cursor;
        self.attachment.lane.advance(cursor, self.received, self.lost, self.skipped);
        self.make_room_known();
    }

    /// Wakes a publisher that waits for this reader.
    fn make_room_known(&self) {
        if self.reads.holds {
            settle::<AtomicU64>();
            self.reads.peer.ring_if(Purpose::Room);
        }
    }

    fn outside(&self) -> TakeError {
        let what = "a sample lies outside the payload area";
        TakeError::Corrupt { writer: self.reads.writer, what }
    }
}

impl Drop for Reader {
    fn drop(&mut self) {
        // The lane closes with the last sample; until then it only stops to hold the publisher.
        if !self.attachment.lane.is_forked() {
            self.attachment.lane.leave();
            self.make_room_known();
        }
    }
}

fn meta(record: &Record) -> Meta {
    Meta { sequence: record.sequence, source_timestamp: record.timestamp }
}
