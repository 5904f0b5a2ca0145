//! The error of everything that makes a key, an identity or a configuration.

/// Why a key, an identity or a configuration could not be made.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// An SAE ID or key_ID cannot be used.
    #[error("{what} {reason}")]
    Name {
        /// Which of the names.
        what: &'static str,
        /// What is wrong with it.
        reason: &'static str,
    },
    /// Both ends have the same SAE ID, so a reflected handshake could not be told from a real one.
    #[error("client and server have the same SAE ID; give each host an SAE of its own")]
    EqualSaeIds,
    /// Bytes that are not a PSK identity of the form `axon-qkd-v1:CLIENT-SAE:key_ID`.
    #[error("not a PSK identity of the form axon-qkd-v1:CLIENT-SAE:key_ID: {0}")]
    PskIdentity(&'static str),
    /// A private key that cannot be used.
    #[error("private key: {0}")]
    PrivateKey(&'static str),
    /// The application protocol to negotiate is empty or too long.
    #[error("ALPN protocol must have 1 to 255 bytes")]
    Alpn,
    /// rustls refused the configuration of a hybrid connection.
    #[cfg(feature = "hybrid")]
    #[error("rustls: {0}")]
    Rustls(#[from] rustls::Error),
    /// A configuration of the caller's that is not hybrid and nothing else. What it has instead.
    #[error(
        "the configuration has {0}, and must be hybrid alone: make it with axon_tls::hybrid::provider()"
    )]
    NotHybrid(String),
    /// A configuration of the caller's with early data (0-RTT), which is replayable.
    #[error("the configuration has early data (0-RTT), which is not supported: leave it off")]
    EarlyData,
    /// Pre-shared keys that cannot be configured together.
    #[error("pre-shared keys: {0}")]
    Psk(&'static str),
    /// rustls-axon refused a pre-shared key or the configuration of a connection on one.
    #[error("rustls-axon: {0}")]
    RustlsAxon(#[from] rustls_axon::Error),
    /// The system's random number generator or key generation failed.
    #[error("key generation failed")]
    KeyGeneration,
    /// A part of [`CaMaterial`](crate::identity::CaMaterial) that cannot be used.
    #[error("{part}: {reason}")]
    Certificates {
        /// Which of the texts it was made from.
        part: CaPart,
        /// What is wrong with it.
        reason: String,
    },
}

/// A text that [`CaMaterial`](crate::identity::CaMaterial) is made from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum CaPart {
    /// The roots.
    Roots,
    /// Our certificate and the chain above it.
    Chain,
    /// The private key of our certificate.
    Key,
    /// The revocation lists.
    RevocationLists,
}

impl std::fmt::Display for CaPart {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::Roots => "roots",
            Self::Chain => "our certificate",
            Self::Key => "our private key",
            Self::RevocationLists => "revocation lists",
        })
    }
}
