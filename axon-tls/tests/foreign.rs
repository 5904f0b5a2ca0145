//! Connections on a pre-shared key with OpenSSL and GnuTLS: every mode that they have in common with
//! us, in both directions, and their refusals.
#![cfg(feature = "hybrid")]

mod peers;

use std::fmt;
use std::net::SocketAddr;
use std::sync::Arc;

use axon_tls::{Cipher, PskKex, qkd};
use peers::psk::{is_on, openssl_psk, our_client, our_server, psk, vector};
use peers::{
    LABEL, Peer, dial, exchange, file, gnutls, handshake, listen, openssls, patient, port, skipped,
};
use rustls_axon::crypto::CryptoProvider;
use rustls_axon::crypto::aws_lc_rs::{cipher_suite, default_provider, kx_group};
use rustls_axon::crypto::hash::HashAlgorithm;
use rustls_axon::external_psk::{
    ExternalPsk, ExternalPskOffer, PskKeyExchangeMode, ResolvesExternalPsk,
};
use rustls_axon::{HandshakeKind, ServerConfig, ServerConnection};
use zeroize::Zeroizing;

/// Runs the test for every cipher and mode that `program` supports.
fn with_openssl(test: impl Fn(&str, Cipher, PskKex)) {
    for (program, has_group) in openssls() {
        for cipher in Cipher::ALL {
            test(&program, cipher, PskKex::PskKe);
            if has_group {
                test(&program, cipher, PskKex::PskDheKe);
            } else {
                skipped(format_args!("psk_dhe_ke, {program} has no X25519MLKEM768"));
            }
        }
    }
}

#[test]
fn openssl_server_with_another_key_is_refused() {
    with_openssl(|program, cipher, kex| {
        let port = port();
        let addr = format!("127.0.0.1:{port}");
        let server = ["s_server", "-nocert", "-accept", &addr];
        let _server = openssl_psk(program, &server, cipher, kex);
        let (mut socket, mut conn) = (dial(port), our_client(psk(cipher, 99), kex));
        assert!(handshake(&mut conn, &mut socket).is_err());
        assert_eq!(qkd::negotiated(&conn), None);
    });
}

#[test]
fn openssl_client_with_another_key_is_refused() {
    with_openssl(|program, cipher, kex| {
        let (listener, addr) = listen();
        let addr = addr.to_string();
        let _client = openssl_psk(program, &["s_client", "-connect", &addr], cipher, kex);
        let mut socket = patient(listener.accept().unwrap().0);
        let mut conn = our_server(psk(cipher, 99), kex);
        assert!(handshake(&mut conn, &mut socket).is_err());
        assert_eq!(qkd::negotiated(&conn), None);
    });
}

#[test]
fn openssl_server_in_every_mode() {
    with_openssl(|program, cipher, kex| {
        let port = port();
        let addr = format!("127.0.0.1:{port}");
        let server = ["s_server", "-nocert", "-accept", &addr];
        let mut server = openssl_psk(program, &server, cipher, kex);
        let (mut socket, mut conn) = (dial(port), our_client(psk(cipher, 0), kex));
        handshake(&mut conn, &mut socket).unwrap();
        exchange(&mut conn, &mut socket, &mut server, false);
        is_on(qkd::negotiated(&conn), cipher, kex);
        assert!(conn.tls13_tickets_received() > 0, "or it does not show that they are ignored");
    });
}

#[test]
fn openssl_client_in_every_mode() {
    with_openssl(|program, cipher, kex| {
        let (listener, addr) = listen();
        let addr = addr.to_string();
        let mut client = openssl_psk(program, &["s_client", "-connect", &addr], cipher, kex);
        let mut socket = patient(listener.accept().unwrap().0);
        let mut conn = our_server(psk(cipher, 0), kex);
        handshake(&mut conn, &mut socket).unwrap();
        exchange(&mut conn, &mut socket, &mut client, false);
        is_on(qkd::negotiated(&conn), cipher, kex);
    });
}

const GNUTLS_PSK: &str = "NORMAL:-VERS-ALL:+VERS-TLS1.3:-KX-ALL:+PSK";
const GNUTLS_ECDHE_PSK: &str = "NORMAL:-VERS-ALL:+VERS-TLS1.3:-KX-ALL:+ECDHE-PSK";

fn gnutls_server(port: u16, priority: &str) -> Peer {
    let (identity, secret) = vector(Cipher::ChaCha20Poly1305);
    // a name with a colon in it goes in hexadecimal
    let name: String = identity.bytes().map(|byte| format!("{byte:02x}")).collect();
    let passwd = file("psk.txt", &format!("#{name}:{secret}\n"));
    let (port, label) = (port.to_string(), format!("--keymatexport={LABEL}"));
    let args = ["--echo", "-p", &port, "--pskpasswd", &passwd, "--priority", priority, &label];
    Peer::start("gnutls-serv", &[&args[..], &["--keymatexportsize=32"]].concat())
}

fn gnutls_client(addr: SocketAddr, priority: &str) -> Peer {
    let (identity, secret) = vector(Cipher::ChaCha20Poly1305);
    let (port, label) = (addr.port().to_string(), format!("--keymatexport={LABEL}"));
    let args =
        ["-p", &port, "--pskusername", &identity, "--pskkey", &secret, "--priority", priority];
    let rest = [&label, "--keymatexportsize=32", "--insecure", "127.0.0.1"];
    Peer::start("gnutls-cli", &[&args[..], &rest].concat())
}

/// GnuTLS has external PSKs with SHA-256 only.
#[test]
fn gnutls_both_ways_and_its_classical_groups_refused() {
    if !gnutls() {
        return;
    }
    let (cipher, kex) = (Cipher::ChaCha20Poly1305, PskKex::PskKe);
    for (priority, works) in [(GNUTLS_ECDHE_PSK, false), (GNUTLS_PSK, true)] {
        let port = port();
        let mut server = gnutls_server(port, priority);
        let (mut socket, mut conn) = (dial(port), our_client(psk(cipher, 0), kex));
        let outcome = handshake(&mut conn, &mut socket);
        assert_eq!(outcome.is_ok(), works, "server, {priority}: {outcome:?}");
        if works {
            exchange(&mut conn, &mut socket, &mut server, true);
            is_on(qkd::negotiated(&conn), cipher, kex);
        } else {
            assert_eq!(qkd::negotiated(&conn), None);
        }

        let (listener, addr) = listen();
        let mut client = gnutls_client(addr, priority);
        let mut socket = patient(listener.accept().unwrap().0);
        let mut conn = our_server(psk(cipher, 0), kex);
        let outcome = handshake(&mut conn, &mut socket);
        assert_eq!(outcome.is_ok(), works, "client, {priority}: {outcome:?}");
        if works {
            exchange(&mut conn, &mut socket, &mut client, false);
            is_on(qkd::negotiated(&conn), cipher, kex);
        } else {
            assert_eq!(qkd::negotiated(&conn), None);
        }
    }
}

/// Creates a server of rustls-axon whose only group is one of which no client sends a share at first.
fn retrying_server() -> ServerConnection {
    let cipher = Cipher::ChaCha20Poly1305;
    let (identity, secret) = vector(cipher);
    let byte = |at| u8::from_str_radix(&secret[at..at + 2], 16).unwrap();
    let secret = Zeroizing::new((0..secret.len()).step_by(2).map(byte).collect::<Vec<u8>>());
    let psk = ExternalPsk::new(identity, secret, HashAlgorithm::SHA256).unwrap();
    let provider = CryptoProvider {
        cipher_suites: vec![cipher_suite::TLS13_CHACHA20_POLY1305_SHA256],
        kx_groups: vec![kx_group::SECP384R1],
        ..default_provider()
    };
    let config = ServerConfig::builder_with_provider(Arc::new(provider))
        .with_external_psk_resolver(Arc::new(OneKey(Arc::new(psk))), PskKeyExchangeMode::PskDheKe)
        .unwrap();
    ServerConnection::new(Arc::new(config)).unwrap()
}

struct OneKey(Arc<ExternalPsk>);

impl fmt::Debug for OneKey {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("OneKey")
    }
}

impl ResolvesExternalPsk for OneKey {
    fn resolve(&self, offer: ExternalPskOffer<'_>) -> Option<Arc<ExternalPsk>> {
        let known = offer.identities().any(|identity| identity == self.0.identity());
        known.then(|| Arc::clone(&self.0))
    }
}

/// Foreign clients fulfil a server's requirements for a second ClientHello.
#[test]
fn foreign_clients_get_through_a_hello_retry_request() {
    let (identity, secret) = vector(Cipher::ChaCha20Poly1305);
    let retried = |start: &dyn Fn(SocketAddr) -> Peer| {
        let (listener, addr) = listen();
        let _client = start(addr);
        let mut socket = patient(listener.accept().unwrap().0);
        let mut conn = retrying_server();
        handshake(&mut conn, &mut socket).unwrap();
        assert_eq!(conn.handshake_kind(), Some(HandshakeKind::FullWithHelloRetryRequest));
        assert_eq!(conn.external_psk().unwrap().identity(), identity.as_bytes());
    };
    for (program, _) in openssls() {
        retried(&|addr| {
            let addr = addr.to_string();
            let mut args = vec!["s_client", "-connect", &addr, "-tls1_3", "-psk", &secret];
            args.extend(["-psk_identity", &identity, "-groups", "X25519:P-384"]);
            args.extend(["-ciphersuites", "TLS_CHACHA20_POLY1305_SHA256"]);
            Peer::start(&program, &args)
        });
    }
    if gnutls() {
        let groups = "-GROUP-ALL:+GROUP-X25519:+GROUP-SECP256R1:+GROUP-SECP384R1";
        retried(&|addr| gnutls_client(addr, &format!("{GNUTLS_ECDHE_PSK}:{groups}")));
    }
}
