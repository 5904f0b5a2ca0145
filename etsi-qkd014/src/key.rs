//! Keys: zeroized, not clonable, not printable.

use secrecy::{ExposeSecret, SecretSlice};
use serde_json::Value;
use subtle::{Choice, ConstantTimeEq};

/// A key from a KME and its key_ID.
///
/// The secret is zeroized on drop. It is neither `Clone` nor `Debug` nor `Display`. It is accessible only through
/// [`ExposeSecret`], [`expose_array`](Key::expose_array) and [`into_secret`](Key::into_secret). Equality compares only
/// the secrets, in constant time.
///
/// ```compile_fail
/// fn clone_it<T: Clone>() {}
/// clone_it::<etsi_qkd014::Key>();
/// ```
/// ```compile_fail
/// fn print_it<T: std::fmt::Debug>() {}
/// print_it::<etsi_qkd014::Key>();
/// ```
pub struct Key {
    key_id: String,
    secret: SecretSlice<u8>,
    key_id_extension: Option<Value>,
    extension: Option<Value>,
}

impl Key {
    pub(crate) fn new(
        key_id: String,
        secret: SecretSlice<u8>,
        key_id_extension: Option<Value>,
        extension: Option<Value>,
    ) -> Self {
        Self { key_id, secret, key_id_extension, extension }
    }

    pub(crate) fn set_key_id(&mut self, asked: String) {
        self.key_id = asked;
    }

    /// Returns the key_ID: from `enc_keys` exactly as the KME spelled it, from `dec_keys` exactly as it was requested
    /// (a KME may answer in another letter case).
    #[must_use]
    pub fn key_id(&self) -> &str {
        &self.key_id
    }

    /// Returns the secret, if it is exactly `N` bytes long.
    #[must_use]
    pub fn expose_array<const N: usize>(&self) -> Option<&[u8; N]> {
        self.expose_secret().try_into().ok()
    }

    /// Returns the secret without its key_ID, for code that takes keys in this form. Nothing is copied.
    #[must_use]
    pub fn into_secret(self) -> SecretSlice<u8> {
        self.secret
    }

    /// Returns the length of the secret in bytes; never 0.
    #[must_use]
    #[allow(clippy::len_without_is_empty, reason = "a key is never empty")]
    pub fn len(&self) -> usize {
        self.expose_secret().len()
    }

    /// Returns the KME's `key_ID_extension` (clause 6.3).
    #[must_use]
    pub fn key_id_extension(&self) -> Option<&Value> {
        self.key_id_extension.as_ref()
    }

    /// Returns the KME's `key_extension` (clause 6.3).
    #[must_use]
    pub fn extension(&self) -> Option<&Value> {
        self.extension.as_ref()
    }
}

/// Exposes the secret.
impl ExposeSecret<[u8]> for Key {
    fn expose_secret(&self) -> &[u8] {
        self.secret.expose_secret()
    }
}

impl ConstantTimeEq for Key {
    fn ct_eq(&self, other: &Self) -> Choice {
        self.expose_secret().ct_eq(other.expose_secret())
    }
}

impl PartialEq for Key {
    fn eq(&self, other: &Self) -> bool {
        self.ct_eq(other).into()
    }
}

impl Eq for Key {}

/// The keys of one answer (clause 6.3): always as many as were requested, at least one.
#[non_exhaustive]
pub struct KeyContainer {
    /// The keys; after `dec_keys` in the order of the request.
    pub keys: Vec<Key>,
    /// The KME's `key_container_extension`.
    pub extension: Option<Value>,
}

impl KeyContainer {
    /// Returns the first key, for a call that requested one. Other keys are dropped and zeroized.
    #[must_use]
    pub fn into_single(self) -> Key {
        self.keys.into_iter().next().expect("a checked container is never empty")
    }
}

impl IntoIterator for KeyContainer {
    type Item = Key;
    type IntoIter = std::vec::IntoIter<Key>;

    fn into_iter(self) -> Self::IntoIter {
        self.keys.into_iter()
    }
}
