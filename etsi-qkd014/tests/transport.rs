//! Tests the client's behaviour below HTTP and just above it: private keys of each form, key exchange, trust, proxies,
//! redirects, and the bytes of a request, as a server of the test sees them.

use std::io::{Read, Write};
use std::net::{SocketAddr, TcpListener};
use std::sync::Arc;
use std::sync::mpsc::{Receiver, channel};
use std::time::Duration;

use etsi_qkd014::sim::{Fault, Network};
use etsi_qkd014::{Client, ClientBuilder, Error, Quirks, RefusedBy, RetryPolicy};
use rcgen::{BasicConstraints, CertificateParams, DnType, IsCa, Issuer, KeyPair, SanType};
use rustls::crypto::aws_lc_rs::{default_provider, kx_group};
use rustls::pki_types::pem::PemObject;
use rustls::pki_types::{CertificateDer, PrivateKeyDer};
use rustls::server::WebPkiClientVerifier;
use rustls::{NamedGroup, RootCertStore, ServerConfig, ServerConnection, StreamOwned};
use serde_json::{Value, json};

/// A CA, a KME's certificate, and an SAE's in each form.
struct Material {
    ca: String,
    kme: (String, String),
    issuer: Issuer<'static, KeyPair>,
}

impl Material {
    fn new() -> Self {
        let key = KeyPair::generate().unwrap();
        let mut params = CertificateParams::default();
        params.distinguished_name.push(DnType::CommonName, "CA of a test");
        params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
        let ca = params.self_signed(&key).unwrap().pem();
        let issuer = Issuer::new(params, key);
        let key = KeyPair::generate().unwrap();
        let mut params = CertificateParams::default();
        params.subject_alt_names = vec![SanType::IpAddress([127, 0, 0, 1].into())];
        let cert = params.signed_by(&key, &issuer).unwrap().pem();
        Self { ca, kme: (cert, key.serialize_pem()), issuer }
    }

    /// Issues a certificate for a private key in PKCS#8.
    fn sae(&self, pkcs8_pem: &str) -> String {
        let key = KeyPair::from_pem(pkcs8_pem).unwrap();
        CertificateParams::default().signed_by(&key, &self.issuer).unwrap().pem()
    }
}

/// The server's record of one connection, and of its first request.
struct Seen {
    group: Option<NamedGroup>,
    client_certificates: usize,
    head: String,
    body: Value,
}

/// Serves one request per connection with a fixed answer.
fn serve(material: &Material, groups: Groups, answer: String) -> (SocketAddr, Receiver<Seen>) {
    let mut provider = default_provider();
    if groups == Groups::Classical {
        provider.kx_groups = vec![kx_group::SECP256R1];
    }
    let provider = Arc::new(provider);
    let mut roots = RootCertStore::empty();
    roots.add(CertificateDer::from_pem_slice(material.ca.as_bytes()).unwrap()).unwrap();
    let verifier = WebPkiClientVerifier::builder_with_provider(roots.into(), provider.clone());
    let (cert, key) = &material.kme;
    let tls = ServerConfig::builder_with_provider(provider)
        .with_safe_default_protocol_versions()
        .unwrap()
        .with_client_cert_verifier(verifier.build().unwrap())
        .with_single_cert(
            vec![CertificateDer::from_pem_slice(cert.as_bytes()).unwrap()],
            PrivateKeyDer::from_pem_slice(key.as_bytes()).unwrap(),
        )
        .unwrap();
    let tls = Arc::new(tls);
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let addr = listener.local_addr().unwrap();
    let (sender, receiver) = channel();
    std::thread::spawn(move || {
        for stream in listener.incoming() {
            let connection = ServerConnection::new(tls.clone()).unwrap();
            let mut stream = StreamOwned::new(connection, stream.unwrap());
            let Ok((head, body)) = request(&mut stream) else { continue };
            let seen = Seen {
                group: stream.conn.negotiated_key_exchange_group().map(|group| group.name()),
                client_certificates: stream.conn.peer_certificates().map_or(0, <[_]>::len),
                head,
                body,
            };
            let _ = stream.write_all(answer.as_bytes());
            stream.conn.send_close_notify();
            let _ = stream.flush();
            if sender.send(seen).is_err() {
                return;
            }
        }
    });
    (addr, receiver)
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum Groups {
    All,
    Classical,
}

fn request(stream: &mut impl Read) -> std::io::Result<(String, Value)> {
    let mut head = Vec::new();
    while !head.ends_with(b"\r\n\r\n") {
        let mut byte = [0];
        stream.read_exact(&mut byte)?;
        head.push(byte[0]);
    }
    let head = String::from_utf8(head).unwrap();
    let length = head.lines().find_map(|line| {
        let (name, value) = line.split_once(':')?;
        name.eq_ignore_ascii_case("content-length").then(|| value.trim().parse().unwrap())
    });
    let mut body = vec![0; length.unwrap_or(0)];
    stream.read_exact(&mut body)?;
    Ok((head, serde_json::from_slice(&body).unwrap_or_default()))
}

const ID: &str = "bc490419-7d60-487f-adc1-4ddcc177c139";

fn ok(body: &Value) -> String {
    let body = body.to_string();
    let length = body.len();
    // Without the last header line the next request might be sent on the connection that ends.
    format!(
        "HTTP/1.1 200 OK\r\nContent-Type: application/json\r\nContent-Length: {length}\r\n\
         Connection: close\r\n\r\n{body}"
    )
}

fn container() -> Value {
    json!({"keys": [{"key_ID": ID, "key": "wHHVxRwDJs3/bXd38GHP3oe4svTuRpZS0yCC7x4Ly+s="}]})
}

fn builder(material: &Material, addr: SocketAddr) -> ClientBuilder {
    let key = KeyPair::generate().unwrap().serialize_pem();
    Client::builder()
        .kme_url(format!("https://{addr}"))
        .ca(material.ca.as_str())
        .sae_cert(material.sae(&key))
        .sae_key(key.into_bytes())
        .retry(RetryPolicy::none())
}

#[tokio::test]
async fn nothing_but_the_ca_given_is_trusted() {
    let material = Material::new();
    let (addr, _seen) = serve(&material, Groups::All, ok(&container()));
    // The variables by which programs are told of other roots.
    let file = tempfile::NamedTempFile::new().unwrap();
    std::fs::write(file.path(), &material.ca).unwrap();
    let output = child("status_of_a_kme_of_another_ca")
        .env("SSL_CERT_FILE", file.path())
        .env("SSL_CERT_DIR", file.path().parent().unwrap())
        .env("ETSI_TEST_KME", addr.to_string())
        .output()
        .unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stdout));
}

/// Run by the test above, with its environment.
#[tokio::test]
async fn status_of_a_kme_of_another_ca() {
    let Ok(addr) = std::env::var("ETSI_TEST_KME") else { return };
    let other = Material::new();
    let error = builder(&other, addr.parse().unwrap()).build().unwrap().status("b").await;
    let error = error.unwrap_err();
    assert!(matches!(error, Error::Tls { refused_by: RefusedBy::Client, .. }), "{error}");
}

#[tokio::test]
async fn a_proxy_of_the_environment_is_not_used() {
    let material = Material::new();
    let (addr, seen) = serve(&material, Groups::All, ok(&container()));
    let proxy = TcpListener::bind("127.0.0.1:0").unwrap();
    proxy.set_nonblocking(true).unwrap();
    let dir = tempfile::tempdir().unwrap();
    let key = KeyPair::generate().unwrap().serialize_pem();
    std::fs::write(dir.path().join("ca.pem"), &material.ca).unwrap();
    std::fs::write(dir.path().join("sae.crt"), material.sae(&key)).unwrap();
    std::fs::write(dir.path().join("sae.key"), key).unwrap();
    let url = format!("http://{}", proxy.local_addr().unwrap());
    let mut child = child("a_key_despite_a_proxy");
    for name in ["HTTPS_PROXY", "https_proxy", "ALL_PROXY", "all_proxy"] {
        child.env(name, &url);
    }
    child.env_remove("NO_PROXY").env_remove("no_proxy");
    child.env("ETSI_TEST_DIR", dir.path()).env("ETSI_TEST_KME", addr.to_string());
    let output = child.output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stdout));
    assert!(seen.try_recv().is_ok());
    assert_eq!(proxy.accept().unwrap_err().kind(), std::io::ErrorKind::WouldBlock);
}

/// Run by the test above, with its environment.
#[tokio::test]
async fn a_key_despite_a_proxy() {
    let Some(dir) = std::env::var_os("ETSI_TEST_DIR").map(std::path::PathBuf::from) else { return };
    let client = Client::builder()
        .kme_url(format!("https://{}", std::env::var("ETSI_TEST_KME").unwrap()))
        .ca_file(dir.join("ca.pem"))
        .sae_cert_file(dir.join("sae.crt"))
        .sae_key_file(dir.join("sae.key"))
        .build()
        .unwrap();
    client.enc_keys("sae-b").send().await.unwrap();
}

fn child(test: &str) -> std::process::Command {
    let mut command = std::process::Command::new(std::env::current_exe().unwrap());
    command.args(["--exact", test, "--nocapture"]);
    command
}

#[tokio::test]
async fn a_redirect_is_told_and_not_followed() {
    let material = Material::new();
    let (elsewhere, visits) = serve(&material, Groups::All, ok(&container()));
    for code in [301, 302, 303, 307, 308] {
        let answer = format!(
            "HTTP/1.1 {code} Moved\r\nLocation: https://{elsewhere}/api/v1/keys/sae-b/enc_keys\r\nContent-Length: 0\r\n\r\n"
        );
        let (addr, seen) = serve(&material, Groups::All, answer);
        let client = builder(&material, addr).build().unwrap();
        let error = client.enc_keys("sae-b").send().await.err().unwrap();
        assert_eq!(error.status_code(), Some(code), "{error}");
        assert!(seen.recv().is_ok() && visits.try_recv().is_err());
    }
}

#[tokio::test]
async fn hybrid_key_exchange_where_the_kme_has_it_and_classical_elsewhere() {
    let material = Material::new();
    for (groups, expected) in
        [(Groups::All, NamedGroup::X25519MLKEM768), (Groups::Classical, NamedGroup::secp256r1)]
    {
        let (addr, seen) = serve(&material, groups, ok(&container()));
        let client = builder(&material, addr).build().unwrap();
        client.enc_keys("sae-b").send().await.unwrap();
        let seen = seen.recv().unwrap();
        assert_eq!((seen.group, seen.client_certificates), (Some(expected), 1));
    }
}

#[tokio::test]
async fn extensions_of_dec_keys_are_in_its_body() {
    let material = Material::new();
    let (addr, seen) = serve(&material, Groups::All, ok(&container()));
    let client = builder(&material, addr).build().unwrap();
    client
        .dec_keys("sae-a")
        .key_id_with_extension(ID, json!({"abc_x": 1}))
        .key_ids_extension(json!({"abc_y": [2]}))
        .send()
        .await
        .unwrap();
    let seen = seen.recv().unwrap();
    assert!(
        seen.head.starts_with("POST /api/v1/keys/sae-a/dec_keys HTTP/1.1\r\n"),
        "{}",
        seen.head
    );
    let expected = json!({
        "key_IDs": [{"key_ID": ID, "key_ID_extension": {"abc_x": 1}}],
        "key_IDs_extension": {"abc_y": [2]},
    });
    assert_eq!(seen.body, expected);
}

#[tokio::test]
async fn sizes_are_bits_unless_the_quirk_says_bytes() {
    let material = Material::new();
    for (quirks, sent) in [(Quirks::STRICT, 256), (Quirks::SIZE_IN_BYTES, 32)] {
        let (addr, seen) = serve(&material, Groups::All, ok(&container()));
        let client = builder(&material, addr).quirks(quirks).build().unwrap();
        let key = client.enc_keys("sae-b").size(256).send().await.unwrap().into_single();
        assert_eq!(key.len(), 32);
        assert_eq!(seen.recv().unwrap().body, json!({ "size": sent }));
        client.enc_keys("sae-b").size(256).via_get().send().await.unwrap();
        assert!(seen.recv().unwrap().head.contains(&format!("?size={sent} ")));
    }
}

#[tokio::test]
async fn keys_under_table_11s_name_need_the_quirk() {
    let material = Material::new();
    let (addr, _seen) = serve(&material, Groups::All, ok(&json!({"Keys": container()["keys"]})));
    let strict = builder(&material, addr).build().unwrap();
    let error = strict.enc_keys("sae-b").send().await.err().unwrap();
    assert!(matches!(error.cause(), Error::Malformed { .. }), "{error}");
    let client = builder(&material, addr).quirks(Quirks::ANY_CASE_MEMBERS).build().unwrap();
    client.enc_keys("sae-b").send().await.unwrap();
}

#[tokio::test]
async fn a_short_retry_after_is_waited_for() {
    let network = Network::builder()
        .strict()
        .kme("kme-a", "127.0.0.1:0".parse().unwrap(), ["sae-a"])
        .kme("kme-b", "127.0.0.1:0".parse().unwrap(), ["sae-b"])
        .start()
        .await
        .unwrap();
    let policy = RetryPolicy::none().status(1).pause(Duration::from_millis(1), Duration::ZERO);
    let client = network.client_builder("sae-a").retry(policy).build().unwrap();
    let kme = network.kme("kme-a").unwrap();
    kme.inject(Fault::Busy(1), 1);
    let asked = std::time::Instant::now();
    client.status("sae-b").await.unwrap();
    assert!(asked.elapsed() >= Duration::from_secs(1), "the KME asked for a second");
    assert_eq!(kme.counters().status_calls, 2);
}

/// Returns the DER inside of PKCS#8: SEC1 for elliptic curves, PKCS#1 for RSA.
fn inner_der(pkcs8: &[u8]) -> Vec<u8> {
    // SEQUENCE { version, algorithm, OCTET STRING { the key } }
    let (_, mut content, _) = element(pkcs8);
    let mut last = (0, &[][..]);
    for _ in 0..3 {
        let (tag, inside, rest) = element(content);
        (last, content) = ((tag, inside), rest);
    }
    assert_eq!(last.0, 0x04);
    last.1.to_vec()
}

/// Returns tag and content of an element, and the bytes after it.
fn element(der: &[u8]) -> (u8, &[u8], &[u8]) {
    let (header, length) = match der[1] {
        short @ 0..=0x7f => (2, usize::from(short)),
        long => {
            let bytes = usize::from(long & 0x7f);
            let length = der[2..2 + bytes].iter().fold(0, |n, byte| n << 8 | usize::from(*byte));
            (2 + bytes, length)
        }
    };
    (der[0], &der[header..header + length], &der[header + length..])
}

fn pem(label: &str, der: &[u8]) -> Vec<u8> {
    use base64::Engine;
    let text = base64::engine::general_purpose::STANDARD.encode(der);
    let lines: Vec<_> = text.as_bytes().chunks(64).map(|line| [line, b"\n"].concat()).collect();
    let (begin, end) = (format!("-----BEGIN {label}-----\n"), format!("-----END {label}-----\n"));
    [begin.as_bytes(), &lines.concat(), end.as_bytes()].concat()
}

#[tokio::test]
async fn private_keys_of_every_form_prove_the_sae() {
    let material = Material::new();
    let (addr, seen) = serve(&material, Groups::All, ok(&container()));
    for (algorithm, label) in [
        (&rcgen::PKCS_ECDSA_P256_SHA256, "EC PRIVATE KEY"),
        (&rcgen::PKCS_ECDSA_P384_SHA384, "EC PRIVATE KEY"),
        (&rcgen::PKCS_RSA_SHA256, "RSA PRIVATE KEY"),
    ] {
        let key = KeyPair::generate_for(algorithm).unwrap();
        let cert = material.sae(&key.serialize_pem());
        let pkcs8 = key.serialize_der();
        let inner = inner_der(&pkcs8);
        let forms = [pem("PRIVATE KEY", &pkcs8), pkcs8, pem(label, &inner), inner];
        for form in forms {
            let client = builder(&material, addr).sae_cert(cert.as_str()).sae_key(form);
            client.build().unwrap().enc_keys("sae-b").send().await.unwrap();
            assert_eq!(seen.recv().unwrap().client_certificates, 1);
        }
    }
}
