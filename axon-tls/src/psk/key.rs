//! A pre-shared key that can be erased while configurations hold it.

use std::sync::{Arc, Mutex, PoisonError};

use rustls_axon::crypto::hash::HashAlgorithm;
use rustls_axon::external_psk::ExternalPsk;
use secrecy::{ExposeSecret, SecretSlice};
use zeroize::Zeroizing;

use crate::{Cipher, Error};

/// A pre-shared key, and the identity it is named by.
///
/// Zeroized on drop; neither `Clone` nor `Debug`. Share it with an [`Arc`].
///
/// A connection keeps its configuration until it ends, and that keeps the key: [`erase`](Self::erase)
/// a key for one connection when the handshake is complete.
pub struct Psk {
    identity: Vec<u8>,
    psk: Mutex<Option<Arc<ExternalPsk>>>,
    cipher: Cipher,
}

impl Psk {
    /// A key from `secret`, for connections with `cipher`. A `Vec<u8>` becomes such a secret by `into()`; one with
    /// more capacity than bytes may be moved for that, and what it leaves behind is not erased.
    ///
    /// Both ends configure the same identity, secret and cipher: TLS ties a pre-shared key to the hash
    /// of one cipher suite (RFC 8446 section 4.2.11). See the [module](crate::psk#security) for what
    /// makes a good secret and who may share it.
    ///
    /// # Errors
    /// [`Error::RustlsAxon`] if the identity is empty or has more than 65,529 bytes, or if the secret has
    /// fewer than 16.
    pub fn new(
        identity: impl Into<Vec<u8>>,
        secret: SecretSlice<u8>,
        cipher: Cipher,
    ) -> Result<Self, Error> {
        let secret = Zeroizing::new(secret.expose_secret().to_vec());
        Ok(ExternalPsk::new(identity, secret, cipher.hash())?.into())
    }

    /// The identity, as the client sends it.
    pub fn identity(&self) -> &[u8] {
        &self.identity
    }

    /// Erases the secret: no handshake begins with it from here on. One under way, which has it
    /// already, goes on and erases it at its end.
    pub fn erase(&self) {
        self.psk.lock().unwrap_or_else(PoisonError::into_inner).take();
    }

    /// Whether the secret was erased.
    pub fn is_erased(&self) -> bool {
        self.psk.lock().unwrap_or_else(PoisonError::into_inner).is_none()
    }

    /// The only cipher this key can be used with.
    pub fn cipher(&self) -> Cipher {
        self.cipher
    }

    /// The key as rustls takes it; `None` once it is erased.
    pub(crate) fn external(&self) -> Option<Arc<ExternalPsk>> {
        self.psk.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }
}

/// The cipher is the one of the key's hash: AES-256-GCM goes with SHA-384, ChaCha20-Poly1305 with SHA-256.
impl From<ExternalPsk> for Psk {
    fn from(psk: ExternalPsk) -> Self {
        let cipher = match psk.hash() {
            HashAlgorithm::SHA384 => Cipher::Aes256Gcm,
            _ => Cipher::ChaCha20Poly1305,
        };
        Self { identity: psk.identity().to_vec(), psk: Mutex::new(Some(Arc::new(psk))), cipher }
    }
}
