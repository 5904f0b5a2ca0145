//! The doorbell of a session and the threads that wait for it.

use std::{
    os::fd::{AsFd, BorrowedFd, OwnedFd},
    sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError, atomic::AtomicU64},
    time::{Duration, Instant},
};

use rustix::{
    event::{EventfdFlags, PollFd, PollFlags, Timespec, eventfd, poll},
    io::{Errno, read, write},
};

use super::{arm, disarm};
use crate::shm::SessionSegment;

/// What a waiter waits for; each has its own armed word.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Purpose {
    /// Samples to take, or any other news.
    Samples = 0,
    /// Room to publish.
    Room = 1,
}

const PURPOSES: [Purpose; 2] = [Purpose::Samples, Purpose::Room];

/// The ringing end of a doorbell: an eventfd, ours or another session's.
pub(crate) struct Bell(OwnedFd);

impl Bell {
    pub(crate) fn new(fd: OwnedFd) -> Self {
        Self(fd)
    }

    /// Rings. That the counter is full is as good: then it is readable already.
    pub(crate) fn ring(&self) {
        let _ = write(&self.0, &1u64.to_ne_bytes());
    }
}

impl AsFd for Bell {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.0.as_fd()
    }
}

/// The waiting end: who of this process sleeps, and who of them polls for all.
///
/// One waiter leads: it polls the eventfd, takes the rings that came and wakes the others, which
/// sleep on a condition variable until something happened since they armed. All tickets are given
/// out under the lock, so the armed words only rise and a ringer never mistakes a new ticket for
/// one it has rung for.
pub(crate) struct Doorbell {
    bell: Bell,
    crowd: Mutex<Crowd>,
    turn: Condvar,
}

#[derive(Default)]
struct Crowd {
    /// Counts what may concern a waiter.
    epoch: u64,
    ticket: u64,
    waiting: [u32; 2],
    leader: Leader,
    /// What the external leader has armed.
    external: [bool; 2],
}

#[derive(Default, PartialEq, Eq)]
enum Leader {
    #[default]
    None,
    Thread,
    External,
}

impl Doorbell {
    pub(crate) fn new() -> Result<Self, Errno> {
        let fd = eventfd(0, EventfdFlags::CLOEXEC | EventfdFlags::NONBLOCK)?;
        Ok(Self { bell: Bell::new(fd), crowd: Mutex::default(), turn: Condvar::new() })
    }

    pub(crate) fn bell(&self) -> &Bell {
        &self.bell
    }

    /// Waits until `ready`, asked again after each ring, each [`Doorbell::notify`] and each event
    /// on `others`, or until `timeout` has passed. Returns what `ready` said last.
    ///
    /// `word` is the armed word of `purpose`. A thread that follows does not see `others`.
    pub(crate) fn wait(
        &self,
        word: &AtomicU64,
        purpose: Purpose,
        mut ready: impl FnMut() -> bool,
        others: &[BorrowedFd<'_>],
        timeout: Option<Duration>,
    ) -> bool {
        if ready() {
            return true;
        }
        let deadline = timeout.and_then(|timeout| Instant::now().checked_add(timeout));
        // Also when `ready` panics.
        let _waiting = Waiting::new(self, word, purpose);
        loop {
            let armed_at = {
                let mut crowd = self.lock();
                crowd.ticket += 1;
                arm(word, crowd.ticket);
                crowd.epoch
            };
            if ready() {
                return true;
            }
            let left = deadline.map(|deadline| deadline.saturating_duration_since(Instant::now()));
            if left.is_some_and(|left| left.is_zero()) {
                return false;
            }
            self.sleep(armed_at, others, left);
        }
    }

    /// Makes every waiter of this process look again.
    pub(crate) fn notify(&self) {
        let mut crowd = self.lock();
        crowd.epoch += 1;
        let polled = crowd.leader != Leader::None;
        drop(crowd);
        self.turn.notify_all();
        if polled {
            self.bell.ring();
        }
    }

    /// Sleeps until something happened after epoch `armed_at`, or for `left`.
    fn sleep(&self, armed_at: u64, others: &[BorrowedFd<'_>], left: Option<Duration>) {
        let mut crowd = self.lock();
        if crowd.epoch != armed_at {
            return;
        }
        if crowd.leader != Leader::None {
            match left {
                Some(left) => drop(self.turn.wait_timeout(crowd, left)),
                None => drop(self.turn.wait(crowd)),
            }
            return;
        }
        crowd.leader = Leader::Thread;
        drop(crowd);
        let rung = poll_readable(self.bell.as_fd(), others, left);
        let mut crowd = self.lock();
        crowd.leader = Leader::None;
        if rung {
            self.take_rings(&mut crowd);
        }
        drop(crowd);
        self.turn.notify_all();
    }

    fn take_rings(&self, crowd: &mut Crowd) {
        let mut counter = [0; 8];
        let _ = read(&self.bell, &mut counter);
        crowd.epoch += 1;
    }

    fn lock(&self) -> MutexGuard<'_, Crowd> {
        self.crowd.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// One of the crowd, until it is dropped.
struct Waiting<'a> {
    doorbell: &'a Doorbell,
    word: &'a AtomicU64,
    purpose: Purpose,
}

impl<'a> Waiting<'a> {
    fn new(doorbell: &'a Doorbell, word: &'a AtomicU64, purpose: Purpose) -> Self {
        doorbell.lock().waiting[purpose as usize] += 1;
        Self { doorbell, word, purpose }
    }
}

impl Drop for Waiting<'_> {
    fn drop(&mut self) {
        let mut crowd = self.doorbell.lock();
        crowd.waiting[self.purpose as usize] -= 1;
        crowd.disarm_idle(self.purpose, self.word);
        drop(crowd);
        // Whoever led may be gone: another one of the crowd takes over.
        self.doorbell.turn.notify_one();
    }
}

impl Crowd {
    fn disarm_idle(&self, purpose: Purpose, word: &AtomicU64) {
        if self.waiting[purpose as usize] == 0 && !self.external[purpose as usize] {
            disarm(word);
        }
    }
}

fn poll_readable(bell: BorrowedFd<'_>, others: &[BorrowedFd<'_>], left: Option<Duration>) -> bool {
    let timeout = left.and_then(|left| Timespec::try_from(left).ok());
    let poll_fd = |fd| PollFd::from_borrowed_fd(fd, PollFlags::IN);
    let (mut alone, mut all);
    let fds = if others.is_empty() {
        alone = [poll_fd(bell)];
        &mut alone[..]
    } else {
        all = Vec::with_capacity(1 + others.len());
        all.extend([bell].iter().chain(others).map(|fd| poll_fd(*fd)));
        &mut all[..]
    };
    // An interrupted poll counts as a spurious wake: the caller looks again and computes what
    // remains of its time.
    poll(fds, timeout.as_ref()).is_ok() && !fds[0].revents().is_empty()
}

/// Leads a session's waits from an event loop instead of a blocked thread.
///
/// Each round: [`clear`](Self::clear), [`arm`](Self::arm), look for work; if there is some,
/// [`disarm`](Self::disarm) and do it, else await that the descriptor is readable. Threads that
/// wait meanwhile are woken by `clear`. In a forked child it does nothing.
pub struct ExternalLeader {
    session: Arc<SessionSegment>,
}

impl ExternalLeader {
    /// `None` when the session has an external leader already.
    pub(crate) fn new(session: Arc<SessionSegment>) -> Option<Self> {
        let doorbell = session.doorbell_hub();
        let mut crowd = doorbell.lock();
        if crowd.leader == Leader::External {
            return None;
        }
        // A thread that leads gives up the lead when it next wakes, which is now.
        while crowd.leader == Leader::Thread {
            doorbell.bell.ring();
            let waited = doorbell.turn.wait_timeout(crowd, Duration::from_millis(1));
            crowd = waited.unwrap_or_else(PoisonError::into_inner).0;
            if crowd.leader == Leader::External {
                return None;
            }
        }
        crowd.leader = Leader::External;
        drop(crowd);
        Some(Self { session })
    }

    /// Takes the rings that came and makes the session's other waiters look again.
    pub fn clear(&self) {
        if self.session.is_forked() {
            return;
        }
        let doorbell = self.session.doorbell_hub();
        let mut crowd = doorbell.lock();
        doorbell.take_rings(&mut crowd);
        drop(crowd);
        doorbell.turn.notify_all();
    }

    /// Arms a new ticket: whatever comes after it rings the doorbell. With `room`, so does room
    /// for a publish that gave [`PublishError::Blocked`](crate::shm::PublishError::Blocked).
    pub fn arm(&self, room: bool) {
        if self.session.is_forked() {
            return;
        }
        let mut crowd = self.session.doorbell_hub().lock();
        crowd.ticket += 1;
        for purpose in PURPOSES {
            if purpose == Purpose::Samples || room {
                crowd.external[purpose as usize] = true;
                arm(self.session.armed_word(purpose), crowd.ticket);
            }
        }
    }

    /// Ends the round without a sleep.
    pub fn disarm(&self) {
        if self.session.is_forked() {
            return;
        }
        let mut crowd = self.session.doorbell_hub().lock();
        crowd.external = [false; 2];
        for purpose in PURPOSES {
            crowd.disarm_idle(purpose, self.session.armed_word(purpose));
        }
    }
}

impl AsFd for ExternalLeader {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.session.doorbell()
    }
}

impl Drop for ExternalLeader {
    fn drop(&mut self) {
        if self.session.is_forked() {
            return;
        }
        self.disarm();
        let doorbell = self.session.doorbell_hub();
        doorbell.lock().leader = Leader::None;
        doorbell.turn.notify_all();
    }
}
