//! Pre-shared keys that are not from QKD, over QUIC: any identity, several of them, and what is refused.
#![cfg(all(feature = "hybrid", feature = "quic"))]

mod common;

use std::sync::Arc;

use axon_tls::psk::{self, Psk, PskResolver, PskTable};
use axon_tls::quic::{hybrid_client, psk_client, psk_server};
use axon_tls::rustls_axon::crypto::aws_lc_rs::cipher_suite::TLS13_AES_256_GCM_SHA384;
use axon_tls::rustls_axon::crypto::hash::HashAlgorithm;
use axon_tls::rustls_axon::external_psk::{ExternalPsk, ImportedIdentity, ImportedPsk};
use axon_tls::zeroize::Zeroizing;
use axon_tls::{Cipher, Error, KeyExchange, PskKex};
use common::connect;

const DECRYPT_ERROR: u8 = 51;
const MISSING_EXTENSION: u8 = 109;
const UNKNOWN_PSK_IDENTITY: u8 = 115;
const ALPN: &[u8] = b"test/1";

fn key(identity: &[u8], secret: u8, cipher: Cipher) -> Arc<Psk> {
    Arc::new(Psk::new(identity, vec![secret; 32].into(), cipher).unwrap())
}

fn table<const N: usize>(keys: [Arc<Psk>; N]) -> Arc<PskTable> {
    Arc::new(PskTable::new(keys).unwrap())
}

/// Connects a client with `keys` and a server with `known`. Returns the identity of the connection, or the alert that
/// ended it.
async fn agreed(keys: Vec<Arc<Psk>>, known: Arc<PskTable>, kex: PskKex) -> Result<Vec<u8>, u8> {
    let cipher = keys[0].cipher();
    let client = psk_client(keys, kex, ALPN).unwrap();
    let outcome = connect(client, psk_server(known, cipher, kex, ALPN).unwrap()).await;
    if outcome.client.is_err() {
        return Err(outcome.alert());
    }
    let (client, server) = outcome.agreed();
    assert_eq!(client, server);
    let key_exchange = match kex {
        PskKex::PskKe => KeyExchange::PskKe,
        PskKex::PskDheKe => KeyExchange::PskDheKe,
    };
    assert_eq!((client.key_exchange, client.cipher), (key_exchange, cipher));
    Ok(client.psk_identity.unwrap())
}

#[tokio::test]
async fn any_identity_works() {
    let long = vec![b'l'; 2_000];
    let very_long: Vec<u8> = (0..40_000).map(|at| at as u8).collect();
    for identity in [
        b"a".as_slice(),
        b"\0",
        b"\xff\xfe:%/ \r\n",
        "Schl\u{fc}ssel".as_bytes(),
        &long,
        &very_long,
    ] {
        for kex in PskKex::ALL {
            let cipher = Cipher::default();
            let known = table([key(b"another", 9, cipher), key(identity, 1, cipher)]);
            assert_eq!(agreed(vec![key(identity, 1, cipher)], known, kex).await.unwrap(), identity);
        }
    }
    let cipher = Cipher::Aes256Gcm;
    let known = table([key(b"a", 1, cipher)]);
    assert_eq!(agreed(vec![key(b"a", 1, cipher)], known, PskKex::PskKe).await.unwrap(), b"a");
}

#[tokio::test]
async fn wrong_key_is_refused() {
    for kex in PskKex::ALL {
        let cipher = Cipher::default();
        let known = table([key(b"a", 2, cipher), key(b"b", 1, cipher)]);
        assert_eq!(agreed(vec![key(b"a", 1, cipher)], known, kex).await, Err(DECRYPT_ERROR));
    }
}

#[tokio::test]
async fn unknown_identity_is_refused() {
    let cipher = Cipher::default();
    for known in [table([]), table([key(b"a ", 1, cipher), key(b"A", 1, cipher)])] {
        let outcome = agreed(vec![key(b"a", 1, cipher)], known, PskKex::PskDheKe).await;
        assert_eq!(outcome, Err(UNKNOWN_PSK_IDENTITY));
    }
}

#[tokio::test]
async fn key_of_another_cipher_is_refused() {
    let [one, other] = Cipher::ALL;
    let known = table([key(b"a", 1, other)]);
    assert!(agreed(vec![key(b"a", 1, one)], known, PskKex::PskKe).await.is_err());
}

#[tokio::test]
async fn client_without_a_key_is_refused() {
    let cipher = Cipher::default();
    let auth = axon_tls::identity::Auth::None(axon_tls::identity::SigningKey::generate().unwrap());
    let server = psk_server(table([key(b"a", 1, cipher)]), cipher, PskKex::PskDheKe, ALPN).unwrap();
    let outcome = connect(hybrid_client(&auth, cipher, ALPN).unwrap(), server).await;
    assert_eq!(outcome.alert(), MISSING_EXTENSION);
}

#[tokio::test]
async fn first_known_identity_of_an_offer_is_taken() {
    let cipher = Cipher::default();
    let offer = || vec![key(b"new", 1, cipher), key(b"old", 2, cipher)];
    let erased = key(b"new", 1, cipher);
    erased.erase();
    for (known, expected) in [
        (table([key(b"new", 1, cipher), key(b"old", 2, cipher)]), b"new"),
        (table([key(b"old", 2, cipher)]), b"old"),
        (table([key(b"new", 1, cipher)]), b"new"),
        // a key of the other hash under the first identity is no key
        (table([key(b"new", 1, Cipher::Aes256Gcm), key(b"old", 2, cipher)]), b"old"),
        // nor is an erased one
        (table([erased, key(b"old", 2, cipher)]), b"old"),
    ] {
        assert_eq!(agreed(offer(), known, PskKex::PskKe).await.unwrap(), expected);
    }
    // the key that is taken decides: the second one is no way around a wrong first one
    let known = table([key(b"new", 7, cipher), key(b"old", 2, cipher)]);
    assert_eq!(agreed(offer(), known, PskKex::PskKe).await, Err(DECRYPT_ERROR));
}

#[tokio::test]
async fn table_changes_while_the_server_runs() {
    let cipher = Cipher::default();
    let known = table([key(b"a", 1, cipher)]);
    let dial = |key| agreed(vec![key], Arc::clone(&known), PskKex::PskKe);
    assert_eq!(dial(key(b"a", 1, cipher)).await.unwrap(), b"a");

    let removed = known.remove(b"a").unwrap();
    assert_eq!(dial(key(b"a", 1, cipher)).await, Err(UNKNOWN_PSK_IDENTITY));
    assert!(known.insert(key(b"a", 2, cipher)).is_none());
    assert_eq!(dial(key(b"a", 1, cipher)).await, Err(DECRYPT_ERROR));
    assert_eq!(dial(key(b"a", 2, cipher)).await.unwrap(), b"a");

    // an erased key is no key, in a table as in an offer
    let replaced = known.insert(removed).unwrap();
    known.resolve(b"a").unwrap().erase();
    assert_eq!(dial(key(b"a", 1, cipher)).await, Err(UNKNOWN_PSK_IDENTITY));
    replaced.erase();
    let config = psk_client(vec![replaced], PskKex::PskKe, ALPN).unwrap();
    let endpoint = quinn::Endpoint::client("127.0.0.1:0".parse().unwrap()).unwrap();
    assert!(endpoint.connect_with(config, "127.0.0.1:9".parse().unwrap(), "axon").is_err());
}

/// An imported key names both roles, and is never taken for one that was not imported.
#[tokio::test]
async fn imported_key_works_and_is_not_mixed_with_others() {
    let base = Zeroizing::new(vec![1; 32]);
    let suite = TLS13_AES_256_GCM_SHA384.tls13().unwrap();
    let identity =
        || ImportedIdentity::new(b"any", b"robot to base", HashAlgorithm::SHA384).unwrap();
    let imported = || {
        let psk = ImportedPsk::new(identity(), &base, suite).unwrap();
        Arc::new(Psk::from(ExternalPsk::from(psk)))
    };
    assert_eq!(imported().cipher(), Cipher::Aes256Gcm);
    let name = imported().identity().to_vec();
    let works = agreed(vec![imported()], table([imported()]), PskKex::PskDheKe).await;
    assert_eq!(works.unwrap(), name);

    let not_imported = Psk::new(name, vec![1; 48].into(), Cipher::Aes256Gcm).unwrap();
    let mixed = agreed(vec![imported()], table([Arc::new(not_imported)]), PskKex::PskKe).await;
    assert_eq!(mixed, Err(DECRYPT_ERROR));
}

#[test]
fn unusable_keys_and_offers_are_refused() {
    let cipher = Cipher::default();
    let new = |identity: &[u8], len| Psk::new(identity, vec![1; len].into(), cipher);
    for (identity, len) in [(&b""[..], 32), (&[1; 65_530], 32), (b"a", 0), (b"a", 15)] {
        assert!(matches!(new(identity, len), Err(Error::RustlsAxon(_))));
    }
    assert!(new(&[1; 65_529], 16).is_ok());

    let refused = |keys| match psk::client_config(keys, PskKex::PskDheKe, ALPN) {
        Err(Error::Psk(why)) => why,
        _ => panic!("not refused"),
    };
    let [one, other] = Cipher::ALL;
    assert!(refused(vec![]).contains("none"));
    assert!(refused(vec![key(b"a", 1, one), key(b"a", 2, one)]).contains("same identity"));
    assert!(refused(vec![key(b"a", 1, one), key(b"b", 1, other)]).contains("ciphers"));
    assert!(refused(vec![key(&[1; 65_529], 1, one)]).contains("too long"));
    let (half, rest) = (key(&[1; 30_000], 1, one), key(&[2; 30_000], 1, one));
    assert!(refused(vec![half, rest]).contains("too long"));
    assert!(PskTable::new([key(b"a", 1, one), key(b"a", 1, other)]).is_err());

    assert!(matches!(psk_client(vec![key(b"a", 1, one)], PskKex::PskKe, b""), Err(Error::Alpn)));
    assert!(psk_server(table([]), one, PskKex::PskKe, &[b'a'; 256]).is_err());
}

/// An offer that passes the check fits a ClientHello. Otherwise quinn would fail without a reason.
#[test]
fn longest_offer_fits() {
    let keys = vec![key(&[1; 59_945], 1, Cipher::Aes256Gcm)];
    let config = psk_client(keys, PskKex::PskDheKe, &[b'a'; 255]).unwrap();
    let runtime = tokio::runtime::Runtime::new().unwrap();
    let _inside = runtime.enter();
    let endpoint = quinn::Endpoint::client("127.0.0.1:0".parse().unwrap()).unwrap();
    assert!(endpoint.connect_with(config, "127.0.0.1:9".parse().unwrap(), "axon").is_ok());
}

#[test]
fn secrets_are_not_printed() {
    let cipher = Cipher::default();
    let table = table([key(b"identity", 0x53, cipher)]);
    let client = psk::client_config(vec![key(b"identity", 0x53, cipher)], PskKex::PskKe, b"");
    let server = psk::server_config(table.clone(), cipher, PskKex::PskKe, b"").unwrap();
    for text in [format!("{table:?}"), format!("{:?}", client.unwrap()), format!("{server:?}")] {
        assert!(
            !text.contains("83, 83") && !text.contains("SSSS") && !text.contains("5353"),
            "{text}"
        );
    }
}
