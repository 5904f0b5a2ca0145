//! The classic identity: this host's key and the peers that it trusts, from the files that the settings name.
//!
//! The files are read again when they change. If a file is unusable, new links are refused. Existing links
//! stay, because nothing shows that their peer was removed.

mod file;
mod load;
#[cfg(test)]
mod tests;
mod watch;

use std::{
    sync::{Mutex, PoisonError, RwLock},
    time::Instant,
};

use axon_tls::identity::Auth;
use axon_transport::config::{ClassicAuth, ClassicConfig};

use self::{
    load::IdentityFiles,
    watch::{FileWatcher, FilesChange},
};
use crate::error::GatewayError;

/// Checks whether the files that `classic` names can be used.
///
/// # Errors
/// A file that cannot be used, by the name of its variable.
pub(crate) fn check(classic: &ClassicConfig) -> Result<(), GatewayError> {
    IdentityFiles::of(classic)?.load(None).map(drop)
}

/// This host's identity and the peers that it trusts, as its files define them.
pub(crate) struct Identity {
    sources: IdentityFiles,
    host: String,
    in_force: RwLock<InForce>,
    watch: Mutex<FileWatcher>,
}

struct InForce {
    auth: Auth,
    /// The reason why no new peer is accepted.
    closed: Option<String>,
}

impl Identity {
    /// Reads the files that `classic` names; makes an ephemeral key for `none`. `node` is this host's own name.
    ///
    /// # Errors
    /// A file that cannot be used, by the name of its variable; or a certificate that does not say which host this is.
    pub(crate) fn load(classic: &ClassicConfig, node: &str) -> Result<Self, GatewayError> {
        let sources = IdentityFiles::of(classic)?;
        // The watch begins before the files are read: a file that is written meanwhile is read again.
        let watch = FileWatcher::new(sources.files());
        let auth = sources.load(None)?.put_in_force();
        let host = sources.host(&auth, node)?;
        let in_force = RwLock::new(InForce { auth, closed: None });
        Ok(Self { sources, host, in_force, watch: Mutex::new(watch) })
    }

    /// Returns this host's name in HELLO.
    pub(crate) fn host(&self) -> &str {
        &self.host
    }

    /// Returns the identity and the trust that are in force.
    pub(crate) fn auth(&self) -> Auth {
        self.in_force.read().unwrap_or_else(PoisonError::into_inner).auth.clone()
    }

    /// Returns the reason why no new peer is accepted now, for people on this host.
    pub(crate) fn closed(&self) -> Option<String> {
        self.in_force.read().unwrap_or_else(PoisonError::into_inner).closed.clone()
    }

    /// Returns whether there are files that can change.
    pub(crate) fn has_files(&self) -> bool {
        !lock(&self.watch).is_empty()
    }

    /// Looks whether the files changed; the caller does this a few times a second. Returns whether the identity in
    /// force changed. Blocks on the file system.
    pub(crate) fn look(&self, now: Instant) -> bool {
        let mut watch = lock(&self.watch);
        match watch.look(now) {
            FilesChange::Same | FilesChange::Changing => false,
            FilesChange::Restless => self.close(
                "the files of this host's identity keep changing, and are not used until they \
                 stand still"
                    .into(),
            ),
            FilesChange::Changed => {
                let before = self.auth();
                let loaded = self.sources.load(Some(&before)).and_then(|loaded| {
                    self.sources.still_names(loaded.auth(), &self.host).map(|()| loaded)
                });
                if !watch.confirm() {
                    return false;
                }
                match loaded {
                    Ok(loaded) => {
                        let auth = loaded.put_in_force();
                        tracing::info!("the files of this host's identity were read again");
                        *self.write() = InForce { auth, closed: None };
                        true
                    }
                    Err(error) => self.close(error.to_string()),
                }
            }
        }
    }

    fn close(&self, why: String) -> bool {
        tracing::error!(
            why,
            "no new link is accepted until the files of this host's identity can be used again; \
             links that stand are kept"
        );
        self.write().closed = Some(why);
        true
    }

    fn write(&self) -> std::sync::RwLockWriteGuard<'_, InForce> {
        self.in_force.write().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Loads the classic identity that the settings name.
///
/// # Errors
/// A file of it cannot be used.
pub(crate) fn load(classic: &ClassicConfig, node: &str) -> Result<Identity, GatewayError> {
    Identity::load(classic, node).inspect(|_| {
        if classic.auth == ClassicAuth::None {
            tracing::warn!(
                "AXON_CLASSIC_AUTH=none: peers are UNAUTHENTICATED. A recording adversary learns \
                 nothing; an active one can pose as a peer. Set AXON_CLASSIC_KEY and \
                 AXON_CLASSIC_TRUST to pin peers."
            );
        }
    })
}

/// Locks a mutex, even if a thread panicked while it held the lock: no panic leaves an inconsistent state.
fn lock<T>(mutex: &Mutex<T>) -> std::sync::MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
