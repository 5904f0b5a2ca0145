//! A QKD key imported as RFC 9258 says: against rustls-axon's own importer, and never in place of the
//! other form.
#![cfg(feature = "hybrid")]

use std::sync::{Arc, Mutex};

use axon_tls::qkd::{
    self, ImportedIdentity, Psk, PskIdentity, PskResolver, derive_psk, import_psk,
};
use axon_tls::{Cipher, KeyExchange, PskKex};
use rustls_axon::crypto::CryptoProvider;
use rustls_axon::crypto::aws_lc_rs::{cipher_suite, default_provider};
use rustls_axon::crypto::hash::HashAlgorithm;
use rustls_axon::external_psk::{ImportedIdentity as TlsIdentity, ImportedPsk, PskKeyExchangeMode};
use rustls_axon::{
    ClientConfig, ClientConnection, Error, PeerIncompatible, PeerMisbehaved, ServerConfig,
    ServerConnection,
};
use zeroize::Zeroizing;

const KEY: [u8; 32] = [7; 32];
const SERVER_SAE: &str = "base";

/// A server that has one QKD key, and serves clients of both kinds.
#[derive(Debug)]
struct Base(Cipher);

impl PskResolver for Base {
    fn resolve(&self, identity: &[u8]) -> Option<Arc<Psk>> {
        let psk = if identity.first() == Some(&0) {
            let identity = ImportedIdentity::parse(identity).ok()?;
            let wanted = (identity.key_id(), identity.server_sae(), identity.cipher());
            if wanted != ("key-1", SERVER_SAE, self.0) {
                return None;
            }
            import_psk(&KEY, "key-1", identity.client_sae(), SERVER_SAE, self.0)
        } else {
            let identity = PskIdentity::parse(identity).ok()?;
            derive_psk(&KEY, identity.key_id(), identity.client_sae(), SERVER_SAE, self.0)
        };
        psk.ok().map(Arc::new)
    }
}

fn handshake(client: ClientConfig, cipher: Cipher, kex: PskKex) -> Result<KeyExchange, Error> {
    let server = qkd::server_config(Arc::new(Base(cipher)), cipher, kex, b"").unwrap();
    connect(client, server)
}

fn handshake_with(
    resolver: Arc<EveryHash>,
    client: ClientConfig,
    cipher: Cipher,
) -> Result<KeyExchange, Error> {
    connect(client, qkd::server_config(resolver, cipher, PskKex::PskKe, b"").unwrap())
}

fn connect(client: ClientConfig, server: ServerConfig) -> Result<KeyExchange, Error> {
    let name = "base".try_into().unwrap();
    let mut client = ClientConnection::new(Arc::new(client), name).unwrap();
    let mut server = ServerConnection::new(Arc::new(server)).unwrap();
    while client.is_handshaking() || server.is_handshaking() {
        let mut records = Vec::new();
        while client.wants_write() {
            client.write_tls(&mut records).unwrap();
        }
        // a long offer takes more than one read
        let mut unread = &records[..];
        while !unread.is_empty() {
            server.read_tls(&mut unread).unwrap();
            server.process_new_packets()?;
        }
        records.clear();
        while server.wants_write() {
            server.write_tls(&mut records).unwrap();
        }
        client.read_tls(&mut &records[..]).unwrap();
        client.process_new_packets()?;
    }
    let [ours, theirs] = [qkd::negotiated(&client), qkd::negotiated(&server)];
    assert_eq!(ours, theirs);
    Ok(ours.unwrap().key_exchange)
}

#[test]
fn both_kinds_of_clients_are_served() {
    for cipher in Cipher::ALL {
        for (kex, exchange) in
            [(PskKex::PskKe, KeyExchange::PskKe), (PskKex::PskDheKe, KeyExchange::PskDheKe)]
        {
            for make in [derive_psk, import_psk] {
                let psk = make(&KEY, "key-1", "robot", SERVER_SAE, cipher).unwrap();
                let client = qkd::client_config(Arc::new(psk), kex, b"").unwrap();
                assert_eq!(handshake(client, cipher, kex), Ok(exchange));
            }
        }
    }
}

/// A stranger that knows RFC 9258 and the context alone, and nothing of this crate.
#[test]
fn a_stranger_imports_the_same() {
    let import = |context: &[u8]| {
        let identity = TlsIdentity::new(b"key-1", context, HashAlgorithm::SHA384).unwrap();
        let suite = cipher_suite::TLS13_AES_128_GCM_SHA256.tls13().unwrap();
        let psk = ImportedPsk::new(identity, &Zeroizing::new(KEY.to_vec()), suite).unwrap();
        let provider = CryptoProvider {
            cipher_suites: vec![cipher_suite::TLS13_AES_256_GCM_SHA384],
            kx_groups: vec![],
            ..default_provider()
        };
        ClientConfig::builder_with_provider(Arc::new(provider))
            .with_external_psks(vec![psk.into()], PskKeyExchangeMode::PskKe)
            .unwrap()
    };
    let run = |context| handshake(import(context), Cipher::Aes256Gcm, PskKex::PskKe);
    for other in [&b""[..], b"\x00\x04base\x00\x05robot", b"\x00\x05robot\x00\x05other"] {
        assert!(run(other).is_err(), "{}", other.escape_ascii());
    }
    assert_eq!(run(b"\x00\x05robot\x00\x04base"), Ok(KeyExchange::PskKe));
}

/// Knows one QKD key, imported for whatever hash is asked for, and counts its look-ups.
#[derive(Debug, Default)]
struct EveryHash {
    looked_up: Mutex<Vec<Vec<u8>>>,
    fetched: Mutex<Vec<Vec<u8>>>,
}

impl PskResolver for EveryHash {
    fn resolve(&self, identity: &[u8]) -> Option<Arc<Psk>> {
        self.fetched.lock().unwrap().push(identity.to_vec());
        self.resolve_known(identity)
    }

    fn resolve_known(&self, identity: &[u8]) -> Option<Arc<Psk>> {
        self.looked_up.lock().unwrap().push(identity.to_vec());
        let named = ImportedIdentity::parse(identity).ok()?;
        let known = named.key_id() == "key-1" && named.server_sae() == SERVER_SAE;
        let psk = import_psk(&KEY, "key-1", named.client_sae(), SERVER_SAE, named.cipher());
        known.then(|| Arc::new(psk.unwrap()))
    }
}

/// Returns the configuration of a stranger that offers a QKD key under each hash, or keys that the server does not
/// know.
fn offering(offers: &[(&str, [u8; 32], HashAlgorithm)]) -> ClientConfig {
    let import = |(key_id, key, hash): &(&str, [u8; 32], HashAlgorithm)| {
        let context = b"\x00\x05robot\x00\x04base";
        let identity = TlsIdentity::new(key_id.as_bytes(), context, *hash).unwrap();
        let suite = cipher_suite::TLS13_AES_128_GCM_SHA256.tls13().unwrap();
        ImportedPsk::new(identity, &Zeroizing::new(key.to_vec()), suite).unwrap().into()
    };
    let provider = CryptoProvider {
        cipher_suites: vec![
            cipher_suite::TLS13_AES_256_GCM_SHA384,
            cipher_suite::TLS13_CHACHA20_POLY1305_SHA256,
        ],
        kx_groups: vec![],
        ..default_provider()
    };
    ClientConfig::builder_with_provider(Arc::new(provider))
        .with_external_psks(offers.iter().map(import).collect(), PskKeyExchangeMode::PskKe)
        .unwrap()
}

/// RFC 8446 4.2.11 and RFC 9258 5.1: the server takes the key that goes with its cipher, wherever it
/// stands in the offer.
#[test]
fn a_server_takes_a_later_identity_that_it_knows() {
    use HashAlgorithm::{SHA256, SHA384};
    let pairs = [[SHA256, SHA384], [SHA384, SHA256]];
    for cipher in Cipher::ALL {
        for pair in pairs {
            let offers = pair.map(|hash| ("key-1", KEY, hash));
            let resolver = Arc::new(EveryHash::default());
            let agreed = handshake_with(resolver.clone(), offering(&offers), cipher);
            assert_eq!(agreed, Ok(KeyExchange::PskKe), "{cipher}, {pair:?}");
            assert!(resolver.fetched.lock().unwrap().is_empty(), "a known key costs no fetch");
        }

        let hash = if cipher == Cipher::Aes256Gcm { SHA384 } else { SHA256 };
        let offers = [("key-0", KEY, hash), ("key-1", KEY, hash)];
        let resolver = Arc::new(EveryHash::default());
        let agreed = handshake_with(resolver.clone(), offering(&offers), cipher);
        assert_eq!(agreed, Ok(KeyExchange::PskKe), "{cipher}, an unknown key first");

        let offers = [("key-0", KEY, hash), ("key-1", [8; 32], hash)];
        let refused = handshake_with(Arc::new(EveryHash::default()), offering(&offers), cipher);
        assert_eq!(refused, Err(PeerMisbehaved::IncorrectBinder.into()), "{cipher}");

        let offers = [("key-0", KEY, hash), ("key-2", KEY, hash)];
        let resolver = Arc::new(EveryHash::default());
        let refused = handshake_with(resolver.clone(), offering(&offers), cipher);
        assert_eq!(refused, Err(PeerIncompatible::UnknownExternalPskIdentity.into()), "{cipher}");
        assert_eq!(resolver.fetched.lock().unwrap().len(), 1, "the first one alone is fetched");
    }
}

/// One ClientHello cannot have a server look a thousand identities up.
#[test]
fn a_server_looks_up_eight_identities_at_most() {
    let names: Vec<String> = (0..500).map(|number| format!("unknown-{number}")).collect();
    let offers: Vec<_> =
        names.iter().map(|name| (name.as_str(), KEY, HashAlgorithm::SHA256)).collect();
    let resolver = Arc::new(EveryHash::default());
    assert!(handshake_with(resolver.clone(), offering(&offers), Cipher::default()).is_err());
    assert_eq!(resolver.looked_up.lock().unwrap().len(), 8 + 1);
    assert_eq!(resolver.fetched.lock().unwrap().len(), 1);
}

#[test]
fn a_server_takes_the_eighth_identity_and_not_the_ninth() {
    let names: Vec<String> = (0..8).map(|number| format!("unknown-{number}")).collect();
    let refused: Error = PeerIncompatible::UnknownExternalPskIdentity.into();
    for (unknown, agreed) in [(7, Ok(KeyExchange::PskKe)), (8, Err(refused))] {
        let offers: Vec<_> = names[..unknown]
            .iter()
            .map(String::as_str)
            .chain(["key-1"])
            .map(|name| (name, KEY, HashAlgorithm::SHA256))
            .collect();
        let resolver = Arc::new(EveryHash::default());
        let cipher = Cipher::ChaCha20Poly1305;
        assert_eq!(handshake_with(resolver, offering(&offers), cipher), agreed, "{unknown}");
    }
}

#[test]
fn another_key_or_name_is_refused() {
    let (cipher, kex) = (Cipher::default(), PskKex::PskKe);
    for (key, key_id, server) in
        [([8; 32], "key-1", "base"), (KEY, "key-2", "base"), (KEY, "key-1", "other")]
    {
        let psk = import_psk(&key, key_id, "robot", server, cipher).unwrap();
        let client = qkd::client_config(Arc::new(psk), kex, b"").unwrap();
        assert!(handshake(client, cipher, kex).is_err(), "{key_id}, {server}");
    }
}
