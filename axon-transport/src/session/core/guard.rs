//! Guard conditions: conditions that a program triggers itself.

use std::{
    fmt,
    sync::{
        Arc, Weak,
        atomic::{AtomicBool, Ordering},
    },
};

use axon_shm::internal::SessionSegment;

use super::SessionCore;

/// A condition that is set from its trigger until a wait has seen it. Thread-safe; cheap to clone, and all clones are
/// the same condition.
///
/// ```
/// # use std::time::Duration;
/// use axon_transport::Waitable;
/// # use axon_transport::{
/// #     Session, SessionOptions,
/// #     config::{Config, DaemonPolicy},
/// # };
/// # let config = Config::builder().daemon(DaemonPolicy::Off).build()?;
/// # let session = Session::open(&config, SessionOptions::new("robot"))?;
/// let stop = session.create_guard_condition();
/// let clone = stop.clone();
/// let other = std::thread::spawn(move || clone.trigger());
/// let ready = session.wait_for(&[Waitable::GuardCondition(&stop)], Some(Duration::from_secs(10)))?;
/// assert_eq!(ready[..], [0]);
/// assert!(!stop.is_triggered(), "the wait resets it");
/// # other.join().unwrap();
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Clone)]
pub struct GuardCondition {
    inner: Arc<Guard>,
}

pub(in crate::session) struct Guard {
    triggered: AtomicBool,
    segment: Arc<SessionSegment>,
    session: Weak<SessionCore>,
}

impl GuardCondition {
    pub(in crate::session) fn new(session: &Arc<SessionCore>) -> Self {
        let (segment, session) = (session.segment.clone(), Arc::downgrade(session));
        Self { inner: Arc::new(Guard { triggered: AtomicBool::new(false), segment, session }) }
    }

    /// Triggers the condition. Async-signal-safe: a signal handler may call this, too. In a forked child it wakes no
    /// thread.
    pub fn trigger(&self) {
        self.inner.trigger();
    }

    /// Returns whether the condition is set.
    pub fn is_triggered(&self) -> bool {
        self.inner.is_triggered()
    }

    pub(in crate::session) fn guard(&self) -> &Arc<Guard> {
        &self.inner
    }
}

impl Guard {
    /// Sets the condition. Costs one exchange, and wakes waiters if the condition was not set.
    pub(in crate::session) fn trigger(&self) {
        // Release pairs with the acquire of `is_triggered` and `take`: a thread that sees the condition sees everything
        // that was done before. A waiter that looked before this is woken by the call below.
        if !self.triggered.swap(true, Ordering::AcqRel) {
            self.segment.wake_listener();
        }
    }

    pub(in crate::session) fn segment(&self) -> &Arc<SessionSegment> {
        &self.segment
    }

    /// Returns its session, if that is still open.
    pub(in crate::session) fn session(&self) -> Option<Arc<SessionCore>> {
        self.session.upgrade()
    }

    pub(in crate::session) fn is_triggered(&self) -> bool {
        self.triggered.load(Ordering::Acquire)
    }

    /// Clears the condition; returns whether it was set.
    pub(in crate::session) fn take(&self) -> bool {
        self.is_triggered() && self.triggered.swap(false, Ordering::AcqRel)
    }
}

impl fmt::Debug for GuardCondition {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("GuardCondition").field(&self.is_triggered()).finish()
    }
}
