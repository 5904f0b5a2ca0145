//! Limits the sessions and segments to the daemon's descriptors.
//!
//! A process may take no more descriptors than stay free for all others: the first process gets half, the next one a
//! third. So another process's first session always fits, however much the others want.

use std::{cell::RefCell, os::fd::OwnedFd};

use axon_shm::internal::descriptors;
use axon_transport::internal::{
    registry::{Registry, SessionEntry},
    wire::session::SessionRole,
};
use rustix::event::{EventfdFlags, eventfd};

/// Descriptors of a session: its connection, segment, doorbell and pidfd. The gateway shares the latter two.
const OF_SESSION: u64 = 4;
/// Descriptors of a relayed session: its connection, a socket pair, and those that a session in this process opens.
const OF_RELAYED: u64 = 24;
/// Number of descriptors that stay free for links, key requests, files and callers; at most a sixth of the limit.
const RESERVED_DESCRIPTORS: u64 = 40;
/// Number of descriptors that are closed for a moment to answer a caller; at most an eighth of the limit.
const SPARE: u64 = 24;

/// The use of the daemon's descriptors.
#[derive(Clone, Copy, Debug)]
pub(super) struct DescriptorRoom {
    /// The soft RLIMIT_NOFILE.
    limit: u64,
    /// Number of open descriptors.
    open: u64,
    /// Number of sessions with descriptors, without the gateway's own.
    sessions: usize,
    /// Number of descriptors held for the sessions of one process.
    held: u64,
}

impl DescriptorRoom {
    /// Computes the use for process `pid`. Returns `None` if there is no limit.
    pub(super) fn of<F: Clone>(registry: &Registry<F>, pid: u32) -> Option<Self> {
        let limit = descriptors::limit()?;
        let mut room = Self { limit, open: descriptors::open(), sessions: 0, held: 0 };
        for (_, entry) in registry.sessions() {
            if entry.role == SessionRole::Application {
                room.add(entry, pid);
            }
        }
        Some(room)
    }

    fn add<F>(&mut self, entry: &SessionEntry<F>, pid: u32) {
        self.sessions += 1;
        if entry.pid == pid {
            let own = if entry.relay.is_some() { OF_RELAYED } else { OF_SESSION };
            self.held += own + entry.segments.len() as u64;
        }
    }

    /// Returns the number of descriptors that no session may take.
    fn kept(&self) -> u64 {
        RESERVED_DESCRIPTORS.min(self.limit / 6)
    }

    /// Returns the number of descriptors that sessions may still take.
    fn free(&self) -> u64 {
        self.limit.saturating_sub(self.open + self.kept())
    }

    /// Returns the reason why there is no descriptor for another session, if so.
    pub(super) fn refuses_session(&self, is_relayed: bool) -> Option<String> {
        self.refuses(if is_relayed { OF_RELAYED } else { OF_SESSION })
    }

    /// Returns the reason why there is no descriptor for another segment of a session, if so.
    pub(super) fn refuses_segment(&self) -> Option<String> {
        self.refuses(1)
    }

    fn refuses(&self, cost: u64) -> Option<String> {
        let Self { limit, open, sessions, held, .. } = self;
        let free = self.free();
        let why = if free < cost {
            format!(
                "has {open} of its {limit} file descriptors open, for {sessions} sessions, and keeps {} for links \
                 and callers",
                self.kept()
            )
        } else if *held > 0 && held + cost > free {
            format!(
                "holds {held} of its {limit} file descriptors for the sessions of its process, and keeps the \
                 {free} that are left for others"
            )
        } else {
            return None;
        };
        let pid = std::process::id();
        Some(format!(
            "the daemon (pid {pid}) {why}: raise RLIMIT_NOFILE of the daemon (ulimit -n where it is started, \
             LimitNOFILE= of its systemd unit, prlimit --pid {pid} --nofile=N while it runs), or run fewer sessions"
        ))
    }
}

/// Descriptors that are kept in reserve: when none can be opened, the daemon frees them to accept and answer a caller.
/// They are opened first and so have low numbers, which makes them useful even after the limit was lowered.
#[derive(Debug, Default)]
pub(super) struct SpareDescriptors(RefCell<Vec<OwnedFd>>);

impl SpareDescriptors {
    /// Opens the missing spare descriptors.
    pub(super) fn fill(&self) {
        let limit = descriptors::limit().unwrap_or(u64::MAX);
        let most = usize::try_from(SPARE.min(limit / 8)).unwrap_or_default();
        let mut all = self.0.borrow_mut();
        while all.len() < most
            && let Ok(fd) = eventfd(0, EventfdFlags::CLOEXEC)
        {
            all.push(fd);
        }
    }

    /// Closes them until the returned value is dropped.
    pub(super) fn lend(&self) -> LentDescriptors<'_> {
        self.0.borrow_mut().clear();
        LentDescriptors(self)
    }

    /// Returns whether a caller may keep the descriptor with which it was answered.
    pub(super) fn can_keep_caller(&self) -> bool {
        self.fill();
        self.0.borrow().len() > 1
    }
}

/// The loan of the spare descriptors; see [`SpareDescriptors::lend`].
pub(super) struct LentDescriptors<'a>(&'a SpareDescriptors);

impl Drop for LentDescriptors<'_> {
    fn drop(&mut self) {
        self.0.fill();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn room(limit: u64, open: u64, held: u64) -> DescriptorRoom {
        DescriptorRoom { limit, open, sessions: 9, held }
    }

    #[test]
    fn session_is_refused_when_it_would_use_reserved_descriptors() {
        let last = 1024 - RESERVED_DESCRIPTORS - OF_SESSION;
        assert_eq!(room(1024, last, 0).refuses_session(false), None);
        let text = room(1024, last + 1, 0).refuses_session(false).unwrap();
        assert!(text.contains("of its 1024 file descriptors open, for 9 sessions"), "{text}");
        assert!(room(1024, last, 0).refuses_session(true).is_some(), "a relayed one takes more");
        assert!(room(20, 60, 0).refuses_segment().is_some(), "the limit was lowered");
        assert_eq!(room(u64::MAX, 60, 1 << 20).refuses_segment(), None);
    }

    /// Each process takes as much as it gets.
    #[test]
    fn greedy_processes_leave_descriptors_for_the_next_process() {
        for limit in [256, 1024, 20_000] {
            let (mut open, mut shares) = (60, Vec::new());
            for _ in 0..5 {
                let mut held = 0;
                while room(limit, open, held).refuses_segment().is_none() {
                    (open, held) = (open + 1, held + 1);
                }
                shares.push(held);
            }
            assert!(shares.windows(2).all(|two| two[0] >= two[1]), "{shares:?}");
            let all: u64 = room(limit, 60, 0).free();
            assert!(shares[0] <= all / 2 + 1, "{shares:?}");
            assert_eq!(room(limit, open, 0).refuses_segment(), None, "{limit}: {shares:?}");
        }
    }

    #[test]
    fn spare_descriptors_are_back_after_they_were_lent() {
        let spare = SpareDescriptors::default();
        spare.fill();
        let all = spare.0.borrow().len();
        assert!(all > 1 && spare.can_keep_caller());
        let lent = spare.lend();
        assert_eq!(spare.0.borrow().len(), 0);
        drop(lent);
        assert_eq!(spare.0.borrow().len(), all);
    }
}
