//! Certificates that cannot be used, or not without giving something up: each is refused in words of its own,
//! with the setting and the file, or the peer, that it is about.

use std::{
    fs,
    io::{Read as _, Write as _},
    net::{SocketAddr, TcpListener},
    os::unix::fs::PermissionsExt as _,
    path::{Path, PathBuf},
    sync::Arc,
};

use axon_daemon::internal::keys::{Kme, UsedKeys};
use axon_tls::identity::CaMaterial;
use axon_transport::config::{
    ClassicAuth, Config, ConfigBuilder, QkdConfig, QkdPeers, Security, SecurityMode,
};
use etsi_qkd014::sim::{Layout, Network, Pki, Site};
use rcgen::{BasicConstraints, CertificateParams, DnType, IsCa, Issuer, KeyPair, SigningKey as _};
use rustls::{
    ServerConfig, ServerConnection, Stream,
    crypto::aws_lc_rs::{default_provider, sign::any_supported_type},
    pki_types::{CertificateDer, PrivateKeyDer, pem::PemObject as _},
    sign::{CertifiedKey, SingleCertAndKey},
};

const VERSION_1: &str = "X.509 version 1";
const NOT_OURS: &str = "not the key of our certificate";

/// A CA.
struct Authority {
    pem: String,
    issuer: Issuer<'static, KeyPair>,
    key: KeyPair,
}

/// A certificate and its key, PEM.
#[derive(Clone)]
struct Pair {
    cert: String,
    key: String,
}

impl Authority {
    fn new() -> Self {
        let key = KeyPair::generate().unwrap();
        let mut params = CertificateParams::default();
        params.distinguished_name.push(DnType::CommonName, "CA of a test");
        params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
        let pem = params.self_signed(&key).unwrap().pem();
        let copy = KeyPair::from_pem(&key.serialize_pem()).unwrap();
        Self { pem, issuer: Issuer::new(params, copy), key }
    }

    /// Issues a certificate with this common name, and these DNS names in its subjectAltName, if any.
    fn issue(&self, name: &str, dns: &[&str]) -> Pair {
        issued(named(name, dns), &self.issuer)
    }

    /// Creates a CA below this one, whose own certificate is of version 1.
    fn below_in_version_1(&self) -> Self {
        let mut params = named("CA below", &[]);
        params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
        let pair = self.in_version_1(&issued(params.clone(), &self.issuer));
        let key = || KeyPair::from_pem(&pair.key).unwrap();
        Self { issuer: Issuer::new(params, key()), key: key(), pem: pair.cert }
    }

    /// Returns the same certificate as version 1: without its number and its extensions, and signed again.
    fn in_version_1(&self, pair: &Pair) -> Pair {
        let cert = version_1(&pair.cert, &self.key);
        Pair { cert, key: pair.key.clone() }
    }
}

/// Returns the parameters of a certificate with this common name and these DNS names.
fn named(name: &str, dns: &[&str]) -> CertificateParams {
    let names: Vec<_> = dns.iter().map(|name| (*name).to_owned()).collect();
    let mut params = CertificateParams::new(names).unwrap();
    params.distinguished_name = rcgen::DistinguishedName::new();
    params.distinguished_name.push(DnType::CommonName, name);
    params
}

fn issued(params: CertificateParams, issuer: &Issuer<'static, KeyPair>) -> Pair {
    let key = KeyPair::generate().unwrap();
    let cert = params.signed_by(&key, issuer).unwrap().pem();
    Pair { cert, key: key.serialize_pem() }
}

/// Returns a certificate as version 1 (RFC 5280, 4.1), signed by `issuer`.
fn version_1(pem: &str, issuer: &KeyPair) -> String {
    let der = CertificateDer::from_pem_slice(pem.as_bytes()).unwrap();
    let mut certificate = content(&der);
    let mut to_be_signed = content(element(&mut certificate));
    let algorithm = element(&mut certificate);
    let mut fields = Vec::new();
    while !to_be_signed.is_empty() {
        let field = element(&mut to_be_signed);
        // version [0] and extensions [3]
        if ![0xa0, 0xa3].contains(&field[0]) {
            fields.extend_from_slice(field);
        }
    }
    let to_be_signed = tagged(0x30, &fields);
    let signature = [&[0][..], &issuer.sign(&to_be_signed).unwrap()].concat();
    let der = tagged(0x30, &[&to_be_signed, algorithm, &tagged(0x03, &signature)].concat());
    use base64::Engine as _;
    let text = base64::engine::general_purpose::STANDARD.encode(der);
    format!("-----BEGIN CERTIFICATE-----\n{text}\n-----END CERTIFICATE-----\n")
}

/// Returns the number of bytes before the content of a DER element, and of the content.
fn lengths(der: &[u8]) -> (usize, usize) {
    match der[1] {
        short @ 0..=0x7f => (2, usize::from(short)),
        long => {
            let count = usize::from(long & 0x7f);
            let length =
                der[2..2 + count].iter().fold(0, |sum, byte| sum << 8 | usize::from(*byte));
            (2 + count, length)
        }
    }
}

fn content(der: &[u8]) -> &[u8] {
    let (head, length) = lengths(der);
    &der[head..head + length]
}

/// Takes the first element.
fn element<'a>(rest: &mut &'a [u8]) -> &'a [u8] {
    let (head, length) = lengths(rest);
    let (first, after) = rest.split_at(head + length);
    *rest = after;
    first
}

fn tagged(tag: u8, content: &[u8]) -> Vec<u8> {
    let [high, low] = u16::try_from(content.len()).unwrap().to_be_bytes();
    let head = match (high, low) {
        (0, short @ 0..=0x7f) => vec![tag, short],
        (0, long) => vec![tag, 0x81, long],
        (high, low) => vec![tag, 0x82, high, low],
    };
    [&head[..], content].concat()
}

fn write(dir: &Path, name: &str, text: &str, mode: u32) -> PathBuf {
    let path = dir.join(name);
    let _ = fs::remove_file(&path);
    fs::write(&path, text).unwrap();
    fs::set_permissions(&path, fs::Permissions::from_mode(mode)).unwrap();
    path
}

fn qkd(builder: ConfigBuilder) -> QkdConfig {
    match builder.build().unwrap().security {
        Security::Qkd(qkd) => qkd,
        Security::Classic(_) => unreachable!(),
    }
}

/// Returns the settings of sae-a, with its files in `dir`.
fn sae(dir: &Path, ca: &str, pair: &Pair, url: &str) -> ConfigBuilder {
    Config::builder()
        .security_mode(SecurityMode::Qkd)
        .qkd_peers(QkdPeers::Listed(vec!["sae-b".to_owned()]))
        .sae_id("sae-a")
        .kme_url(url)
        .kme_ca(write(dir, "roots.pem", ca, 0o644))
        .sae_cert(write(dir, "client.pem", &pair.cert, 0o644))
        .sae_key(write(dir, "client.key", &pair.key, 0o600))
}

/// Returns the result of the daemon's KME client for a status request.
async fn asked(config: &QkdConfig) -> Result<(), String> {
    let (kme, _events) = Kme::start(config, UsedKeys::in_memory()).unwrap();
    kme.probe("sae-b").await.map(drop).map_err(|failure| failure.to_string())
}

/// Starts a TLS server that presents the certificates of `pair`, usable or not, and serves no request.
fn show(pair: &Pair) -> SocketAddr {
    let chain = CertificateDer::pem_slice_iter(pair.cert.as_bytes()).map(Result::unwrap).collect();
    let key = PrivateKeyDer::from_pem_slice(pair.key.as_bytes()).unwrap();
    let certified = CertifiedKey::new(chain, any_supported_type(&key).unwrap());
    let config = ServerConfig::builder_with_provider(Arc::new(default_provider()))
        .with_safe_default_protocol_versions()
        .unwrap()
        .with_no_client_auth()
        .with_cert_resolver(Arc::new(SingleCertAndKey::from(certified)));
    let config = Arc::new(config);
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = listener.local_addr().unwrap();
    std::thread::spawn(move || {
        for socket in listener.incoming() {
            let mut socket = socket.unwrap();
            let mut connection = ServerConnection::new(Arc::clone(&config)).unwrap();
            let mut stream = Stream::new(&mut connection, &mut socket);
            let _ = stream.read(&mut [0]);
            let _ = stream.flush();
        }
    });
    address
}

#[tokio::test(flavor = "multi_thread")]
async fn a_kme_of_version_1_is_refused_by_that_name() {
    let dir = tempfile::tempdir().unwrap();
    let ca = Authority::new();
    let client = ca.issue("sae-a", &[]);
    let good = ca.issue("kme-a", &["localhost"]);
    let sent_along =
        |pair: &Pair, pem: &str| Pair { cert: format!("{}{pem}", pair.cert), ..pair.clone() };
    // A root is only a name and a key, in any version. A CA below it must state in an extension that it is a CA.
    let old_root = sent_along(&good, &version_1(&ca.pem, &ca.key));
    let below = ca.below_in_version_1();
    let old_issuer = sent_along(&below.issue("kme-a", &["localhost"]), &below.pem);
    let shown =
        [(ca.in_version_1(&good), true), (good, false), (old_root, false), (old_issuer, true)];
    for (pair, said) in &shown {
        let said = *said;
        let url = format!("https://localhost:{}", show(pair).port());
        let text = asked(&qkd(sae(dir.path(), &ca.pem, &client, &url))).await.unwrap_err();
        assert_eq!(text.contains(VERSION_1), said, "{text}");
        if said {
            assert!(text.contains("KME's certificate") && text.contains("version 3"), "{text}");
            assert!(text.contains("localhost"), "it says which KME: {text}");
        }
    }
}

#[test]
fn an_saes_certificate_of_version_1_is_refused_by_setting_and_file() {
    let dir = tempfile::tempdir().unwrap();
    let ca = Authority::new();
    let client = ca.issue("sae-a", &[]);
    let builder = |pair: &Pair| sae(dir.path(), &ca.pem, pair, "https://127.0.0.1:9");
    Kme::check(&qkd(builder(&client))).unwrap();
    let text = Kme::check(&qkd(builder(&ca.in_version_1(&client)))).unwrap_err().to_string();
    for part in ["AXON_SAE_CERT", "client.pem", VERSION_1, "version 3"] {
        assert!(text.contains(part), "{part}: {text}");
    }
    // A root is only a name and a key, in any version.
    let roots = version_1(&ca.pem, &ca.key);
    Kme::check(&qkd(sae(dir.path(), &roots, &client, "https://127.0.0.1:9"))).unwrap();
}

/// Returns the settings of a host that shows `pair`.
fn host(dir: &Path, roots: &str, pair: &Pair) -> Config {
    let config = Config::builder()
        .classic_auth(ClassicAuth::Ca)
        .classic_ca(write(dir, "roots.pem", roots, 0o644))
        .classic_cert(write(dir, "host.pem", &pair.cert, 0o644))
        .classic_key(write(dir, "host.key", &pair.key, 0o600));
    config.build().unwrap()
}

#[test]
fn our_own_certificate_is_refused_with_the_actual_cause() {
    let dir = tempfile::tempdir().unwrap();
    let ca = Authority::new();
    let good = ca.issue("a", &["a"]);
    let other = ca.issue("a", &["a"]);
    let check = |roots: &str, pair: &Pair| {
        axon_daemon::check(&host(dir.path(), roots, pair)).map_err(|error| error.to_string())
    };
    check(&ca.pem, &good).unwrap();
    check(&version_1(&ca.pem, &ca.key), &good).unwrap();

    let text = check(&ca.pem, &ca.in_version_1(&good)).unwrap_err();
    for part in ["AXON_CLASSIC_CERT", "host.pem", VERSION_1, "version 3"] {
        assert!(text.contains(part), "{part}: {text}");
    }
    assert!(!text.contains(NOT_OURS), "{text}");

    let chain = format!("{}{}", good.cert, version_1(&ca.pem, &ca.key));
    let text = check(&ca.pem, &Pair { cert: chain, key: good.key.clone() }).unwrap_err();
    assert!(text.contains("AXON_CLASSIC_CERT") && text.contains(VERSION_1), "{text}");

    let text = check(&ca.pem, &Pair { cert: good.cert.clone(), key: other.key }).unwrap_err();
    for part in ["AXON_CLASSIC_KEY", "host.key", NOT_OURS] {
        assert!(text.contains(part), "{part}: {text}");
    }

    let junk = "-----BEGIN CERTIFICATE-----\nMAMCAQE=\n-----END CERTIFICATE-----\n".to_owned();
    let text = check(&ca.pem, &Pair { cert: junk, key: good.key.clone() }).unwrap_err();
    assert!(text.contains("AXON_CLASSIC_CERT") && text.contains("cannot be read"), "{text}");
    assert!(!text.contains(NOT_OURS), "{text}");

    for (label, said) in [("EC PRIVATE KEY", "SEC1"), ("ENCRYPTED PRIVATE KEY", "is encrypted")] {
        let key = good.key.replace("PRIVATE KEY", label);
        let text = check(&ca.pem, &Pair { cert: good.cert.clone(), key }).unwrap_err();
        assert!(text.contains("AXON_CLASSIC_KEY") && text.contains(said), "{text}");
        assert!(!text.contains(NOT_OURS), "{text}");
    }
}

#[test]
fn a_peer_that_shows_version_1_is_refused_by_that_name() {
    let ca = Authority::new();
    let [ours, theirs] = ["a", "b"].map(|name| ca.issue(name, &[name]));
    let material = CaMaterial::from_pem(&ca.pem, &ours.cert, &ours.key, None).unwrap();
    let chain = |pair: &Pair| [CertificateDer::from_pem_slice(pair.cert.as_bytes()).unwrap()];
    material.accepts_client(&chain(&theirs)).unwrap();
    let old = chain(&ca.in_version_1(&theirs));
    for said in [material.accepts_client(&old), material.accepts_server(&old)] {
        let said = said.unwrap_err().to_string();
        assert!(said.contains(VERSION_1) && said.contains("version 3"), "{said}");
    }
}

/// A simulated KME whose certificate has a common name and no subjectAltName.
#[tokio::test(flavor = "multi_thread")]
async fn a_kme_without_a_name_is_known_by_its_id_where_that_is_said() {
    let dir = tempfile::tempdir().unwrap();
    let ca = Authority::new();
    let site = |kme: &str, sae: &str| Site {
        kme: kme.to_owned(),
        bind: "127.0.0.1:0".parse().unwrap(),
        saes: vec![sae.to_owned()],
    };
    let layout = Layout { sites: vec![site("kme-a", "sae-a"), site("kme-b", "sae-b")] };
    let of_kmes = dir.path().join("kmes");
    Pki::create(&layout).unwrap().write(&of_kmes).unwrap();
    let nameless = ca.issue("kme-a", &[]);
    write(&of_kmes, "ca.pem", &ca.pem, 0o644);
    write(&of_kmes, "kme-a.crt", &nameless.cert, 0o644);
    write(&of_kmes, "kme-a.key", &nameless.key, 0o600);
    let pki = Pki::load(&of_kmes, &layout).unwrap();
    let network = Network::builder().layout(layout, pki).start().await.unwrap();
    let url = network.kme("kme-a").unwrap().url().to_owned();
    let client = ca.issue("sae-a", &[]);
    let settings = || sae(dir.path(), &ca.pem, &client, &url);

    let text = asked(&qkd(settings().kme_id("kme-a"))).await.unwrap_err();
    assert!(text.contains("name"), "{text}");
    let by_id = |id: &str| settings().kme_id(id).kme_quirks([QkdConfig::NO_NAME_CHECK]);
    asked(&qkd(by_id("kme-a"))).await.unwrap();
    // The client still distinguishes another KME of the same CA.
    let text = asked(&qkd(by_id("kme-b"))).await.unwrap_err();
    assert!(text.contains("kme-a") && text.contains("kme-b"), "{text}");
    // Otherwise the client could not identify the KME at all.
    let error = settings().kme_quirks([QkdConfig::NO_NAME_CHECK]).build().unwrap_err();
    assert_eq!(error.variable(), "AXON_KME_QUIRKS");
    assert!(error.to_string().contains("AXON_KME_ID"), "{error}");
    // Another CA is trusted no more than before.
    let stranger = Authority::new();
    let config = sae(dir.path(), &stranger.pem, &client, &url).kme_id("kme-a");
    asked(&qkd(config.kme_quirks([QkdConfig::NO_NAME_CHECK]))).await.unwrap_err();
}
