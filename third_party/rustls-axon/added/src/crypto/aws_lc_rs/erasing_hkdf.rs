//! HKDF that erases what it held and leaves nothing behind.
//!
//! `aws_lc_rs::hkdf` keeps a salt in memory that it does not erase when it frees it.  In the key
//! schedule of TLS the salt is a secret: from it alone follow all keys of a connection in psk_ke.
//! Its `Prk` and the contexts of `aws_lc_rs::hmac` are moved on the stack, which leaves copies that
//! their destructors do not know.  So HKDF is made of HMAC here (RFC 5869), secrets are in memory
//! that does not move, and the stack that HMAC used is overwritten.

use alloc::boxed::Box;
use core::hint::black_box;

use aws_lc_rs::hmac;

use crate::crypto;
use crate::crypto::tls13::{Hkdf, HkdfExpander, OkmBlock, OutputLengthError};

/// HKDF over one HMAC.
pub(super) struct ErasingHkdf(pub(super) hmac::Algorithm);

impl ErasingHkdf {
    fn extract(&self, salt: Option<&[u8]>, secret: &[u8]) -> Box<dyn HkdfExpander> {
        let zeros = [0u8; OkmBlock::MAX_LEN];
        let len = self.0.tag_len();
        let salt = salt.unwrap_or(&zeros[..len]);
        let prk = OkmBlock::filled(len, |prk| mac(self.0, salt, [&[], &[secret], &[]], prk));
        Box::new(ErasingExpander { alg: self.0, prk })
    }
}

impl Hkdf for ErasingHkdf {
    fn extract_from_zero_ikm(&self, salt: Option<&[u8]>) -> Box<dyn HkdfExpander> {
        let zeros = [0u8; OkmBlock::MAX_LEN];
        self.extract(salt, &zeros[..self.0.tag_len()])
    }

    fn extract_from_secret(&self, salt: Option<&[u8]>, secret: &[u8]) -> Box<dyn HkdfExpander> {
        self.extract(salt, secret)
    }

    fn expander_for_okm(&self, okm: &OkmBlock) -> Box<dyn HkdfExpander> {
        Box::new(ErasingExpander {
            alg: self.0,
            prk: okm.clone(),
        })
    }

    fn hmac_sign(&self, key: &OkmBlock, message: &[u8]) -> crypto::hmac::Tag {
        let mut tag = [0u8; OkmBlock::MAX_LEN];
        let tag = &mut tag[..self.0.tag_len()];
        mac(self.0, key.as_ref(), [&[], &[message], &[]], tag);
        crypto::hmac::Tag::new(tag)
    }

    fn fips(&self) -> bool {
        super::fips()
    }
}

struct ErasingExpander {
    alg: hmac::Algorithm,
    prk: OkmBlock,
}

impl ErasingExpander {
    /// T(n) of RFC 5869 2.3, from T(n - 1).
    fn block(&self, previous: &OkmBlock, info: &[&[u8]], n: u8, out: &mut [u8]) {
        let parts: [&[&[u8]]; 3] = [&[previous.as_ref()], info, &[&[n]]];
        mac(self.alg, self.prk.as_ref(), parts, out);
    }
}

impl HkdfExpander for ErasingExpander {
    fn expand_slice(&self, info: &[&[u8]], output: &mut [u8]) -> Result<(), OutputLengthError> {
        let len = self.alg.tag_len();
        if output.len() > 255 * len {
            return Err(OutputLengthError);
        }

        let mut previous = OkmBlock::new(&[]);
        for (n, chunk) in output.chunks_mut(len).enumerate() {
            let block = OkmBlock::filled(len, |block| {
                self.block(&previous, info, n as u8 + 1, block);
            });
            chunk.copy_from_slice(&block.as_ref()[..chunk.len()]);
            previous = block;
        }
        Ok(())
    }

    fn expand_block(&self, info: &[&[u8]]) -> OkmBlock {
        OkmBlock::filled(self.alg.tag_len(), |block| {
            self.block(&OkmBlock::new(&[]), info, 1, block);
        })
    }

    fn hash_len(&self) -> usize {
        self.alg.tag_len()
    }
}

/// Writes the HMAC of `parts` under `key` to `out`, and leaves neither on the stack.
fn mac(alg: hmac::Algorithm, key: &[u8], parts: [&[&[u8]]; 3], out: &mut [u8]) {
    mac_on_the_stack(alg, key, parts, out);
    overwrite_stack();
}

#[inline(never)]
fn mac_on_the_stack(alg: hmac::Algorithm, key: &[u8], parts: [&[&[u8]]; 3], out: &mut [u8]) {
    let mut context = hmac::Context::with_key(&hmac::Key::new(alg, key));
    for part in parts.into_iter().flatten() {
        context.update(part);
    }
    out.copy_from_slice(context.sign().as_ref());
}

/// Overwrites the stack below the caller, where a call has just returned from.
#[inline(never)]
fn overwrite_stack() {
    black_box([0u8; STACK_OF_HMAC].as_mut_slice());
}

/// More than HMAC takes, copies of its contexts in builds without optimization counted.
const STACK_OF_HMAC: usize = 16 * 1024;
