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

/// The longest sleep of a waiter where nobody watches the processes that are to ring: the waiter then
/// finds news of a process that ended before it rang. Tests sleep for ever, so that they notice.
const MAX_SLEEP: Option<Duration> = if cfg!(test) { None } else { Some(Duration::from_secs(1)) };

/// What a waiter waits for; each has its own armed word.
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

/// A check that another thread may make for a waiter: whether its wait is over.
pub trait WakeCheck: Send + Sync {
    /// Whether the wait is over. Must be quick, and must not block on a thread that waits at a doorbell.
    fn ready(&self) -> bool;
}

/// A session of this process, at whose doorbell a thread may sleep.
pub(crate) trait WakeListener: Send + Sync {
    /// Makes the listening thread check again.
    fn wake_listener(&self);
}

/// The threads of this process that sleep, and the one of them that listens for all.
///
/// One waiter leads: it listens to the bell, and when it rang, wakes the other waiters whose wait may be over.
/// The others sleep until then. All tickets are given out under the lock, so the armed
/// words only rise and a ringer never mistakes a new ticket for one it has rung for.
pub(crate) struct Doorbell {
    receiver: DoorbellReceiver,
    waiters: Mutex<Waiters>,
    spin: Spin,
    /// Signalled by a leader that has given up its lead on request.
    way: Condvar,
}

#[derive(Default)]
struct Waiters {
    /// Counts what may concern a waiter.
    epoch: u64,
    ticket: u64,
    waiting: [u32; 2],
    leader: Leader,
    /// What the external leader has armed.
    external: [bool; 2],
    followers: Vec<Arc<Follower>>,
    /// Rings whose events have come stand in the queue. They are taken before the next ticket is
    /// given out, which is before anybody can rely on an event of one that is taken with them.
    queued: bool,
    /// Another process closed the bell for all.
    closed: bool,
    /// An event loop is about to lead.
    coming: bool,
    /// Somebody notifies when a process ends that might have rung.
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
    /// It sleeps at the session's doorbell.
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

    /// The end that others ring.
    pub(crate) fn bell(&self) -> &DoorbellSender {
        self.receiver.bell()
    }

    /// Rings from this very process, whatever others do to the bell.
    pub(crate) fn ring_own(&self) {
        self.receiver.wake_self();
    }

    /// Waits until `ready`, asked again after each ring, each [`Doorbell::notify`] and each event
    /// on `others`, or until `timeout` has passed. Returns what `ready` said last.
    ///
    /// A thread that follows does not see `others`. With `look`, which is made when it begins to follow
    /// and must say what `ready` says, it is woken for nothing else but its turn to lead.
    pub(crate) fn wait(
        &self,
        words: Words<'_>,
        purpose: Purpose,
        mut ready: impl FnMut() -> bool,
        look: Option<&dyn Fn() -> Arc<dyn WakeCheck>>,
        others: &[BorrowedFd<'_>],
        timeout: Option<Duration>,
    ) -> bool {
        // What does not sleep in the end costs no look at the clock that can be done without.
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
        // Also when `ready` panics.
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
            // Most sleeps end with what they were for, which is not kept waiting for another ticket.
            if ready() {
                self.spin.slept(start.elapsed());
                return true;
            }
        }
    }

    /// The caller [notifies](Self::notify) when a process ends that might have rung: from now on
    /// waiters sleep for as long as nothing comes.
    pub(crate) fn is_watched(&self) {
        self.lock().watched = true;
    }

    /// Makes every waiter of this process look again.
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

    /// Sleeps until something happened after epoch `armed_at`, or for `left`.
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

    /// Wakes those of the waiters that what was heard may concern.
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
            // What comes after a look must ring again.
            waiters.arm(&self.receiver, &[words[Purpose::Samples as usize]]);
        }
        drop(waiters);
        for follower in followers {
            if follower.look.as_ref().is_none_or(|look| look.ready()) {
                follower.wake();
            }
        }
    }

    /// Has the doorbell of `elsewhere`, where a thread of this process sleeps, rung when `look` may be
    /// ready, until what this returns is dropped. Somebody must listen here meanwhile.
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

    /// An event loop leads from now on; `false` when another one does already.
    pub(crate) fn lead_from_outside(&self) -> bool {
        let mut waiters = self.lock();
        if waiters.coming || waiters.leader == Leader::External {
            return false;
        }
        waiters.coming = true;
        while waiters.leader == Leader::Thread {
            // It gives up the lead when it next wakes, which is now.
            self.receiver.wake_self();
            waiters = self.way.wait(waiters).unwrap_or_else(PoisonError::into_inner);
        }
        waiters.coming = false;
        waiters.leader = Leader::External;
        waiters.pace(&self.receiver);
        true
    }

    /// The event loop takes what came.
    pub(crate) fn take_from_outside(&self, words: Words<'_>) {
        let heard = self.receiver.take(Some(&Timespec::default()));
        self.spread(self.lock(), words, heard);
    }

    /// The event loop is about to sleep.
    pub(crate) fn arm_from_outside(&self, words: Words<'_>, purposes: &[Purpose]) {
        let mut waiters = self.lock();
        for &purpose in purposes {
            waiters.external[purpose as usize] = true;
            waiters.arm(&self.receiver, &[words[purpose as usize]]);
        }
    }

    /// The event loop is not going to sleep.
    pub(crate) fn disarm_from_outside(&self, words: Words<'_>) {
        let mut waiters = self.lock();
        waiters.external = [false; 2];
        PURPOSES.iter().for_each(|&purpose| waiters.disarm_idle(purpose, words));
    }

    /// The event loop leads no more.
    pub(crate) fn leave_from_outside(&self) {
        let mut waiters = self.lock();
        waiters.leader = Leader::None;
        waiters.pace(&self.receiver);
        waiters.hand_over();
    }

    /// As where the kernel cannot keep descriptors out of the bell.
    #[cfg(test)]
    pub(crate) fn let_rights_pass(&mut self) {
        self.receiver.let_rights_pass();
    }

    fn lock(&self) -> MutexGuard<'_, Waiters> {
        self.waiters.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl AsFd for Doorbell {
    /// Readable when it rang.
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.receiver.as_fd()
    }
}

/// A follower that sleeps elsewhere, until it is dropped.
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

/// One of the waiters, until it is dropped.
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
    /// Gives out a new ticket.
    fn arm(&mut self, receiver: &DoorbellReceiver, words: &[&AtomicU64]) {
        if self.queued {
            let drained = receiver.drain();
            self.queued = drained == Drained::Some;
            match drained {
                Drained::All => {}
                // A ring whose event was still to come may have been taken with the others, and
                // somebody sleeps who relies on it.
                Drained::Some => receiver.wake_self(),
                Drained::Rights => {
                    self.give_up(receiver, "put descriptors into the session's doorbell")
                }
            }
        }
        self.ticket += 1;
        words.iter().for_each(|word| arm(*word, self.ticket));
    }

    /// The bell is of no use any more: there is a look for news by time.
    fn give_up(&mut self, receiver: &DoorbellReceiver, what: &str) {
        self.closed = true;
        receiver.give_up();
        self.pace(receiver);
        tracing::error!(
            "doorbell unusable: another process {what}; this session now polls every few milliseconds"
        );
    }

    /// Has who listens woken for nothing as often as is needed.
    fn pace(&self, receiver: &DoorbellReceiver) {
        let interval = match self.leader {
            _ if self.closed => Some(CLOSED),
            // Threads that listen see to it themselves.
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

    /// Has one of those that sleep listen, when nobody does.
    fn hand_over(&self) {
        if self.leader == Leader::None
            && let Some(follower) = self.followers.iter().rfind(|one| one.elsewhere.is_none())
        {
            follower.wake();
        }
    }
}
