//! Reads the identity that a server shows, without trusting it.

use std::sync::{Arc, OnceLock};

use rustls::client::danger::HandshakeSignatureValid;
use rustls::client::{ResolvesClientCert, Resumption};
use rustls::crypto::aws_lc_rs::default_provider;
use rustls::crypto::{
    WebPkiSupportedAlgorithms, verify_tls13_signature, verify_tls13_signature_with_raw_key,
};
use rustls::pki_types::{CertificateDer, SubjectPublicKeyInfoDer, UnixTime};
use rustls::sign::CertifiedKey;
use rustls::version::TLS13;
use rustls::{CertificateError, ClientConfig, DigitallySignedStruct, Error, SignatureScheme};

use super::SpkiDigest;
use super::roots::host_names;
use super::verifier::{Peers, Role, Verifier};
use crate::hybrid::provider;
use crate::negotiated::protocols;

/// A client that reads a server's key and then ends the handshake.
///
/// Its handshake always fails, at the latest after the server has signed it. No data can be sent or received, and the
/// server receives the alert `access_denied`. [`Probe::shown()`] then returns what the server has shown, provided that
/// the server has the private key. **No one has verified the owner of the key**: compare it with a copy of that host's
/// key from another source.
///
/// A probe is for one connection.
///
/// ```
/// # use axon_tls::{Error, identity::Probe};
/// let probe = Probe::for_raw_key(b"axon/1")?;
/// let config = probe.client_config();
/// // connect with it; after the handshake has failed:
/// if let Some(shown) = probe.shown() {
///     println!("{}", shown.key);
/// }
/// # let _ = config;
/// # Ok::<(), Error>(())
/// ```
#[derive(Debug)]
pub struct Probe {
    config: Arc<ClientConfig>,
    shown: Arc<OnceLock<Shown>>,
}

/// The key or certificate with which a server signed the handshake.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct Shown {
    /// The digest of its public key.
    pub key: SpkiDigest,
    /// The signature scheme.
    pub scheme: SignatureScheme,
    /// The DNS names of its certificate, as written there. `None` for a raw public key.
    pub certificate_names: Option<Vec<String>>,
}

impl Probe {
    /// Creates a probe for a raw public key (RFC 7250), as [`Auth::Pinned`](super::Auth::Pinned) and
    /// [`Auth::None`](super::Auth::None) show it.
    ///
    /// A server with certificates answers with the alert `handshake_failure`.
    pub fn for_raw_key(alpn: &[u8]) -> Result<Self, crate::Error> {
        Self::new::<true>(alpn)
    }

    /// Creates a probe for a certificate, as [`Auth::Ca`](super::Auth::Ca) shows it.
    ///
    /// A server with a raw public key answers with the alert `handshake_failure`.
    pub fn for_certificate(alpn: &[u8]) -> Result<Self, crate::Error> {
        Self::new::<false>(alpn)
    }

    /// Returns the configuration to connect with. It has the hybrid key exchange and both cipher suites.
    pub fn client_config(&self) -> Arc<ClientConfig> {
        Arc::clone(&self.config)
    }

    /// Returns what the server has shown, after it has signed the handshake with it.
    pub fn shown(&self) -> Option<&Shown> {
        self.shown.get()
    }

    fn new<const RAW_KEYS: bool>(alpn: &[u8]) -> Result<Self, crate::Error> {
        let shown = Arc::new(OnceLock::new());
        let look = ScanVerifier::<RAW_KEYS> {
            shown: Arc::clone(&shown),
            algorithms: default_provider().signature_verification_algorithms,
        };
        let mut config = ClientConfig::builder_with_provider(Arc::new(provider()))
            .with_protocol_versions(&[&TLS13])?
            .dangerous()
            .with_custom_certificate_verifier(Arc::new(Verifier(look)))
            .with_client_cert_resolver(Arc::new(Nobody::<RAW_KEYS>));
        config.alpn_protocols = protocols(alpn)?;
        config.resumption = Resumption::disabled();
        config.enable_sni = false;
        Ok(Self { config: Arc::new(config), shown })
    }
}

#[derive(Debug)]
struct ScanVerifier<const RAW_KEYS: bool> {
    shown: Arc<OnceLock<Shown>>,
    algorithms: WebPkiSupportedAlgorithms,
}

impl<const RAW_KEYS: bool> Peers for ScanVerifier<RAW_KEYS> {
    const RAW_KEYS: bool = RAW_KEYS;

    /// Accepts any identity. rustls calls this before it verifies the signature, where the handshake ends.
    fn accept(
        &self,
        _shown: &CertificateDer<'_>,
        _others: &[CertificateDer<'_>],
        _role: Role<'_>,
        _now: UnixTime,
    ) -> Result<(), Error> {
        Ok(())
    }

    /// Records the identity if the signature is valid. Always returns an error.
    fn signed(
        &self,
        message: &[u8],
        shown: &CertificateDer<'_>,
        signature: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, Error> {
        let (key, certificate_names) = if RAW_KEYS {
            let key = SubjectPublicKeyInfoDer::from(shown.as_ref());
            verify_tls13_signature_with_raw_key(message, &key, signature, &self.algorithms)?;
            (Some(SpkiDigest::of(shown)), None)
        } else {
            verify_tls13_signature(message, shown, signature, &self.algorithms)?;
            (SpkiDigest::of_peer(shown), Some(host_names(shown)))
        };
        if let Some(key) = key {
            let _ = self.shown.set(Shown { key, scheme: signature.scheme, certificate_names });
        }
        Err(CertificateError::ApplicationVerificationFailure.into())
    }

    fn schemes(&self) -> Vec<SignatureScheme> {
        self.algorithms.supported_schemes()
    }
}

/// A client without a key. It must still state the kind of its key, because a server with raw public keys refuses a
/// client that does not support them.
#[derive(Debug)]
struct Nobody<const RAW_KEYS: bool>;

impl<const RAW_KEYS: bool> ResolvesClientCert for Nobody<RAW_KEYS> {
    fn resolve(&self, _: &[&[u8]], _: &[SignatureScheme]) -> Option<Arc<CertifiedKey>> {
        None
    }

    fn only_raw_public_keys(&self) -> bool {
        RAW_KEYS
    }

    fn has_certs(&self) -> bool {
        false
    }
}

#[cfg(test)]
mod tests {
    use std::io::{Read, Write};

    use rustls::pki_types::PrivateKeyDer;
    use rustls::server::AlwaysResolvesServerRawPublicKeys;
    use rustls::{AlertDescription, ClientConnection, ServerConfig, ServerConnection};

    use super::super::raw_key::RawKeys;
    use super::super::{Auth, CaMaterial, KeyAlgorithm, SigningKey, Trust, pem, signing_key};
    use super::*;
    use crate::{Cipher, hybrid};

    const ALPN: &[u8] = b"axon/1";

    /// Runs a handshake until both ends have nothing more to send. Panics if an end completes the handshake, or if any
    /// of the client's data arrives. Returns the errors of both ends.
    fn meet(probe: &Probe, server: ServerConfig) -> (Option<Error>, Option<Error>) {
        let name = "peer".try_into().unwrap();
        let mut client = ClientConnection::new(probe.client_config(), name).unwrap();
        let mut server = ServerConnection::new(Arc::new(server)).unwrap();
        client.writer().write_all(b"data").unwrap();
        let mut errors = (None, None);
        for _ in 0..8 {
            let mut wire = Vec::new();
            while client.wants_write() {
                client.write_tls(&mut wire).unwrap();
            }
            let mut rest = &wire[..];
            while !rest.is_empty() {
                server.read_tls(&mut rest).unwrap();
                errors.1 = server.process_new_packets().err().or(errors.1.take());
            }
            wire.clear();
            while server.wants_write() {
                server.write_tls(&mut wire).unwrap();
            }
            let mut rest = &wire[..];
            while !rest.is_empty() {
                client.read_tls(&mut rest).unwrap();
                errors.0 = client.process_new_packets().err().or(errors.0.take());
            }
        }
        assert!(client.is_handshaking() && server.is_handshaking(), "{errors:?}");
        assert!(!matches!(server.reader().read(&mut [0; 8]), Ok(1..)));
        errors
    }

    fn server(auth: &Auth, cipher: Cipher) -> ServerConfig {
        hybrid::server_config(auth, cipher, ALPN).unwrap()
    }

    fn ca() -> (Auth, SpkiDigest) {
        let key = rcgen::KeyPair::generate().unwrap();
        let params = rcgen::CertificateParams::new(["arm-2".to_owned()]).unwrap();
        let cert = params.self_signed(&key).unwrap();
        let (cert, pem) = (cert.pem(), key.serialize_pem());
        let material = CaMaterial::from_pem(&cert, &cert, &pem, None).unwrap();
        let spki = rcgen::PublicKeyData::subject_public_key_info(&key);
        (Auth::Ca(Arc::new(material)), SpkiDigest::of(&spki))
    }

    #[test]
    fn a_key_that_the_server_does_not_hold_is_not_taken_for_its_own() {
        let pem = SigningKey::generate_pem().unwrap();
        let der = pem::private_key(&pem).unwrap();
        let signs = signing_key(&PrivateKeyDer::Pkcs8(der.as_slice().into())).unwrap();
        let other = SigningKey::generate_pem().unwrap();
        let der = pem::private_key(&other).unwrap();
        let others = signing_key(&PrivateKeyDer::Pkcs8(der.as_slice().into())).unwrap();
        let spki = others.public_key().unwrap().as_ref().to_vec();

        let shown = CertifiedKey::new(vec![CertificateDer::from(spki)], signs);
        let mut config = ServerConfig::builder_with_provider(Arc::new(provider()))
            .with_protocol_versions(&[&TLS13])
            .unwrap()
            .with_client_cert_verifier(Arc::new(Verifier(RawKeys::new(None))))
            .with_cert_resolver(Arc::new(AlwaysResolvesServerRawPublicKeys::new(Arc::new(shown))));
        config.alpn_protocols = vec![ALPN.to_vec()];

        let probe = Probe::for_raw_key(ALPN).unwrap();
        let (why, _) = meet(&probe, config);
        assert!(matches!(why, Some(Error::InvalidCertificate(_))), "{why:?}");
        assert_eq!(probe.shown(), None);
    }

    #[test]
    fn a_raw_key_is_seen_and_nothing_can_be_sent() {
        for (algorithm, scheme) in [
            (KeyAlgorithm::MlDsa65, SignatureScheme::ML_DSA_65),
            (KeyAlgorithm::Ed25519, SignatureScheme::ED25519),
        ] {
            for cipher in Cipher::ALL {
                let pem = SigningKey::generate_pem_with(algorithm).unwrap();
                let key = SigningKey::from_pem(&pem).unwrap();
                let digest = key.spki_digest();
                let probe = Probe::for_raw_key(ALPN).unwrap();
                let auth = Auth::Pinned { key, trust: Trust::default() };
                let (_, why) = meet(&probe, server(&auth, cipher));
                assert_eq!(why, Some(Error::AlertReceived(AlertDescription::AccessDenied)));
                let shown = Shown { key: digest, scheme, certificate_names: None };
                assert_eq!(probe.shown(), Some(&shown));
            }
        }
    }

    #[test]
    fn a_certificate_is_seen_with_its_names_and_nothing_can_be_sent() {
        let (auth, digest) = ca();
        let probe = Probe::for_certificate(ALPN).unwrap();
        let (_, why) = meet(&probe, server(&auth, Cipher::default()));
        assert_eq!(why, Some(Error::AlertReceived(AlertDescription::AccessDenied)));
        let shown = probe.shown().unwrap();
        assert_eq!(shown.key, digest);
        assert_eq!(shown.certificate_names.as_deref(), Some(&["arm-2".to_owned()][..]));
    }

    #[test]
    fn the_kind_that_a_server_does_not_have_is_not_seen() {
        let (certificates, _) = ca();
        let raw = Auth::None(SigningKey::generate().unwrap());
        for (probe, auth) in [
            (Probe::for_raw_key(ALPN).unwrap(), certificates),
            (Probe::for_certificate(ALPN).unwrap(), raw),
        ] {
            let (why, _) = meet(&probe, server(&auth, Cipher::default()));
            assert_eq!(why, Some(Error::AlertReceived(AlertDescription::HandshakeFailure)));
            assert_eq!(probe.shown(), None);
        }
    }
}
