//! Configurations of rustls-axon for a pre-shared key, and the result of a connection.

use std::collections::HashSet;
use std::fmt::{self, Debug};
use std::sync::Arc;

use rustls_axon::crypto::CryptoProvider;
use rustls_axon::crypto::aws_lc_rs::{cipher_suite, default_provider, kx_group};
use rustls_axon::external_psk::{
    ExternalPsk, ExternalPskOffer, ExternalPskSource, PskKeyExchangeMode, ResolvesExternalPsk,
};
use rustls_axon::pki_types::ServerName;
use rustls_axon::{ClientConfig, CommonState, NamedGroup, ServerConfig, SupportedCipherSuite};

use super::Psk;
use crate::negotiated::protocols;
use crate::{Cipher, Error, KeyExchange, Negotiated, PskKex};

/// The source of a server's pre-shared keys.
///
/// It is called on the thread that handles the packet, so an implementation must not block. A look-up must not consume
/// the key, because anyone can send an identity that they saw on the wire. The key is consumed when [`negotiated()`] of
/// the connection is `Some`.
pub trait PskResolver: Debug + Send + Sync {
    /// Returns the key with exactly this identity. `None` refuses the client with the alert `unknown_psk_identity`.
    ///
    /// The identity comes from the network. For the identity of a QKD key, use
    /// [`PskIdentity::parse()`](crate::qkd::PskIdentity::parse).
    fn resolve(&self, identity: &[u8]) -> Option<Arc<Psk>>;

    /// As [`resolve()`](Self::resolve), without side effects. A resolver that fetches keys which it does not have must
    /// not start a fetch here.
    ///
    /// If a client offers several identities, this is called for each of the first eight, in the client's order, until
    /// one has a key that was derived for the configured cipher and is not erased. If none has,
    /// [`resolve()`](Self::resolve) is called for the first identity.
    fn resolve_known(&self, identity: &[u8]) -> Option<Arc<Psk>> {
        self.resolve(identity)
    }
}

/// Makes a client's configuration that offers `psks`, most preferred first. It has one ALPN protocol, or none if `alpn`
/// is empty. The cipher is the one that the keys are for.
///
/// No server name is sent. A server of this crate looks up the first eight identities.
///
/// # Errors
/// [`Error::Psk`] if there is no key, if two have the same identity, if they are for different ciphers, or if their
/// identities together do not fit into a ClientHello (about 60,000 bytes).
pub fn client_config(psks: Vec<Arc<Psk>>, kex: PskKex, alpn: &[u8]) -> Result<ClientConfig, Error> {
    let cipher = psks.first().ok_or(Error::Psk("there is none to offer"))?.cipher();
    client_config_with(provider(cipher, kex), psks, kex, alpn)
}

pub(crate) fn client_config_with(
    provider: CryptoProvider,
    psks: Vec<Arc<Psk>>,
    kex: PskKex,
    alpn: &[u8],
) -> Result<ClientConfig, Error> {
    check_offer(&psks)?;
    let mut config = ClientConfig::builder_with_provider(Arc::new(provider))
        .with_external_psk_source(Arc::new(Offer(psks)), mode(kex))?;
    config.alpn_protocols = protocols(alpn)?;
    config.enable_sni = false;
    Ok(config)
}

/// Checks the keys now. A bad key would otherwise fail only when a connection is made, and over quinn without a reason.
fn check_offer(psks: &[Arc<Psk>]) -> Result<(), Error> {
    let (mut identities, mut len) = (HashSet::new(), 0);
    for psk in psks {
        if psk.cipher() != psks[0].cipher() {
            return Err(Error::Psk("the keys of one offer are for different ciphers"));
        }
        if !identities.insert(psk.identity()) {
            return Err(Error::Psk("two keys have the same identity"));
        }
        len += psk.identity().len() + OFFER_OVERHEAD;
    }
    if len > MAX_OFFER {
        return Err(Error::Psk("the identities are too long for a ClientHello"));
    }
    Ok(())
}

/// Makes a server's configuration with one ALPN protocol, or none if `alpn` is empty.
///
/// A key that the resolver returns is used only if it was derived for `cipher`.
pub fn server_config(
    resolver: Arc<dyn PskResolver>,
    cipher: Cipher,
    kex: PskKex,
    alpn: &[u8],
) -> Result<ServerConfig, Error> {
    server_config_with(provider(cipher, kex), resolver, cipher, kex, alpn)
}

pub(crate) fn server_config_with(
    provider: CryptoProvider,
    resolver: Arc<dyn PskResolver>,
    cipher: Cipher,
    kex: PskKex,
    alpn: &[u8],
) -> Result<ServerConfig, Error> {
    let resolver = Arc::new(FirstKnown { resolver, cipher });
    let mut config = ServerConfig::builder_with_provider(Arc::new(provider))
        .with_external_psk_resolver(resolver, mode(kex))?;
    config.alpn_protocols = protocols(alpn)?;
    Ok(config)
}

/// Returns the result of a finished handshake. Returns `None` while the handshake is in progress.
///
/// On a server the handshake is finished when the client's Finished has been verified. The key is consumed at that
/// time.
pub fn negotiated(conn: &CommonState) -> Option<Negotiated> {
    let psk = conn.external_psk()?;
    let agreed = conn.negotiated_cipher_suite()?.suite();
    let group = conn.negotiated_key_exchange_group().map(|group| group.name());
    Some(Negotiated {
        key_exchange: match (psk.mode(), group) {
            (PskKeyExchangeMode::PskKe, None) => KeyExchange::PskKe,
            (PskKeyExchangeMode::PskDheKe, Some(NamedGroup::X25519MLKEM768)) => {
                KeyExchange::PskDheKe
            }
            _ => return None,
        },
        cipher: Cipher::ALL.into_iter().find(|cipher| suite(*cipher).suite() == agreed)?,
        psk_identity: Some(psk.identity().to_vec()),
        #[cfg(feature = "hybrid")]
        peer: None,
        alpn: conn.alpn_protocol().unwrap_or_default().to_vec(),
    })
}

pub(crate) fn provider(cipher: Cipher, kex: PskKex) -> CryptoProvider {
    CryptoProvider {
        cipher_suites: vec![suite(cipher)],
        kx_groups: match kex {
            PskKex::PskKe => vec![],
            PskKex::PskDheKe => vec![kx_group::X25519MLKEM768],
        },
        ..default_provider()
    }
}

fn suite(cipher: Cipher) -> SupportedCipherSuite {
    match cipher {
        Cipher::ChaCha20Poly1305 => cipher_suite::TLS13_CHACHA20_POLY1305_SHA256,
        Cipher::Aes256Gcm => cipher_suite::TLS13_AES_256_GCM_SHA384,
    }
}

fn mode(kex: PskKex) -> PskKeyExchangeMode {
    match kex {
        PskKex::PskKe => PskKeyExchangeMode::PskKe,
        PskKex::PskDheKe => PskKeyExchangeMode::PskDheKe,
    }
}

/// The keys that a client offers. If all are erased, connecting fails, because there is nothing to offer.
struct Offer(Vec<Arc<Psk>>);

impl ExternalPskSource for Offer {
    fn external_psks(&self, _server_name: &ServerName<'_>) -> Vec<Arc<ExternalPsk>> {
        self.0.iter().filter_map(|psk| psk.external()).collect()
    }
}

impl Debug for Offer {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let identities = self.0.iter().map(|psk| psk.identity().escape_ascii().to_string());
        f.debug_list().entries(identities).finish()
    }
}

/// Selects the first offered identity whose key is known and is for the configured cipher.
struct FirstKnown {
    resolver: Arc<dyn PskResolver>,
    cipher: Cipher,
}

impl ResolvesExternalPsk for FirstKnown {
    fn resolve(&self, offer: ExternalPskOffer<'_>) -> Option<Arc<ExternalPsk>> {
        let identities: Vec<&[u8]> = offer.identities().take(MAX_LOOKED_UP).collect();
        let (first, others) = identities.split_first()?;
        let at_hand = |identity: &&[u8]| {
            let psk = self.resolver.resolve_known(identity)?;
            let usable = psk.cipher() == self.cipher && !psk.is_erased();
            (psk.identity() == *identity && usable).then_some(psk)
        };

        // If a later identity has a key at hand, the first identity's key must not be fetched.
        let known = if others.is_empty() { None } else { identities.iter().find_map(at_hand) };
        known
            .or_else(|| self.resolver.resolve(first).filter(|psk| psk.identity() == *first))
            .and_then(|psk| psk.external())
    }
}

impl Debug for FirstKnown {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.resolver.fmt(f)
    }
}

/// The most identities of one ClientHello that are looked up.
///
/// A ClientHello has room for more than a thousand, and every client can send that many.
const MAX_LOOKED_UP: usize = 8;

/// The bytes of a ClientHello that remain beside its other extensions, of which the key share is the longest.
const MAX_OFFER: usize = 60_000;

/// The bytes of an offer besides the identity: the identity's length, an obfuscated ticket age, and a binder with its
/// length.
const OFFER_OVERHEAD: usize = 2 + 4 + 1 + 48;
