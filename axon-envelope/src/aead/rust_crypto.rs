//! AES-256-GCM by RustCrypto's `aes-gcm`.

use alloc::boxed::Box;

use aes_gcm::aead::inout::InOutBuf;
use aes_gcm::{AeadInOut, Aes256Gcm, KeyInit};

use super::{Aead, AeadError};
use crate::TAG_LEN;
use crate::erase::erasing_stack;
use crate::header::NONCE_LEN;

/// AES-256-GCM by RustCrypto, erased on drop.
///
/// It can be neither copied nor printed:
///
/// ```compile_fail,E0599
/// # use axon_envelope::aead::RustCrypto;
/// # fn f(aead: RustCrypto) {
/// let copy: RustCrypto = aead.clone();
/// # }
/// ```
/// ```compile_fail,E0277
/// # use axon_envelope::aead::RustCrypto;
/// # fn f(aead: RustCrypto) {
/// println!("{aead:?}");
/// # }
/// ```
// The box makes a move copy a pointer, so that a move leaves no key schedule behind.
pub struct RustCrypto(Box<Aes256Gcm>);

impl Aead for RustCrypto {
    const NAME: &'static str = "aes-gcm";

    fn new(key: &[u8; 32]) -> Self {
        Self(Box::new(Aes256Gcm::new(key.into())))
    }

    fn seal_in_place(
        &self,
        nonce: &[u8; NONCE_LEN],
        aad: &[u8],
        in_out: &mut [u8],
    ) -> Result<[u8; TAG_LEN], AeadError> {
        erasing_stack(|| {
            let tag = self.0.encrypt_inout_detached(nonce.into(), aad, in_out.into());
            tag.map(Into::into).map_err(|_| AeadError)
        })
    }

    fn seal_apart(
        &self,
        nonce: &[u8; NONCE_LEN],
        aad: &[u8],
        plaintext: &[u8],
        ciphertext: &mut [u8],
    ) -> Result<[u8; TAG_LEN], AeadError> {
        let buffers = InOutBuf::new(plaintext, ciphertext).map_err(|_| AeadError)?;
        erasing_stack(|| {
            let tag = self.0.encrypt_inout_detached(nonce.into(), aad, buffers);
            tag.map(Into::into).map_err(|_| AeadError)
        })
    }

    fn open_in_place(
        &self,
        nonce: &[u8; NONCE_LEN],
        aad: &[u8],
        in_out: &mut [u8],
        tag: &[u8; TAG_LEN],
    ) -> Result<(), AeadError> {
        erasing_stack(|| {
            self.0
                .decrypt_inout_detached(nonce.into(), aad, in_out.into(), tag.into())
                .map_err(|_| AeadError)
        })
    }

    fn open_apart(
        &self,
        nonce: &[u8; NONCE_LEN],
        aad: &[u8],
        ciphertext: &[u8],
        tag: &[u8; TAG_LEN],
        plaintext: &mut [u8],
    ) -> Result<(), AeadError> {
        let buffers = InOutBuf::new(ciphertext, plaintext).map_err(|_| AeadError)?;
        erasing_stack(|| {
            self.0
                .decrypt_inout_detached(nonce.into(), aad, buffers, tag.into())
                .map_err(|_| AeadError)
        })
    }
}
