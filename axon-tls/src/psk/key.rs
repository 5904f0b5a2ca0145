//! A pre-shared key that can be erased while configurations hold it.

use std::sync::{Arc, Mutex, PoisonError};

use rustls_axon::crypto::hash::HashAlgorithm;
use rustls_axon::external_psk::ExternalPsk;
use secrecy::{ExposeSecret, SecretSlice};
use zeroize::Zeroizing;

use crate::{Cipher, Error};

/// A pre-shared key and its identity.
///
/// It is zeroized on drop, and is neither `Clone` nor `Debug`. Share it with an [`Arc`].
///
/// A connection keeps its configuration, and thus the key, until it ends. For a key of one connection, call
/// [`erase`](Self::erase) when the handshake is complete.
pub struct Psk {
    identity: Vec<u8>,
    psk: Mutex<Option<Arc<ExternalPsk>>>,
    cipher: Cipher,
}

impl Psk {
    /// Makes a key from `secret`, for connections with `cipher`. `into()` converts a `Vec<u8>` to such a secret. A
    /// vector with more capacity than bytes may be moved for that, and the bytes that it leaves behind are not erased.
    ///
    /// Both ends configure the same identity, secret and cipher: TLS ties a pre-shared key to the hash of one cipher
    /// suite (RFC 8446 section 4.2.11). See the [module](crate::psk#security) for the properties of a good secret and
    /// for who may share it.
    ///
    /// # Errors
    /// [`Error::RustlsAxon`] if the identity is empty or has more than 65,529 bytes, or if the secret has fewer than
    /// 16.
    pub fn new(
        identity: impl Into<Vec<u8>>,
        secret: SecretSlice<u8>,
        cipher: Cipher,
    ) -> Result<Self, Error> {
        let secret = Zeroizing::new(secret.expose_secret().to_vec());
        Ok(ExternalPsk::new(identity, secret, cipher.hash())?.into())
    }

    /// Returns the identity, as the client sends it.
    pub fn identity(&self) -> &[u8] {
        &self.identity
    }

    /// Erases the secret. No handshake can begin with it after this. A handshake in progress that already has the
    /// secret continues, and erases it when it ends.
    pub fn erase(&self) {
        self.psk.lock().unwrap_or_else(PoisonError::into_inner).take();
    }

    /// Returns whether the secret was erased.
    pub fn is_erased(&self) -> bool {
        self.psk.lock().unwrap_or_else(PoisonError::into_inner).is_none()
    }

    /// Returns the only cipher with which this key can be used.
    pub fn cipher(&self) -> Cipher {
        self.cipher
    }

    /// Returns the key in the form that rustls takes. Returns `None` after the key was erased.
    pub(crate) fn external(&self) -> Option<Arc<ExternalPsk>> {
        self.psk.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }
}

/// Chooses the cipher by the key's hash: AES-256-GCM for SHA-384, ChaCha20-Poly1305 for SHA-256.
impl From<ExternalPsk> for Psk {
    fn from(psk: ExternalPsk) -> Self {
        let cipher = match psk.hash() {
            HashAlgorithm::SHA384 => Cipher::Aes256Gcm,
            _ => Cipher::ChaCha20Poly1305,
        };
        Self { identity: psk.identity().to_vec(), psk: Mutex::new(Some(Arc::new(psk))), cipher }
    }
}
