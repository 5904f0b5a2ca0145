//! The hybrid mode with OpenSSL 3.5 or later, in both directions: keys of its own making as raw
//! public keys (RFC 7250) and in certificates, and what is refused of it.
#![cfg(feature = "hybrid")]

mod peers;

use std::process::Command;
use std::sync::Arc;

use axon_tls::identity::{
    Auth, CaMaterial, KeyAlgorithm, SigningKey, SpkiDigest, Trust, TrustFile,
};
use axon_tls::{Cipher, KeyExchange, hybrid};
use peers::{
    LABEL, Peer, dial, exchange, file, handshake, listen, patient, port, with_hybrid_openssl,
};
use rustls::{ClientConnection, ServerConnection};

const ALGORITHMS: [(&str, KeyAlgorithm); 2] =
    [("ML-DSA-65", KeyAlgorithm::MlDsa65), ("ed25519", KeyAlgorithm::Ed25519)];

/// A key that OpenSSL has made, and a certificate for it.
struct Theirs {
    key: String,
    certificate: String,
    digest: SpkiDigest,
}

fn run(program: &str, args: &[&str]) -> Vec<u8> {
    let output = Command::new(program).args(args).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    output.stdout
}

impl Theirs {
    /// Creates a certificate that is signed by itself, or by `issuer`.
    fn new(program: &str, algorithm: &str, issuer: Option<&Self>) -> Self {
        let (key, certificate) = (file("theirs.key", ""), file("theirs.crt", ""));
        run(program, &["genpkey", "-algorithm", algorithm, "-out", &key]);
        let mut args = vec!["req", "-x509", "-new", "-key", &key, "-out", &certificate];
        args.extend(["-subj", "/CN=peer", "-days", "30", "-addext", "subjectAltName=DNS:peer"]);
        if let Some(issuer) = issuer {
            args.extend(["-CA", &issuer.certificate, "-CAkey", &issuer.key]);
            args.extend(["-addext", "basicConstraints=critical,CA:FALSE"]);
        }
        run(program, &args);
        let spki = run(program, &["pkey", "-in", &key, "-pubout", "-outform", "DER"]);
        let digest = aws_lc_rs::digest::digest(&aws_lc_rs::digest::SHA256, &spki);
        Self { key, certificate, digest: SpkiDigest(digest.as_ref().try_into().unwrap()) }
    }

    fn read(&self) -> (String, String) {
        let read = |path| std::fs::read_to_string(path).unwrap();
        (read(&self.certificate), read(&self.key))
    }
}

fn pinned(ours: &SigningKey, theirs: SpkiDigest) -> Auth {
    let trust = TrustFile::parse(&format!("peer {theirs}")).unwrap();
    Auth::Pinned { key: ours.clone(), trust: Trust::new(trust) }
}

fn key(algorithm: KeyAlgorithm) -> SigningKey {
    SigningKey::from_pem(&SigningKey::generate_pem_with(algorithm).unwrap()).unwrap()
}

fn suite(cipher: Cipher) -> &'static str {
    match cipher {
        Cipher::ChaCha20Poly1305 => "TLS_CHACHA20_POLY1305_SHA256",
        Cipher::Aes256Gcm => "TLS_AES_256_GCM_SHA384",
    }
}

const RAW_KEYS: [&str; 2] = ["-enable_server_rpk", "-enable_client_rpk"];

/// Starts `s_server` or `s_client`, with its key, only for the hybrid group.
fn start(program: &str, command: &[&str], theirs: &Theirs, cipher: Cipher, more: &[&str]) -> Peer {
    let mut args = command.to_vec();
    args.extend(["-tls1_3", "-groups", "X25519MLKEM768", "-ciphersuites", suite(cipher)]);
    args.extend(["-cert", &theirs.certificate, "-key", &theirs.key]);
    args.extend(["-keymatexport", LABEL, "-keymatexportlen", "32"]);
    args.extend(more);
    Peer::start(program, &args)
}

fn our_client(auth: &Auth, cipher: Cipher) -> ClientConnection {
    let config = hybrid::client_config(auth, cipher, b"").unwrap();
    ClientConnection::new(Arc::new(config), "peer".try_into().unwrap()).unwrap()
}

/// Returns the outcome of our client with their server. A success must be the same on both ends.
fn dialled(
    program: &str,
    auth: &Auth,
    theirs: &Theirs,
    cipher: Cipher,
    more: &[&str],
) -> Result<SpkiDigest, String> {
    let port = port();
    let addr = format!("127.0.0.1:{port}");
    let server = ["s_server", "-accept", &addr, "-Verify", "1"];
    let mut server = start(program, &server, theirs, cipher, more);
    let (mut socket, mut conn) = (dial(port), our_client(auth, cipher));
    if let Err(err) = handshake(&mut conn, &mut socket) {
        assert_eq!(hybrid::negotiated(&conn), None);
        return Err(err.to_string());
    }
    exchange(&mut conn, &mut socket, &mut server, false);
    let negotiated = hybrid::negotiated(&conn).unwrap();
    assert_eq!(negotiated.key_exchange, KeyExchange::X25519MlKem768);
    assert_eq!(negotiated.cipher, cipher);
    Ok(negotiated.peer.unwrap())
}

/// Returns the outcome of their client with our server.
fn accepted(
    program: &str,
    auth: &Auth,
    theirs: &Theirs,
    cipher: Cipher,
    more: &[&str],
) -> Result<SpkiDigest, String> {
    let (listener, addr) = listen();
    let addr = addr.to_string();
    let mut client = start(program, &["s_client", "-connect", &addr], theirs, cipher, more);
    let mut socket = patient(listener.accept().unwrap().0);
    let config = hybrid::server_config(auth, cipher, b"").unwrap();
    let mut conn = ServerConnection::new(Arc::new(config)).unwrap();
    if let Err(err) = handshake(&mut conn, &mut socket) {
        assert_eq!(hybrid::negotiated(&conn), None);
        return Err(err.to_string());
    }
    exchange(&mut conn, &mut socket, &mut client, false);
    let negotiated = hybrid::negotiated(&conn).unwrap();
    assert_eq!(negotiated.key_exchange, KeyExchange::X25519MlKem768);
    assert_eq!(negotiated.cipher, cipher);
    Ok(negotiated.peer.unwrap())
}

#[test]
fn unpinned_keys_are_refused_for_every_signature_algorithm() {
    with_hybrid_openssl(|program| {
        let cipher = Cipher::default();
        let expected = Theirs::new(program, "ML-DSA-65", None);
        let auth = pinned(&key(KeyAlgorithm::MlDsa65), expected.digest);
        for algorithm in ["ML-DSA-65", "ed25519", "ec", "RSA"] {
            let other = if algorithm == "ec" {
                let (key, certificate) = (file("theirs.key", ""), file("theirs.crt", ""));
                let group = "ec_paramgen_curve:P-256";
                run(program, &["genpkey", "-algorithm", "ec", "-pkeyopt", group, "-out", &key]);
                let args =
                    ["req", "-x509", "-key", &key, "-subj", "/CN=peer", "-out", &certificate];
                run(program, &args);
                Theirs { key, certificate, digest: SpkiDigest([0; 32]) }
            } else {
                Theirs::new(program, algorithm, None)
            };
            let err = dialled(program, &auth, &other, cipher, &RAW_KEYS).unwrap_err();
            assert!(err.contains("UnknownIssuer"), "{algorithm}: {err}");
            let err = accepted(program, &auth, &other, cipher, &RAW_KEYS).unwrap_err();
            assert!(err.contains("UnknownIssuer"), "{algorithm}: {err}");
        }
    });
}

/// A peer that takes no signature but those that a quantum computer forges gets none from a key that
/// is not of that kind.
#[test]
fn a_client_that_takes_other_signatures_alone_is_refused() {
    with_hybrid_openssl(|program| {
        let cipher = Cipher::default();
        let theirs = Theirs::new(program, "ML-DSA-65", None);
        let auth = pinned(&key(KeyAlgorithm::MlDsa65), theirs.digest);
        for schemes in ["ed25519", "ECDSA+SHA256", "RSA-PSS+SHA256", "ed25519:ECDSA+SHA256"] {
            let more = [&RAW_KEYS[..], &["-sigalgs", schemes]].concat();
            let err = accepted(program, &auth, &theirs, cipher, &more).unwrap_err();
            assert!(err.contains("NoSignatureSchemesInCommon"), "{schemes}: {err}");
        }
    });
}

/// A certificate where a raw public key was agreed on, and the other way round.
#[test]
fn certificates_and_raw_keys_do_not_mix() {
    with_hybrid_openssl(|program| {
        let cipher = Cipher::default();
        let root = Theirs::new(program, "ML-DSA-65", None);
        let theirs = Theirs::new(program, "ML-DSA-65", Some(&root));
        let auth = pinned(&key(KeyAlgorithm::MlDsa65), theirs.digest);
        assert!(dialled(program, &auth, &theirs, cipher, &[]).is_err());
        assert!(accepted(program, &auth, &theirs, cipher, &[]).is_err());
    });
}

#[test]
fn raw_public_keys_both_ways() {
    with_hybrid_openssl(|program| {
        for cipher in Cipher::ALL {
            for (name, algorithm) in ALGORITHMS {
                let theirs = Theirs::new(program, name, None);
                for auth in [
                    pinned(&key(algorithm), theirs.digest),
                    Auth::None(SigningKey::generate().unwrap()),
                ] {
                    let peer = dialled(program, &auth, &theirs, cipher, &RAW_KEYS).unwrap();
                    assert_eq!(peer, theirs.digest);
                    let peer = accepted(program, &auth, &theirs, cipher, &RAW_KEYS).unwrap();
                    assert_eq!(peer, theirs.digest);
                }
            }
        }
    });
}

/// A root and leaves of ML-DSA-65, all made by OpenSSL.
#[test]
fn certificates_both_ways() {
    with_hybrid_openssl(|program| {
        let cipher = Cipher::default();
        let root = Theirs::new(program, "ML-DSA-65", None);
        let [theirs, ours] = [0, 1].map(|_| Theirs::new(program, "ML-DSA-65", Some(&root)));
        let (certificate, key) = ours.read();
        let material = |root: &Theirs| {
            let material = CaMaterial::from_pem(&root.read().0, &certificate, &key, None);
            Auth::Ca(Arc::new(material.unwrap()))
        };
        let verifying = ["-CAfile", &root.certificate, "-verify_return_error"];

        let stranger = material(&Theirs::new(program, "ML-DSA-65", None));
        assert!(dialled(program, &stranger, &theirs, cipher, &verifying).is_err());
        assert!(accepted(program, &stranger, &theirs, cipher, &verifying).is_err());

        let auth = material(&root);
        let peer = dialled(program, &auth, &theirs, cipher, &verifying).unwrap();
        assert_eq!(peer, theirs.digest);
        let peer = accepted(program, &auth, &theirs, cipher, &verifying).unwrap();
        assert_eq!(peer, theirs.digest);
    });
}
