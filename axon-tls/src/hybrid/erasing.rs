//! Cipher suites of rustls as released, with the HKDF of rustls-axon.
//!
//! The HKDF of rustls's own provider leaves the salt of each step, which is a secret in the key
//! schedule of TLS, in freed memory. Secrets that rustls itself holds by value, such as those of
//! the traffic, are beyond what a provider can erase.

use std::sync::LazyLock;

use rustls::crypto::CipherSuiteCommon;
use rustls::crypto::aws_lc_rs::cipher_suite as released;
use rustls::crypto::hmac::Tag;
use rustls::crypto::tls13::{Hkdf, HkdfExpander, OkmBlock, OutputLengthError};
use rustls::{SupportedCipherSuite, Tls13CipherSuite};
use rustls_axon::crypto::aws_lc_rs::cipher_suite as axon_suite;
use rustls_axon::crypto::tls13 as axon;

use crate::Cipher;

pub(super) fn suite(cipher: Cipher) -> SupportedCipherSuite {
    SupportedCipherSuite::Tls13(match cipher {
        Cipher::ChaCha20Poly1305 => &CHACHA20_POLY1305_SHA256,
        Cipher::Aes256Gcm => &AES_256_GCM_SHA384,
    })
}

static CHACHA20_POLY1305_SHA256: LazyLock<Tls13CipherSuite> = LazyLock::new(|| {
    with_hkdf(released::TLS13_CHACHA20_POLY1305_SHA256, &Erasing(Cipher::ChaCha20Poly1305))
});
static AES_256_GCM_SHA384: LazyLock<Tls13CipherSuite> =
    LazyLock::new(|| with_hkdf(released::TLS13_AES_256_GCM_SHA384, &Erasing(Cipher::Aes256Gcm)));

fn with_hkdf(suite: SupportedCipherSuite, hkdf_provider: &'static Erasing) -> Tls13CipherSuite {
    let suite = suite.tls13().expect("the suite is one of TLS 1.3");
    Tls13CipherSuite {
        common: CipherSuiteCommon {
            suite: suite.common.suite,
            hash_provider: suite.common.hash_provider,
            confidentiality_limit: suite.common.confidentiality_limit,
        },
        hkdf_provider,
        aead_alg: suite.aead_alg,
        quic: suite.quic,
    }
}

/// The HKDF of rustls-axon, with the types of rustls.
struct Erasing(Cipher);

impl Erasing {
    fn hkdf(&self) -> &'static dyn axon::Hkdf {
        let suite = match self.0 {
            Cipher::ChaCha20Poly1305 => axon_suite::TLS13_CHACHA20_POLY1305_SHA256,
            Cipher::Aes256Gcm => axon_suite::TLS13_AES_256_GCM_SHA384,
        };
        suite.tls13().expect("the suite is one of TLS 1.3").hkdf_provider
    }
}

impl Hkdf for Erasing {
    fn extract_from_zero_ikm(&self, salt: Option<&[u8]>) -> Box<dyn HkdfExpander> {
        Box::new(Expander(self.hkdf().extract_from_zero_ikm(salt)))
    }

    fn extract_from_secret(&self, salt: Option<&[u8]>, secret: &[u8]) -> Box<dyn HkdfExpander> {
        Box::new(Expander(self.hkdf().extract_from_secret(salt, secret)))
    }

    fn expander_for_okm(&self, okm: &OkmBlock) -> Box<dyn HkdfExpander> {
        Box::new(Expander(self.hkdf().expander_for_okm(&axon::OkmBlock::new(okm.as_ref()))))
    }

    fn hmac_sign(&self, key: &OkmBlock, message: &[u8]) -> Tag {
        let key = axon::OkmBlock::new(key.as_ref());
        Tag::new(self.hkdf().hmac_sign(&key, message).as_ref())
    }
}

struct Expander(Box<dyn axon::HkdfExpander>);

impl HkdfExpander for Expander {
    fn expand_slice(&self, info: &[&[u8]], output: &mut [u8]) -> Result<(), OutputLengthError> {
        self.0.expand_slice(info, output).map_err(|_| OutputLengthError)
    }

    fn expand_block(&self, info: &[&[u8]]) -> OkmBlock {
        OkmBlock::new(self.0.expand_block(info).as_ref())
    }

    fn hash_len(&self) -> usize {
        self.0.hash_len()
    }
}
