//! Changes of a session, and the threads and the listener that wait for them.

use std::{
    fmt,
    sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError},
    time::{Duration, Instant},
};

use crate::ids::{DaemonId, Gid};

/// A change that a session's owner may want to know about.
///
/// ```
/// use axon_transport::SessionEvent;
///
/// fn log(event: &SessionEvent) {
///     match event {
///         SessionEvent::DaemonLost => println!("the daemon is gone"),
///         SessionEvent::DaemonFound(daemon) => println!("connected to daemon {daemon:?}"),
///         other => println!("{other:?}"),
///     }
/// }
/// # log(&SessionEvent::DaemonLost);
/// ```
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum SessionEvent {
    /// The graph changed.
    Graph,
    /// The readers of this publisher, or the publishers of this subscription, changed.
    Matched(Gid),
    /// The daemon is gone. Attached rings continue to carry samples.
    DaemonLost,
    /// A daemon, perhaps another one than before, knows the session's endpoints.
    DaemonFound(DaemonId),
    /// The daemon refuses this endpoint: no other session learns of it, and the graph does not show it.
    Refused(Gid),
}

type Listener = Arc<dyn Fn(&SessionEvent) + Send + Sync>;

/// The threads that wait for a change of the session, and the listener that receives each event.
#[derive(Default)]
pub(in crate::session) struct ChangeWaiters {
    /// Counts changes that may end a wait.
    count: Mutex<u64>,
    changed: Condvar,
    listener: Mutex<Option<Listener>>,
}

impl ChangeWaiters {
    /// Makes the waiting threads look again. The caller makes the change before this call.
    pub(in crate::session) fn notify(&self) {
        *self.lock() += 1;
        self.changed.notify_all();
    }

    /// Waits for changes until `reached` returns true; it runs without a lock. Returns false if the time is over.
    pub(in crate::session) fn wait(
        &self,
        timeout: Duration,
        mut reached: impl FnMut() -> bool,
    ) -> bool {
        let deadline = Instant::now().checked_add(timeout);
        loop {
            // Read before `reached` looks, so that a change after it is not missed.
            let seen = *self.lock();
            if reached() {
                return true;
            }
            let mut count = self.lock();
            while *count == seen {
                let left =
                    deadline.map_or(Duration::MAX, |d| d.saturating_duration_since(Instant::now()));
                if left.is_zero() {
                    return false;
                }
                let nap = left.min(Duration::from_secs(3600));
                let woken = self.changed.wait_timeout(count, nap);
                count = woken.unwrap_or_else(PoisonError::into_inner).0;
            }
        }
    }

    /// Sets the listener that is called for every event, in place of the previous one.
    pub(in crate::session) fn set_listener(
        &self,
        listener: impl Fn(&SessionEvent) + Send + Sync + 'static,
    ) {
        let mut slot = self.listener.lock().unwrap_or_else(PoisonError::into_inner);
        *slot = Some(Arc::new(listener));
    }

    /// Calls the listener, if there is one.
    pub(in crate::session) fn tell_listener(&self, event: &SessionEvent) {
        let listener = self.listener.lock().unwrap_or_else(PoisonError::into_inner).clone();
        if let Some(listener) = listener {
            listener(event);
        }
    }

    fn lock(&self) -> MutexGuard<'_, u64> {
        self.count.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl fmt::Debug for ChangeWaiters {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("ChangeWaiters").finish_non_exhaustive()
    }
}
