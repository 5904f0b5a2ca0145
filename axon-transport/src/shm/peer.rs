//! Another session as seen from this one: its segment, its doorbell, and whether it lives.

use std::{
    fs, io,
    os::fd::{AsFd, AsRawFd, BorrowedFd},
    sync::{Arc, atomic::AtomicU64},
};

use rustix::event::{PollFd, PollFlags, Timespec, poll};

use super::{SessionSegment, ShmError, layout, memory::Map};
use crate::{
    ids::SessionId,
    passed::PassedFd,
    wait::{Bell, Purpose, due},
};

/// What a session hands over so that others can share memory with it, in the order in which the
/// descriptors are sent.
#[derive(Debug)]
pub struct PeerDescriptors {
    /// Its session segment.
    pub segment: PassedFd,
    /// What wakes it: one end of a pair of unix sockets that keep packets apart.
    pub doorbell: PassedFd,
    /// The pidfd of its process.
    pub pidfd: PassedFd,
}

impl PeerDescriptors {
    /// Duplicates all of them.
    ///
    /// # Errors
    /// The process has no descriptors left.
    pub fn try_clone(&self) -> io::Result<Self> {
        Ok(Self {
            segment: self.segment.try_clone()?,
            doorbell: self.doorbell.try_clone()?,
            pidfd: self.pidfd.try_clone()?,
        })
    }

    /// The process that the pidfd refers to, to be compared with the credentials of the socket
    /// it came over. `None` when it is no pidfd, or its process has ended.
    pub fn process(&self) -> Option<u32> {
        // What some things tell of themselves there takes locks that others can keep.
        if !self.pidfd.is_pidfd() {
            return None;
        }
        let path = format!("/proc/self/fdinfo/{}", self.pidfd.as_fd().as_raw_fd());
        let text = fs::read_to_string(path).ok()?;
        let pid = text.lines().find_map(|line| line.strip_prefix("Pid:"))?;
        // -1 once the process has been reaped.
        pid.trim().parse().ok().filter(|pid| *pid > 0)
    }
}

/// Another session, mapped read-only.
pub struct PeerSession {
    id: SessionId,
    map: Map,
    lanes: u32,
    bell: Bell,
    pidfd: PassedFd,
    /// The last ticket of each of its armed words that this process rang for.
    rung: [AtomicU64; 2],
}

impl PeerSession {
    /// Checks and maps the segment of session `id`.
    ///
    /// # Errors
    /// The descriptors are not those of a session, or not of this one.
    pub fn map(id: SessionId, descriptors: PeerDescriptors) -> Result<Arc<Self>, ShmError> {
        let PeerDescriptors { segment, doorbell, pidfd } = descriptors;
        let bell = Bell::received(doorbell).ok_or(ShmError::Refused {
            what: "its doorbell is no unix socket that keeps packets",
        })?;
        let map = Map::open(segment.as_fd())?;
        let lanes = layout::read_session(map.words(), id)?;
        Ok(Arc::new(Self { id, map, lanes, bell, pidfd, rung: Default::default() }))
    }

    /// Its id.
    pub fn id(&self) -> SessionId {
        self.id
    }

    /// Whether its process has ended: a system call.
    pub fn is_dead(&self) -> bool {
        let mut fds = [PollFd::from_borrowed_fd(self.pidfd.as_fd(), PollFlags::IN)];
        poll(&mut fds, Some(&Timespec::default())).is_ok_and(|ready| ready > 0)
    }

    /// Its process: readable once that has ended.
    pub fn pidfd(&self) -> BorrowedFd<'_> {
        self.pidfd.as_fd()
    }

    fn ring_if(&self, purpose: Purpose) {
        let word = match purpose {
            Purpose::Samples => layout::session::ARMED,
            Purpose::Room => layout::session::BLOCKED,
        };
        if due(&self.map.words()[word], &self.rung[purpose as usize]) {
            self.bell.ring();
        }
    }
}

/// The session at the other end of a ring.
#[derive(Clone)]
pub enum Peer {
    /// The very same session.
    Local(Arc<SessionSegment>),
    /// Another one, in this process or another.
    Remote(Arc<PeerSession>),
}

impl Peer {
    /// The session's id.
    pub fn id(&self) -> SessionId {
        match self {
            Self::Local(session) => session.id(),
            Self::Remote(session) => session.id(),
        }
    }

    /// Whether its process has ended; never true of our own.
    pub fn is_dead(&self) -> bool {
        match self {
            Self::Local(_) => false,
            Self::Remote(session) => session.is_dead(),
        }
    }

    pub(super) fn remote(&self) -> Option<&Arc<PeerSession>> {
        match self {
            Self::Local(_) => None,
            Self::Remote(session) => Some(session),
        }
    }

    /// Rings if somebody there waits for `purpose` and this process has not rung for it yet.
    #[inline]
    pub(super) fn ring_if(&self, purpose: Purpose) {
        match self {
            Self::Local(session) => session.ring_if(purpose),
            Self::Remote(session) => session.ring_if(purpose),
        }
    }

    pub(super) fn lanes(&self) -> u32 {
        match self {
            Self::Local(_) => layout::LANES,
            Self::Remote(session) => session.lanes,
        }
    }

    pub(super) fn lane_words(&self, index: u32) -> &[AtomicU64; layout::LANE_WORDS] {
        match self {
            Self::Local(session) => session.lane_words(index),
            Self::Remote(session) => layout::lane_words(session.map.words(), index),
        }
    }
}
