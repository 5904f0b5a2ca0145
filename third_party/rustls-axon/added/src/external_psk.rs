//! External pre-shared keys for TLS 1.3.
//!
//! A pre-shared key is *external* when both ends were given it by something other than TLS
//! ([RFC 8446 section 2.2], [RFC 9257]): a key manager, a provisioning step, a person.  It
//! authenticates both ends, so a connection that runs on one has no certificates at all.
//!
//! Use is mandatory by construction.  The methods that take external PSKs end the config
//! builder at the place where a verifier and certificates would otherwise be chosen:
//!
//! - [`ConfigBuilder::with_external_psks()`] and [`ConfigBuilder::with_external_psk_source()`]
//!   make a [`ClientConfig`];
//! - [`ConfigBuilder::with_external_psk_resolver()`] makes a [`ServerConfig`].
//!
//! A connection made from such a config completes on one of its external PSKs or fails.  It
//! speaks TLS 1.3 only, sends no ticket, stores none that the peer sends, has no early data and
//! never calls the config's [`KeyLog`].  It ignores the certificate, resumption and early data
//! fields of the config, whatever they are set to.
//!
//! # Security
//!
//! [`PskKeyExchangeMode::PskKe`] has **no forward secrecy**: who learns the PSK later, and has
//! recorded the connection, reads it.  Use a fresh PSK for every connection, or
//! [`PskKeyExchangeMode::PskDheKe`].
//!
//! A PSK must be known to exactly one client and one server, and never be used with the roles
//! swapped (the Selfie attack, [RFC 9257 section 4.1]): derive it from inputs that name both ends,
//! or import it with a context that does ([`ImportedPsk`]).
//! It must have at least 128 bits of entropy: a password is open to an offline dictionary attack.
//!
//! The identity is sent in the clear.  Looking one up must have no side effect: anybody can send
//! an identity that they saw.  A single-use PSK is spent when the handshake completed, that is
//! when [`CommonState::external_psk()`] returns it.
//!
//! [`CommonState::external_psk()`]: crate::CommonState::external_psk
//! [`ConfigBuilder::with_external_psks()`]: crate::ConfigBuilder::with_external_psks
//! [`ConfigBuilder::with_external_psk_source()`]: crate::ConfigBuilder::with_external_psk_source
//! [`ConfigBuilder::with_external_psk_resolver()`]: crate::ConfigBuilder::with_external_psk_resolver
//! [`ClientConfig`]: crate::ClientConfig
//! [`ServerConfig`]: crate::ServerConfig
//! [`KeyLog`]: crate::KeyLog
//! [RFC 8446 section 2.2]: https://datatracker.ietf.org/doc/html/rfc8446#section-2.2
//! [RFC 9257]: https://datatracker.ietf.org/doc/html/rfc9257
//! [RFC 9257 section 4.1]: https://datatracker.ietf.org/doc/html/rfc9257#section-4.1

use alloc::vec::Vec;
use core::fmt;
use core::fmt::Debug;

use pki_types::{DnsName, ServerName};
use zeroize::Zeroizing;

use crate::crypto::CryptoProvider;
use crate::crypto::hash::HashAlgorithm;
use crate::error::Error;
use crate::sync::Arc;
use crate::tls13::Tls13CipherSuite;

mod imported;
pub use imported::{ImportedIdentity, ImportedPsk};

/// An external pre-shared key: an identity that is sent, a secret that is not, and the one hash
/// function that the secret is used with.
///
/// The secret is zeroized on drop.  The type is neither `Clone` nor `Debug`: share it with an
/// [`Arc`].
pub struct ExternalPsk {
    identity: Vec<u8>,
    secret: Zeroizing<Vec<u8>>,
    hash: HashAlgorithm,
    imported: bool,
}

impl ExternalPsk {
    /// The shortest secret accepted, in bytes ([RFC 9257 section 6]).
    ///
    /// [RFC 9257 section 6]: https://datatracker.ietf.org/doc/html/rfc9257#section-6
    pub const MIN_SECRET_LEN: usize = 16;

    /// Makes an external PSK.
    ///
    /// `hash` must be SHA-256 or SHA-384, and is the hash of the cipher suites that this PSK can
    /// be used with ([RFC 8446 section 4.2.11]).
    ///
    /// Fails if `identity` is empty or longer than a list of identities can be, if `secret` is
    /// shorter than [`Self::MIN_SECRET_LEN`], or if `hash` is another one.  Whether all that a
    /// client offers fits into its ClientHello is seen when a connection is made.
    ///
    /// [RFC 8446 section 4.2.11]: https://datatracker.ietf.org/doc/html/rfc8446#section-4.2.11
    pub fn new(
        identity: impl Into<Vec<u8>>,
        secret: Zeroizing<Vec<u8>>,
        hash: HashAlgorithm,
    ) -> Result<Self, Error> {
        let identity = identity.into();
        if identity.is_empty() || identity.len() > MAX_IDENTITIES_LEN - IDENTITY_OVERHEAD {
            return Err(Error::General(
                "external PSK: identity must have 1 to 65,529 bytes".into(),
            ));
        }
        if secret.len() < Self::MIN_SECRET_LEN {
            return Err(Error::General(
                "external PSK: secret must have at least 16 bytes".into(),
            ));
        }
        if !matches!(hash, HashAlgorithm::SHA256 | HashAlgorithm::SHA384) {
            return Err(Error::General(
                "external PSK: hash must be SHA-256 or SHA-384".into(),
            ));
        }

        Ok(Self {
            identity,
            secret,
            hash,
            imported: false,
        })
    }

    /// The identity, as it is sent.
    pub fn identity(&self) -> &[u8] {
        &self.identity
    }

    /// The hash function this PSK is used with.
    pub fn hash(&self) -> HashAlgorithm {
        self.hash
    }

    pub(crate) fn secret(&self) -> &[u8] {
        &self.secret
    }

    /// Whether this PSK was imported (see [`ImportedPsk`]), which gives it another binder.
    pub fn is_imported(&self) -> bool {
        self.imported
    }

    /// Whether this PSK and `suite` go together.
    pub(crate) fn usable_with(&self, suite: &Tls13CipherSuite) -> bool {
        suite.common.hash_provider.algorithm() == self.hash
    }

    /// The bytes that this PSK needs in the `identities` list of an offer.
    pub(crate) fn offered_identity_len(&self) -> usize {
        IDENTITY_OVERHEAD + self.identity.len()
    }
}

/// How a PSK and a (EC)DHE key exchange go together ([RFC 8446 section 4.2.9]).
///
/// A config has exactly one: a peer that wants the other is refused.
///
/// [RFC 8446 section 4.2.9]: https://datatracker.ietf.org/doc/html/rfc8446#section-4.2.9
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PskKeyExchangeMode {
    /// PSK-only key establishment: no `supported_groups` and no `key_share` are sent.
    ///
    /// The groups of the [`CryptoProvider`] are not used, and there need not be any.
    PskKe,

    /// PSK with (EC)DHE key establishment, over the groups of the [`CryptoProvider`] and no others.
    PskDheKe,
}

/// The external PSK that a connection runs on.
///
/// See [`CommonState::external_psk()`].
///
/// [`CommonState::external_psk()`]: crate::CommonState::external_psk
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct NegotiatedExternalPsk {
    pub(crate) identity: Vec<u8>,
    pub(crate) mode: PskKeyExchangeMode,
}

impl NegotiatedExternalPsk {
    /// The identity of the PSK.
    pub fn identity(&self) -> &[u8] {
        &self.identity
    }

    /// The key exchange mode it was used in.
    pub fn mode(&self) -> PskKeyExchangeMode {
        self.mode
    }
}

/// Where a client gets the external PSKs of one connection from.
pub trait ExternalPskSource: Debug + Send + Sync {
    /// The PSKs to offer to `server_name`, most preferred first.
    ///
    /// An empty list fails the connection before anything is sent.
    fn external_psks(&self, server_name: &ServerName<'_>) -> Vec<Arc<ExternalPsk>>;
}

/// How a server finds the external PSK for an offer.
pub trait ResolvesExternalPsk: Debug + Send + Sync {
    /// Picks one of the PSKs that a client offered.
    ///
    /// The returned PSK must have one of the identities in `offer`.  `None` refuses the connection
    /// with an `unknown_psk_identity` alert.
    ///
    /// The hash of the PSK must go with a cipher suite both ends support:
    /// [`ExternalPskOffer::accepts()`] tells.  If it does not, this is called again without that
    /// identity, a few times at most, so that a client can offer one PSK for each hash.
    ///
    /// This is called before the binder is checked, and again after a HelloRetryRequest: see the
    /// [module documentation](self#security) for what that means for single-use keys.
    fn resolve(&self, offer: ExternalPskOffer<'_>) -> Option<Arc<ExternalPsk>>;
}

/// What a client offered, as seen by [`ResolvesExternalPsk`].
#[derive(Clone, Copy, Debug)]
pub struct ExternalPskOffer<'a> {
    pub(crate) identities: &'a [&'a [u8]],
    pub(crate) suites: &'a [&'static Tls13CipherSuite],
    pub(crate) server_name: Option<&'a DnsName<'a>>,
}

impl<'a> ExternalPskOffer<'a> {
    /// The identities, in the client's order of preference.
    pub fn identities(&self) -> impl Iterator<Item = &'a [u8]> + 'a {
        self.identities.iter().copied()
    }

    /// Whether a cipher suite that both ends support has the hash function of `psk`.
    pub fn accepts(&self, psk: &ExternalPsk) -> bool {
        self.suites
            .iter()
            .any(|suite| psk.usable_with(suite))
    }

    /// The server name that the client sent, if any.
    pub fn server_name(&self) -> Option<&str> {
        self.server_name
            .map(|name| name.as_ref())
    }
}

/// The part of a `ClientConfig` that makes external PSKs mandatory.
#[derive(Clone, Debug)]
pub(crate) struct ClientExternalPsks {
    pub(crate) source: Arc<dyn ExternalPskSource>,
    pub(crate) mode: PskKeyExchangeMode,
}

/// The part of a `ServerConfig` that makes external PSKs mandatory.
#[derive(Clone, Debug)]
pub(crate) struct ServerExternalPsks {
    pub(crate) resolver: Arc<dyn ResolvesExternalPsk>,
    pub(crate) mode: PskKeyExchangeMode,
}

/// A fixed list of PSKs, the same for every server.
pub(crate) struct FixedExternalPsks(pub(crate) Vec<Arc<ExternalPsk>>);

impl ExternalPskSource for FixedExternalPsks {
    fn external_psks(&self, _server_name: &ServerName<'_>) -> Vec<Arc<ExternalPsk>> {
        self.0.clone()
    }
}

impl Debug for FixedExternalPsks {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("FixedExternalPsks")
            .field("len", &self.0.len())
            .finish()
    }
}

/// Refuses a provider that cannot make a handshake in `mode`.
///
/// This stands in for the checks of `with_protocol_versions()`, which every other config passes.
pub(crate) fn check_provider(
    provider: &CryptoProvider,
    mode: PskKeyExchangeMode,
) -> Result<(), Error> {
    if !provider
        .cipher_suites
        .iter()
        .any(|suite| suite.tls13().is_some())
    {
        return Err(Error::General(
            "external PSK: no TLS 1.3 cipher suites configured".into(),
        ));
    }
    if mode == PskKeyExchangeMode::PskDheKe && provider.kx_groups.is_empty() {
        return Err(Error::General(
            "external PSK: psk_dhe_ke needs a kx group, and none is configured".into(),
        ));
    }
    Ok(())
}

/// `PskIdentity identities<7..2^16-1>`
pub(crate) const MAX_IDENTITIES_LEN: usize = 0xffff;

/// Length prefix and obfuscated ticket age of one `PskIdentity`.
const IDENTITY_OVERHEAD: usize = 2 + 4;
