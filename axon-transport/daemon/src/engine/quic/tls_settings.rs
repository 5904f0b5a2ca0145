//! Converts the settings of a [`Config`](axon_transport::config::Config) to those of `axon-tls`.

use axon_tls::{Cipher, PskKex};
use axon_transport::config::{QkdKex, QuicCipher};

/// Returns the cipher suite of `AXON_QUIC_CIPHER`.
pub(crate) const fn tls_cipher(cipher: QuicCipher) -> Cipher {
    match cipher {
        QuicCipher::ChaCha20Poly1305 => Cipher::ChaCha20Poly1305,
        QuicCipher::Aes256Gcm => Cipher::Aes256Gcm,
    }
}

/// Returns the use of a pre-shared key of `AXON_QKD_KEX`.
pub(crate) const fn psk_kex(kex: QkdKex) -> PskKex {
    match kex {
        QkdKex::PskKe => PskKex::PskKe,
        QkdKex::PskDheKe => PskKex::PskDheKe,
    }
}

#[test]
fn both_have_the_same_names() {
    for cipher in [QuicCipher::ChaCha20Poly1305, QuicCipher::Aes256Gcm] {
        assert_eq!(tls_cipher(cipher).name(), cipher.name());
    }
    for kex in [QkdKex::PskKe, QkdKex::PskDheKe] {
        assert_eq!(psk_kex(kex).name(), kex.name());
    }
}
