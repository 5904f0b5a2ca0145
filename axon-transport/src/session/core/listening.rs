//! Counts the callbacks and tasks for which the control thread listens on the session's doorbell, and stores the time
//! at which waiting threads and tasks look again without a ring.

use std::{
    sync::{Arc, Mutex, MutexGuard, PoisonError},
    time::{Duration, Instant},
};

use axon_shm::{ExternalLeader, ShmError, internal::SessionSegment};

/// Time for which the control thread still listens after the last task: most tasks wait again, and each begin and end
/// costs several system calls.
const LINGER: Duration = Duration::from_secs(1);

/// The leader by which the control thread listens, and the number of callbacks and tasks that need it.
#[derive(Default)]
pub(in crate::session) struct Listening {
    state: Mutex<ListeningState>,
    /// Deadline at which waiters check again without an event.
    again: Mutex<Option<Instant>>,
}

#[derive(Default)]
struct ListeningState {
    /// Number of subscriptions with a callback, and of waits by other sessions. Each ring is answered for them.
    callbacks: usize,
    /// Number of waiting futures, and of streams that may wait again. They arm a ticket when they wait.
    tasks: usize,
    leader: Option<Arc<ExternalLeader>>,
    /// Time at which listening ends, unless it is needed then. The control thread checks at that time.
    until: Option<Instant>,
}

impl Listening {
    /// Begins to listen for a callback. Returns whether the control thread has to be woken.
    pub(in crate::session) fn begin_callback(
        &self,
        segment: &Arc<SessionSegment>,
    ) -> Result<bool, ShmError> {
        let mut state = self.lock();
        let new = state.lead(segment)?;
        state.callbacks += 1;
        // Arms a ticket for a control thread that is asleep already and has armed none since the last one was used up.
        state.arm();
        Ok(new)
    }

    /// Stops listening for a callback. Returns whether the control thread has to be woken.
    pub(in crate::session) fn end_callback(&self) -> bool {
        let mut state = self.lock();
        state.callbacks -= 1;
        let idle = state.is_idle();
        if idle {
            state.until = Some(Instant::now());
        }
        idle
    }

    /// Begins to listen for a task that waits or may wait. Returns whether the control thread has to be woken.
    pub(super) fn begin_task(&self, segment: &Arc<SessionSegment>) -> Result<bool, ShmError> {
        let mut state = self.lock();
        let new = state.lead(segment)?;
        state.tasks += 1;
        Ok(new)
    }

    /// Stops listening for a task. Returns whether the control thread must be woken: not if it checks soon anyway.
    pub(super) fn end_task(&self) -> bool {
        let mut state = self.lock();
        state.tasks -= 1;
        state.is_idle() && state.until.is_none()
    }

    /// Arms the doorbell: the next sample rings it.
    pub(in crate::session) fn arm(&self) {
        self.lock().arm();
    }

    /// Returns whether a callback is set, which receives every sample.
    pub(in crate::session) fn has_callbacks(&self) -> bool {
        self.lock().callbacks > 0
    }

    /// Returns the leader by which the control thread listens, and the time at which it must call this again. The
    /// control thread must have dropped the leader that it got before.
    pub(in crate::session) fn leader(&self) -> (Option<Arc<ExternalLeader>>, Option<Instant>) {
        let mut state = self.lock();
        if state.leader.is_none() {
            return (None, None);
        }
        let now = Instant::now();
        if state.is_idle() {
            let until = *state.until.get_or_insert(now + LINGER);
            if until <= now {
                // Dropped under the lock: otherwise the next listener would find a leader and could not begin.
                state.leader = None;
                state.until = None;
            }
        } else if state.until.is_some_and(|until| until <= now) {
            state.until = None;
        }
        (state.leader.clone(), state.until)
    }

    /// Makes waiting threads and tasks look again at `at`. Returns whether that is sooner than the time set before.
    pub(super) fn look_again(&self, at: Instant) -> bool {
        let mut again = self.again.lock().unwrap_or_else(PoisonError::into_inner);
        let sooner = again.is_none_or(|before| at < before);
        if sooner {
            *again = Some(at);
        }
        sooner
    }

    /// Returns whether waiting threads and tasks have to look again now, and the next time at which they have to.
    pub(in crate::session) fn take_due(&self, now: Instant) -> (bool, Option<Instant>) {
        let mut again = self.again.lock().unwrap_or_else(PoisonError::into_inner);
        let due = again.take_if(|again| *again <= now).is_some();
        (due, *again)
    }

    fn lock(&self) -> MutexGuard<'_, ListeningState> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl ListeningState {
    /// Makes sure that there is a leader. Returns whether it is a new one.
    fn lead(&mut self, segment: &Arc<SessionSegment>) -> Result<bool, ShmError> {
        let new = self.leader.is_none();
        if new {
            self.leader = Some(Arc::new(segment.external_leader()?));
        }
        Ok(new)
    }

    fn arm(&self) {
        if let Some(leader) = &self.leader {
            leader.arm(false);
        }
    }

    fn is_idle(&self) -> bool {
        self.callbacks + self.tasks == 0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_soonest_look_counts_and_is_over_once_it_was_due() {
        let (listening, now) = (Listening::default(), Instant::now());
        let second = Duration::from_secs(1);
        assert_eq!(listening.take_due(now), (false, None));
        assert!(listening.look_again(now + 2 * second));
        assert!(listening.look_again(now + second));
        assert!(!listening.look_again(now + 2 * second), "it is looked sooner");
        assert_eq!(listening.take_due(now), (false, Some(now + second)));
        assert_eq!(listening.take_due(now + second), (true, None));
    }
}
