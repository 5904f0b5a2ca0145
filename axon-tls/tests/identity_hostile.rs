//! Peers that show a certificate that is not theirs, or that is none: every one is refused, in either role, and
//! the end that checks it does not panic.
#![cfg(feature = "hybrid")]

use std::sync::Arc;

use axon_tls::identity::{Auth, CaMaterial, KeyAlgorithm, Probe, SigningKey};
use axon_tls::{Cipher, hybrid};
use rcgen::{BasicConstraints, CertificateParams, IsCa, Issuer, KeyPair, KeyUsagePurpose};
use rustls::client::ResolvesClientCert;
use rustls::crypto::aws_lc_rs::sign::any_supported_type;
use rustls::pki_types::{CertificateDer, PrivateKeyDer, PrivatePkcs8KeyDer, pem::PemObject};
use rustls::server::{ClientHello, ResolvesServerCert};
use rustls::sign::CertifiedKey;
use rustls::{ClientConnection, Connection, ServerConnection, SignatureScheme};

/// Shows anything, and signs with its own key.
#[derive(Debug)]
struct Shows {
    certified: Arc<CertifiedKey>,
    raw: bool,
}

impl ResolvesServerCert for Shows {
    fn resolve(&self, _: ClientHello<'_>) -> Option<Arc<CertifiedKey>> {
        Some(Arc::clone(&self.certified))
    }

    fn only_raw_public_keys(&self) -> bool {
        self.raw
    }
}

impl ResolvesClientCert for Shows {
    fn resolve(&self, _: &[&[u8]], _: &[SignatureScheme]) -> Option<Arc<CertifiedKey>> {
        Some(Arc::clone(&self.certified))
    }

    fn only_raw_public_keys(&self) -> bool {
        self.raw
    }

    fn has_certs(&self) -> bool {
        true
    }
}

fn signs(pem: &str) -> Arc<dyn rustls::sign::SigningKey> {
    let der = PrivatePkcs8KeyDer::from_pem_slice(pem.as_bytes()).unwrap();
    any_supported_type(&PrivateKeyDer::Pkcs8(der)).unwrap()
}

/// Connects `us` with a peer that shows `chain`, in both roles. Returns whether our side accepts.
fn meet(us: &Auth, chain: &[Vec<u8>], key: &Arc<dyn rustls::sign::SigningKey>) -> [bool; 2] {
    let raw = !matches!(us, Auth::Ca(_));
    let chain = chain.iter().map(|der| CertificateDer::from(der.clone())).collect();
    let certified = Arc::new(CertifiedKey::new(chain, Arc::clone(key)));
    let shows = Arc::new(Shows { certified, raw });
    // The peer's configuration is one of ours, except for what it shows.
    let anybody = Auth::None(SigningKey::generate().unwrap());
    let base = if raw { &anybody } else { us };
    let cipher = Cipher::default();
    let mut server = hybrid::server_config(base, cipher, b"").unwrap();
    server.cert_resolver = shows.clone();
    let mut client = hybrid::client_config(base, cipher, b"").unwrap();
    client.client_auth_cert_resolver = shows;
    let name = || "peer".try_into().unwrap();

    let ours = hybrid::client_config(us, cipher, b"").unwrap();
    let dialling = ClientConnection::new(Arc::new(ours), name()).unwrap();
    let server = ServerConnection::new(Arc::new(server)).unwrap();
    let ours = hybrid::server_config(us, cipher, b"").unwrap();
    let answering = ServerConnection::new(Arc::new(ours)).unwrap();
    let client = ClientConnection::new(Arc::new(client), name()).unwrap();
    [accepts(dialling.into(), server.into()), accepts(answering.into(), client.into())]
}

/// Returns whether `us` finishes the handshake.
fn accepts(mut us: Connection, mut peer: Connection) -> bool {
    for _ in 0..6 {
        for _ in 0..2 {
            std::mem::swap(&mut us, &mut peer);
            let mut wire = Vec::new();
            while us.wants_write() {
                us.write_tls(&mut wire).unwrap();
            }
            let mut unread = &wire[..];
            while !unread.is_empty() {
                peer.read_tls(&mut unread).unwrap();
                let _ = peer.process_new_packets();
            }
        }
    }
    !us.is_handshaking() && hybrid::negotiated(&us).is_some()
}

/// Returns mutations: cut at each byte, with one bit of each byte flipped, and with bytes appended.
fn mutations(whole: &[u8]) -> Vec<Vec<u8>> {
    let cut = (0..whole.len()).map(|end| whole[..end].to_vec());
    let flipped = (0..whole.len()).map(|at| {
        let mut bytes = whole.to_vec();
        bytes[at] ^= 1 << (at % 8);
        bytes
    });
    let longer = [whole.to_vec(), vec![0]].concat();
    cut.chain(flipped).chain([longer, vec![0x30; 60_000], vec![0xff; 300]]).collect()
}

#[test]
fn raw_key_of_another_signer_is_refused_even_if_any_key_is_accepted() {
    let anybody = Auth::None(SigningKey::generate().unwrap());
    let pem = SigningKey::generate_pem_with(KeyAlgorithm::Ed25519).unwrap();
    let key = signs(&pem);
    let own = key.public_key().unwrap().to_vec();
    assert_eq!(meet(&anybody, std::slice::from_ref(&own), &key), [true, true]);
    for shown in mutations(&own) {
        assert_eq!(
            meet(&anybody, std::slice::from_ref(&shown), &key),
            [false, false],
            "{shown:02x?}"
        );
    }
    assert_eq!(meet(&anybody, &[], &key), [false, false], "no key at all");
    // Somebody else's key is as public as a name is.
    for algorithm in [KeyAlgorithm::Ed25519, KeyAlgorithm::MlDsa65] {
        let other = signs(&SigningKey::generate_pem_with(algorithm).unwrap());
        let shown = other.public_key().unwrap().to_vec();
        assert_eq!(meet(&anybody, &[shown], &key), [false, false], "{algorithm:?}");
    }
}

#[test]
fn a_certificate_with_one_bit_changed_is_refused() {
    let mut params = CertificateParams::new([]).unwrap();
    params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
    params.key_usages = vec![KeyUsagePurpose::KeyCertSign];
    let root_key = KeyPair::generate().unwrap();
    let root = params.self_signed(&root_key).unwrap();
    let issuer = Issuer::new(params, root_key);
    let pair = KeyPair::generate().unwrap();
    let params = CertificateParams::new(["host".to_owned()]).unwrap();
    let own = params.signed_by(&pair, &issuer).unwrap();
    let pem = pair.serialize_pem();
    let material = CaMaterial::from_pem(&root.pem(), &own.pem(), &pem, None).unwrap();
    let us = Auth::Ca(Arc::new(material.with_names_checked_by_application()));
    let (key, der) = (signs(&pem), own.der().to_vec());
    assert_eq!(meet(&us, std::slice::from_ref(&der), &key), [true, true]);
    for shown in mutations(&der) {
        assert_eq!(meet(&us, std::slice::from_ref(&shown), &key), [false, false], "{shown:02x?}");
        // Bytes that are no certificate name no host, and do not make the check panic.
        if shown.len() < der.len() {
            assert!(!CaMaterial::is_for_host(&CertificateDer::from(shown), "host"));
        }
    }
    // Without the key it is worth nothing.
    let other = signs(&KeyPair::generate().unwrap().serialize_pem());
    assert_eq!(meet(&us, std::slice::from_ref(&der), &other), [false, false]);
    // More certificates than a chain can have cost no more than a refusal.
    let root = root.der().to_vec();
    let chain: Vec<_> = std::iter::once(der).chain((0..80).map(|_| root.clone())).collect();
    meet(&us, &chain, &key);
}

#[test]
fn a_probe_refuses_malformed_raw_keys() {
    let pem = SigningKey::generate_pem_with(KeyAlgorithm::Ed25519).unwrap();
    let key = signs(&pem);
    let own = key.public_key().unwrap().to_vec();
    let anybody = Auth::None(SigningKey::generate().unwrap());
    for shown in mutations(&own) {
        let probe = Probe::for_raw_key(b"axon/1").unwrap();
        let chain = vec![CertificateDer::from(shown)];
        let certified = Arc::new(CertifiedKey::new(chain, Arc::clone(&key)));
        let mut server = hybrid::server_config(&anybody, Cipher::default(), b"axon/1").unwrap();
        server.cert_resolver = Arc::new(Shows { certified, raw: true });
        let client = ClientConnection::new(probe.client_config(), "peer".try_into().unwrap());
        let server = ServerConnection::new(Arc::new(server)).unwrap();
        assert!(!accepts(client.unwrap().into(), server.into()));
        assert_eq!(probe.shown(), None);
    }
}
