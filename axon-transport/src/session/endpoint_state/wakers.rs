//! The tasks that wait at an endpoint.

use std::{
    fmt,
    sync::{Mutex, MutexGuard, PoisonError},
    task::Waker,
};

/// The wakers of the tasks that wait at an endpoint. All of them are woken at once, and the tasks find out which of
/// them gets a message: none stays asleep when another woken task is dropped.
#[derive(Default)]
pub(in crate::session) struct Wakers {
    list: Mutex<List>,
}

#[derive(Default)]
struct List {
    next: u64,
    waiting: Vec<(u64, Waker)>,
}

impl Wakers {
    /// Stores `waker` for the task `id`, which becomes a new one if it is `None`. Returns whether the task was not
    /// waiting before, so that it has to look once more.
    pub(in crate::session) fn set(&self, id: &mut Option<u64>, waker: &Waker) -> bool {
        // Cloned outside the lock: it is foreign code.
        let waker = waker.clone();
        let mut list = self.lock();
        let waiting = id.and_then(|id| list.waiting.iter_mut().find(|(other, _)| *other == id));
        let replaced = match waiting {
            Some((_, before)) => Some(std::mem::replace(before, waker)),
            None => {
                let new = *id.get_or_insert_with(|| {
                    list.next += 1;
                    list.next
                });
                list.waiting.push((new, waker));
                None
            }
        };
        drop(list);
        replaced.is_none()
    }

    /// Removes a task that does not wait any more.
    pub(in crate::session) fn remove(&self, id: u64) {
        let mut list = self.lock();
        let at = list.waiting.iter().position(|(other, _)| *other == id);
        let removed = at.map(|at| list.waiting.swap_remove(at));
        drop(list);
        drop(removed);
    }

    /// Wakes all tasks if `something` returns true. Returns whether tasks still wait because it returned false.
    pub(in crate::session) fn wake_if(&self, something: impl FnOnce() -> bool) -> bool {
        if self.lock().waiting.is_empty() {
            return false;
        }
        if !something() {
            return true;
        }
        let woken = std::mem::take(&mut self.lock().waiting);
        woken.into_iter().for_each(|(_, waker)| waker.wake());
        false
    }

    fn lock(&self) -> MutexGuard<'_, List> {
        self.list.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl fmt::Debug for Wakers {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Wakers").finish_non_exhaustive()
    }
}

#[cfg(test)]
mod tests {
    use std::{
        sync::{
            Arc,
            atomic::{AtomicUsize, Ordering},
        },
        task::Wake,
    };

    use super::*;

    #[derive(Default)]
    struct Count(AtomicUsize);

    impl Wake for Count {
        fn wake(self: Arc<Self>) {
            self.0.fetch_add(1, Ordering::SeqCst);
        }
    }

    fn counter() -> (Waker, Arc<Count>) {
        let count = Arc::<Count>::default();
        (Waker::from(count.clone()), count)
    }

    #[test]
    fn all_tasks_are_woken_once_and_only_if_there_is_something() {
        let (wakers, (first, one), (second, two)) = (Wakers::default(), counter(), counter());
        let (mut a, mut b) = (None, None);
        assert!(!wakers.wake_if(|| unreachable!("nobody waits")));
        assert!(wakers.set(&mut a, &first) && wakers.set(&mut b, &second));
        assert!(wakers.wake_if(|| false), "they wait in vain");
        assert_eq!((one.0.load(Ordering::SeqCst), two.0.load(Ordering::SeqCst)), (0, 0));
        assert!(!wakers.wake_if(|| true));
        assert!(!wakers.wake_if(|| true));
        assert_eq!((one.0.load(Ordering::SeqCst), two.0.load(Ordering::SeqCst)), (1, 1));
        assert!(wakers.set(&mut a, &first), "it was woken, and has to look once more");
    }

    #[test]
    fn a_waker_that_is_replaced_is_not_woken_and_let_go() {
        let (wakers, (first, one), (second, two)) = (Wakers::default(), counter(), counter());
        let mut id = None;
        assert!(wakers.set(&mut id, &first));
        assert!(!wakers.set(&mut id, &second), "it waits already");
        drop(first);
        assert_eq!(Arc::strong_count(&one), 1);
        assert!(!wakers.wake_if(|| true));
        assert_eq!((one.0.load(Ordering::SeqCst), two.0.load(Ordering::SeqCst)), (0, 1));
    }

    #[test]
    fn a_task_that_waits_no_more_leaves_nothing() {
        let (wakers, (waker, count)) = (Wakers::default(), counter());
        let mut id = None;
        wakers.set(&mut id, &waker);
        drop(waker);
        wakers.remove(id.unwrap());
        wakers.remove(id.unwrap());
        assert_eq!(Arc::strong_count(&count), 1);
        assert!(!wakers.wake_if(|| unreachable!("nobody waits")));
    }

    /// A waker that owns the last reference to its task, as in some runtimes.
    struct Owns(Arc<Wakers>, u64);

    impl Wake for Owns {
        fn wake(self: Arc<Self>) {}
    }

    impl Drop for Owns {
        fn drop(&mut self) {
            self.0.remove(self.1);
        }
    }

    #[test]
    fn a_waker_may_drop_a_task_that_waits_here_too() {
        let wakers = Arc::<Wakers>::default();
        let owner = |task| Waker::from(Arc::new(Owns(wakers.clone(), task)));
        let (mut a, mut b) = (None, None);
        wakers.set(&mut a, Waker::noop());
        // Woken, replaced and removed.
        wakers.set(&mut b, &owner(a.unwrap()));
        wakers.wake_if(|| true);
        wakers.set(&mut b, &owner(a.unwrap()));
        wakers.set(&mut b, &owner(a.unwrap()));
        wakers.remove(b.unwrap());
        assert!(!wakers.wake_if(|| unreachable!("nobody waits")));
    }
}
