//! Cipher suites of the released rustls, with the HKDF of rustls-axon.
//!
//! The HKDF of rustls's own provider leaves the salt of each step, which is a secret in the key schedule of TLS, in
//! freed memory. A provider cannot erase secrets that rustls itself holds by value, for example traffic secrets.

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

/// As [`suite`], for configurations that resume nothing. rustls computes the resumption secret of each connection even
/// so, and a client keeps it for as long as the connection exists. This suite returns random bytes instead.
pub(super) fn suite_without_resumption(cipher: Cipher) -> SupportedCipherSuite {
    SupportedCipherSuite::Tls13(match cipher {
        Cipher::ChaCha20Poly1305 => &CHACHA20_POLY1305_SHA256_UNRESUMED,
        Cipher::Aes256Gcm => &AES_256_GCM_SHA384_UNRESUMED,
    })
}

static CHACHA20_POLY1305_SHA256: LazyLock<Tls13CipherSuite> =
    LazyLock::new(|| with_hkdf(&Erasing { cipher: Cipher::ChaCha20Poly1305, resumes: true }));
static AES_256_GCM_SHA384: LazyLock<Tls13CipherSuite> =
    LazyLock::new(|| with_hkdf(&Erasing { cipher: Cipher::Aes256Gcm, resumes: true }));
static CHACHA20_POLY1305_SHA256_UNRESUMED: LazyLock<Tls13CipherSuite> =
    LazyLock::new(|| with_hkdf(&Erasing { cipher: Cipher::ChaCha20Poly1305, resumes: false }));
static AES_256_GCM_SHA384_UNRESUMED: LazyLock<Tls13CipherSuite> =
    LazyLock::new(|| with_hkdf(&Erasing { cipher: Cipher::Aes256Gcm, resumes: false }));

fn with_hkdf(hkdf_provider: &'static Erasing) -> Tls13CipherSuite {
    let suite = match hkdf_provider.cipher {
        Cipher::ChaCha20Poly1305 => released::TLS13_CHACHA20_POLY1305_SHA256,
        Cipher::Aes256Gcm => released::TLS13_AES_256_GCM_SHA384,
    };
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
struct Erasing {
    cipher: Cipher,
    /// Whether resumption secrets are computed.
    resumes: bool,
}

impl Erasing {
    fn hkdf(&self) -> &'static dyn axon::Hkdf {
        let suite = match self.cipher {
            Cipher::ChaCha20Poly1305 => axon_suite::TLS13_CHACHA20_POLY1305_SHA256,
            Cipher::Aes256Gcm => axon_suite::TLS13_AES_256_GCM_SHA384,
        };
        suite.tls13().expect("the suite is one of TLS 1.3").hkdf_provider
    }

    fn expander(&self, hkdf: Box<dyn axon::HkdfExpander>) -> Box<dyn HkdfExpander> {
        Box::new(Expander { hkdf, resumes: self.resumes })
    }
}

impl Hkdf for Erasing {
    fn extract_from_zero_ikm(&self, salt: Option<&[u8]>) -> Box<dyn HkdfExpander> {
        self.expander(self.hkdf().extract_from_zero_ikm(salt))
    }

    fn extract_from_secret(&self, salt: Option<&[u8]>, secret: &[u8]) -> Box<dyn HkdfExpander> {
        self.expander(self.hkdf().extract_from_secret(salt, secret))
    }

    fn expander_for_okm(&self, okm: &OkmBlock) -> Box<dyn HkdfExpander> {
        self.expander(self.hkdf().expander_for_okm(&axon::OkmBlock::new(okm.as_ref())))
    }

    fn hmac_sign(&self, key: &OkmBlock, message: &[u8]) -> Tag {
        let key = axon::OkmBlock::new(key.as_ref());
        Tag::new(self.hkdf().hmac_sign(&key, message).as_ref())
    }
}

/// The beginning of the HkdfLabel of the resumption secret, after the output length: the label's length, and the label
/// (RFC 8446, section 7.1).
const RESUMPTION: &[u8] = b"\x10tls13 res master";

/// Returns whether an HkdfLabel is that of the resumption secret.
fn is_resumption(info: &[&[u8]]) -> bool {
    info.iter().copied().flatten().skip(2).take(RESUMPTION.len()).eq(RESUMPTION)
}

struct Expander {
    hkdf: Box<dyn axon::HkdfExpander>,
    resumes: bool,
}

impl HkdfExpander for Expander {
    fn expand_slice(&self, info: &[&[u8]], output: &mut [u8]) -> Result<(), OutputLengthError> {
        self.hkdf.expand_slice(info, output).map_err(|_| OutputLengthError)
    }

    fn expand_block(&self, info: &[&[u8]]) -> OkmBlock {
        if !self.resumes && is_resumption(info) {
            // A constant would let others resume the session if resumption were turned on by mistake.
            let mut random = [0; OkmBlock::MAX_LEN];
            let random = &mut random[..self.hkdf.hash_len()];
            aws_lc_rs::rand::fill(random).expect("the system has random bytes");
            return OkmBlock::new(random);
        }
        OkmBlock::new(self.hkdf.expand_block(info).as_ref())
    }

    fn hash_len(&self) -> usize {
        self.hkdf.hash_len()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Expands a label without a context from a fixed secret.
    fn expand(suite: SupportedCipherSuite, label: &str) -> Vec<u8> {
        let hkdf = suite.tls13().unwrap().hkdf_provider;
        let expander = hkdf.extract_from_secret(None, b"secret");
        let (length, label) = ([0, expander.hash_len() as u8], format!("tls13 {label}"));
        let info: &[&[u8]] = &[&length, &[label.len() as u8], label.as_bytes(), &[0]];
        expander.expand_block(info).as_ref().to_vec()
    }

    #[test]
    fn without_resumption_its_secret_alone_is_another_each_time() {
        for cipher in Cipher::ALL {
            for label in ["c ap traffic", "s hs traffic", "exp master", "derived", "res binder"] {
                let of = [suite, suite_without_resumption].map(|of| expand(of(cipher), label));
                assert_eq!(of[0], of[1], "{cipher}: {label}");
            }
            let resumed = || expand(suite(cipher), "res master");
            let unresumed = || expand(suite_without_resumption(cipher), "res master");
            assert_eq!(resumed(), resumed());
            assert_ne!(resumed(), unresumed());
            assert_ne!(unresumed(), unresumed());
            assert_eq!(unresumed().len(), resumed().len());
        }
    }
}
