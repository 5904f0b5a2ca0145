//! The thread that carries a session's samples to its daemon and back.

use std::{
    io,
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    thread::JoinHandle,
};

use axon_shm::internal::BlockedSignals;

use super::core::ChangeSignal;

/// Carries a session's samples to its daemon and back, until it is dropped.
#[derive(Debug)]
pub(in crate::session) struct RelayThread {
    finish: Arc<AtomicBool>,
    change_signal: Arc<ChangeSignal>,
    thread: Option<JoinHandle<()>>,
}

impl RelayThread {
    /// Starts the thread. It runs `carry`, which ends soon once `finish` is set and `change_signal` says so.
    ///
    /// # Errors
    /// No thread can be started.
    pub(super) fn spawn(
        finish: Arc<AtomicBool>,
        change_signal: Arc<ChangeSignal>,
        carry: impl FnOnce() + Send + 'static,
    ) -> io::Result<Self> {
        let blocked = BlockedSignals::all();
        let thread = std::thread::Builder::new().name("axon-relay".into()).spawn(carry)?;
        drop(blocked);
        Ok(Self { finish, change_signal, thread: Some(thread) })
    }
}

impl Drop for RelayThread {
    fn drop(&mut self) {
        // Pairs with the loads of the relay's thread.
        self.finish.store(true, Ordering::Release);
        self.change_signal.wake();
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}
