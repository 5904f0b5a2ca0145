//! The importer of RFC 9258: hostile uses, vectors of an independent script, then handshakes.
#![cfg(feature = "aws_lc_rs")]

use std::io::Write;
use std::process::Command;
use std::sync::Arc;

use hmac::{Hmac, KeyInit, Mac};
use rustls_axon::crypto::aws_lc_rs::{cipher_suite, default_provider};
use rustls_axon::crypto::hash::HashAlgorithm;
use rustls_axon::external_psk::{
    ExternalPsk, ExternalPskOffer, ImportedIdentity, ImportedPsk, PskKeyExchangeMode,
    ResolvesExternalPsk,
};
use rustls_axon::{
    AlertDescription, ClientConfig, ClientConnection, Error, PeerIncompatible, PeerMisbehaved,
    ServerConfig, ServerConnection, SupportedCipherSuite,
};
use serde_json::Value;
use sha2::{Digest, Sha256, Sha384};
use zeroize::Zeroizing;

const SUITES: [SupportedCipherSuite; 2] =
    [cipher_suite::TLS13_CHACHA20_POLY1305_SHA256, cipher_suite::TLS13_AES_256_GCM_SHA384];
const MODE: PskKeyExchangeMode = PskKeyExchangeMode::PskKe;

fn hash(name: &str) -> HashAlgorithm {
    match name {
        "sha256" => HashAlgorithm::SHA256,
        _ => HashAlgorithm::SHA384,
    }
}

fn import(name: &[u8], context: &[u8], key: &[u8], base: &str, target: &str) -> ImportedPsk {
    let identity = ImportedIdentity::new(name, context, hash(target)).unwrap();
    let suite = SUITES[usize::from(base != "sha256")].tls13().unwrap();
    ImportedPsk::new(identity, &Zeroizing::new(key.to_vec()), suite).unwrap()
}

/// Has a base key for a name, and imports it as it is asked for, in one context.
#[derive(Debug)]
struct Importer {
    name: Vec<u8>,
    context: Vec<u8>,
    key: Vec<u8>,
    base: String,
}

impl ResolvesExternalPsk for Importer {
    fn resolve(&self, offer: ExternalPskOffer<'_>) -> Option<Arc<ExternalPsk>> {
        let identity = offer.identities().filter_map(ImportedIdentity::decode).find(|offered| {
            offered.external_identity() == self.name && offered.context() == self.context
        })?;
        let suite = SUITES[usize::from(self.base != "sha256")].tls13()?;
        let key = Zeroizing::new(self.key.clone());
        Some(ImportedPsk::new(identity, &key, suite).ok()?.into())
    }
}

/// Has one PSK, whatever is asked for.
struct Only(Arc<ExternalPsk>);

impl std::fmt::Debug for Only {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("Only")
    }
}

impl ResolvesExternalPsk for Only {
    fn resolve(&self, _offer: ExternalPskOffer<'_>) -> Option<Arc<ExternalPsk>> {
        Some(self.0.clone())
    }
}

fn client(psks: Vec<Arc<ExternalPsk>>) -> Result<ClientConnection, Error> {
    let provider = rustls_axon::crypto::CryptoProvider {
        cipher_suites: SUITES.to_vec(),
        kx_groups: vec![],
        ..default_provider()
    };
    let config = ClientConfig::builder_with_provider(provider.into())
        .with_external_psks(psks, MODE)
        .unwrap();
    ClientConnection::new(config.into(), "example.com".try_into().unwrap())
}

fn server(resolver: Arc<dyn ResolvesExternalPsk>) -> ServerConnection {
    let provider = rustls_axon::crypto::CryptoProvider {
        cipher_suites: SUITES.to_vec(),
        kx_groups: vec![],
        ..default_provider()
    };
    let config = ServerConfig::builder_with_provider(provider.into())
        .with_external_psk_resolver(resolver, MODE)
        .unwrap();
    ServerConnection::new(config.into()).unwrap()
}

/// The error of the first end that has one.
fn handshake(client: &mut ClientConnection, server: &mut ServerConnection) -> Result<(), Error> {
    for _ in 0..2 {
        let mut flight = Vec::new();
        while client.wants_write() {
            client.write_tls(&mut flight).unwrap();
        }
        while !flight.is_empty() {
            let read = server.read_tls(&mut &flight[..]).unwrap();
            flight.drain(..read);
            server.process_new_packets()?;
        }
        while server.wants_write() {
            server.write_tls(&mut flight).unwrap();
        }
        while !flight.is_empty() {
            let read = client.read_tls(&mut &flight[..]).unwrap();
            flight.drain(..read);
            client.process_new_packets()?;
        }
    }
    assert!(!client.is_handshaking() && !server.is_handshaking());
    Ok(())
}

/// The last alert, which goes out in the clear, that an end wrote.
fn alert(server: &mut ServerConnection) -> AlertDescription {
    let mut flight = Vec::new();
    while server.wants_write() {
        server.write_tls(&mut flight).unwrap();
    }
    AlertDescription::from(*flight.last().unwrap())
}

#[test]
fn a_reflected_client_hello_finds_no_key() {
    let (ours, theirs) = (b"client alice, server bob", b"client bob, server alice");
    let mut client = client(vec![import(b"k", ours, &[1; 32], "sha256", "sha256").into()]).unwrap();
    let importer = Importer {
        name: b"k".to_vec(),
        context: theirs.to_vec(),
        key: vec![1; 32],
        base: "sha256".into(),
    };
    let mut server = server(Arc::new(importer));
    let error = handshake(&mut client, &mut server).unwrap_err();
    assert_eq!(error, PeerIncompatible::UnknownExternalPskIdentity.into());
    assert_eq!(alert(&mut server), AlertDescription::UnknownPSKIdentity);
}

/// Both ends have the same secret under the same identity, and only one of them imported it.
#[test]
fn imported_and_not_imported_are_never_mixed() {
    for vector in vectors() {
        let (imported, plain) = (vector.import(), vector.plain());
        for (offered, known) in [(imported.into(), plain), (vector.plain(), vector.import().into())]
        {
            let mut client = client(vec![offered]).unwrap();
            let mut server = server(Arc::new(Only(known)));
            let error = handshake(&mut client, &mut server).unwrap_err();
            assert_eq!(error, PeerMisbehaved::IncorrectBinder.into());
            assert_eq!(alert(&mut server), AlertDescription::DecryptError);
        }
    }
}

#[test]
fn another_base_key_or_hash_has_another_binder() {
    let right = || import(b"k", b"c", &[1; 32], "sha256", "sha256").into();
    for (key, base) in [([2; 32], "sha256"), ([1; 32], "sha384")] {
        let importer = Importer {
            name: b"k".to_vec(),
            context: b"c".to_vec(),
            key: key.into(),
            base: base.into(),
        };
        let mut server = server(Arc::new(importer));
        let error = handshake(&mut client(vec![right()]).unwrap(), &mut server).unwrap_err();
        assert_eq!(error, PeerMisbehaved::IncorrectBinder.into());
    }
}

#[test]
fn an_identity_that_is_not_exactly_one_is_not_decoded() {
    let right = import(b"name", b"context", &[1; 32], "sha256", "sha384").identity().to_vec();
    let decoded = ImportedIdentity::decode(&right).unwrap();
    assert_eq!((decoded.external_identity(), decoded.context()), (&b"name"[..], &b"context"[..]));
    assert_eq!(decoded.target_hash(), HashAlgorithm::SHA384);

    for end in 0..right.len() {
        assert_eq!(ImportedIdentity::decode(&right[..end]), None, "cut at {end}");
    }
    assert_eq!(ImportedIdentity::decode(&[&right[..], &[0]].concat()), None);
    // no external identity; TLS 1.2; reserved and unknown KDFs
    assert_eq!(ImportedIdentity::decode(&[0, 0, 0, 0, 3, 4, 0, 1]), None);
    for tail in [[3, 3, 0, 1], [3, 4, 0, 0], [3, 4, 0, 3], [0xfe, 0xfc, 0, 1]] {
        assert_eq!(ImportedIdentity::decode(&[&[0, 1, 7, 0, 0][..], &tail].concat()), None);
    }
}

#[test]
fn psks_that_cannot_be_imported_are_refused() {
    let suite = SUITES[0].tls13().unwrap();
    assert!(ImportedIdentity::new(b"", b"", HashAlgorithm::SHA256).is_err());
    assert!(ImportedIdentity::new(b"k", b"", HashAlgorithm::SHA512).is_err());
    let short = Zeroizing::new(vec![1; 15]);
    let identity = ImportedIdentity::new(b"k", b"", HashAlgorithm::SHA256).unwrap();
    assert!(ImportedPsk::new(identity, &short, suite).is_err());
    for (name, context) in [(65_536, 0), (65_000, 600), (1, 65_536)] {
        let (name, context) = (vec![b'k'; name], vec![b'c'; context]);
        let identity = ImportedIdentity::new(&name, &context, HashAlgorithm::SHA256).unwrap();
        assert!(ImportedPsk::new(identity, &Zeroizing::new(vec![1; 32]), suite).is_err());
    }
    let twice = || import(b"k", b"", &[1; 32], "sha256", "sha256").into();
    assert!(client(vec![twice(), twice()]).is_err(), "one identity twice in an offer");
}

struct Vector(Value);

impl Vector {
    fn text(&self, name: &str) -> &str {
        self.0[name].as_str().unwrap()
    }

    fn bytes(&self, name: &str) -> Vec<u8> {
        unhex(self.text(name))
    }

    fn import(&self) -> ImportedPsk {
        let [name, context, key] =
            ["external_identity", "context", "base_key"].map(|n| self.bytes(n));
        import(&name, &context, &key, self.text("base_hash"), self.text("target_hash"))
    }

    /// The derived secret as if it were an external PSK of that identity.
    fn plain(&self) -> Arc<ExternalPsk> {
        let secret = Zeroizing::new(self.bytes("ipskx"));
        let identity = self.bytes("imported_identity");
        Arc::new(ExternalPsk::new(identity, secret, hash(self.text("target_hash"))).unwrap())
    }
}

fn unhex(text: &str) -> Vec<u8> {
    (0..text.len())
        .step_by(2)
        .map(|at| u8::from_str_radix(&text[at..at + 2], 16).unwrap())
        .collect()
}

fn vectors() -> Vec<Vector> {
    let all: Value = serde_json::from_str(include_str!("vectors/rfc9258.json")).unwrap();
    all.as_array().unwrap().iter().cloned().map(Vector).collect()
}

#[test]
fn stored_vectors_match_the_script_output() {
    let script = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/vectors/rfc9258.py");
    let Ok(output) = Command::new("python3").arg(script).output() else {
        // Past the harness, which would show it only beside a failure.
        let _ = writeln!(std::io::stderr(), "skipped: there is no python3 here");
        return;
    };
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    assert_eq!(String::from_utf8(output.stdout).unwrap(), include_str!("vectors/rfc9258.json"));
}

macro_rules! binder {
    ($hash:ty, $len:literal, $secret:expr, $label:expr, $transcript_hash:expr) => {{
        let hmac = |key: &[u8], parts: &[&[u8]]| {
            let mut mac = Hmac::<$hash>::new_from_slice(key).unwrap();
            parts.iter().for_each(|part| mac.update(part));
            mac.finalize().into_bytes().to_vec()
        };
        let expand = |key: &[u8], label: &[u8], context: &[u8]| {
            let lens = [label.len() as u8 + 6, context.len() as u8];
            let parts: [&[u8]; 7] =
                [&[0, $len], &lens[..1], b"tls13 ", label, &lens[1..], context, &[1]];
            hmac(key, &parts)
        };
        let early = hmac(&[0; $len], &[$secret]);
        let key = expand(&early, $label, &<$hash>::digest(b""));
        hmac(&expand(&key, b"finished", b""), &[$transcript_hash])
    }};
}

/// RFC 8448, section 4: what makes the binders below worth comparing with.
#[test]
fn the_binders_of_this_test_are_those_of_rfc_8448() {
    let secret = unhex("4ecd0eb6ec3b4d87f5d6028f922ca4c5851a277fd41311c9e62d2c9492e1c4f3");
    let hash = unhex("63224b2e4573f2d3454ca84b9d009a04f6be9e05711a8396473aefa01e924a14");
    let expected = unhex("3add4fb2d8fdf822a0ca3cf7678ef5e88dae990141c5924d57bb6fa31b9e5f9d");
    assert_eq!(binder!(Sha256, 32, &secret, b"res binder", &hash), expected);
}

/// Identity, secret and binder label, read off the wire.
#[test]
fn client_hellos_have_the_identity_and_binder_of_the_vectors() {
    for vector in vectors() {
        let secret = vector.bytes("ipskx");
        let psks: [(Arc<ExternalPsk>, &[u8]); 2] =
            [(vector.import().into(), b"imp binder"), (vector.plain(), b"ext binder")];
        for (psk, label) in psks {
            let mut hello = Vec::new();
            client(vec![psk]).unwrap().write_tls(&mut hello).unwrap();
            let hello = &hello[5..];

            let (before, binder) = hello.split_at(hello.len() - secret.len());
            let (truncated, lens) = before.split_at(before.len() - 3);
            assert_eq!(lens, [0, secret.len() as u8 + 1, secret.len() as u8]);
            let identity = vector.bytes("imported_identity");
            assert!(truncated.ends_with(&[&identity[..], &[0; 4]].concat()), "age is 0");

            let expected = match vector.text("target_hash") {
                "sha256" => binder!(Sha256, 32, &secret, label, &Sha256::digest(truncated)),
                _ => binder!(Sha384, 48, &secret, label, &Sha384::digest(truncated)),
            };
            assert_eq!(binder, expected);
        }
    }
}

#[test]
fn handshakes_on_imported_psks_work() {
    for vector in vectors() {
        let [name, context, key] =
            ["external_identity", "context", "base_key"].map(|name| vector.bytes(name));
        let base = vector.text("base_hash").to_owned();
        let mut client = client(vec![vector.import().into()]).unwrap();
        let mut server = server(Arc::new(Importer { name, context, key, base }));
        handshake(&mut client, &mut server).unwrap();
        for used in [client.external_psk(), server.external_psk()] {
            assert_eq!(used.unwrap().identity(), vector.bytes("imported_identity"));
        }
    }
}
