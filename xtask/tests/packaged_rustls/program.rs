//! rustls and rustls-axon in one program: a handshake in memory with each.

use std::sync::Arc;

use rustls_axon::external_psk::{
    ExternalPsk, ExternalPskOffer, PskKeyExchangeMode, ResolvesExternalPsk,
};

const CERTIFICATE: &[u8] = include_bytes!("certificate.der");
const KEY: &[u8] = include_bytes!("key.der");
const IDENTITY: &str = "PSK of the test";

/// Carries records to and fro until the handshake is complete on both ends.
macro_rules! shake_hands {
    ($client:expr, $server:expr) => {
        while $client.is_handshaking() || $server.is_handshaking() {
            let mut records = Vec::new();
            while $client.wants_write() {
                $client.write_tls(&mut records).unwrap();
            }
            $server.read_tls(&mut &records[..]).unwrap();
            $server.process_new_packets().unwrap();
            records.clear();
            while $server.wants_write() {
                $server.write_tls(&mut records).unwrap();
            }
            $client.read_tls(&mut &records[..]).unwrap();
            $client.process_new_packets().unwrap();
        }
    };
}

fn stock() -> Result<(), Box<dyn std::error::Error>> {
    use rustls::crypto::aws_lc_rs::default_provider;
    use rustls::pki_types::{CertificateDer, PrivatePkcs8KeyDer};
    use rustls::{ClientConfig, ClientConnection, RootCertStore, ServerConfig, ServerConnection};

    let certificate = CertificateDer::from(CERTIFICATE);
    let mut roots = RootCertStore::empty();
    roots.add(certificate.clone())?;
    let provider = Arc::new(default_provider());
    let client = ClientConfig::builder_with_provider(Arc::clone(&provider))
        .with_protocol_versions(&[&rustls::version::TLS13])?
        .with_root_certificates(roots)
        .with_no_client_auth();
    let server = ServerConfig::builder_with_provider(provider)
        .with_protocol_versions(&[&rustls::version::TLS13])?
        .with_no_client_auth()
        .with_single_cert(vec![certificate], PrivatePkcs8KeyDer::from(KEY).into())?;

    let mut client = ClientConnection::new(Arc::new(client), "stock".try_into()?)?;
    let mut server = ServerConnection::new(Arc::new(server))?;
    shake_hands!(client, server);
    println!("rustls: {:?}, no PSK", server.protocol_version().ok_or("no version")?);
    Ok(())
}

#[derive(Debug)]
struct OneKey;

impl ResolvesExternalPsk for OneKey {
    fn resolve(&self, offer: ExternalPskOffer<'_>) -> Option<Arc<ExternalPsk>> {
        offer.identities().any(|identity| identity == IDENTITY.as_bytes()).then(key)
    }
}

fn key() -> Arc<ExternalPsk> {
    let secret = zeroize::Zeroizing::new(vec![7; 32]);
    let hash = rustls_axon::crypto::hash::HashAlgorithm::SHA256;
    Arc::new(ExternalPsk::new(IDENTITY, secret, hash).unwrap())
}

fn axon() -> Result<(), Box<dyn std::error::Error>> {
    use rustls_axon::crypto::{CryptoProvider, aws_lc_rs::default_provider};
    use rustls_axon::{ClientConfig, ClientConnection, ServerConfig, ServerConnection};

    let provider = Arc::new(CryptoProvider { kx_groups: vec![], ..default_provider() });
    let client = ClientConfig::builder_with_provider(Arc::clone(&provider))
        .with_external_psks(vec![key()], PskKeyExchangeMode::PskKe)?;
    let server = ServerConfig::builder_with_provider(provider)
        .with_external_psk_resolver(Arc::new(OneKey), PskKeyExchangeMode::PskKe)?;

    let mut client = ClientConnection::new(Arc::new(client), "axon".try_into()?)?;
    let mut server = ServerConnection::new(Arc::new(server))?;
    shake_hands!(client, server);
    let version = server.protocol_version().ok_or("no version")?;
    for psk in [client.external_psk(), server.external_psk()] {
        let psk = psk.ok_or("no PSK")?;
        assert_eq!(psk.identity(), IDENTITY.as_bytes());
        assert_eq!(psk.mode(), PskKeyExchangeMode::PskKe);
    }
    println!("rustls-axon: {version:?}, {IDENTITY}");
    Ok(())
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    stock()?;
    axon()
}
