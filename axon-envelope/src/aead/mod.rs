//! The AEAD under the envelope: AES-256-GCM, by one of two libraries.
//!
//! | feature       | type          | library                  | needs                     |
//! | ------------- | ------------- | ------------------------ | ------------------------- |
//! | `aws-lc-rs`   | `AwsLc`       | aws-lc-rs                | `std`, a C compiler       |
//! | `rust-crypto` | `RustCrypto`  | `aes-gcm` of RustCrypto  | `alloc`                   |
//!
//! Both can be enabled. [`DefaultAead`] is then `AwsLc`. Both produce the same bytes.

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

/// The default AEAD of `Sealer` and `Opener`.
#[cfg(feature = "aws-lc-rs")]
pub type DefaultAead = AwsLc;
/// The default AEAD of `Sealer` and `Opener`.
#[cfg(all(feature = "rust-crypto", not(feature = "aws-lc-rs")))]
pub type DefaultAead = RustCrypto;

/// The AEAD failed to seal or to open. The error does not give the reason.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("the AEAD refused")]
pub struct AeadError;

/// AES-256-GCM with one key, a 12-byte nonce and a 16-byte tag.
///
/// An implementation erases the key on drop and leaves nothing derived from it on the stack. It compares tags in
/// constant time and allocates nothing for a message. If a tag is wrong, the output buffer may contain anything but the
/// plaintext. This trait must not be implemented for another algorithm, because the envelope's magic stands for
/// AES-256-GCM.
pub trait Aead: Sized + Send + Sync {
    /// The library's name, for logs and benchmarks.
    const NAME: &'static str;

    /// Prepares a key.
    fn new(key: &[u8; 32]) -> Self;

    /// Encrypts `in_out` in place and returns the tag.
    ///
    /// # Errors
    /// [`AeadError`] if it is longer than AES-GCM allows.
    fn seal_in_place(
        &self,
        nonce: &[u8; NONCE_LEN],
        aad: &[u8],
        in_out: &mut [u8],
    ) -> Result<[u8; TAG_LEN], AeadError>;

    /// Encrypts `plaintext` into `ciphertext`, which has the same length, and returns the tag.
    ///
    /// # Errors
    /// [`AeadError`] if the lengths differ or exceed what AES-GCM allows.
    fn seal_apart(
        &self,
        nonce: &[u8; NONCE_LEN],
        aad: &[u8],
        plaintext: &[u8],
        ciphertext: &mut [u8],
    ) -> Result<[u8; TAG_LEN], AeadError>;

    /// Decrypts `in_out` in place.
    ///
    /// # Errors
    /// [`AeadError`] if the tag is wrong.
    fn open_in_place(
        &self,
        nonce: &[u8; NONCE_LEN],
        aad: &[u8],
        in_out: &mut [u8],
        tag: &[u8; TAG_LEN],
    ) -> Result<(), AeadError>;

    /// Decrypts `ciphertext` into `plaintext`, which has the same length.
    ///
    /// # Errors
    /// [`AeadError`] if the lengths differ or the tag is wrong.
    fn open_apart(
        &self,
        nonce: &[u8; NONCE_LEN],
        aad: &[u8],
        ciphertext: &[u8],
        tag: &[u8; TAG_LEN],
        plaintext: &mut [u8],
    ) -> Result<(), AeadError>;
}
