//! OpenSSL and GnuTLS with one classical way alone are refused, as clients and as servers.
#![cfg(feature = "hybrid")]

mod peers;

use std::net::SocketAddr;
use std::sync::Arc;

use axon_tls::identity::{Auth, SigningKey};
use axon_tls::{Cipher, PskKex, hybrid, qkd};
use peers::psk::{our_client, our_server, psk};
use peers::{Peer, dial, file, gnutls, handshake, listen, openssls, patient, port};

/// The arguments that make a peer offer only one classical way: for OpenSSL, and for GnuTLS.
const CLASSICAL: [([&str; 3], &str); 3] = [
    (["-tls1_3", "-groups", "X25519"], "NORMAL:-VERS-ALL:+VERS-TLS1.3:-GROUP-ALL:+GROUP-X25519"),
    (["-tls1_3", "-groups", "P-256"], "NORMAL:-VERS-ALL:+VERS-TLS1.3:-GROUP-ALL:+GROUP-SECP256R1"),
    (["-tls1_2", "-groups", "X25519"], "NORMAL:-VERS-ALL:+VERS-TLS1.2"),
];

#[test]
fn classical_clients_are_refused() {
    let refuse = |start: &dyn Fn(&SocketAddr) -> Peer| {
        let (listener, addr) = listen();
        let _client = start(&addr);
        let mut socket = patient(listener.accept().unwrap().0);
        let auth = Auth::None(SigningKey::generate().unwrap());
        let config = hybrid::server_config(&auth, Cipher::default(), b"").unwrap();
        let mut conn = rustls::ServerConnection::new(Arc::new(config)).unwrap();
        let err = conn.complete_io(&mut socket).unwrap_err().to_string();
        assert!(err.contains("incompatible"), "{err}");
        assert_eq!(hybrid::negotiated(&conn), None);

        for kex in PskKex::ALL {
            let _client = start(&addr);
            let mut socket = patient(listener.accept().unwrap().0);
            let mut conn = our_server(psk(Cipher::default(), 0), kex);
            let err = handshake(&mut conn, &mut socket).unwrap_err().to_string();
            assert!(err.contains("incompatible"), "{err}");
            assert_eq!(qkd::negotiated(&conn), None);
        }
    };
    for (options, priority) in CLASSICAL {
        for (program, _) in openssls() {
            refuse(&|addr| {
                let args = ["s_client", "-connect", &addr.to_string()];
                Peer::start(&program, &[&args[..], &options].concat())
            });
        }
        if gnutls() {
            refuse(&|addr| {
                let port = addr.port().to_string();
                let args = ["-p", &port, "--insecure", "--priority", priority, "127.0.0.1"];
                Peer::start("gnutls-cli", &args)
            });
        }
    }
}

/// The same servers accept a stock rustls client, so our client refuses them because of their offer.
#[test]
fn classical_servers_are_refused() {
    let certified = rcgen::generate_simple_self_signed(["peer".to_owned()]).unwrap();
    let certificate = file("certificate.pem", &certified.cert.pem());
    let key = file("key.pem", &certified.signing_key.serialize_pem());
    let mut roots = rustls::RootCertStore::empty();
    roots.add(certified.cert.der().clone()).unwrap();

    let refused = |port: u16, tls13: bool| {
        if tls13 {
            let provider = Arc::new(rustls::crypto::aws_lc_rs::default_provider());
            let stock = rustls::ClientConfig::builder_with_provider(provider)
                .with_protocol_versions(&[&rustls::version::TLS13])
                .unwrap()
                .with_root_certificates(roots.clone())
                .with_no_client_auth();
            let mut conn =
                rustls::ClientConnection::new(Arc::new(stock), "peer".try_into().unwrap()).unwrap();
            let mut socket = dial(port);
            while conn.is_handshaking() {
                conn.complete_io(&mut socket).unwrap();
            }
        }
        let auth = Auth::None(SigningKey::generate().unwrap());
        let config = hybrid::client_config(&auth, Cipher::default(), b"").unwrap();
        let mut conn =
            rustls::ClientConnection::new(Arc::new(config), "peer".try_into().unwrap()).unwrap();
        let mut socket = dial(port);
        while conn.is_handshaking() && conn.complete_io(&mut socket).is_ok() {}
        assert!(conn.is_handshaking(), "a classical server was accepted");
        assert_eq!(hybrid::negotiated(&conn), None);

        for kex in PskKex::ALL {
            let (mut conn, mut socket) = (our_client(psk(Cipher::default(), 0), kex), dial(port));
            assert!(handshake(&mut conn, &mut socket).is_err());
            assert_eq!(qkd::negotiated(&conn), None);
        }
    };
    for (options, priority) in CLASSICAL {
        let tls13 = options[0] == "-tls1_3";
        for (program, _) in openssls() {
            let port = port();
            let addr = format!("127.0.0.1:{port}");
            let args = ["s_server", "-accept", &addr, "-cert", &certificate, "-key", &key];
            let _server = Peer::start(&program, &[&args[..], &options].concat());
            refused(port, tls13);
        }
        if gnutls() {
            let port = port();
            let text = port.to_string();
            let args = ["--echo", "-p", &text, "--x509certfile", &certificate, "--x509keyfile"];
            let rest = [&key, "--disable-client-cert", "--priority", priority];
            let _server = Peer::start("gnutls-serv", &[&args[..], &rest].concat());
            refused(port, tls13);
        }
    }
}
