//! Reads the key of the daemon at an address.

use std::{
    net::{Ipv4Addr, Ipv6Addr, SocketAddr},
    sync::Arc,
};

use axon_tls::{
    identity::{Probe, Shown},
    quic::{ALPN, tls_alert},
};
use quinn::{ConnectionError, Endpoint, crypto::rustls::QuicClientConfig};
use rustls::crypto::aws_lc_rs::cipher_suite::TLS13_AES_128_GCM_SHA256;

use crate::text::printable;

/// Creates an endpoint from which `address` can be reached.
pub(super) fn endpoint(address: SocketAddr) -> std::io::Result<Endpoint> {
    Endpoint::client(match address {
        SocketAddr::V4(_) => (Ipv4Addr::UNSPECIFIED, 0).into(),
        SocketAddr::V6(_) => (Ipv6Addr::UNSPECIFIED, 0).into(),
    })
}

/// Returns the key of the daemon at `address`: a raw public key or, if the daemon has none, that of
/// a certificate.
///
/// # Errors
/// The daemon has no key, or nothing answers. The text gives the reason.
pub(super) async fn look(endpoint: &Endpoint, address: SocketAddr) -> Result<Shown, String> {
    let raw = Probe::for_raw_key(ALPN).map_err(|e| e.to_string())?;
    match connect(endpoint, address, &raw).await? {
        Ok(shown) => return Ok(shown),
        Err(error) if tls_alert(&error) == Some(HANDSHAKE_FAILURE) => {}
        Err(error) => return Err(reason(&error)),
    }
    let certificate = Probe::for_certificate(ALPN).map_err(|e| e.to_string())?;
    connect(endpoint, address, &certificate).await?.map_err(|error| reason(&error))
}

const HANDSHAKE_FAILURE: u8 = 40;
const MISSING_EXTENSION: u8 = 109;
const NO_APPLICATION_PROTOCOL: u8 = 120;

/// Makes one handshake. It fails in any case.
async fn connect(
    endpoint: &Endpoint,
    address: SocketAddr,
    probe: &Probe,
) -> Result<Result<Shown, ConnectionError>, String> {
    // QUIC version 1 requires this cipher for Initial packets. TLS does not offer it.
    let initial = TLS13_AES_128_GCM_SHA256.tls13().and_then(|suite| suite.quic_suite());
    let initial = initial.ok_or("rustls lacks the cipher of QUIC's Initial packets")?;
    let tls = QuicClientConfig::with_initial(probe.client_config(), initial);
    let config = quinn::ClientConfig::new(Arc::new(tls.map_err(|e| e.to_string())?));
    let connecting = endpoint.connect_with(config, address, "axon").map_err(|e| e.to_string())?;
    let outcome = connecting.await;
    if let Some(shown) = probe.shown() {
        return Ok(Ok(shown.clone()));
    }
    match outcome {
        Err(error) => Ok(Err(error)),
        Ok(_) => Err("connected without having shown a key".to_owned()),
    }
}

fn reason(error: &ConnectionError) -> String {
    match (error, tls_alert(error)) {
        (ConnectionError::TimedOut, _) => "does not answer".to_owned(),
        (ConnectionError::ConnectionClosed(_), Some(HANDSHAKE_FAILURE)) => {
            "refuses X25519MLKEM768 or AXON's ciphers: no AXON daemon in classic".to_owned()
        }
        (ConnectionError::ConnectionClosed(_), Some(MISSING_EXTENSION)) => {
            "wants a pre-shared key: a daemon in qkd, which has no key to pin".to_owned()
        }
        (ConnectionError::ConnectionClosed(_), Some(NO_APPLICATION_PROTOCOL)) => {
            "speaks QUIC, but not axon/1".to_owned()
        }
        _ => printable(&error.to_string()),
    }
}

#[cfg(test)]
mod tests {
    use std::{net::UdpSocket, time::Duration};

    use axon_tls::{
        Cipher, PskKex,
        identity::{Auth, CaMaterial, SigningKey, Trust},
        qkd::{Psk, PskResolver},
        quic::{hybrid_server, qkd_server},
    };

    use super::*;

    /// Returns what a probe sees of a server, and checks that the server never had a connection.
    async fn seen_of(config: quinn::ServerConfig) -> Result<Shown, String> {
        let server = Endpoint::server(config, (Ipv4Addr::LOCALHOST, 0).into()).expect("endpoint");
        let address = server.local_addr().expect("address");
        let serving = tokio::spawn(async move {
            while let Some(incoming) = server.accept().await {
                assert!(incoming.await.is_err(), "a connection");
            }
        });
        let client = endpoint(address).expect("endpoint");
        let seen = look(&client, address).await;
        client.wait_idle().await;
        assert!(!serving.is_finished(), "the server had a connection");
        serving.abort();
        seen
    }

    #[derive(Debug)]
    struct NoKeys;

    impl PskResolver for NoKeys {
        fn resolve(&self, _: &[u8]) -> Option<Arc<Psk>> {
            None
        }
    }

    #[tokio::test]
    async fn scan_explains_servers_without_a_key_to_pin() {
        let cipher = Cipher::default();
        for kex in [PskKex::PskKe, PskKex::PskDheKe] {
            let qkd = qkd_server(Arc::new(NoKeys), cipher, kex, ALPN).expect("server");
            let why = seen_of(qkd).await.expect_err("no key");
            assert!(why.contains("qkd"), "{kex:?}: {why}");
        }
        let auth = Auth::None(SigningKey::generate().expect("key"));
        let other = hybrid_server(&auth, cipher, b"h3").expect("server");
        let why = seen_of(other).await.expect_err("no key");
        assert!(why.contains("not axon/1"), "{why}");
    }

    #[tokio::test]
    async fn an_address_that_does_not_answer_is_waited_for_by_the_caller() {
        let deaf = UdpSocket::bind((Ipv4Addr::LOCALHOST, 0)).expect("socket");
        let address = deaf.local_addr().expect("address");
        let client = endpoint(address).expect("endpoint");
        let look = look(&client, address);
        assert!(tokio::time::timeout(Duration::from_millis(300), look).await.is_err());
    }

    #[tokio::test]
    async fn raw_keys_and_certificates_are_seen() {
        let key = SigningKey::generate().expect("key");
        let digest = key.spki_digest();
        for cipher in Cipher::ALL {
            let auth = Auth::Pinned { key: key.clone(), trust: Trust::default() };
            let server = hybrid_server(&auth, cipher, ALPN).expect("server");
            let shown = seen_of(server).await.expect("a key");
            assert_eq!((shown.key, shown.certificate_names), (digest, None));
        }

        let key = rcgen::KeyPair::generate().expect("key");
        let params = rcgen::CertificateParams::new(["arm-2".to_owned()]).expect("names");
        let cert = params.self_signed(&key).expect("certificate").pem();
        let ca = CaMaterial::from_pem(&cert, &cert, &key.serialize_pem(), None).expect("CA");
        let server = hybrid_server(&Auth::Ca(Arc::new(ca)), Cipher::default(), ALPN);
        let shown = seen_of(server.expect("server")).await.expect("a certificate");
        assert_eq!(shown.certificate_names, Some(vec!["arm-2".to_owned()]));
    }
}
