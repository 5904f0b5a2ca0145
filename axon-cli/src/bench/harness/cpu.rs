//! Processor time of processes, in seconds.

use std::fs;

use rustix::time::{ClockId, clock_gettime};

/// Returns the processor time of this process so far, in all its threads, including ended threads.
pub(crate) fn own() -> f64 {
    let time = clock_gettime(ClockId::ProcessCPUTime);
    time.tv_sec as f64 + time.tv_nsec as f64 / 1e9
}

/// Returns the processor time of process `pid` so far, in its current threads.
///
/// The kernel accounts for a thread when it sleeps, and at each tick while it runs. The result is exact for a process
/// that sleeps between messages.
pub(crate) fn of(pid: u32) -> f64 {
    let tasks = fs::read_dir(format!("/proc/{pid}/task"));
    let nanoseconds = tasks.into_iter().flatten().filter_map(|task| {
        let text = fs::read_to_string(task.ok()?.path().join("schedstat")).ok()?;
        text.split(' ').next()?.parse::<u64>().ok()
    });
    nanoseconds.sum::<u64>() as f64 / 1e9
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn time_of_ended_threads_counts() {
        let before = own();
        let spun = std::thread::spawn(|| {
            let start = own();
            while own() < start + 0.01 {}
        });
        spun.join().expect("it ends");
        assert!(own() >= before + 0.01);
    }

    #[test]
    fn a_process_that_is_gone_has_none() {
        assert!(of(std::process::id()) > 0.0);
        assert_eq!(of(u32::MAX), 0.0);
    }
}
