//! A client that is correct except for its key exchange: plain quinn and stock rustls, which offer
//! only classical groups.

use std::{net::SocketAddr, sync::Arc, time::Duration};

use quinn::{ConnectionError, crypto::rustls::QuicClientConfig};
use rustls::{
    DigitallySignedStruct, Error, SignatureScheme,
    client::{
        AlwaysResolvesClientRawPublicKeys,
        danger::{HandshakeSignatureValid, ServerCertVerified, ServerCertVerifier},
    },
    crypto::{
        CryptoProvider, SupportedKxGroup,
        aws_lc_rs::{default_provider, kx_group},
        verify_tls13_signature_with_raw_key,
    },
    pki_types::{
        CertificateDer, PrivateKeyDer, PrivatePkcs8KeyDer, ServerName, SubjectPublicKeyInfoDer,
        UnixTime,
    },
    sign::CertifiedKey,
};

/// The groups that a quantum computer breaks.
pub(crate) const CLASSICAL: [&dyn SupportedKxGroup; 3] =
    [kx_group::X25519, kx_group::SECP256R1, kx_group::SECP384R1];

/// The time in which the peer has to answer.
const ANSWER: Duration = Duration::from_secs(5);

/// The result of the attempt.
#[derive(Debug)]
pub(crate) enum ClassicalAttempt {
    /// The handshake completed.
    Connected,
    /// The peer ended the handshake.
    Refused {
        /// The TLS alert, if the peer sent one.
        alert: Option<u8>,
        /// The peer's reason.
        reason: String,
    },
}

/// Connects from the address `from` to an AXON daemon in classic, and offers `groups`.
///
/// # Errors
/// Nothing answers, or the client cannot be created. In these cases nothing was refused.
pub(crate) async fn connect(
    groups: &[&'static dyn SupportedKxGroup],
    from: SocketAddr,
    to: SocketAddr,
) -> Result<ClassicalAttempt, String> {
    let text = |error: &dyn std::fmt::Display| error.to_string();
    let tls = client(groups).map_err(|e| text(&e))?;
    let config = QuicClientConfig::try_from(tls).map_err(|e| text(&e))?;
    let endpoint = quinn::Endpoint::client(from).map_err(|e| text(&e))?;
    let config = quinn::ClientConfig::new(Arc::new(config));
    let connecting = endpoint.connect_with(config, to, "axon").map_err(|e| text(&e))?;
    let outcome = tokio::time::timeout(ANSWER, connecting).await;
    match outcome.map_err(|_| "the daemon does not answer".to_owned())? {
        Ok(connection) => {
            connection.close(0_u32.into(), b"");
            Ok(ClassicalAttempt::Connected)
        }
        Err(ConnectionError::ConnectionClosed(close)) => {
            // QUIC carries an alert in the low byte of a CRYPTO_ERROR, 0x0100 to 0x01ff (RFC 9001,
            // section 4.8).
            let code = u64::from(close.error_code);
            let alert = (code >> 8 == 1).then_some(code.to_be_bytes()[7]);
            Ok(ClassicalAttempt::Refused { alert, reason: close.to_string() })
        }
        Err(error) => Err(text(&error)),
    }
}

/// Returns a TLS 1.3 configuration with every cipher of rustls. It has a raw public key on both
/// sides and no SNI, as AXON has.
fn client(groups: &[&'static dyn SupportedKxGroup]) -> Result<rustls::ClientConfig, Error> {
    let provider = CryptoProvider { kx_groups: groups.to_vec(), ..default_provider() };
    let key = rcgen::KeyPair::generate().map_err(|e| Error::General(e.to_string()))?;
    let key = PrivateKeyDer::from(PrivatePkcs8KeyDer::from(key.serialize_der()));
    let key = provider.key_provider.load_private_key(key)?;
    let public = key.public_key().ok_or_else(|| Error::General("no public key".to_owned()))?;
    let public = CertificateDer::from(public.as_ref().to_vec());
    let certified = Arc::new(CertifiedKey::new(vec![public], key));
    let mut config = rustls::ClientConfig::builder_with_provider(Arc::new(provider))
        .with_protocol_versions(&[&rustls::version::TLS13])?
        .dangerous()
        .with_custom_certificate_verifier(Arc::new(AnyRawKey))
        .with_client_cert_resolver(Arc::new(AlwaysResolvesClientRawPublicKeys::new(certified)));
    config.alpn_protocols = vec![b"axon/1".to_vec()];
    config.enable_sni = false;
    Ok(config)
}

/// Accepts any raw public key whose signature is valid, as AXON does without trust material.
#[derive(Debug)]
struct AnyRawKey;

impl ServerCertVerifier for AnyRawKey {
    fn verify_server_cert(
        &self,
        _end_entity: &CertificateDer<'_>,
        _intermediates: &[CertificateDer<'_>],
        _server_name: &ServerName<'_>,
        _ocsp_response: &[u8],
        _now: UnixTime,
    ) -> Result<ServerCertVerified, Error> {
        Ok(ServerCertVerified::assertion())
    }

    fn verify_tls12_signature(
        &self,
        _message: &[u8],
        _cert: &CertificateDer<'_>,
        _dss: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, Error> {
        Err(rustls::PeerIncompatible::Tls12NotOfferedOrEnabled.into())
    }

    fn verify_tls13_signature(
        &self,
        message: &[u8],
        cert: &CertificateDer<'_>,
        dss: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, Error> {
        let key = SubjectPublicKeyInfoDer::from(cert.as_ref());
        let algorithms = default_provider().signature_verification_algorithms;
        verify_tls13_signature_with_raw_key(message, &key, dss, &algorithms)
    }

    fn supported_verify_schemes(&self) -> Vec<SignatureScheme> {
        default_provider().signature_verification_algorithms.supported_schemes()
    }

    fn requires_raw_public_keys(&self) -> bool {
        true
    }
}

#[cfg(test)]
mod tests {
    use axon_tls::{
        Cipher,
        identity::{Auth, SigningKey},
        quic::{ALPN, hybrid_server},
    };

    use super::*;

    async fn against_a_server(groups: &[&'static dyn SupportedKxGroup]) -> ClassicalAttempt {
        let key = SigningKey::generate().expect("key");
        let config = hybrid_server(&Auth::None(key), Cipher::default(), ALPN).expect("server");
        let loopback = SocketAddr::from(([127, 0, 0, 1], 0));
        let server = quinn::Endpoint::server(config, loopback).expect("endpoint");
        let address = server.local_addr().expect("address");
        let serving = tokio::spawn(async move {
            let incoming = server.accept().await.expect("a connection");
            let connection = incoming.await;
            server.wait_idle().await;
            drop(connection);
        });
        let outcome = connect(groups, loopback, address).await.expect("an answer");
        serving.abort();
        outcome
    }

    #[tokio::test]
    async fn the_groups_are_all_that_is_wrong_with_it() {
        let right = against_a_server(&[kx_group::X25519MLKEM768]).await;
        assert!(matches!(right, ClassicalAttempt::Connected), "{right:?}");
        let wrong = against_a_server(&CLASSICAL).await;
        assert!(matches!(wrong, ClassicalAttempt::Refused { alert: Some(40), .. }), "{wrong:?}");
    }
}
