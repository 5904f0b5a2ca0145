//! Checks of the connection: versions and groups of TLS, and client certificates.

use std::sync::Arc;

use reqwest::Url;
use rustls::client::WebPkiServerVerifier;
use rustls::client::danger::{HandshakeSignatureValid, ServerCertVerified, ServerCertVerifier};
use rustls::crypto::{CryptoProvider, SupportedKxGroup, aws_lc_rs};
use rustls::pki_types::pem::PemObject;
use rustls::pki_types::{CertificateDer, PrivateKeyDer, ServerName, UnixTime};
use rustls::version::{TLS12, TLS13};
use rustls::{
    CertificateError, ClientConfig, DigitallySignedStruct, RootCertStore, SignatureScheme,
    SupportedProtocolVersion,
};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;
use tokio_rustls::TlsConnector;

use super::party::Party;
use crate::{CommandResult, other};

/// The certificate with which the probe connects.
#[derive(Clone, Copy)]
pub(super) enum Auth {
    /// The certificate of the SAE.
    Sae,
    None,
    /// A certificate with the SAE's name that no CA of the KME has signed.
    Stranger,
}

pub(super) const GROUPS: [&dyn SupportedKxGroup; 4] = [
    aws_lc_rs::kx_group::X25519MLKEM768,
    aws_lc_rs::kx_group::X25519,
    aws_lc_rs::kx_group::SECP256R1,
    aws_lc_rs::kx_group::SECP384R1,
];
pub(super) const VERSIONS: [&SupportedProtocolVersion; 2] = [&TLS13, &TLS12];

pub(super) fn config(
    party: &Party,
    versions: &[&'static SupportedProtocolVersion],
    groups: &[&'static dyn SupportedKxGroup],
    auth: Auth,
) -> CommandResult<ClientConfig> {
    let provider =
        Arc::new(CryptoProvider { kx_groups: groups.to_vec(), ..aws_lc_rs::default_provider() });
    let mut roots = RootCertStore::empty();
    for certificate in certificates(&party.ca)? {
        roots.add(certificate).map_err(other)?;
    }
    let webpki =
        WebPkiServerVerifier::builder_with_provider(Arc::new(roots), Arc::clone(&provider))
            .build()
            .map_err(other)?;
    let verifier = Arc::new(Verifier { webpki, any_name: party.kme_id_only });
    let builder = ClientConfig::builder_with_provider(provider)
        .with_protocol_versions(versions)
        .map_err(other)?
        .dangerous()
        .with_custom_certificate_verifier(verifier);
    let mut config = match auth {
        Auth::None => builder.with_no_client_auth(),
        Auth::Sae => builder
            .with_client_auth_cert(certificates(&party.cert)?, private_key(&party.key)?)
            .map_err(other)?,
        Auth::Stranger => {
            let (certificate, key) = stranger(&party.sae)?;
            builder.with_client_auth_cert(vec![certificate], key).map_err(other)?
        }
    };
    config.resumption = rustls::client::Resumption::disabled();
    Ok(config)
}

fn certificates(bytes: &[u8]) -> CommandResult<Vec<CertificateDer<'static>>> {
    if !is_pem(bytes) {
        return Ok(vec![bytes.to_vec().into()]);
    }
    CertificateDer::pem_slice_iter(bytes).collect::<Result<_, _>>().map_err(other)
}

fn private_key(bytes: &[u8]) -> CommandResult<PrivateKeyDer<'static>> {
    let read = if is_pem(bytes) {
        PrivateKeyDer::from_pem_slice(bytes).ok()
    } else {
        PrivateKeyDer::try_from(bytes).ok().map(|key| key.clone_key())
    };
    // The parser's reason is not passed on, because the parser has seen the key.
    read.ok_or_else(|| other("the SAE's key cannot be read"))
}

fn is_pem(bytes: &[u8]) -> bool {
    bytes.windows(11).any(|window| window == b"-----BEGIN ")
}

fn stranger(sae: &str) -> CommandResult<(CertificateDer<'static>, PrivateKeyDer<'static>)> {
    let key = rcgen::KeyPair::generate().map_err(other)?;
    let mut params = rcgen::CertificateParams::default();
    params.distinguished_name = rcgen::DistinguishedName::new();
    params.distinguished_name.push(rcgen::DnType::CommonName, sae);
    params.extended_key_usages = vec![rcgen::ExtendedKeyUsagePurpose::ClientAuth];
    let certificate = params.self_signed(&key).map_err(other)?.der().clone();
    Ok((certificate, PrivateKeyDer::Pkcs8(key.serialize_der().into())))
}

/// webpki's checks. The host name may differ if the KME is identified by its ID alone; the client
/// that the probe calls first has checked the ID.
#[derive(Debug)]
struct Verifier {
    webpki: Arc<WebPkiServerVerifier>,
    any_name: bool,
}

impl ServerCertVerifier for Verifier {
    fn verify_server_cert(
        &self,
        end_entity: &CertificateDer<'_>,
        intermediates: &[CertificateDer<'_>],
        server_name: &ServerName<'_>,
        ocsp_response: &[u8],
        now: UnixTime,
    ) -> Result<ServerCertVerified, rustls::Error> {
        use rustls::Error::InvalidCertificate;
        let verified = self.webpki.verify_server_cert(
            end_entity,
            intermediates,
            server_name,
            ocsp_response,
            now,
        );
        match verified {
            // webpki checks the name after everything else.
            Err(InvalidCertificate(
                CertificateError::NotValidForName | CertificateError::NotValidForNameContext { .. },
            )) if self.any_name => Ok(ServerCertVerified::assertion()),
            other => other,
        }
    }

    fn verify_tls12_signature(
        &self,
        message: &[u8],
        cert: &CertificateDer<'_>,
        dss: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, rustls::Error> {
        self.webpki.verify_tls12_signature(message, cert, dss)
    }

    fn verify_tls13_signature(
        &self,
        message: &[u8],
        cert: &CertificateDer<'_>,
        dss: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, rustls::Error> {
        self.webpki.verify_tls13_signature(message, cert, dss)
    }

    fn supported_verify_schemes(&self) -> Vec<SignatureScheme> {
        self.webpki.supported_verify_schemes()
    }
}

/// Makes a handshake, and returns its key exchange group.
pub(super) async fn handshake(party: &Party, config: ClientConfig) -> CommandResult<String> {
    let url = Url::parse(&party.url).map_err(other)?;
    let host = url.host_str().ok_or_else(|| other("the URL has no host"))?;
    let name = host.trim_matches(['[', ']']).to_owned();
    let name = ServerName::try_from(name).map_err(other)?;
    let connect = async {
        let stream = tcp(&url).await?;
        TlsConnector::from(Arc::new(config)).connect(name, stream).await
    };
    let stream = tokio::time::timeout(party.timeout, connect)
        .await
        .map_err(|_| other("no answer in time"))?
        .map_err(other)?;
    let group = stream.get_ref().1.negotiated_key_exchange_group();
    Ok(group.map_or_else(|| "no group".to_owned(), |group| format!("{:?}", group.name())))
}

async fn tcp(url: &Url) -> std::io::Result<TcpStream> {
    let host = url.host_str().unwrap_or_default().trim_matches(['[', ']']);
    TcpStream::connect((host, url.port_or_known_default().unwrap_or(443))).await
}

/// Offers only TLS 1.1. Returns whether that was refused, and a description of the answer.
pub(super) async fn old_version(party: &Party) -> CommandResult<(bool, &'static str)> {
    let url = Url::parse(&party.url).map_err(other)?;
    let exchange = async {
        let mut stream = tcp(&url).await?;
        stream.write_all(&client_hello_of_tls_1_1()).await?;
        let mut first = [0; 1];
        let read = stream.read(&mut first).await?;
        std::io::Result::Ok((read, first[0]))
    };
    Ok(match tokio::time::timeout(party.timeout, exchange).await {
        Ok(Ok((0, _)) | Err(_)) => (true, "connection closed"),
        Ok(Ok((_, 21))) => (true, "alert"),
        Ok(Ok((_, 22))) => (false, "ServerHello"),
        Ok(Ok(_)) => (false, "no TLS"),
        Err(_) => (false, "no answer in time"),
    })
}

/// Returns a ClientHello of RFC 4346, 7.4.1.2, with suites that servers of that time supported.
fn client_hello_of_tls_1_1() -> Vec<u8> {
    const VERSION: [u8; 2] = [3, 2];
    const SUITES: [[u8; 2]; 6] =
        [[0xc0, 0x09], [0xc0, 0x0a], [0xc0, 0x13], [0xc0, 0x14], [0x00, 0x2f], [0x00, 0x35]];
    // supported_groups: secp256r1 and secp384r1; ec_point_formats: uncompressed (RFC 8422).
    const EXTENSIONS: [u8; 16] = [0, 10, 0, 6, 0, 4, 0, 23, 0, 24, 0, 11, 0, 2, 1, 0];
    let mut body = VERSION.to_vec();
    // The random bytes protect nothing, because the handshake goes no further.
    body.extend_from_slice(&[0x5a; 32]);
    body.push(0);
    body.extend_from_slice(&[0, SUITES.len() as u8 * 2]);
    body.extend(SUITES.iter().flatten());
    body.extend_from_slice(&[1, 0, 0, EXTENSIONS.len() as u8]);
    body.extend_from_slice(&EXTENSIONS);
    let length = body.len() as u8;
    let mut record = vec![22, 3, 1, 0, length + 4, 1, 0, 0, length];
    record.append(&mut body);
    record
}
