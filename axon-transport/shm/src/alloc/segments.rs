//! A session's own segments, by their numbers.

use std::{
    collections::BTreeMap,
    fmt,
    os::fd::{BorrowedFd, OwnedFd},
    sync::{Arc, OnceLock, PoisonError, RwLock},
};

use crate::{
    error::ShmError,
    ids::{Gid, SessionId},
    memory::segment::{Map, OwnMapping},
    ring::layout::{self, SegmentKind},
};

/// The description of a segment that other sessions receive.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SegmentInfo {
    /// The segment's number in its session, counted from 0. Numbers are never reused.
    pub number: u32,
    /// The purpose of the segment.
    pub kind: SegmentKind,
}

/// An event that a session's owner passes on to the other sessions. The order of events must be kept.
#[derive(Clone, Copy, Debug)]
pub enum SegmentEvent<'a> {
    /// A segment was opened. Objects that others read will be in it.
    Opened(SegmentInfo, BorrowedFd<'a>),
    /// A segment was closed: nobody reads it any more.
    Gone(SegmentInfo),
    /// This publisher asks its owner to [prepare](crate::writer::Writer::prepare) memory for its next sample. Other
    /// sessions do not need this event.
    Low(Gid),
}

type Listener = Box<dyn Fn(SegmentEvent<'_>) + Send + Sync>;

/// One segment of a session.
pub(crate) struct OwnSegment {
    pub(crate) info: SegmentInfo,
    pub(crate) memory: OwnMapping,
}

impl OwnSegment {
    pub(crate) fn number(&self) -> u32 {
        self.info.number
    }

    pub(crate) fn map(&self) -> &Arc<Map> {
        self.memory.map()
    }

    pub(crate) fn descriptor(&self) -> Result<OwnedFd, ShmError> {
        self.memory
            .fd()
            .try_clone_to_owned()
            .map_err(|source| ShmError::System { what: "duplicating a descriptor", source })
    }
}

/// All segments of a session.
pub(crate) struct Segments {
    session: SessionId,
    table: RwLock<SegmentTable>,
    listener: OnceLock<Listener>,
}

#[derive(Default)]
struct SegmentTable {
    live: BTreeMap<u32, Arc<OwnSegment>>,
    next: u32,
}

impl Segments {
    pub(crate) fn new(session: SessionId) -> Self {
        Self { session, table: RwLock::default(), listener: OnceLock::new() }
    }

    /// Sets `listener`, which is called for each later segment, in the order of their numbers. It is called while locks
    /// are held: it must neither block nor call into the session. Returns false if there is a listener already.
    pub(crate) fn listen(&self, listener: Listener) -> bool {
        self.listener.set(listener).is_ok()
    }

    /// Calls the listener.
    pub(crate) fn tell(&self, event: SegmentEvent<'_>) {
        if let Some(listener) = self.listener.get() {
            listener(event);
        }
    }

    /// Opens a new segment of `bytes` bytes, of which the first [`layout::ALIGN`] are backed by memory.
    pub(crate) fn open(&self, kind: SegmentKind, bytes: u64) -> Result<Arc<OwnSegment>, ShmError> {
        let name = match kind {
            SegmentKind::Session => "axon-session",
            SegmentKind::Heap => "axon-heap",
            SegmentKind::Samples(_) => "axon-samples",
        };
        let memory = OwnMapping::create(name, bytes)?;
        memory.commit(0, layout::ALIGN)?;
        let mut table = self.table.write().unwrap_or_else(PoisonError::into_inner);
        let number = table.next;
        if number > layout::MAX_NUMBER {
            return Err(ShmError::NoNumber(self.session));
        }
        table.next += 1;
        layout::write_segment(memory.words(), self.session, number, kind);
        let segment = Arc::new(OwnSegment { info: SegmentInfo { number, kind }, memory });
        table.live.insert(number, Arc::clone(&segment));
        self.tell(SegmentEvent::Opened(segment.info, segment.memory.fd()));
        Ok(segment)
    }

    /// Closes a segment whose content nobody needs any more.
    pub(crate) fn close(&self, number: u32) {
        let mut table = self.table.write().unwrap_or_else(PoisonError::into_inner);
        if let Some(segment) = table.live.remove(&number) {
            self.tell(SegmentEvent::Gone(segment.info));
        }
    }

    pub(crate) fn get(&self, number: u32) -> Option<Arc<OwnSegment>> {
        self.table.read().unwrap_or_else(PoisonError::into_inner).live.get(&number).cloned()
    }

    /// Returns the segments other than the first, by number.
    pub(crate) fn further(&self) -> Vec<Arc<OwnSegment>> {
        let table = self.table.read().unwrap_or_else(PoisonError::into_inner);
        table.live.values().filter(|s| s.info.kind != SegmentKind::Session).cloned().collect()
    }
}

impl fmt::Debug for Segments {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let table = self.table.read().unwrap_or_else(PoisonError::into_inner);
        f.debug_tuple("Segments").field(&table.live.keys().collect::<Vec<_>>()).finish()
    }
}
