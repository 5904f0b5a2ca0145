//! Which PSK of several a server takes.

use std::fmt;
use std::sync::Arc;

use rustls_axon::crypto::hash::HashAlgorithm;
use rustls_axon::external_psk::{
    ExternalPsk, ExternalPskOffer, ImportedIdentity, ImportedPsk, PskKeyExchangeMode,
    ResolvesExternalPsk,
};
use rustls_axon::{ServerConfig, SupportedCipherSuite};
use zeroize::Zeroizing;

use crate::common::*;
use crate::peer::{plaintext, records, ClientHello, Offer, HANDSHAKE};

const SECRET: [u8; 32] = [1; 32];
const MODE: PskKeyExchangeMode = PskKeyExchangeMode::PskKe;

/// One base key, imported for both hashes (RFC 9258 5.1).
fn imported(suite: SupportedCipherSuite) -> Arc<ExternalPsk> {
    let hash = hash_of(suite);
    let identity = ImportedIdentity::new(b"base key", b"client to server", hash).unwrap();
    let base_key = Zeroizing::new(vec![7; 32]);
    ImportedPsk::new(identity, &base_key, SHA256.tls13().unwrap()).unwrap().into()
}

fn server_on(
    suites: &[SupportedCipherSuite],
    resolver: Arc<dyn ResolvesExternalPsk>,
) -> ServerConfig {
    server_config_over(suites, &[], resolver, MODE)
}

/// Whatever the order of the offer and of the resolver, the PSK that goes with the server's suite is
/// taken, and under the binder that stands at its place.
#[test]
fn server_takes_the_imported_psk_of_its_hash_in_either_order() {
    for offered in [[SHA256, SHA384], [SHA384, SHA256]] {
        for known in [[SHA256, SHA384], [SHA384, SHA256]] {
            for suite in [SHA256, SHA384] {
                let psks = offered.map(imported).to_vec();
                let mut client = client(client_config(&[SHA256, SHA384], psks, MODE));
                let resolver = Known::new(known.map(imported).to_vec());
                let mut server = server(server_on(&[suite], resolver));
                handshake(&mut client, &mut server).unwrap();
                let expected = imported(suite);
                for used in [client.external_psk(), server.external_psk()] {
                    assert_eq!(used.unwrap().identity(), expected.identity());
                }
                assert_eq!(client.negotiated_cipher_suite(), Some(suite));
            }
        }
    }
}

/// The answer of a server that knows `a` and nothing else: the index it selects, or its alert.
fn answer(offers: Vec<Offer>, binders: Option<Vec<Vec<u8>>>) -> Result<u16, u8> {
    let resolver = Known::new(vec![psk("a", 1, SHA256)]);
    let mut server = server(server_on(&[SHA256], resolver));
    let hello = ClientHello { binders, ..ClientHello::new(offers) };
    let result = feed(&mut server, &records(HANDSHAKE, &hello.encode()));
    let flight = written(&mut server);
    match result {
        Ok(()) => {
            let hello = plaintext(&flight);
            let at = hello.windows(4).position(|window| window == [0, 41, 0, 2]).unwrap() + 4;
            Ok(u16::from_be_bytes([hello[at], hello[at + 1]]))
        }
        Err(_) => Err(*flight.last().unwrap()),
    }
}

#[test]
fn server_takes_the_second_identity_under_its_own_binder() {
    let right = || Offer::new("a", &SECRET);
    let unknown = || Offer::new("b", &SECRET);
    let wrong = || Offer::new("a", &[2; 32]);
    for (what, offers, expected) in [
        ("known and unknown", vec![right(), unknown()], Ok(0)),
        ("unknown and known", vec![unknown(), right()], Ok(1)),
        ("the third", vec![unknown(), Offer::new("c", &SECRET), right()], Ok(2)),
        ("unknown, and known with a wrong binder", vec![unknown(), wrong()], Err(51)),
        ("known with a wrong binder, and unknown", vec![wrong(), unknown()], Err(51)),
        // the first place of a name counts, a right binder elsewhere does not
        ("the name twice, wrong first", vec![wrong(), right()], Err(51)),
        ("the name twice, right first", vec![right(), wrong()], Ok(0)),
        ("all unknown", vec![unknown(), Offer::new("c", &SECRET)], Err(115)),
    ] {
        assert_eq!(answer(offers, None), expected, "{what}");
    }

    // the binders of both, swapped: right ones at the wrong place
    let offers = vec![unknown(), right()];
    let encoded = ClientHello::new(offers.clone()).encode();
    let [first, second] = [1, 0].map(|back| {
        let end = encoded.len() - 33 * back;
        encoded[end - 32..end].to_vec()
    });
    assert_eq!(answer(offers.clone(), Some(vec![first.clone(), second.clone()])), Ok(1));
    let other = vec![Offer::new("b", &[2; 32]), right()];
    let encoded = ClientHello::new(other.clone()).encode();
    let [first, second] = [1, 0].map(|back| {
        let end = encoded.len() - 33 * back;
        encoded[end - 32..end].to_vec()
    });
    assert_eq!(answer(other.clone(), Some(vec![first.clone(), second.clone()])), Ok(1));
    assert_eq!(answer(other, Some(vec![second, first])), Err(51));
}

/// A resolver that compares names carelessly: the server compares them by itself.
struct Careless;

impl fmt::Debug for Careless {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Careless")
    }
}

impl ResolvesExternalPsk for Careless {
    fn resolve(&self, _: ExternalPskOffer<'_>) -> Option<Arc<ExternalPsk>> {
        Some(psk("a", 1, SHA256))
    }
}

/// RFC 9257 6.1.1: identities are compared byte by byte.
#[test]
fn an_identity_that_differs_in_one_byte_is_another() {
    for (offered, alert) in [("a", None), ("A", Some(80)), ("a\0", Some(80)), ("aa", Some(80))] {
        let mut server = server(server_on(&[SHA256], Arc::new(Careless)));
        let hello = ClientHello::new(vec![Offer::new(offered, &SECRET)]).encode();
        let refused = feed(&mut server, &records(HANDSHAKE, &hello)).is_err();
        assert_eq!(refused.then(|| *written(&mut server).last().unwrap()), alert, "{offered:?}");
    }
}

/// Knows a PSK under every name, and none of them goes with a suite of the server.
struct WrongHash(std::sync::atomic::AtomicUsize);

impl fmt::Debug for WrongHash {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("WrongHash")
    }
}

impl ResolvesExternalPsk for WrongHash {
    fn resolve(&self, offer: ExternalPskOffer<'_>) -> Option<Arc<ExternalPsk>> {
        self.0.fetch_add(1, std::sync::atomic::Ordering::Relaxed);
        let identity = offer.identities().next()?;
        let secret = Zeroizing::new(vec![1; 48]);
        let psk = ExternalPsk::new(identity, secret, HashAlgorithm::SHA384).unwrap();
        assert!(!offer.accepts(&psk));
        Some(Arc::new(psk))
    }
}

/// One ClientHello does not cause a look-up for each of a thousand identities.
#[test]
fn psks_of_the_wrong_hash_are_passed_over_a_few_times() {
    for (count, asked) in [(1_u16, 1), (3, 3), (1_000, 9)] {
        let resolver = Arc::new(WrongHash(Default::default()));
        let mut server = server(server_on(&[SHA256], resolver.clone()));
        let offers = (0..count).map(|number| Offer::new(number.to_be_bytes(), &SECRET)).collect();
        let binders = Some(vec![vec![9; 32]; usize::from(count)]);
        let hello = ClientHello { binders, ..ClientHello::new(offers) };
        assert!(feed(&mut server, &records(HANDSHAKE, &hello.encode())).is_err());
        assert_eq!(written(&mut server).last(), Some(&40), "{count}");
        assert_eq!(resolver.0.load(std::sync::atomic::Ordering::Relaxed), asked, "{count}");
    }
}
