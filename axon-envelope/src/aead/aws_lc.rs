//! AES-256-GCM by aws-lc-rs.

use aws_lc_rs::aead::{AES_256_GCM, Aad, LessSafeKey, Nonce, UnboundKey};

use super::{Aead, AeadError};
use crate::TAG_LEN;
use crate::erase::erasing_stack;
use crate::header::NONCE_LEN;

/// AES-256-GCM by aws-lc-rs. The library keeps the key behind a pointer, and erases it when it
/// frees it.
///
/// It can be neither copied nor printed:
///
/// ```compile_fail,E0599
/// # use axon_envelope::aead::AwsLc;
/// # fn f(aead: AwsLc) {
/// let copy: AwsLc = aead.clone();
/// # }
/// ```
/// ```compile_fail,E0277
/// # use axon_envelope::aead::AwsLc;
/// # fn f(aead: AwsLc) {
/// println!("{aead:?}");
/// # }
/// ```
// "Less safe" means that the caller is responsible for the nonces. `Sealer` takes this
// responsibility.
pub struct AwsLc(LessSafeKey);

impl Aead for AwsLc {
    const NAME: &'static str = "aws-lc-rs";

    fn new(key: &[u8; 32]) -> Self {
        let key = UnboundKey::new(&AES_256_GCM, key).expect("AES-256-GCM takes 32 bytes of key");
        Self(LessSafeKey::new(key))
    }

    fn seal_in_place(
        &self,
        nonce: &[u8; NONCE_LEN],
        aad: &[u8],
        in_out: &mut [u8],
    ) -> Result<[u8; TAG_LEN], AeadError> {
        erasing_stack(|| {
            let nonce = Nonce::assume_unique_for_key(*nonce);
            let tag = self.0.seal_in_place_separate_tag(nonce, Aad::from(aad), in_out);
            tag.map_err(|_| AeadError)?.as_ref().try_into().map_err(|_| AeadError)
        })
    }

    fn seal_apart(
        &self,
        nonce: &[u8; NONCE_LEN],
        aad: &[u8],
        plaintext: &[u8],
        ciphertext: &mut [u8],
    ) -> Result<[u8; TAG_LEN], AeadError> {
        let mut tag = [0; TAG_LEN];
        let sealed = erasing_stack(|| {
            let nonce = Nonce::assume_unique_for_key(*nonce);
            let aad = Aad::from(aad);
            self.0.seal_out_of_place_scatter(nonce, aad, plaintext, ciphertext, &[], &mut tag)
        });
        sealed.map(|()| tag).map_err(|_| AeadError)
    }

    fn open_in_place(
        &self,
        nonce: &[u8; NONCE_LEN],
        aad: &[u8],
        in_out: &mut [u8],
        tag: &[u8; TAG_LEN],
    ) -> Result<(), AeadError> {
        erasing_stack(|| {
            let nonce = Nonce::assume_unique_for_key(*nonce);
            let opened = self.0.open_in_place_separate_tag(nonce, Aad::from(aad), tag, in_out);
            opened.map(|_| ()).map_err(|_| AeadError)
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
        erasing_stack(|| {
            let nonce = Nonce::assume_unique_for_key(*nonce);
            let opened =
                self.0.open_separate_gather(nonce, Aad::from(aad), ciphertext, tag, plaintext);
            opened.map_err(|_| AeadError)
        })
    }
}
