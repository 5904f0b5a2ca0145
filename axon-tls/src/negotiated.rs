//! The ciphers and key exchanges that peers choose from, and the result of their negotiation.

use std::fmt;
use std::str::FromStr;

use rustls_axon::crypto::hash::HashAlgorithm;

use crate::Error;
#[cfg(feature = "hybrid")]
use crate::identity::SpkiDigest;

/// The cipher suite of a connection: TLS 1.3 with a 256-bit key.
///
/// A configuration has exactly one. It also determines the hash of the key schedule and of a pre-shared key.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub enum Cipher {
    /// TLS_CHACHA20_POLY1305_SHA256
    #[default]
    ChaCha20Poly1305,
    /// TLS_AES_256_GCM_SHA384
    Aes256Gcm,
}

impl Cipher {
    /// All ciphers.
    pub const ALL: [Self; 2] = [Self::ChaCha20Poly1305, Self::Aes256Gcm];

    /// Returns the name used in configuration: `chacha20-poly1305` or `aes-256-gcm`.
    pub const fn name(self) -> &'static str {
        match self {
            Self::ChaCha20Poly1305 => "chacha20-poly1305",
            Self::Aes256Gcm => "aes-256-gcm",
        }
    }

    /// Returns the hash of the cipher suite.
    pub(crate) const fn hash(self) -> HashAlgorithm {
        match self {
            Self::ChaCha20Poly1305 => HashAlgorithm::SHA256,
            Self::Aes256Gcm => HashAlgorithm::SHA384,
        }
    }
}

/// The use of a pre-shared key (RFC 8446 section 4.2.9).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub enum PskKex {
    /// The key alone. There is no forward secrecy: an attacker who learns the key later can read a recorded connection.
    #[default]
    PskKe,
    /// The key together with X25519MLKEM768.
    PskDheKe,
}

impl PskKex {
    /// Both modes.
    pub const ALL: [Self; 2] = [Self::PskKe, Self::PskDheKe];

    /// Returns the name used in configuration: `psk_ke` or `psk_dhe_ke`.
    pub const fn name(self) -> &'static str {
        match self {
            Self::PskKe => "psk_ke",
            Self::PskDheKe => "psk_dhe_ke",
        }
    }
}

/// The key exchange of a finished handshake.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum KeyExchange {
    /// X25519 and ML-KEM-768 together.
    X25519MlKem768,
    /// An external pre-shared key alone.
    PskKe,
    /// An external pre-shared key and X25519MLKEM768.
    PskDheKe,
}

impl fmt::Display for KeyExchange {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::X25519MlKem768 => "X25519MLKEM768",
            Self::PskKe => "psk_ke",
            Self::PskDheKe => "psk_dhe_ke (X25519MLKEM768)",
        })
    }
}

/// The result of a finished handshake, as the connection reports it.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct Negotiated {
    /// The key exchange.
    pub key_exchange: KeyExchange,
    /// The cipher suite.
    pub cipher: Cipher,
    /// The identity of the pre-shared key, if the connection uses one.
    pub psk_identity: Option<Vec<u8>>,
    /// The digest of the peer's public key. It is `None` on a pre-shared key, and for a client that was not asked for a
    /// certificate.
    ///
    /// The peer has proved that it has the private key. Whether this identifies the peer depends on the
    /// [`Auth`](crate::identity::Auth) of the configuration.
    #[cfg(feature = "hybrid")]
    pub peer: Option<SpkiDigest>,
    /// The application protocol. It is empty if none was configured.
    pub alpn: Vec<u8>,
}

/// Returns the list of protocols of a configuration: one, or none if `alpn` is empty.
pub(crate) fn protocols(alpn: &[u8]) -> Result<Vec<Vec<u8>>, Error> {
    match alpn.len() {
        0 => Ok(Vec::new()),
        1..=255 => Ok(vec![alpn.to_vec()]),
        _ => Err(Error::Alpn),
    }
}

/// A name that is not one of the accepted names.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("`{given}` is not one of {accepted}")]
pub struct UnknownName {
    given: String,
    accepted: &'static str,
}

macro_rules! named {
    ($ty:ty, $accepted:literal) => {
        impl fmt::Display for $ty {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str(self.name())
            }
        }

        impl FromStr for $ty {
            type Err = UnknownName;

            fn from_str(given: &str) -> Result<Self, Self::Err> {
                Self::ALL.into_iter().find(|known| known.name() == given).ok_or_else(|| {
                    UnknownName { given: given.chars().take(64).collect(), accepted: $accepted }
                })
            }
        }
    };
}

named!(Cipher, "chacha20-poly1305, aes-256-gcm");
named!(PskKex, "psk_ke, psk_dhe_ke");

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_exact() {
        for wrong in ["", "CHACHA20-POLY1305", "aes-256-gcm ", "aes-128-gcm", "psk"] {
            assert!(wrong.parse::<Cipher>().is_err(), "{wrong}");
            assert!(wrong.parse::<PskKex>().is_err(), "{wrong}");
        }
        for cipher in Cipher::ALL {
            assert_eq!(cipher.to_string().parse(), Ok(cipher));
        }
        for kex in PskKex::ALL {
            assert_eq!(kex.to_string().parse(), Ok(kex));
        }
    }
}
