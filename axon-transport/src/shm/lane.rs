//! A reader's own words in its session's segment.

use std::sync::{Arc, atomic::AtomicU64};

use super::{Grant, SessionSegment, layout, sync::Ordering};
use crate::ids::Gid;

/// A place in a session's segment where one reader tells its publisher how far it is.
///
/// Freed when dropped.
pub struct Lane {
    session: Arc<SessionSegment>,
    index: u32,
}

impl Lane {
    pub(super) fn new(session: Arc<SessionSegment>, index: u32) -> Self {
        Self { session, index }
    }

    /// Its number, by which a publisher finds it.
    pub fn index(&self) -> u32 {
        self.index
    }

    /// Whether the calling process is a fork of the lane's: it must not touch the lane.
    pub(super) fn is_forked(&self) -> bool {
        self.session.is_forked()
    }

    pub(super) fn open(&self, grant: Grant, reader: Gid, writer: Gid) {
        let words = self.words();
        layout::write_id(words, layout::lane::READER, reader.0);
        layout::write_id(words, layout::lane::WRITER, writer.0);
        words[layout::lane::RECEIVED].store(0, Ordering::Relaxed);
        words[layout::lane::LOST].store(0, Ordering::Relaxed);
        words[layout::lane::CURSOR].store(grant.first, Ordering::Relaxed);
        // Release: a publisher that sees the generation sees its cursor.
        words[layout::lane::GENERATION].store(grant.generation, Ordering::Release);
    }

    /// All below `cursor` is done with.
    #[inline]
    pub(super) fn advance(&self, cursor: u64, received: u64, lost: u64) {
        let words = self.words();
        words[layout::lane::RECEIVED].store(received, Ordering::Relaxed);
        words[layout::lane::LOST].store(lost, Ordering::Relaxed);
        // Release: pairs with the publisher's acquire load before it reuses what was read.
        words[layout::lane::CURSOR].store(cursor, Ordering::Release);
    }

    /// Tells a publisher that still counts on the reader that it is gone.
    pub(super) fn close(&self) {
        self.words()[layout::lane::GENERATION].store(0, Ordering::Release);
    }

    fn words(&self) -> &[AtomicU64] {
        self.session.lane_words(self.index)
    }
}

impl Drop for Lane {
    fn drop(&mut self) {
        if !self.is_forked() {
            self.close();
            self.session.free_lane(self.index);
        }
    }
}
