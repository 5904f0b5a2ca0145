//! Connects to the next daemon after the connection to the last one is lost. A session that is being closed waits for
//! that for a limited time.

use std::{
    sync::atomic::Ordering,
    time::{Duration, Instant},
};

use super::{RelayContext, stand_ins::LeftByConnection};
use crate::{
    config::{Config, DaemonPolicy},
    session::{
        daemon::connect::{Caller, Connected},
        error::SessionError,
        relayed::LINGER,
    },
};

/// Shortest pause between attempts to find a daemon.
const MIN_PAUSE: Duration = Duration::from_millis(100);
const MAX_PAUSE: Duration = Duration::from_secs(2);

impl RelayContext {
    pub(super) fn finishes(&self) -> bool {
        // Pairs with the release store as the session ends.
        self.finish.load(Ordering::Acquire)
    }

    /// Returns the time until which an ending session waits for the delivery of its messages.
    pub(super) fn finish_by(&self) -> Option<Instant> {
        self.finishes().then(|| *self.finish_by.get_or_init(|| Instant::now() + LINGER))
    }

    /// Returns whether the time of an ending session is over.
    pub(super) fn is_over(&self) -> bool {
        self.finish_by().is_some_and(|by| Instant::now() >= by)
    }

    /// Connects to another daemon; returns `None` if the session ends. `brief` is true if the last connection ended
    /// almost at once: the first attempt then waits, too.
    pub(super) fn reconnect(&self, brief: bool, kept: &mut LeftByConnection) -> Option<Connected> {
        let mut pause = MIN_PAUSE;
        let mut wait = brief;
        while !self.is_over() {
            kept.drop_overdue();
            if std::mem::replace(&mut wait, true) {
                std::thread::sleep(pause);
                pause = (pause * 2).min(if self.finishes() { MIN_PAUSE } else { MAX_PAUSE });
            }
            // A session that ends starts no daemon.
            let config = &self.shared.core.config;
            let last = self
                .finishes()
                .then(|| Config { daemon: DaemonPolicy::Require, ..Config::clone(config) });
            let caller = Caller {
                config: last.as_ref().unwrap_or(config),
                options: &self.shared.core.options,
                id: self.shared.core.id,
                segment: None,
                relay: Some(&self.reason),
                cancel: Some(&|| if last.is_some() { self.is_over() } else { self.finishes() }),
            };
            match caller.connect() {
                Ok(connected) => return Some(connected),
                Err(SessionError::NoDaemon { .. }) => {}
                Err(error) => tracing::error!(%error, "no daemon took the session"),
            }
        }
        None
    }
}
