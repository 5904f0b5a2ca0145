//! The doorbell of a session and the threads that wait for it.

use std::{
    os::fd::{AsFd, BorrowedFd},
    sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError, atomic::AtomicU64},
    time::{Duration, Instant},
};

use rustix::{event::Timespec, io::Errno};

use super::{
    DoorbellSender, arm, disarm,
    receiver::{CLOSED, DoorbellReceiver, Drained, HeardBells},
    spin::Spin,
};

/// The longest sleep of a waiter if nobody watches the processes that may ring. It then finds the news of a process
/// that ended before it rang. In tests waiters sleep for ever, so that a lost ring is noticed.
const MAX_SLEEP: Option<Duration> = if cfg!(test) { None } else { Some(Duration::from_secs(1)) };

/// The purpose of a wait; each has its own armed word.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Purpose {
    /// Samples to take, or any other news.
    Samples = 0,
    /// Room to publish.
    Room = 1,
}

pub(crate) const PURPOSES: [Purpose; 2] = [Purpose::Samples, Purpose::Room];

/// The armed words, in the order of [`PURPOSES`].
pub(crate) type Words<'a> = [&'a AtomicU64; 2];

/// A check that another thread may make for a waiter.
pub trait WakeCheck: Send + Sync {
    /// Returns whether the wait is over. Must be quick, and must not block on a thread that waits at a doorbell.
    fn ready(&self) -> bool;
}

/// A session of this process at whose doorbell a thread may sleep.
pub(crate) trait WakeListener: Send + Sync {
    /// Makes the listening thread check again.
    fn wake_listener(&self);
}

/// The sleeping threads of this process, and the thread that listens for all of them.
///
/// One waiter leads: it listens to the bell, and when the bell rang, it wakes the other waiters whose wait may be over.
/// The others sleep until then. All tickets are issued under the lock, so the armed words only increase, and a ringer
/// never mistakes a new ticket for one that it has rung for.
pub(crate) struct Doorbell {
    receiver: DoorbellReceiver,
    waiters: Mutex<Waiters>,
    spin: Spin,
    /// Signalled by a leader that has given up its lead on request.
    way: Condvar,
}

#[derive(Default)]
struct Waiters {
    /// Counts the events that may concern a waiter.
    epoch: u64,
    ticket: u64,
    waiting: [u32; 2],
    leader: Leader,
    /// The purposes that the external leader has armed.
    external: [bool; 2],
    followers: Vec<Arc<Follower>>,
    /// True if the queue holds rings whose events have arrived. They are drained before the next ticket is issued, so
    /// before any thread relies on the event of a ring that is drained with them.
    queued: bool,
    /// True if another process closed the bell for all.
    closed: bool,
    /// True if an event loop is about to lead.
    coming: bool,
    /// True if another thread calls `notify` when a process ends that might have rung.
    watched: bool,
}

#[derive(Default, PartialEq, Eq)]
enum Leader {
    #[default]
    None,
    Thread,
    External,
}

/// A waiter that sleeps while another one listens.
struct Follower {
    turn: Condvar,
    look: Option<Arc<dyn WakeCheck>>,
    /// Set if the waiter sleeps at this session's doorbell instead.
    elsewhere: Option<Arc<dyn WakeListener>>,
}

impl Follower {
    fn wake(&self) {
        match &self.elsewhere {
            Some(session) => session.wake_listener(),
            None => self.turn.notify_one(),
        }
    }
}

impl Doorbell {
    pub(crate) fn new() -> Result<Self, Errno> {
        Ok(Self {
            receiver: DoorbellReceiver::new()?,
            waiters: Mutex::default(),
            spin: Spin::new(),
            way: Condvar::new(),
        })
    }

    /// Returns the end that other processes ring.
    pub(crate) fn bell(&self) -> &DoorbellSender {
        self.receiver.bell()
    }

    /// Rings from within this process. Works whatever other processes do to the bell.
    pub(crate) fn ring_own(&self) {
        self.receiver.wake_self();
    }

    /// Waits until `ready` returns true or until `timeout` has passed. `ready` is called again after each ring, each
    /// [`Doorbell::notify`] and each event on `others`. Returns the last result of `ready`.
    ///
    /// A thread that follows does not see `others`. `look` makes a check when the thread begins to follow; the check
    /// must return what `ready` returns. With it, the thread is woken only if the check succeeds or if its turn to lead
    /// has come.
    pub(crate) fn wait(
        &self,
        words: Words<'_>,
        purpose: Purpose,
        mut ready: impl FnMut() -> bool,
        look: Option<&dyn Fn() -> Arc<dyn WakeCheck>>,
        others: &[BorrowedFd<'_>],
        timeout: Option<Duration>,
    ) -> bool {
        // A wait that need not sleep should not read the clock.
        if ready() {
            return true;
        }
        if timeout == Some(Duration::ZERO) {
            return false;
        }
        let now = Instant::now();
        let deadline = timeout.and_then(|timeout| now.checked_add(timeout));
        if self.spin.look(&mut ready, now, deadline) {
            return true;
        }
        let start = Instant::now();
        // Also dropped when `ready` panics.
        let _waiting = Waiting::new(self, words, purpose);
        loop {
            let armed_at = {
                let mut waiters = self.lock();
                waiters.arm(&self.receiver, &[words[purpose as usize]]);
                waiters.epoch
            };
            if ready() {
                self.spin.slept(start.elapsed());
                return true;
            }
            let left = deadline.map(|deadline| deadline.saturating_duration_since(Instant::now()));
            if left.is_some_and(|left| left.is_zero()) {
                return false;
            }
            self.sleep(words, armed_at, look, others, left);
            // Most sleeps end because `ready` holds. Then no other ticket is issued.
            if ready() {
                self.spin.slept(start.elapsed());
                return true;
            }
        }
    }

    /// Declares that the caller [notifies](Self::notify) when a process ends that might have rung. From now on waiters
    /// sleep without a limit.
    pub(crate) fn is_watched(&self) {
        self.lock().watched = true;
    }

    /// Makes every waiter of this process call its `ready` again.
    pub(crate) fn notify(&self) {
        let mut waiters = self.lock();
        waiters.epoch += 1;
        waiters.followers.iter().for_each(|follower| follower.wake());
        let heard = waiters.leader != Leader::None;
        drop(waiters);
        if heard {
            self.receiver.wake_self();
        }
    }

    /// Sleeps until something happens after epoch `armed_at`, at most for `left`.
    fn sleep(
        &self,
        words: Words<'_>,
        armed_at: u64,
        look: Option<&dyn Fn() -> Arc<dyn WakeCheck>>,
        others: &[BorrowedFd<'_>],
        left: Option<Duration>,
    ) {
        let mut waiters = self.lock();
        if waiters.epoch != armed_at {
            return;
        }
        if waiters.leader != Leader::None || waiters.coming {
            self.follow(waiters, look.map(|look| look()), left);
            return;
        }
        waiters.leader = Leader::Thread;
        let left = waiters.not_too_long(left);
        drop(waiters);
        let heard = self.receiver.listen(others, left);
        let mut waiters = self.lock();
        waiters.leader = Leader::None;
        if waiters.coming {
            self.way.notify_all();
        }
        self.spread(waiters, words, heard);
    }

    fn follow(
        &self,
        mut waiters: MutexGuard<'_, Waiters>,
        look: Option<Arc<dyn WakeCheck>>,
        left: Option<Duration>,
    ) {
        let follower = Arc::new(Follower { turn: Condvar::new(), look, elsewhere: None });
        waiters.followers.push(Arc::clone(&follower));
        waiters = match waiters.not_too_long(left) {
            Some(left) => {
                let woken = follower.turn.wait_timeout(waiters, left);
                woken.unwrap_or_else(PoisonError::into_inner).0
            }
            None => follower.turn.wait(waiters).unwrap_or_else(PoisonError::into_inner),
        };
        waiters.followers.retain(|other| !Arc::ptr_eq(other, &follower));
    }

    /// Wakes the waiters that the events may concern.
    fn spread(&self, mut waiters: MutexGuard<'_, Waiters>, words: Words<'_>, heard: HeardBells) {
        if heard.closed && !waiters.closed {
            waiters.give_up(&self.receiver, "closed the session's doorbell");
        }
        waiters.queued = (waiters.queued || heard.queued) && !waiters.closed;
        let rung = heard.rung || (heard.tick && waiters.closed);
        if !rung {
            return;
        }
        waiters.epoch += 1;
        if waiters.followers.is_empty() {
            return;
        }
        let followers = waiters.followers.clone();
        if followers.iter().any(|follower| follower.look.is_some()) {
            // News that comes after a check must ring again.
            waiters.arm(&self.receiver, &[words[Purpose::Samples as usize]]);
        }
        drop(waiters);
        for follower in followers {
            if follower.look.as_ref().is_none_or(|look| look.ready()) {
                follower.wake();
            }
        }
    }

    /// Rings the doorbell of `elsewhere`, where a thread of this process sleeps, when `look` may be ready, until the
    /// returned value is dropped. Another thread must listen here meanwhile.
    pub(crate) fn forward_wakeups<'a>(
        &'a self,
        words: Words<'a>,
        look: Arc<dyn WakeCheck>,
        elsewhere: Arc<dyn WakeListener>,
    ) -> ForwardedWakeups<'a> {
        let waiting = Waiting::new(self, words, Purpose::Samples);
        let (look, elsewhere) = (Some(look), Some(elsewhere));
        let follower = Arc::new(Follower { turn: Condvar::new(), look, elsewhere });
        let mut waiters = self.lock();
        waiters.followers.push(follower.clone());
        waiters.arm(&self.receiver, &[words[Purpose::Samples as usize]]);
        ForwardedWakeups { follower, waiting }
    }

    /// Makes an event loop the leader. Returns false if another one leads already.
    pub(crate) fn lead_from_outside(&self) -> bool {
        let mut waiters = self.lock();
        if waiters.coming || waiters.leader == Leader::External {
            return false;
        }
        waiters.coming = true;
        while waiters.leader == Leader::Thread {
            // The thread gives up the lead when it next wakes, which this causes.
            self.receiver.wake_self();
            waiters = self.way.wait(waiters).unwrap_or_else(PoisonError::into_inner);
        }
        waiters.coming = false;
        waiters.leader = Leader::External;
        waiters.pace(&self.receiver);
        true
    }

    /// Handles the events that arrived, for the event loop.
    pub(crate) fn take_from_outside(&self, words: Words<'_>) {
        let heard = self.receiver.take(Some(&Timespec::default()));
        self.spread(self.lock(), words, heard);
    }

    /// Arms the words, because the event loop is about to sleep.
    pub(crate) fn arm_from_outside(&self, words: Words<'_>, purposes: &[Purpose]) {
        let mut waiters = self.lock();
        for &purpose in purposes {
            waiters.external[purpose as usize] = true;
            waiters.arm(&self.receiver, &[words[purpose as usize]]);
        }
    }

    /// Disarms the words, because the event loop does not sleep.
    pub(crate) fn disarm_from_outside(&self, words: Words<'_>) {
        let mut waiters = self.lock();
        waiters.external = [false; 2];
        PURPOSES.iter().for_each(|&purpose| waiters.disarm_idle(purpose, words));
    }

    /// Ends the lead of the event loop.
    pub(crate) fn leave_from_outside(&self) {
        let mut waiters = self.lock();
        waiters.leader = Leader::None;
        waiters.pace(&self.receiver);
        waiters.hand_over();
    }

    /// Acts like a kernel that cannot keep descriptors out of the bell.
    #[cfg(test)]
    pub(crate) fn let_rights_pass(&mut self) {
        self.receiver.let_rights_pass();
    }

    fn lock(&self) -> MutexGuard<'_, Waiters> {
        self.waiters.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl AsFd for Doorbell {
    /// Returns a descriptor that is readable after a ring.
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.receiver.as_fd()
    }
}

/// Forwards wake-ups to a follower that sleeps at another doorbell, until it is dropped.
pub struct ForwardedWakeups<'a> {
    follower: Arc<Follower>,
    waiting: Waiting<'a>,
}

impl Drop for ForwardedWakeups<'_> {
    fn drop(&mut self) {
        let mut waiters = self.waiting.doorbell.lock();
        waiters.followers.retain(|other| !Arc::ptr_eq(other, &self.follower));
    }
}

/// The registration of a waiter, until it is dropped.
struct Waiting<'a> {
    doorbell: &'a Doorbell,
    words: Words<'a>,
    purpose: Purpose,
}

impl<'a> Waiting<'a> {
    fn new(doorbell: &'a Doorbell, words: Words<'a>, purpose: Purpose) -> Self {
        doorbell.lock().waiting[purpose as usize] += 1;
        Self { doorbell, words, purpose }
    }
}

impl Drop for Waiting<'_> {
    fn drop(&mut self) {
        let mut waiters = self.doorbell.lock();
        waiters.waiting[self.purpose as usize] -= 1;
        waiters.disarm_idle(self.purpose, self.words);
        waiters.hand_over();
    }
}

impl Waiters {
    /// Issues a new ticket.
    fn arm(&mut self, receiver: &DoorbellReceiver, words: &[&AtomicU64]) {
        if self.queued {
            let drained = receiver.drain();
            self.queued = drained == Drained::Some;
            match drained {
                Drained::All => {}
                // A ring whose event is still to come may have been drained with the others, and a sleeping thread may
                // rely on it.
                Drained::Some => receiver.wake_self(),
                Drained::Rights => {
                    self.give_up(receiver, "put descriptors into the session's doorbell")
                }
            }
        }
        self.ticket += 1;
        words.iter().for_each(|word| arm(*word, self.ticket));
    }

    /// Gives up the bell, which has become useless. Waiters poll for news instead.
    fn give_up(&mut self, receiver: &DoorbellReceiver, what: &str) {
        self.closed = true;
        receiver.give_up();
        self.pace(receiver);
        tracing::error!(
            "doorbell unusable: another process {what}; this session now polls every few milliseconds"
        );
    }

    /// Sets the timer that wakes the listener without a ring.
    fn pace(&self, receiver: &DoorbellReceiver) {
        let interval = match self.leader {
            _ if self.closed => Some(CLOSED),
            // Threads limit their own sleeps.
            Leader::External => self.longest(),
            Leader::None | Leader::Thread => None,
        };
        receiver.tick(interval);
    }

    fn longest(&self) -> Option<Duration> {
        MAX_SLEEP.filter(|_| !self.watched)
    }

    fn not_too_long(&self, left: Option<Duration>) -> Option<Duration> {
        left.into_iter().chain(self.longest()).min()
    }

    fn disarm_idle(&self, purpose: Purpose, words: Words<'_>) {
        if self.waiting[purpose as usize] == 0 && !self.external[purpose as usize] {
            disarm(words[purpose as usize]);
        }
    }

    /// Wakes a sleeping thread to lead, if no thread leads.
    fn hand_over(&self) {
        if self.leader == Leader::None
            && let Some(follower) = self.followers.iter().rfind(|one| one.elsewhere.is_none())
        {
            follower.wake();
        }
    }
}
