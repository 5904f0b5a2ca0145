//! Turns the doorbell of the gateway's session into wake-ups of tokio tasks. Tasks that move samples wait
//! for it.

use std::{
    io,
    os::fd::AsFd,
    sync::{
        Arc,
        atomic::{AtomicUsize, Ordering},
    },
};

use axon_shm::ShmError;
use axon_transport::Session;
use tokio::sync::watch;

use crate::gateway::watch::watch as watch_descriptor;

/// Wakes whoever waits for samples in a ring, or for room in one.
#[derive(Clone)]
pub(super) struct RingWakeups {
    wakeups: watch::Receiver<u64>,
    blocked: Arc<AtomicUsize>,
    session: Session,
}

/// Counts one publish that waits for room, as long as it lives.
pub(super) struct Blocked(Arc<AtomicUsize>);

impl Drop for Blocked {
    fn drop(&mut self) {
        // Relaxed: a stale count costs one ring too many.
        self.0.fetch_sub(1, Ordering::Relaxed);
    }
}

impl RingWakeups {
    /// Starts the task that watches the doorbell of `session`; it ends when all copies of it are gone.
    pub(super) fn start(session: &Session) -> Result<Self, ShmError> {
        let leader = session.segment().external_leader()?;
        let (sender, wakeups) = watch::channel(0);
        let blocked = Arc::new(AtomicUsize::new(0));
        let count = Arc::clone(&blocked);
        tokio::spawn(async move {
            if let Err(error) = watch_doorbell(leader, &sender, &count).await {
                tracing::error!(%error, "the gateway can no longer hear its doorbell");
            }
        });
        Ok(Self { wakeups, blocked, session: session.clone() })
    }

    /// A receiver whose `changed` resolves whenever a ring may hold something new.
    pub(super) fn subscribe(&self) -> watch::Receiver<u64> {
        self.wakeups.clone()
    }

    /// From now until the guard is dropped room in a ring counts too.
    pub(super) fn wait_for_room(&self) -> Blocked {
        self.blocked.fetch_add(1, Ordering::Relaxed);
        // Re-arms the doorbell with the new interest.
        self.session.segment().notify();
        Blocked(Arc::clone(&self.blocked))
    }
}

async fn watch_doorbell(
    leader: axon_shm::ExternalLeader,
    wakeups: &watch::Sender<u64>,
    blocked: &AtomicUsize,
) -> io::Result<()> {
    let doorbell = watch_descriptor(leader.as_fd().try_clone_to_owned()?)?;
    while !wakeups.is_closed() {
        leader.clear();
        leader.arm(blocked.load(Ordering::Relaxed) > 0);
        // After the arming: what came before it is found by the tasks that this wakes, what comes
        // after it rings.
        wakeups.send_modify(|n| *n += 1);
        tokio::select! {
            ready = doorbell.readable() => ready?.clear_ready(),
            () = wakeups.closed() => {}
        }
    }
    Ok(())
}
