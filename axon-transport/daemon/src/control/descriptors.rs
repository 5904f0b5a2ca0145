//! How many sessions and segments the daemon's descriptors allow.
//!
//! A process may take no more than stays free for all others: the first one gets half, the next one a third. So there
//! is always room for another process's first session, however much the others want.

use std::{cell::RefCell, os::fd::OwnedFd};

use axon_shm::internal::descriptors;
use axon_transport::internal::{
    registry::{Registry, SessionEntry},
    wire::session::SessionRole,
};
use rustix::event::{EventfdFlags, eventfd};

/// A session's connection, segment, doorbell and pidfd.
const OF_SESSION: u64 = 4;
/// A session's doorbell and pidfd, in the gateway, once another host has to do with one of its endpoints.
const IN_GATEWAY: u64 = 2;
/// A relayed session: its connection, a socket pair, and what a session in this process opens.
const OF_RELAYED: u64 = 24;
/// What stays free for links, key requests, files and callers. Of a low limit a sixth.
const RESERVED_DESCRIPTORS: u64 = 40;
/// Descriptors that are given up for a moment to answer a caller. Of a low limit an eighth.
const SPARE: u64 = 24;

/// What the daemon's descriptors are used for.
#[derive(Clone, Copy, Debug)]
pub(super) struct DescriptorRoom {
    /// The soft RLIMIT_NOFILE.
    limit: u64,
    /// Those that are open.
    open: u64,
    /// Those that the gateway may yet open for the sessions that there are.
    owed: u64,
    /// The sessions with descriptors, without the gateway's own.
    sessions: usize,
    /// Those that are held for the sessions of one process.
    held: u64,
}

impl DescriptorRoom {
    /// The room for process `pid`. `None` where there is no limit.
    pub(super) fn of<F: Clone>(registry: &Registry<F>, pid: u32) -> Option<Self> {
        let limit = descriptors::limit()?;
        let mut room = Self { limit, open: descriptors::open(), owed: 0, sessions: 0, held: 0 };
        let mut gateway = None;
        for (_, entry) in registry.sessions() {
            match entry.role {
                SessionRole::Gateway => gateway = Some(entry),
                SessionRole::Tool => {}
                SessionRole::Application => room.add(entry, pid),
            }
        }
        if let Some(gateway) = gateway {
            let met = gateway.holds_memory_of().min(room.sessions);
            room.owed = IN_GATEWAY * (room.sessions - met) as u64;
        }
        Some(room)
    }

    fn add<F>(&mut self, entry: &SessionEntry<F>, pid: u32) {
        self.sessions += 1;
        if entry.pid == pid {
            let own = if entry.relay.is_some() { OF_RELAYED } else { OF_SESSION };
            self.held += own + IN_GATEWAY + entry.segments.len() as u64;
        }
    }

    /// Those that nobody's session may take.
    fn kept(&self) -> u64 {
        self.owed + RESERVED_DESCRIPTORS.min(self.limit / 6)
    }

    /// Those that sessions may still take.
    fn free(&self) -> u64 {
        self.limit.saturating_sub(self.open + self.kept())
    }

    /// Why there is none for another session, if so.
    pub(super) fn refuses_session(&self, is_relayed: bool) -> Option<String> {
        self.refuses(if is_relayed { OF_RELAYED } else { OF_SESSION } + IN_GATEWAY)
    }

    /// Why there is none for another segment of a session, if so.
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

/// Descriptors that are kept so that there are some when none can be opened: with them the daemon accepts and answers a
/// caller. Opened first, they have low numbers, and so are of use as well after the limit was lowered.
#[derive(Debug, Default)]
pub(super) struct SpareDescriptors(RefCell<Vec<OwnedFd>>);

impl SpareDescriptors {
    /// Opens those that are missing.
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

    /// Gives them up until what is returned is dropped.
    pub(super) fn lend(&self) -> LentDescriptors<'_> {
        self.0.borrow_mut().clear();
        LentDescriptors(self)
    }

    /// Whether a caller may keep the one that it was answered with.
    pub(super) fn can_keep_caller(&self) -> bool {
        self.fill();
        self.0.borrow().len() > 1
    }
}

/// See [`SpareDescriptors::lend`].
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
        DescriptorRoom { limit, open, owed: 0, sessions: 9, held }
    }

    #[test]
    fn session_is_refused_where_it_would_take_what_is_kept() {
        let last = 1024 - RESERVED_DESCRIPTORS - OF_SESSION - IN_GATEWAY;
        assert_eq!(room(1024, last, 0).refuses_session(false), None);
        let text = room(1024, last + 1, 0).refuses_session(false).unwrap();
        assert!(text.contains("of its 1024 file descriptors open, for 9 sessions"), "{text}");
        assert!(room(1024, last, 0).refuses_session(true).is_some(), "a relayed one takes more");
        let owed = DescriptorRoom { owed: 1, ..room(1024, last, 0) };
        assert!(owed.refuses_session(false).is_some(), "the gateway needs it");
        assert!(room(20, 60, 0).refuses_segment().is_some(), "the limit was lowered");
        assert_eq!(room(u64::MAX, 60, 1 << 20).refuses_segment(), None);
    }

    /// Each process takes as much as it gets.
    #[test]
    fn whatever_processes_take_there_is_room_for_the_next_one() {
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
