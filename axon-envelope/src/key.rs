//! Key bytes as they come from the KME, and what is derived from them.

use alloc::boxed::Box;

use hkdf::Hkdf;
use sha2::Sha256;
use zeroize::{Zeroize, Zeroizing};

use crate::channel::{Channel, KeyId};

/// A 256-bit key as a KME delivered it, erased on drop.
///
/// It can be neither cloned nor printed:
///
/// ```compile_fail,E0599
/// # use axon_envelope::KmeKey;
/// let key = KmeKey::take(&mut [1; 32]);
/// let copy: KmeKey = key.clone();
/// ```
/// ```compile_fail,E0277
/// # use axon_envelope::KmeKey;
/// let key = KmeKey::take(&mut [1; 32]);
/// println!("{key:?}");
/// ```
// Boxed, so that moving the key copies a pointer and leaves no key bytes behind.
pub struct KmeKey(Box<Zeroizing<[u8; 32]>>);

/// Key bytes of a length other than 32.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("the key has {0} bytes; AXQKD001 takes exactly 32: ask the KME for keys of size 256")]
pub struct KeyLength(pub usize);

/// The operating system gave no random bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("the system's random number generator failed: {0}")]
pub struct RandomError(#[from] getrandom::Error);

impl KmeKey {
    /// Takes the key over and erases the place it came from.
    pub fn take(bytes: &mut [u8; 32]) -> Self {
        let mut key = Self::zeroed();
        key.0.copy_from_slice(bytes);
        bytes.zeroize();
        key
    }

    /// Copies a key; erasing `bytes` stays with the caller.
    ///
    /// # Errors
    /// [`KeyLength`] unless there are exactly 32 bytes.
    pub fn from_slice(bytes: &[u8]) -> Result<Self, KeyLength> {
        if bytes.len() != 32 {
            return Err(KeyLength(bytes.len()));
        }
        let mut key = Self::zeroed();
        key.0.copy_from_slice(bytes);
        Ok(key)
    }

    /// The key's bytes, for a derivation of the caller's own.
    pub fn expose(&self) -> &[u8; 32] {
        &self.0
    }

    pub(crate) fn random() -> Result<Self, RandomError> {
        let mut key = Self::zeroed();
        getrandom::fill(&mut key.0[..])?;
        Ok(key)
    }

    fn zeroed() -> Self {
        Self(Box::new(Zeroizing::new([0; 32])))
    }
}

/// The AEAD key for one KME key in one direction of one connection.
///
/// Every field is length-prefixed, so no two different tuples share an info string.
pub(crate) fn aead_key(channel: &Channel, key_id: &KeyId, key: &KmeKey) -> Zeroizing<[u8; 32]> {
    const LABEL: &[u8] = b"seal";
    let fields =
        [LABEL, key_id.as_bytes(), channel.sender(), channel.receiver(), channel.context()];
    let lengths = fields.map(|field| {
        // `KeyId` and `Channel` hold at most 65,535 bytes a field.
        (field.len() as u16).to_be_bytes()
    });
    let mut info: [&[u8]; 10] = [&[]; 10];
    for (pair, (length, field)) in info.chunks_exact_mut(2).zip(lengths.iter().zip(fields)) {
        pair[0] = length;
        pair[1] = field;
    }

    let mut derived = Zeroizing::new([0; 32]);
    Hkdf::<Sha256>::new(Some(b"AXQKD001"), key.expose())
        .expand_multi_info(&info, &mut derived[..])
        .expect("32 bytes are within HKDF-SHA256's 8,160");
    derived
}
