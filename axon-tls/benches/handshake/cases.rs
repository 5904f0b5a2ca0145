//! The handshakes that are compared.
//!
//! What one connection needs for itself is part of its handshake: a connection on a QKD key derives
//! its PSK on both ends and makes a configuration for it. What many connections share is not:
//! certificates, keys, endpoints. Nothing is resumed and no ticket is sent, by anyone.

mod quic;
mod stock;
mod tcp;

use std::fmt;
use std::sync::Arc;

use axon_tls::identity::{Auth, CaMaterial, KeyAlgorithm, SigningKey, Trust, TrustFile};
use axon_tls::qkd::{Psk, PskIdentity, PskResolver, derive_psk};
use axon_tls::{Cipher, PskKex};

pub(crate) const ALPN: &[u8] = b"bench/1";
const CLIENT_SAE: &str = "sae-client";
const SERVER_SAE: &str = "sae-server";
const KEY_ID: &str = "bc490419-7d60-487f-adc1-4ddcc177c139";
const KEY: [u8; 32] = [7; 32];

/// What carries the handshake.
#[derive(Clone, Copy, PartialEq)]
pub(crate) enum Transport {
    Tcp,
    Quic,
}

impl Transport {
    pub(crate) const ALL: [Self; 2] = [Self::Tcp, Self::Quic];
}

impl fmt::Display for Transport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(if *self == Self::Tcp { "TCP" } else { "QUIC" })
    }
}

/// Bytes that a handshake takes: TLS records over TCP, UDP payloads over QUIC.
#[derive(Clone, Copy, Default)]
pub(crate) struct Traffic {
    pub(crate) to_server: usize,
    pub(crate) to_client: usize,
}

/// A kind of handshake.
pub(crate) struct Case {
    pub(crate) name: &'static str,
    /// Does one, from new connections to both ends connected.
    pub(crate) handshake: Box<dyn FnMut() -> Traffic>,
}

/// The first two are rustls as everybody has it: what all others are compared to.
pub(crate) fn all(transport: Transport, cipher: Cipher) -> Vec<Case> {
    let pki = stock::Pki::new();
    let case = |name, handshake| Case { name, handshake };
    let stock = |client_auth| {
        let (client, server) = pki.configs(cipher, client_auth);
        match transport {
            Transport::Tcp => tcp::stock(client, server),
            Transport::Quic => quic::stock(client, server),
        }
    };
    let hybrid = |ends: [Auth; 2]| match transport {
        Transport::Tcp => tcp::hybrid(ends, cipher),
        Transport::Quic => quic::hybrid(ends, cipher),
    };
    let qkd = |kex| match transport {
        Transport::Tcp => tcp::qkd(cipher, kex),
        Transport::Quic => quic::qkd(cipher, kex),
    };
    vec![
        case("stock X25519, server certificate", stock(false)),
        case("stock X25519, mutual certificates", stock(true)),
        case("hybrid, mutual certificates", hybrid(pki.ends())),
        case("hybrid, pinned Ed25519", hybrid(pinned(KeyAlgorithm::Ed25519))),
        case("hybrid, pinned ML-DSA-65", hybrid(pinned(KeyAlgorithm::MlDsa65))),
        case("psk_dhe_ke", qkd(PskKex::PskDheKe)),
        case("psk_ke", qkd(PskKex::PskKe)),
    ]
}

/// Two ends that have each other's key.
fn pinned(algorithm: KeyAlgorithm) -> [Auth; 2] {
    let key = || SigningKey::from_pem(&SigningKey::generate_pem_with(algorithm).unwrap()).unwrap();
    let (client, server) = (key(), key());
    [(&client, &server), (&server, &client)].map(|(ours, theirs)| {
        let file = format!("peer {}", theirs.spki_digest());
        let trust = Trust::new(TrustFile::parse(&file).unwrap());
        Auth::Pinned { key: ours.clone(), trust }
    })
}

impl stock::Pki {
    /// The same certificates for axon-tls.
    fn ends(&self) -> [Auth; 2] {
        [&self.client, &self.server].map(|(cert, key)| {
            let material =
                CaMaterial::from_pem(&self.root.pem(), &cert.pem(), &key.serialize_pem(), None);
            Auth::Ca(Arc::new(material.unwrap()))
        })
    }
}

/// The client's key for one connection.
fn psk(cipher: Cipher) -> Arc<Psk> {
    Arc::new(derive_psk(&KEY, KEY_ID, CLIENT_SAE, SERVER_SAE, cipher).unwrap())
}

/// A server that derives the key of each connection from the QKD key.
#[derive(Debug)]
struct Deriving(Cipher);

impl PskResolver for Deriving {
    fn resolve(&self, identity: &[u8]) -> Option<Arc<Psk>> {
        let identity = PskIdentity::parse(identity).ok()?;
        derive_psk(&KEY, identity.key_id(), identity.client_sae(), SERVER_SAE, self.0)
            .ok()
            .map(Arc::new)
    }
}
