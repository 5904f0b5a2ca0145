//! Peers that show the right key and sign with another one, in another scheme or over something else;
//! peers that take other signatures alone; peers with nothing after TLS 1.2.
#![cfg(feature = "hybrid")]

#[path = "common/anybody.rs"]
mod anybody;

use std::sync::Arc;

use axon_tls::identity::{
    Auth, CaMaterial, KeyAlgorithm, SigningKey, SpkiDigest, Trust, TrustFile,
};
use axon_tls::{Cipher, hybrid};
use rustls::client::{AlwaysResolvesClientRawPublicKeys, ResolvesClientCert};
use rustls::crypto::aws_lc_rs::{default_provider, sign::any_supported_type};
use rustls::pki_types::{PrivateKeyDer, SubjectPublicKeyInfoDer};
use rustls::server::{AlwaysResolvesServerRawPublicKeys, ResolvesServerCert};
use rustls::sign::CertifiedKey;
use rustls::version::{TLS12, TLS13};
use rustls::{
    ClientConfig, ClientConnection, Error, PeerIncompatible, ServerConfig, ServerConnection,
    SignatureAlgorithm, SignatureScheme,
};

use self::anybody::Anybody;

type Key = Arc<dyn rustls::sign::SigningKey>;

/// The parts from which a peer makes its CertificateVerify.
#[derive(Clone, Debug)]
struct Forger {
    /// The public key that the peer shows.
    shown: Vec<u8>,
    /// The key with which the peer signs, if it signs at all.
    key: Option<Key>,
    /// The scheme that it says it has signed in.
    claimed: SignatureScheme,
    /// Whether it signs as if it were in the other role.
    other_role: bool,
}

impl rustls::sign::SigningKey for Forger {
    fn choose_scheme(&self, _offered: &[SignatureScheme]) -> Option<Box<dyn rustls::sign::Signer>> {
        Some(Box::new(self.clone()))
    }

    fn public_key(&self) -> Option<SubjectPublicKeyInfoDer<'_>> {
        Some(self.shown.as_slice().into())
    }

    fn algorithm(&self) -> SignatureAlgorithm {
        SignatureAlgorithm::ED25519
    }
}

impl rustls::sign::Signer for Forger {
    fn sign(&self, message: &[u8]) -> Result<Vec<u8>, Error> {
        let Some(key) = &self.key else { return Ok(Vec::new()) };
        let mut message = message.to_vec();
        if self.other_role {
            // 64 spaces, then "TLS 1.3, client CertificateVerify", or server
            let role = &mut message[64 + 9..][..6];
            let other = if role == b"client" { b"server" } else { b"client" };
            role.copy_from_slice(other);
        }
        key.choose_scheme(&every_scheme()).unwrap().sign(&message)
    }

    fn scheme(&self) -> SignatureScheme {
        self.claimed
    }
}

fn every_scheme() -> Vec<SignatureScheme> {
    default_provider().signature_verification_algorithms.supported_schemes()
}

/// A client or a server on rustls as released, with a key to show and schemes to take.
struct Stranger {
    shown: Arc<CertifiedKey>,
    takes: Vec<SignatureScheme>,
}

impl Stranger {
    fn new(key: Key, takes: Vec<SignatureScheme>) -> Self {
        let spki = key.public_key().unwrap().as_ref().to_vec();
        Self { shown: Arc::new(CertifiedKey::new(vec![spki.into()], key)), takes }
    }

    fn client(&self) -> ClientConnection {
        let resolver: Arc<dyn ResolvesClientCert> =
            Arc::new(AlwaysResolvesClientRawPublicKeys::new(Arc::clone(&self.shown)));
        let config = ClientConfig::builder_with_provider(Arc::new(hybrid::provider()))
            .with_protocol_versions(&[&TLS13])
            .unwrap()
            .dangerous()
            .with_custom_certificate_verifier(Arc::new(Anybody {
                schemes: self.takes.clone(),
                raw: true,
            }))
            .with_client_cert_resolver(resolver);
        ClientConnection::new(Arc::new(config), "peer".try_into().unwrap()).unwrap()
    }

    fn server(&self) -> ServerConnection {
        let resolver: Arc<dyn ResolvesServerCert> =
            Arc::new(AlwaysResolvesServerRawPublicKeys::new(Arc::clone(&self.shown)));
        let config = ServerConfig::builder_with_provider(Arc::new(hybrid::provider()))
            .with_protocol_versions(&[&TLS13])
            .unwrap()
            .with_client_cert_verifier(Arc::new(Anybody { schemes: self.takes.clone(), raw: true }))
            .with_cert_resolver(resolver);
        ServerConnection::new(Arc::new(config)).unwrap()
    }
}

fn our_client(auth: &Auth) -> ClientConnection {
    let config = hybrid::client_config(auth, Cipher::default(), b"").unwrap();
    ClientConnection::new(Arc::new(config), "peer".try_into().unwrap()).unwrap()
}

fn our_server(auth: &Auth) -> ServerConnection {
    let config = hybrid::server_config(auth, Cipher::default(), b"").unwrap();
    ServerConnection::new(Arc::new(config)).unwrap()
}

/// The result of each end.
struct Outcome {
    client: Result<(), Error>,
    server: Result<(), Error>,
}

fn handshake(client: &mut ClientConnection, server: &mut ServerConnection) -> Outcome {
    let mut outcome = Outcome { client: Ok(()), server: Ok(()) };
    while client.wants_write() || server.wants_write() {
        let mut records = Vec::new();
        while client.wants_write() {
            client.write_tls(&mut records).unwrap();
        }
        let mut unread = &records[..];
        while !unread.is_empty() && outcome.server.is_ok() {
            server.read_tls(&mut unread).unwrap();
            outcome.server = server.process_new_packets().map(drop);
        }
        records.clear();
        while server.wants_write() {
            server.write_tls(&mut records).unwrap();
        }
        let mut unread = &records[..];
        while !unread.is_empty() && outcome.client.is_ok() {
            client.read_tls(&mut unread).unwrap();
            outcome.client = client.process_new_packets().map(drop);
        }
    }
    outcome
}

/// Creates a key of an algorithm that we generate ourselves, for us and for a stranger.
fn ours(algorithm: KeyAlgorithm) -> (SigningKey, Key) {
    let pem = SigningKey::generate_pem_with(algorithm).unwrap();
    let der = rustls::pki_types::pem::PemObject::from_pem_slice(pem.as_bytes()).unwrap();
    (SigningKey::from_pem(&pem).unwrap(), any_supported_type(&PrivateKeyDer::Pkcs8(der)).unwrap())
}

fn ecdsa() -> Key {
    let key = rcgen::KeyPair::generate().unwrap().serialize_der();
    any_supported_type(&PrivateKeyDer::try_from(key).unwrap()).unwrap()
}

fn rsa() -> Key {
    use aws_lc_rs::encoding::{AsDer, Pkcs8V1Der};
    let key = aws_lc_rs::rsa::KeyPair::generate(aws_lc_rs::rsa::KeySize::Rsa2048).unwrap();
    let der: Pkcs8V1Der<'_> = key.as_der().unwrap();
    any_supported_type(&PrivateKeyDer::try_from(der.as_ref().to_vec()).unwrap()).unwrap()
}

fn pinned(key: &SigningKey, peer: SpkiDigest) -> Auth {
    let trust = TrustFile::parse(&format!("peer {peer}")).unwrap();
    Auth::Pinned { key: key.clone(), trust: Trust::new(trust) }
}

#[test]
fn a_key_is_not_proven_by_a_signature_of_another_scheme() {
    let (us, _) = ours(KeyAlgorithm::MlDsa65);
    let (ed25519, ml_dsa) = (ours(KeyAlgorithm::Ed25519).1, ours(KeyAlgorithm::MlDsa65).1);
    let (ecdsa, rsa) = (ecdsa(), rsa());
    for algorithm in [KeyAlgorithm::MlDsa65, KeyAlgorithm::Ed25519] {
        let (peer, genuine) = ours(algorithm);
        let right = match algorithm {
            KeyAlgorithm::Ed25519 => SignatureScheme::ED25519,
            _ => SignatureScheme::ML_DSA_65,
        };
        let honest = Forger {
            shown: genuine.public_key().unwrap().as_ref().to_vec(),
            key: Some(Arc::clone(&genuine)),
            claimed: right,
            other_role: false,
        };
        let by =
            |key: &Key, claimed| Forger { key: Some(Arc::clone(key)), claimed, ..honest.clone() };
        let forgers = [
            // a key of the attacker's own, with and without a lie about it
            by(&ed25519, SignatureScheme::ED25519),
            by(&ed25519, SignatureScheme::ML_DSA_65),
            by(&ml_dsa, SignatureScheme::ML_DSA_65),
            by(&ml_dsa, SignatureScheme::ED25519),
            by(&ecdsa, SignatureScheme::ECDSA_NISTP256_SHA256),
            by(&ecdsa, right),
            by(&rsa, SignatureScheme::RSA_PSS_SHA256),
            by(&rsa, SignatureScheme::RSA_PKCS1_SHA256),
            by(&rsa, SignatureScheme::RSA_PKCS1_SHA1),
            by(&rsa, right),
            // the right signature under a wrong name
            by(&genuine, SignatureScheme::ML_DSA_44),
            by(&genuine, SignatureScheme::ML_DSA_87),
            by(&genuine, SignatureScheme::ECDSA_NISTP256_SHA256),
            by(&genuine, SignatureScheme::ED448),
            by(&genuine, SignatureScheme::Unknown(0xfe00)),
            // of the other role, and none at all
            Forger { other_role: true, ..honest.clone() },
            Forger { key: None, ..honest.clone() },
        ];
        for auth in [pinned(&us, peer.spki_digest()), Auth::None(us.clone())] {
            for forger in &forgers {
                let stranger = Stranger::new(Arc::new(forger.clone()), every_scheme());
                let (mut client, mut server) = (our_client(&auth), stranger.server());
                let refused = handshake(&mut client, &mut server).client;
                assert!(refused.is_err(), "{auth:?} of a server: {forger:?}");
                assert_eq!(hybrid::negotiated(&client), None);

                let (mut client, mut server) = (stranger.client(), our_server(&auth));
                let refused = handshake(&mut client, &mut server).server;
                assert!(refused.is_err(), "{auth:?} of a client: {forger:?}");
                assert_eq!(hybrid::negotiated(&server), None);
            }

            // what is refused above is the signature
            let stranger = Stranger::new(Arc::new(honest.clone()), every_scheme());
            let (mut client, mut server) = (our_client(&auth), stranger.server());
            let outcome = handshake(&mut client, &mut server);
            assert_eq!((outcome.client, outcome.server), (Ok(()), Ok(())));
            assert_eq!(hybrid::negotiated(&client).unwrap().peer, Some(peer.spki_digest()));
            let (mut client, mut server) = (stranger.client(), our_server(&auth));
            let outcome = handshake(&mut client, &mut server);
            assert_eq!((outcome.client, outcome.server), (Ok(()), Ok(())));
            assert_eq!(hybrid::negotiated(&server).unwrap().peer, Some(peer.spki_digest()));
        }
    }
}

/// We sign with the one key that we have, or not at all.
#[test]
fn a_peer_that_takes_other_signatures_alone_gets_none() {
    let (us, _) = ours(KeyAlgorithm::MlDsa65);
    for takes in [
        vec![SignatureScheme::ED25519],
        vec![SignatureScheme::ECDSA_NISTP256_SHA256, SignatureScheme::ED25519],
        vec![SignatureScheme::RSA_PSS_SHA256],
        vec![SignatureScheme::ML_DSA_44],
    ] {
        let stranger = Stranger::new(ours(KeyAlgorithm::Ed25519).1, takes.clone());
        let auth = Auth::None(us.clone());
        let (mut client, mut server) = (stranger.client(), our_server(&auth));
        let refused = handshake(&mut client, &mut server).server.unwrap_err();
        let expected = PeerIncompatible::NoSignatureSchemesInCommon;
        assert_eq!(refused, Error::PeerIncompatible(expected), "{takes:?}");

        // a client says that it has no certificate, and then the server decides
        let (mut client, mut server) = (our_client(&auth), stranger.server());
        assert!(handshake(&mut client, &mut server).server.is_err(), "{takes:?}");
    }
}

#[test]
fn tls12_is_refused_under_every_authentication() {
    let certified = rcgen::generate_simple_self_signed(["peer".to_owned()]).unwrap();
    let (cert, key) = (certified.cert.pem(), certified.signing_key.serialize_pem());
    let (us, _) = ours(KeyAlgorithm::Ed25519);
    let material = CaMaterial::from_pem(&cert, &cert, &key, None).unwrap();
    let auths =
        [Auth::None(us.clone()), pinned(&us, us.spki_digest()), Auth::Ca(Arc::new(material))];
    for auth in auths {
        let provider = Arc::new(default_provider());
        let client = ClientConfig::builder_with_provider(Arc::clone(&provider))
            .with_protocol_versions(&[&TLS12])
            .unwrap()
            .dangerous()
            .with_custom_certificate_verifier(Arc::new(Anybody {
                schemes: every_scheme(),
                raw: true,
            }))
            .with_no_client_auth();
        let name = "peer".try_into().unwrap();
        let mut client = ClientConnection::new(Arc::new(client), name).unwrap();
        let mut server = our_server(&auth);
        let refused = handshake(&mut client, &mut server).server.unwrap_err();
        assert!(matches!(refused, Error::PeerIncompatible(_)), "{auth:?}: {refused:?}");

        let key = PrivateKeyDer::try_from(certified.signing_key.serialize_der()).unwrap();
        let server = ServerConfig::builder_with_provider(provider)
            .with_protocol_versions(&[&TLS12])
            .unwrap()
            .with_no_client_auth()
            .with_single_cert(vec![certified.cert.der().clone()], key)
            .unwrap();
        let mut server = ServerConnection::new(Arc::new(server)).unwrap();
        let mut client = our_client(&auth);
        let outcome = handshake(&mut client, &mut server);
        assert!(outcome.server.is_err() && outcome.client.is_err(), "{auth:?}");
    }
}
