//! The end of a wait, with the resolution of the kernel's clock: tokio's own timers have one of 1 ms, which is longer
//! than most round trips.

use std::{future::pending, io, os::fd::OwnedFd, time::Duration};

use axon_shm::internal::descriptors::PassedFd;
use rustix::{
    io::{Errno, read},
    time::{
        Itimerspec, TimerfdClockId, TimerfdFlags, TimerfdTimerFlags, Timespec, timerfd_create,
        timerfd_settime,
    },
};
use tokio::{io::unix::AsyncFd, time::sleep};

use crate::async_fd::watch;

/// Longer waits do without a system call for their end.
const TIMERFD_THRESHOLD: Duration = Duration::from_millis(100);

/// Waits until a time. Where the kernel gives no timer, tokio's do.
pub(super) struct Timer(Option<AsyncFd<PassedFd>>);

impl Timer {
    /// Creates a timer of the kernel. Needs a tokio runtime.
    pub(super) fn new() -> Self {
        let timer = create().and_then(watch);
        if let Err(error) = &timer {
            tracing::debug!(%error, "no timerfd: timers have a resolution of 1 ms");
        }
        Self(timer.ok())
    }

    /// Waits for so long, or for ever. Cancel safe.
    pub(super) async fn wait(&self, left: Option<Duration>) {
        let Some(left) = left else { return pending().await };
        match &self.0 {
            Some(timer) if left < TIMERFD_THRESHOLD && set(timer, left).is_ok() => {
                expire(timer).await
            }
            _ => sleep(left).await,
        }
    }
}

fn create() -> io::Result<OwnedFd> {
    let flags = TimerfdFlags::NONBLOCK | TimerfdFlags::CLOEXEC;
    Ok(timerfd_create(TimerfdClockId::Monotonic, flags)?)
}

fn set(timer: &AsyncFd<PassedFd>, left: Duration) -> io::Result<()> {
    // Zero would stop it.
    let left = left.max(Duration::from_nanos(1));
    let it_value = Timespec { tv_sec: left.as_secs() as i64, tv_nsec: left.subsec_nanos().into() };
    let it_interval = Timespec { tv_sec: 0, tv_nsec: 0 };
    let value = Itimerspec { it_interval, it_value };
    timerfd_settime(timer, TimerfdTimerFlags::empty(), &value)?;
    Ok(())
}

async fn expire(timer: &AsyncFd<PassedFd>) {
    let mut expirations = [0; 8];
    // An error is of a runtime that ends.
    while let Ok(mut ready) = timer.readable().await {
        match read(timer, &mut expirations) {
            // The end of a wait that was given up.
            Err(Errno::AGAIN | Errno::INTR) => ready.clear_ready(),
            _ => return,
        }
    }
}

#[cfg(test)]
mod tests {
    use std::time::Instant;

    use super::*;

    #[tokio::test]
    async fn timer_waits_do_not_end_early_after_an_abandoned_wait() {
        let kernel = Timer::new();
        assert!(kernel.0.is_some(), "Linux has timerfd since 2.6.25");
        for timer in [kernel, Timer(None)] {
            for micros in [0, 1, 300, 2_000] {
                // A wait that is given up, some of them once they are over.
                let given_up = timer.wait(Some(Duration::from_micros(50)));
                tokio::select! {
                    biased;
                    () = tokio::task::yield_now() => {}
                    () = given_up => {}
                }
                std::thread::sleep(Duration::from_micros(100));
                let (begun, left) = (Instant::now(), Duration::from_micros(micros));
                timer.wait(Some(left)).await;
                assert!(begun.elapsed() >= left, "{micros}: {:?}", begun.elapsed());
            }
        }
    }
}
