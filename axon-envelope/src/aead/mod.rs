//! The AEAD under the envelope: AES-256-GCM, by one of two libraries.
//!
//! | feature       | type          | library                  | needs                     |
//! | ------------- | ------------- | ------------------------ | ------------------------- |
//! | `aws-lc-rs`   | `AwsLc`       | aws-lc-rs                | `std`, a C compiler       |
//! | `rust-crypto` | `RustCrypto`  | `aes-gcm` of RustCrypto  | `alloc`                   |
//!
//! Both can be enabled; [`DefaultAead`] is then `AwsLc`. Both write the same bytes.

#[cfg(feature = "aws-lc-rs")]
mod aws_lc;
#[cfg(feature = "rust-crypto")]
mod rust_crypto;

#[cfg(feature = "aws-lc-rs")]
pub use aws_lc::AwsLc;
#[cfg(feature = "rust-crypto")]
pub use rust_crypto::RustCrypto;

use crate::TAG_LEN;
use crate::header::NONCE_LEN;

/// What `Sealer` and `Opener` use unless told otherwise.
#[cfg(feature = "aws-lc-rs")]
pub type DefaultAead = AwsLc;
/// What `Sealer` and `Opener` use unless told otherwise.
#[cfg(all(feature = "rust-crypto", not(feature = "aws-lc-rs")))]
pub type DefaultAead = RustCrypto;

/// The AEAD did not seal or open. It does not say why.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("the AEAD refused")]
pub struct AeadError;

/// AES-256-GCM under one key, with a 12-byte nonce and a 16-byte tag.
///
/// Implementations erase the key on drop, leave nothing that is made of it on the stack, compare tags
/// in constant time, allocate nothing per message, and on a wrong tag may leave anything but the
/// plaintext in the output buffer. Another algorithm must not be put behind this trait: the
/// envelope's magic stands for AES-256-GCM.
pub trait Aead: Sized + Send + Sync {
    /// The library's name, for logs and benchmarks.
    const NAME: &'static str;

    /// Prepares the key.
    fn new(key: &[u8; 32]) -> Self;

    /// Encrypts `in_out` where it lies and returns the tag.
    ///
    /// # Errors
    /// [`AeadError`] if it is longer than AES-GCM allows.
    fn seal_in_place(
        &self,
        nonce: &[u8; NONCE_LEN],
        aad: &[u8],
        in_out: &mut [u8],
    ) -> Result<[u8; TAG_LEN], AeadError>;

    /// Encrypts `plaintext` into `ciphertext`, of the same length, and returns the tag.
    ///
    /// # Errors
    /// [`AeadError`] if the lengths differ or are more than AES-GCM allows.
    fn seal_apart(
        &self,
        nonce: &[u8; NONCE_LEN],
        aad: &[u8],
        plaintext: &[u8],
        ciphertext: &mut [u8],
    ) -> Result<[u8; TAG_LEN], AeadError>;

    /// Decrypts `in_out` where it lies.
    ///
    /// # Errors
    /// [`AeadError`] if the tag does not fit.
    fn open_in_place(
        &self,
        nonce: &[u8; NONCE_LEN],
        aad: &[u8],
        in_out: &mut [u8],
        tag: &[u8; TAG_LEN],
    ) -> Result<(), AeadError>;

    /// Decrypts `ciphertext` into `plaintext`, of the same length.
    ///
    /// # Errors
    /// [`AeadError`] if the lengths differ or the tag does not fit.
    fn open_apart(
        &self,
        nonce: &[u8; NONCE_LEN],
        aad: &[u8],
        ciphertext: &[u8],
        tag: &[u8; TAG_LEN],
        plaintext: &mut [u8],
    ) -> Result<(), AeadError>;
}
