//! The error of all functions that make a key, an identity or a configuration.

/// The reason why a key, an identity or a configuration could not be made.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// An SAE ID or key_ID cannot be used.
    #[error("{what} {reason}")]
    Name {
        /// The name that is wrong.
        what: &'static str,
        /// The reason.
        reason: &'static str,
    },
    /// Both ends have the same SAE ID, so a reflected handshake would be indistinguishable from a
    /// genuine one.
    #[error("client and server have the same SAE ID; give each host an SAE of its own")]
    EqualSaeIds,
    /// The bytes are not a PSK identity of the form `axon-qkd-v1:CLIENT-SAE:key_ID`.
    #[error("not a PSK identity of the form axon-qkd-v1:CLIENT-SAE:key_ID: {0}")]
    PskIdentity(&'static str),
    /// A private key cannot be used.
    #[error("private key: {0}")]
    PrivateKey(&'static str),
    /// The application protocol to negotiate is empty or too long.
    #[error("ALPN protocol must have 1 to 255 bytes")]
    Alpn,
    /// rustls refused the configuration of a hybrid connection.
    #[cfg(feature = "hybrid")]
    #[error("rustls: {0}")]
    Rustls(#[from] rustls::Error),
    /// A configuration of the caller permits something other than the hybrid mode, which the text
    /// names.
    #[error(
        "the configuration has {0}, and must be hybrid alone: make it with axon_tls::hybrid::provider()"
    )]
    NotHybrid(String),
    /// A configuration of the caller has early data (0-RTT), which can be replayed.
    #[error("the configuration has early data (0-RTT), which is not supported: leave it off")]
    EarlyData,
    /// The pre-shared keys cannot be configured together.
    #[error("pre-shared keys: {0}")]
    Psk(&'static str),
    /// rustls-axon refused a pre-shared key, or the configuration of a connection with one.
    #[error("rustls-axon: {0}")]
    RustlsAxon(#[from] rustls_axon::Error),
    /// The system's random number generator or key generation failed.
    #[error("key generation failed")]
    KeyGeneration,
    /// A part of [`CaMaterial`](crate::identity::CaMaterial) cannot be used.
    #[error("{part}: {reason}")]
    Certificates {
        /// The text that is wrong.
        part: CaPart,
        /// The reason.
        reason: String,
    },
}

/// A text from which [`CaMaterial`](crate::identity::CaMaterial) is made.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum CaPart {
    /// The root certificates.
    Roots,
    /// The certificate of this end, and the chain above it.
    Chain,
    /// The private key of this end's certificate.
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
