//! A callback of the application that is called with the number of new events.

use std::{
    convert::Infallible,
    fmt,
    sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError},
    thread::{self, ThreadId},
};

/// A function that receives the number of events since its last call; at least one. It may be called on the session's
/// control thread, but never by two threads at once, and must neither block nor panic.
///
/// ```
/// # use std::time::Duration;
/// use std::sync::{Arc, atomic::{AtomicU64, Ordering}};
/// use axon_transport::NewDataCallback;
/// # use axon_transport::{
/// #     EndpointSpec, Session, SessionOptions,
/// #     config::{Config, DaemonPolicy},
/// #     qos::Qos,
/// # };
/// # let config = Config::builder().daemon(DaemonPolicy::Off).build()?;
/// # let session = Session::open(&config, SessionOptions::new("robot"))?;
/// # let spec = || EndpointSpec::new("/speed", "example/Speed", Qos::default());
/// let publisher = session.create_publisher(spec())?;
/// let subscription = session.create_subscription(spec())?;
/// assert!(publisher.wait_matched(1, Duration::from_secs(10)));
/// let new = Arc::new(AtomicU64::new(0));
/// let counter = new.clone();
/// let callback: NewDataCallback = Arc::new(move |count| {
///     counter.fetch_add(count, Ordering::Relaxed);
/// });
/// publisher.publish(b"1.5 m/s")?;
/// subscription.set_on_new_sample(Some(callback))?;
/// assert_eq!(new.load(Ordering::Relaxed), 1);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub type NewDataCallback = Arc<dyn Fn(u64) + Send + Sync>;

/// An application's callback, and the number of events that have not been reported to it.
#[derive(Default)]
pub(in crate::session) struct Callback {
    state: Mutex<CallbackState>,
    idle: Condvar,
}

#[derive(Default)]
struct CallbackState {
    function: Option<NewDataCallback>,
    untold: u64,
    /// The thread that runs the function. Another thread that has events to report meanwhile leaves them to that
    /// thread: if two threads were in the same function and each waited for the other to return, they would wait for
    /// ever.
    running: Option<ThreadId>,
    /// Set by `end`: no function is stored any more.
    ended: bool,
}

impl Callback {
    /// Adds `count` events, and reports them unless a call is under way.
    pub(in crate::session) fn add(&self, count: u64) {
        if count > 0 {
            self.lock().untold += count;
            self.tell();
        }
    }

    /// Sets the number of unreported events to `count`.
    pub(in crate::session) fn recount(&self, count: u64) {
        self.lock().untold = count;
    }

    /// Returns whether a function is set.
    pub(in crate::session) fn is_set(&self) -> bool {
        self.lock().function.is_some()
    }

    /// Replaces the function and reports the unreported events to it at once, unless this callback has
    /// [ended](Self::end). Once this returns, the previous function is not running and is not called
    /// any more. Exception: if the previous function itself calls this, its run continues, and its thread reports to
    /// `function` after that.
    pub(in crate::session) fn set(&self, function: Option<NewDataCallback>) {
        let Ok(()) = self.replace(function, Ok::<_, Infallible>);
    }

    /// Like [`set`](Self::set). `recount` receives the number of unreported events and returns the number that counts
    /// from now on. It runs under the lock, at the moment from which `function` is responsible for later events. If it
    /// fails, no function is set.
    pub(in crate::session) fn replace<E>(
        &self,
        function: Option<NewDataCallback>,
        recount: impl FnOnce(u64) -> Result<u64, E>,
    ) -> Result<(), E> {
        let mut state = self.vacate();
        if state.ended {
            return Ok(());
        }
        state.untold = recount(state.untold)?;
        state.function = function;
        drop(state);
        self.tell();
        Ok(())
    }

    /// Removes the function for good: a function that is set later is ignored. Once this returns, the function is not
    /// running and is not called any more. Exception: if the function itself calls this, its run continues.
    pub(in crate::session) fn end(&self) {
        self.lock().ended = true;
        drop(self.vacate());
    }

    /// Removes the function, and waits for a call that is under way on another thread.
    fn vacate(&self) -> MutexGuard<'_, CallbackState> {
        let me = thread::current().id();
        let mut state = self.lock();
        loop {
            if let Some(before) = state.function.take() {
                drop(state);
                // Dropped outside the lock: the drop runs code of the application.
                drop(before);
                state = self.lock();
            } else if state.running.is_some_and(|running| running != me) {
                state = self.idle.wait(state).unwrap_or_else(PoisonError::into_inner);
            } else {
                return state;
            }
        }
    }

    fn tell(&self) {
        loop {
            let mut state = self.lock();
            if state.running.is_some() || state.untold == 0 {
                return;
            }
            let Some(function) = state.function.clone() else { return };
            let count = std::mem::take(&mut state.untold);
            state.running = Some(thread::current().id());
            drop(state);
            let running = Running(self);
            function(count);
            drop((function, running));
        }
    }

    fn lock(&self) -> MutexGuard<'_, CallbackState> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Marks a call as under way until it is dropped.
struct Running<'a>(&'a Callback);

impl Drop for Running<'_> {
    fn drop(&mut self) {
        self.0.lock().running = None;
        self.0.idle.notify_all();
    }
}

impl fmt::Debug for Callback {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Callback").finish_non_exhaustive()
    }
}

#[cfg(test)]
mod tests {
    use std::sync::{
        atomic::{AtomicBool, AtomicU64, Ordering},
        mpsc,
    };

    use super::*;

    fn counter() -> (NewDataCallback, Arc<AtomicU64>) {
        let told = Arc::new(AtomicU64::new(0));
        let count = told.clone();
        let add = move |new| {
            assert!(new > 0);
            count.fetch_add(new, Ordering::SeqCst);
        };
        (Arc::new(add), told)
    }

    #[test]
    fn a_new_callback_receives_earlier_events_once() {
        let callback = Callback::default();
        callback.recount(2);
        callback.add(1);
        let (first, told_first) = counter();
        callback.set(Some(first));
        assert_eq!(told_first.load(Ordering::SeqCst), 3);
        callback.add(4);
        assert_eq!(told_first.load(Ordering::SeqCst), 7);
        let (second, told_second) = counter();
        callback.set(Some(second));
        callback.add(0);
        assert_eq!(told_second.load(Ordering::SeqCst), 0);
        callback.set(None);
        callback.add(5);
        callback.recount(0);
        callback.add(1);
        let (third, told_third) = counter();
        callback.set(Some(third));
        assert_eq!(told_third.load(Ordering::SeqCst), 1);
    }

    #[test]
    fn a_callback_may_replace_itself() {
        let callback = Arc::new(Callback::default());
        let own = Arc::downgrade(&callback);
        callback.set(Some(Arc::new(move |_| own.upgrade().unwrap().set(None))));
        callback.add(1);
        assert!(!callback.is_set());
    }

    #[test]
    fn a_callback_that_replaces_itself_tells_the_next_one_of_the_rest() {
        let callback = Arc::new(Callback::default());
        let (next, told) = counter();
        let (own, count) = (Arc::downgrade(&callback), told.clone());
        callback.set(Some(Arc::new(move |_| {
            let own = own.upgrade().unwrap();
            own.set(Some(next.clone()));
            own.add(2);
            assert_eq!(count.load(Ordering::SeqCst), 0, "this one has not returned");
        })));
        callback.add(1);
        assert_eq!(told.load(Ordering::SeqCst), 2);
    }

    /// Returns a function that reports its entry, and that returns when the test permits.
    fn gate() -> (NewDataCallback, mpsc::Receiver<u64>, mpsc::Sender<()>, Arc<AtomicBool>) {
        let (entered, entries) = mpsc::channel();
        let (go, goes) = mpsc::channel();
        let (inside, goes) = (Arc::new(AtomicBool::new(false)), Mutex::new(goes));
        let within = inside.clone();
        let function = move |new| {
            assert!(!inside.swap(true, Ordering::SeqCst), "in two threads at once");
            entered.send(new).unwrap();
            goes.lock().unwrap().recv().unwrap();
            inside.store(false, Ordering::SeqCst);
        };
        (Arc::new(function), entries, go, within)
    }

    #[test]
    fn events_during_a_callback_are_reported_after_it_by_the_same_thread() {
        let callback = Callback::default();
        let (function, entries, go, _) = gate();
        callback.set(Some(function));
        thread::scope(|scope| {
            scope.spawn(|| callback.add(1));
            assert_eq!(entries.recv(), Ok(1));
            callback.add(2);
            callback.add(3);
            go.send(()).unwrap();
            assert_eq!(entries.recv(), Ok(5));
            go.send(()).unwrap();
        });
    }

    #[test]
    fn replacing_a_callback_waits_for_the_old_one_and_reports_pending_counts() {
        let callback = Callback::default();
        let (function, entries, go, inside) = gate();
        let (next, told) = counter();
        callback.set(Some(function));
        thread::scope(|scope| {
            scope.spawn(|| callback.add(1));
            assert_eq!(entries.recv(), Ok(1));
            let (vacant, counted) = (&callback, &inside);
            let replacing = scope.spawn(move || {
                let Ok(()) = vacant.replace(Some(next), |untold| {
                    assert!(!counted.load(Ordering::SeqCst), "it was waited for");
                    Ok::<_, Infallible>(untold.min(2))
                });
            });
            // The function is removed as soon as `replace` begins to wait.
            while callback.is_set() {
                thread::yield_now();
            }
            callback.add(3);
            assert_eq!(told.load(Ordering::SeqCst), 0);
            go.send(()).unwrap();
            replacing.join().unwrap();
        });
        assert_eq!(told.load(Ordering::SeqCst), 2);
    }

    #[test]
    fn an_ended_callback_slot_runs_no_callback_set_later() {
        let callback = Callback::default();
        let (function, entries, go, inside) = gate();
        let (late, told) = counter();
        callback.set(Some(function));
        thread::scope(|scope| {
            scope.spawn(|| callback.add(1));
            assert_eq!(entries.recv(), Ok(1));
            let ending = scope.spawn(|| {
                callback.end();
                assert!(!inside.load(Ordering::SeqCst), "it was waited for");
            });
            while callback.is_set() {
                thread::yield_now();
            }
            callback.add(3);
            // `set` waits, too.
            let setting = scope.spawn(|| callback.set(Some(late.clone())));
            go.send(()).unwrap();
            ending.join().unwrap();
            setting.join().unwrap();
        });
        callback.set(Some(late.clone()));
        callback.add(1);
        assert_eq!(told.load(Ordering::SeqCst), 0);
        assert_eq!(Arc::strong_count(&late), 1, "it was not kept");
    }

    #[test]
    fn a_callback_may_end_itself_and_is_not_called_if_counting_fails() {
        let callback = Arc::new(Callback::default());
        let own = Arc::downgrade(&callback);
        callback.set(Some(Arc::new(move |_| own.upgrade().unwrap().end())));
        callback.add(1);
        callback.add(1);
        assert!(!callback.is_set());

        let callback = Callback::default();
        let (function, told) = counter();
        assert_eq!(callback.replace(Some(function), |_| Err("no")), Err("no"));
        callback.add(1);
        assert_eq!(told.load(Ordering::SeqCst), 0);
    }

    #[test]
    fn none_of_many_is_lost_or_told_twice() {
        let callback = Callback::default();
        let (first, told) = counter();
        thread::scope(|scope| {
            for _ in 0..4 {
                scope.spawn(|| (0..10_000).for_each(|_| callback.add(1)));
            }
            for round in 0..1000 {
                callback.set((round % 2 == 0).then(|| first.clone()));
            }
        });
        callback.set(Some(first.clone()));
        assert_eq!(told.load(Ordering::SeqCst), 40_000);
    }
}
