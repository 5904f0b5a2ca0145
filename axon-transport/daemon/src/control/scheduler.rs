//! Shares the control plane's one thread fairly between processes: a process may have many sessions.
//!
//! The daemon handles a session's requests in parts of about [`PART`], and one part of one process at a time. After
//! each part it serves the other processes, so that a process with many requests delays only itself.

use std::{
    collections::HashMap,
    rc::{Rc, Weak},
    time::Duration,
};

use tokio::sync::Mutex;

/// The time of one part of work, after which other processes have their turn.
pub(super) const PART: Duration = Duration::from_millis(1);

/// The lock that a session's task holds while it does a part of its process's work. First come, first served.
pub(super) type ProcessTurn = Rc<Mutex<()>>;

/// The turns of all processes that have sessions.
#[derive(Debug, Default)]
pub(super) struct ProcessScheduler(HashMap<u32, Weak<Mutex<()>>>);

impl ProcessScheduler {
    /// Returns the turn of the sessions of process `pid`.
    pub(super) fn of(&mut self, pid: u32) -> ProcessTurn {
        if let Some(turn) = self.0.get(&pid).and_then(Weak::upgrade) {
            return turn;
        }
        self.0.retain(|_, turn| turn.strong_count() > 0);
        let turn = ProcessTurn::default();
        self.0.insert(pid, Rc::downgrade(&turn));
        turn
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sessions_of_a_process_share_a_turn_and_nothing_is_left_of_it() {
        let mut turns = ProcessScheduler::default();
        let (one, again, other) = (turns.of(1), turns.of(1), turns.of(2));
        let held = one.try_lock().unwrap();
        assert!(again.try_lock().is_err() && other.try_lock().is_ok());
        drop(held);
        drop((one, again));
        let _third = turns.of(3);
        assert_eq!(turns.0.len(), 2);
    }

    /// Counted in parts, not in time: the time of a part depends on the machine.
    #[test]
    fn process_with_a_thousand_busy_sessions_has_one_part_between_two_of_another_process() {
        use std::cell::Cell;

        use tokio::task::{LocalSet, spawn_local, yield_now};

        let runtime = tokio::runtime::Builder::new_current_thread().build().unwrap();
        LocalSet::new().block_on(&runtime, async {
            let (mut turns, parts) = (ProcessScheduler::default(), Rc::new(Cell::new(0_u32)));
            for _ in 0..1000 {
                let (turn, parts) = (turns.of(1), Rc::clone(&parts));
                spawn_local(async move {
                    loop {
                        {
                            let _turn = turn.lock().await;
                            parts.set(parts.get() + 1);
                            // A conversation does this after each part.
                            yield_now().await;
                        }
                    }
                });
            }
            let turn = turns.of(2);
            let other = spawn_local(async move {
                // All tasks have begun.
                while parts.get() < 10_000 {
                    yield_now().await;
                }
                let mut most = 0;
                for _ in 0..1000 {
                    let before = parts.get();
                    yield_now().await;
                    drop(turn.lock().await);
                    most = most.max(parts.get() - before);
                }
                (most, parts.get())
            });
            let (most, parts) = other.await.unwrap();
            assert!(most <= 2, "{most} parts in between");
            assert!(parts > 10_100, "they stand still: {parts}");
        });
    }
}
