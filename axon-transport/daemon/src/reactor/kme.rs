//! The KME client, on a runtime with a thread of its own: TLS with the KME does not hold up the links.
//!
//! The TLS library of that connection (rustls as released) leaves traffic secrets and keys of ciphers on the stack. They
//! pass through tasks of the HTTP library, which this crate does not call, so the whole stack is overwritten whenever the
//! thread has nothing left to do.

use axon_transport::config::{Config, Security};
use tokio::runtime::{Builder, Runtime};

use crate::{
    error::GatewayError,
    keys::{Events, Kme, UsedKeys},
};

/// Number of bytes of the stack that are overwritten: more than a handshake takes below the tasks that it runs in, in
/// builds without optimization too (`tests/tests/hosts/kme_keys.rs`).
const STACK_DEPTH: usize = 384 << 10;

/// The KME client and its thread.
pub(super) struct KmeThread {
    pub(super) kme: Kme,
    pub(super) used: UsedKeys,
    pub(super) runtime: Runtime,
}

/// Starts the KME client of a daemon in qkd; in classic there is none.
///
/// # Errors
/// The settings make no client, or there is no thread for it.
pub(super) fn start(config: &Config) -> Result<Option<(KmeThread, Events)>, GatewayError> {
    let Security::Qkd(qkd) = &config.security else { return Ok(None) };
    let runtime = Builder::new_multi_thread()
        .worker_threads(1)
        .thread_name("axon-kme")
        // A thread parks from the frame that it runs tasks in.
        .on_thread_park(|| axon_tls::erasing::<STACK_DEPTH, _>(|| ()))
        .enable_all()
        .build()?;
    let used = UsedKeys::open(config.runtime_dir.as_deref(), config.domain);
    let (kme, events) = {
        let _entered = runtime.enter();
        Kme::start(qkd, used.clone())?
    };
    Ok(Some((KmeThread { kme, used, runtime }, events)))
}
