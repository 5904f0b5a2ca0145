//! Tests the ClientHello on the wire in every mode, taken from records and packets and parsed here.
#![cfg(all(feature = "hybrid", feature = "quic"))]

mod common;

use std::sync::Arc;

use axon_tls::identity::{Auth, SigningKey};
use axon_tls::quic::{ALPN, hybrid_client, qkd_client, qkd_server};
use axon_tls::{Cipher, PskKex, hybrid, qkd};
use common::hello::{
    CLIENT_CERTIFICATE_TYPE, ClientHello, KEY_SHARE, PRE_SHARED_KEY, QUIC_TRANSPORT_PARAMETERS,
    SERVER_CERTIFICATE_TYPE, SIGNATURE_ALGORITHMS, SUPPORTED_GROUPS, in_record,
};
use common::{OneKey, psk};

#[test]
fn psk_ke() {
    for cipher in Cipher::ALL {
        for hello in qkd_hellos(cipher, PskKex::PskKe) {
            hello.is_tls13_with(cipher);
            hello.offers_psk(cipher, 0);
            hello.lacks(SUPPORTED_GROUPS);
            hello.lacks(KEY_SHARE);
        }
    }
}

#[test]
fn psk_dhe_ke() {
    for cipher in Cipher::ALL {
        for hello in qkd_hellos(cipher, PskKex::PskDheKe) {
            hello.is_tls13_with(cipher);
            hello.offers_psk(cipher, 1);
            hello.has_one_group();
        }
    }
}

#[test]
fn hybrid_mode() {
    let auth = Auth::None(SigningKey::generate().unwrap());
    for cipher in Cipher::ALL {
        let tcp = hybrid::client_config(&auth, cipher, ALPN).unwrap();
        let conn = rustls::ClientConnection::new(Arc::new(tcp), "axon".try_into().unwrap());
        let mut record = Vec::new();
        conn.unwrap().write_tls(&mut record).unwrap();

        let tcp = ClientHello::parse(in_record(&record));
        let quic = over_quic(hybrid_client(&auth, cipher, ALPN).unwrap());
        for hello in [tcp, quic] {
            hello.is_tls13_with(cipher);
            hello.has_one_group();
            hello.lacks(PRE_SHARED_KEY);
            assert!(hello.extensions.contains_key(&SIGNATURE_ALGORITHMS));
            // raw public keys alone, RFC 7250
            assert_eq!(hello.extensions[&CLIENT_CERTIFICATE_TYPE], [1, 2]);
            assert_eq!(hello.extensions[&SERVER_CERTIFICATE_TYPE], [1, 2]);
        }
    }
}

/// Returns the ClientHello over TCP and the one over QUIC.
fn qkd_hellos(cipher: Cipher, kex: PskKex) -> [ClientHello; 2] {
    let tcp = qkd::client_config(psk(1, cipher), kex, ALPN).unwrap();
    let conn = rustls_axon::ClientConnection::new(Arc::new(tcp), "axon".try_into().unwrap());
    let mut record = Vec::new();
    conn.unwrap().write_tls(&mut record).unwrap();

    let quic = over_quic(qkd_client(psk(1, cipher), kex, ALPN).unwrap());
    assert!(quic.extensions.contains_key(&QUIC_TRANSPORT_PARAMETERS));
    [ClientHello::parse(in_record(&record)), quic]
}

/// Returns the ClientHello over QUIC. The server only provides an address.
fn over_quic(config: quinn::ClientConfig) -> ClientHello {
    let cipher = Cipher::default();
    let server = qkd_server(OneKey::none(), cipher, PskKex::default(), ALPN).unwrap();
    ClientHello::over_quic(config, server)
}
