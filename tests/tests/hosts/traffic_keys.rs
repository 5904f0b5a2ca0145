//! What a link leaves behind in the memory of a daemon: traffic secrets, and the keys of QUIC's packets.
//!
//! This process is the other end of the link, and its TLS library says its secrets (`KeyLog`). The keys follow from them
//! (RFC 9001, section 5.1). While the link stands its keys have to be somewhere: that they are found shows that the search
//! works, and they are on no stack. Once it has ended they are nowhere: heap, freed heap, stacks.

use std::{
    collections::BTreeSet,
    net::{Ipv4Addr, SocketAddr},
    sync::{Arc, Mutex},
};

use axon_tests::{
    memory::{Find, Needles},
    unexpected,
};
use axon_tls::{
    Cipher, hybrid,
    identity::{Auth, SigningKey},
    quic::{ALPN, hybrid_client_with},
};
use hkdf::Hkdf;
use quinn::Endpoint;
use rustls::KeyLog;
use sha2::{Sha256, Sha384};

use super::{
    link_memory::{begin_hello, close, search, wait_until_nowhere},
    mode::classic,
    pair::Plan,
    secrets::may_search,
};

/// What stands in memory while a link does: the keys of its packets and headers, the secrets that the next keys are made
/// of, and what the TLS library (rustls as released) keeps until the connection ends (`docs/security.md`).
const ALIVE: [&str; 6] = [
    "handshake traffic secret",
    "traffic secret",
    "next traffic secret",
    "packet key",
    "header key",
    "exporter secret",
];

/// The secrets of one connection, as its TLS library says them.
#[derive(Debug, Default)]
struct Said(Mutex<Vec<(String, Vec<u8>)>>);

impl KeyLog for Said {
    fn log(&self, label: &str, _: &[u8], secret: &[u8]) {
        self.0.lock().unwrap().push((label.to_owned(), secret.to_vec()));
    }
}

/// HKDF-Expand-Label of RFC 8446, section 7.1, without a context.
pub(crate) fn expand(secret: &[u8], label: &str, length: usize) -> Vec<u8> {
    let label = format!("tls13 {label}");
    let info: [&[u8]; 4] = [&[0, length as u8, label.len() as u8], label.as_bytes(), &[0], &[]];
    let mut out = vec![0; length];
    match secret.len() {
        32 => Hkdf::<Sha256>::from_prk(secret).unwrap().expand_multi_info(&info, &mut out),
        _ => Hkdf::<Sha384>::from_prk(secret).unwrap().expand_multi_info(&info, &mut out),
    }
    .unwrap();
    out
}

/// All that TLS and QUIC make of what was said.
fn needles(said: &Said) -> Needles {
    let mut needles = Needles::default();
    for (label, secret) in said.0.lock().unwrap().iter() {
        match label.as_str() {
            "CLIENT_HANDSHAKE_TRAFFIC_SECRET" | "SERVER_HANDSHAKE_TRAFFIC_SECRET" => {
                needles.add("handshake traffic secret", 0, secret);
                needles.add("handshake packet key", 0, &expand(secret, "quic key", 32));
                needles.add("handshake header key", 0, &expand(secret, "quic hp", 32));
            }
            "CLIENT_TRAFFIC_SECRET_0" | "SERVER_TRAFFIC_SECRET_0" => {
                needles.add("header key", 0, &expand(secret, "quic hp", 32));
                let mut secret = secret.clone();
                for update in 0..3 {
                    let kind = if update == 0 { "traffic secret" } else { "next traffic secret" };
                    needles.add(kind, update, &secret);
                    needles.add("packet key", update, &expand(&secret, "quic key", 32));
                    secret = expand(&secret, "quic ku", secret.len());
                }
            }
            "EXPORTER_SECRET" => needles.add("exporter secret", 0, secret),
            other => panic!("{other} is none of TLS 1.3"),
        }
    }
    needles
}

fn of_a_link(cipher: Cipher) {
    if !may_search() {
        return;
    }
    let name = cipher.to_string();
    let settings = || classic(&[("AXON_QUIC_CIPHER", &name), ("AXON_CLASSIC_AUTH", "none")]);
    let [host, _] = Plan::new([settings(), settings()]).start();
    let said = Arc::new(Said::default());
    let auth = Auth::None(SigningKey::generate().unwrap());
    let mut tls = hybrid::client_config(&auth, cipher, ALPN).unwrap();
    tls.key_log = said.clone();
    let client = hybrid_client_with(tls).unwrap();
    let status = host.status();
    let daemon = SocketAddr::from((host.address, status.port.unwrap()));
    let runtime = tokio::runtime::Runtime::new().unwrap();
    let (endpoint, connection, control) = runtime.block_on(async {
        let endpoint = Endpoint::client((Ipv4Addr::UNSPECIFIED, 0).into()).unwrap();
        let connection = endpoint.connect_with(client, daemon, "axon").unwrap().await.unwrap();
        let control = begin_hello(&connection).await;
        (endpoint, connection, control)
    });
    let needles = needles(&said);
    let alive = search(status.pid, &needles);
    let kinds: BTreeSet<_> = alive.iter().map(|find| find.secret.kind).collect();
    eprintln!("{name}: while the link stands, in live memory: {kinds:?}");
    assert!(kinds.contains("packet key"), "the search finds nothing: {kinds:?}");
    let is_needed = |find: &Find| ALIVE.contains(&find.secret.kind);
    assert_eq!(unexpected("the daemon", &alive, is_needed), 0, "{name}: while the link stands");
    drop(control);
    runtime.block_on(close(&endpoint, &connection));
    wait_until_nowhere(&name, || search(status.pid, &needles));
}

#[test]
fn keys_of_a_link_that_ended_are_nowhere_in_the_daemon_with_chacha20() {
    of_a_link(Cipher::ChaCha20Poly1305);
}

#[test]
fn keys_of_a_link_that_ended_are_nowhere_in_the_daemon_with_aes() {
    of_a_link(Cipher::Aes256Gcm);
}
