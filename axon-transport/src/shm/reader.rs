//! The taking end of a ring.

use std::{
    os::fd::{AsFd, OwnedFd},
    sync::atomic::AtomicU64,
};

use super::{
    Grant, Lane, Meta, Peer, ShmError, TakeError,
    audience::{depth, holds},
    layout::RingLayout,
    memory::Map,
    ring::{self, Geometry, Look, Record},
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

/// A sample that was taken.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Taken {
    /// What goes with it.
    pub meta: Meta,
    /// Its position in the publisher's ring.
    pub position: u64,
}

/// One subscription's view of one publisher's ring.
///
/// Goes on after the publisher's death until it is drained. Dropping it tells the publisher.
pub struct Reader {
    options: ReaderOptions,
    map: Map,
    geometry: Geometry,
    depth: u64,
    cursor: u64,
    received: u64,
    lost: u64,
    skipped: u64,
    corrupt: Option<&'static str>,
}

impl Reader {
    /// Checks and maps a ring, and opens the lane.
    ///
    /// # Errors
    /// The descriptor is not a ring, or not this publisher's.
    pub fn map(ring: OwnedFd, options: ReaderOptions) -> Result<Self, ShmError> {
        if options.lane.is_forked() {
            return Err(ShmError::Forked);
        }
        let map = Map::open(ring.as_fd())?;
        let layout = RingLayout::read(map.words(), options.writer)?;
        options.lane.open(options.grant, options.reader, options.writer);
        Ok(Self {
            map,
            geometry: layout.geometry(),
            depth: depth(&options.qos),
            cursor: options.grant.first,
            received: 0,
            lost: 0,
            skipped: 0,
            corrupt: None,
            options,
        })
    }

    /// Whether there is something to take: two loads.
    pub fn has_data(&self) -> bool {
        self.unread() > 0
    }

    /// How many samples are to be taken; at most the subscription's depth.
    pub fn unread(&self) -> u64 {
        match (self.corrupt, ring::bounds(self.map.words(), &self.geometry)) {
            (None, Ok((tail, head))) => head.saturating_sub(self.cursor.max(tail)).min(self.depth),
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
    /// The ring cannot be read, or memory for the payload is short. `out` holds nothing useful.
    pub fn take(&mut self, out: &mut Vec<u8>) -> Result<Option<Taken>, TakeError> {
        for _ in 0..ATTEMPTS {
            let Some(record) = self.find()? else { break };
            let words = self.map.words();
            let data = ring::data(words, &self.geometry, self.cursor, &record)
                .ok_or_else(|| self.corrupt_error("a sample lies outside the payload area"))?;
            let len = record.len as usize;
            ring::copy_out(data, len, out).map_err(|_| TakeError::NoMemory { len: len as u64 })?;
            if ring::stands(words, &self.geometry, self.cursor) {
                let position = self.cursor;
                self.received += 1;
                self.advance(position + 1);
                return Ok(Some(Taken { meta: meta(&record), position }));
            }
        }
        out.clear();
        Ok(None)
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
        self.options.writer
    }

    /// The grant by which it reads.
    pub fn grant(&self) -> Grant {
        self.options.grant
    }

    /// Its lane's number.
    pub fn lane(&self) -> u32 {
        self.options.lane.index()
    }

    /// Whether the publisher's process has ended: a system call. Drain before dropping.
    pub fn writer_dead(&self) -> bool {
        self.options.peer.is_dead()
    }

    /// The record at the cursor, once that is past all that is skipped or lost.
    fn find(&mut self) -> Result<Option<Record>, TakeError> {
        if self.options.lane.is_forked() {
            return Err(TakeError::Forked);
        }
        if let Some(what) = self.corrupt {
            return Err(TakeError::Corrupt { writer: self.options.writer, what });
        }
        match self.find_sane() {
            Ok(found) => Ok(found),
            Err(what) => {
                self.corrupt = Some(what);
                Err(TakeError::Corrupt { writer: self.options.writer, what })
            }
        }
    }

    fn find_sane(&mut self) -> Result<Option<Record>, &'static str> {
        for _ in 0..ATTEMPTS {
            let (tail, head) = ring::bounds(self.map.words(), &self.geometry)?;
            let Some(unread) = head.checked_sub(self.cursor) else {
                return Err("its head went back");
            };
            if unread > self.depth {
                self.skipped += unread - self.depth;
                self.advance(head - self.depth);
            }
            if self.cursor < tail {
                self.lost += tail - self.cursor;
                self.advance(tail);
            }
            if self.cursor == head {
                return Ok(None);
            }
            match ring::look(self.map.words(), &self.geometry, self.cursor) {
                Look::Sample(record) if u64::from(record.len) <= self.options.max_message => {
                    return Ok(Some(record));
                }
                Look::Sample(_) => return Err("a sample is longer than AXON_MAX_MESSAGE_MB"),
                Look::Lapped => {}
                Look::Corrupt(what) => return Err(what),
            }
        }
        Ok(None)
    }

    fn advance(&mut self, cursor: u64) {
        self.cursor = cursor;
        self.options.lane.advance(cursor, self.received, self.lost);
        self.make_room_known();
    }

    /// Wakes a publisher that waits for this reader.
    fn make_room_known(&self) {
        if holds(&self.options.qos) && self.options.peer.remote().is_some() {
            settle::<AtomicU64>();
            self.options.peer.ring_if(Purpose::Room);
        }
    }

    fn corrupt_error(&self, what: &'static str) -> TakeError {
        TakeError::Corrupt { writer: self.options.writer, what }
    }
}

impl Drop for Reader {
    fn drop(&mut self) {
        if !self.options.lane.is_forked() {
            self.options.lane.close();
            self.make_room_known();
        }
    }
}

fn meta(record: &Record) -> Meta {
    Meta { sequence: record.sequence, source_timestamp: record.timestamp }
}
