//! The search for a daemon. It has a thread of its own, because peers may die meanwhile.

use std::{
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
        mpsc::{Receiver, TryRecvError, sync_channel},
    },
    time::Duration,
};

use super::pause;
use crate::session::{
    core::SessionCore,
    daemon::connect::{Caller, Connected},
    error::SessionError,
};

/// A running search. Dropping it ends the search.
pub(super) struct Search {
    found: Receiver<Connected>,
    over: Arc<AtomicBool>,
}

impl Search {
    /// Begins a search after a pause. Returns `None` if no thread can be started.
    pub(super) fn begin(core: Arc<SessionCore>, first: Duration) -> Option<Self> {
        let (found, receiver) = sync_channel(1);
        let over = Arc::new(AtomicBool::new(false));
        let search = Self { found: receiver, over: over.clone() };
        // Pairs with the release store in `Search::drop`.
        let is_over = move || over.load(Ordering::Acquire);
        let run = move || {
            std::thread::sleep(first);
            let mut pause = pause::next(Duration::ZERO);
            while !is_over() {
                let caller = Caller {
                    segment: Some(&core.segment),
                    cancel: Some(&is_over),
                    ..Caller::new(&core.config, &core.options, core.id)
                };
                match caller.connect() {
                    Ok(connected) => {
                        let _ = found.send(connected);
                        core.wake();
                        return;
                    }
                    Err(SessionError::NoDaemon { .. }) => {}
                    Err(error) => tracing::error!(%error, "no daemon took the session"),
                }
                std::thread::sleep(pause);
                pause = pause::next(pause);
            }
        };
        match std::thread::Builder::new().name("axon-connect".into()).spawn(run) {
            Ok(_) => Some(search),
            Err(error) => {
                tracing::error!(%error, "no thread to look for a daemon with");
                None
            }
        }
    }

    /// Returns the daemon that was found.
    ///
    /// # Errors
    /// The error of a channel: no daemon yet, or the search has failed.
    pub(super) fn try_found(&self) -> Result<Connected, TryRecvError> {
        self.found.try_recv()
    }
}

impl Drop for Search {
    fn drop(&mut self) {
        // Pairs with the acquire loads of the thread.
        self.over.store(true, Ordering::Release);
    }
}
