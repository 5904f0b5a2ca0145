//! A reader's maps of the ring's header and of its lane. The reader shares them with the samples that it
//! lent out, so that both stay mapped until the last sample is dropped.

use std::{
    ops::Range,
    sync::{Arc, atomic::AtomicU64},
};

use crate::{
    memory::segment::Map,
    ring::{layout::ring::TAIL, pins::RECORDS},
    session::lane::Lane,
};

/// The record that is used while a sample is copied out; the others are for samples in use.
const COPY: usize = RECORDS - 1;

/// One reader's attachment to one ring. It exists until the reader and all samples in use are dropped; only then does
/// the lane show that the reader has left.
pub(crate) struct Attachment {
    map: Arc<Map>,
    /// The range of the ring's header in the map.
    ring: Range<usize>,
    pub(crate) lane: Lane,
}

/// The result of pinning a sample.
pub(crate) enum Pinning<T> {
    Pinned(T),
    /// The publisher has given the sample up.
    Overtaken,
    /// All records are in use.
    NoRecord,
}

impl Attachment {
    /// Creates the attachment to the ring whose header is in these words of `map`.
    pub(crate) fn new(map: Arc<Map>, ring: Range<usize>, lane: Lane) -> Arc<Self> {
        Arc::new(Self { map, ring, lane })
    }

    /// Returns the ring's header.
    #[inline]
    pub(crate) fn ring(&self) -> &[AtomicU64] {
        &self.map.words()[self.ring.clone()]
    }

    /// Records the highest number of the publisher's segments that have come.
    pub(crate) fn set_mapped(&self, number: u32) {
        if !self.lane.is_forked() {
            self.lane.set_mapped(number);
        }
    }

    /// Keeps the sample at `position` in place for as long as the pin lives. Only the reader itself may call this,
    /// which does one thing at a time: no other thread takes a record meanwhile.
    pub(crate) fn pin(self: &Arc<Self>, position: u64) -> Pinning<Pin> {
        let Some(record) = self.lane.free_record(COPY) else { return Pinning::NoRecord };
        if self.lane.pin(record, position, self.tail()) {
            Pinning::Pinned(Pin { attachment: Arc::clone(self), record })
        } else {
            Pinning::Overtaken
        }
    }

    /// Runs `read` while the sample at `position` is kept in place; returns `None` if the publisher has given it up.
    /// Only the reader itself may call this, which does one thing at a time.
    pub(crate) fn while_pinned<T>(&self, position: u64, read: impl FnOnce() -> T) -> Option<T> {
        if !self.lane.pin(COPY, position, self.tail()) {
            return None;
        }
        let unpin = Unpin(self);
        let result = read();
        drop(unpin);
        Some(result)
    }

    fn tail(&self) -> &AtomicU64 {
        &self.ring()[TAIL]
    }
}

struct Unpin<'a>(&'a Attachment);

impl Drop for Unpin<'_> {
    fn drop(&mut self) {
        self.0.lane.unpin(COPY);
    }
}

/// A pinned sample. Dropping this value unpins it.
pub(crate) struct Pin {
    attachment: Arc<Attachment>,
    record: usize,
}

impl Pin {
    pub(crate) fn attachment(&self) -> &Attachment {
        &self.attachment
    }
}

impl Drop for Pin {
    fn drop(&mut self) {
        // A forked child must not change the parent's records.
        if !self.attachment.lane.is_forked() {
            self.attachment.lane.unpin(self.record);
        }
    }
}
