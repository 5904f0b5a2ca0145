//! A callback that is told how often something happened.

use std::{
    fmt,
    sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError},
    thread::{self, ThreadId},
};

/// Told how often something happened since it was told last; at least once. It may be called on the
/// session's control thread, and must neither block nor panic.
pub type OnNew = Arc<dyn Fn(u64) + Send + Sync>;

/// What is to be told, and to whom.
#[derive(Default)]
pub(super) struct Callback {
    state: Mutex<State>,
    idle: Condvar,
}

#[derive(Default)]
struct State {
    function: Option<OnNew>,
    /// Rises with each function.
    version: u64,
    untold: u64,
    /// Who is in which function.
    running: Vec<(ThreadId, u64)>,
}

impl Callback {
    /// One for something that has happened `untold` times already.
    pub(super) fn new(untold: u64) -> Self {
        let state = State { untold, ..State::default() };
        Self { state: Mutex::new(state), idle: Condvar::new() }
    }

    /// It happened `count` times more.
    pub(super) fn add(&self, count: u64) {
        if count > 0 {
            self.lock().untold += count;
            self.tell();
        }
    }

    /// What happened so far has been seen.
    pub(super) fn forget(&self) {
        self.lock().untold = 0;
    }

    /// Whether there is anybody to tell.
    pub(super) fn is_set(&self) -> bool {
        self.lock().function.is_some()
    }

    /// Has `function` told from now on, and at once of what nobody was told. The one before is not
    /// called any more once this returns, but by the calling thread that is in it.
    pub(super) fn set(&self, function: Option<OnNew>) {
        self.replace(function, |untold| untold);
    }

    /// As [`set`](Self::set), where `recount` says of how often it happened untold what that is now.
    pub(super) fn replace(&self, function: Option<OnNew>, recount: impl FnOnce(u64) -> u64) {
        let me = thread::current().id();
        let mut state = self.lock();
        let before = std::mem::replace(&mut state.function, function);
        state.version += 1;
        let version = state.version;
        while state.running.iter().any(|(thread, of)| *thread != me && *of < version) {
            state = self.idle.wait(state).unwrap_or_else(PoisonError::into_inner);
        }
        state.untold = recount(state.untold);
        drop(state);
        drop(before);
        self.tell();
    }

    fn tell(&self) {
        loop {
            let mut state = self.lock();
            let Some(function) = state.function.clone().filter(|_| state.untold > 0) else {
                return;
            };
            let count = std::mem::take(&mut state.untold);
            let run = (thread::current().id(), state.version);
            state.running.push(run);
            drop(state);
            let running = Running { callback: self, run };
            function(count);
            drop(running);
        }
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// A call that is under way, until it is dropped.
struct Running<'a> {
    callback: &'a Callback,
    run: (ThreadId, u64),
}

impl Drop for Running<'_> {
    fn drop(&mut self) {
        let mut state = self.callback.lock();
        if let Some(index) = state.running.iter().position(|run| *run == self.run) {
            state.running.swap_remove(index);
        }
        drop(state);
        self.callback.idle.notify_all();
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
        Barrier,
        atomic::{AtomicBool, AtomicU64, Ordering},
    };

    use super::*;

    fn counter() -> (OnNew, Arc<AtomicU64>) {
        let told = Arc::new(AtomicU64::new(0));
        let count = told.clone();
        let add = move |new| {
            assert!(new > 0);
            count.fetch_add(new, Ordering::SeqCst);
        };
        (Arc::new(add), told)
    }

    #[test]
    fn what_happened_before_is_told_at_once_and_once() {
        let callback = Callback::new(2);
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
        callback.forget();
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
    fn the_one_before_runs_no_more_once_it_is_replaced() {
        let callback = Callback::default();
        let (entered, over) = (Barrier::new(2), AtomicBool::new(false));
        thread::scope(|scope| {
            let entered: &'static Barrier = Box::leak(Box::new(entered));
            let over: &'static AtomicBool = Box::leak(Box::new(over));
            callback.set(Some(Arc::new(move |_| {
                entered.wait();
                thread::sleep(std::time::Duration::from_millis(50));
                over.store(true, Ordering::SeqCst);
            })));
            scope.spawn(|| callback.add(1));
            entered.wait();
            callback.set(None);
            assert!(over.load(Ordering::SeqCst), "it was waited for");
        });
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
