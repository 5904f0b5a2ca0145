//! Tests which secrets a connection in `psk_dhe_ke` leaves in the memory of a daemon that accepted it, and of one that
//! dialled.
//!
//! This process is the other end. It knows the key, and a key exchange group of the test reveals the shared secret.
//! With both, all other secrets follow from the recorded handshake ([`recorded`](super::recorded)). A daemon that dials
//! may have given up another dial under the same key, which keeps the PSK until its connection is closed
//! (`docs/security.md`).

mod tapped;

use std::{
    collections::BTreeSet,
    net::{Ipv4Addr, SocketAddr},
    sync::Arc,
    time::{Duration, Instant},
};

use axon_daemon::internal::wire;
use axon_tests::{
    memory::{Find, Needles},
    schedule::Terms,
    unexpected,
};
use axon_tls::{Cipher, quic::tls_alert};
use quinn::{Connection, Endpoint, RecvStream, SendStream};
use tokio::runtime::Runtime;

use super::{
    groups::Told,
    link_memory::{begin_hello, close, hear_hello, search, wait_until_nowhere},
    lure,
    mode::{Kmes, SAE},
    pair::{Host, Plan},
    process::PATIENCE,
    recorded::{self, IN_USE, USED_UP},
    secrets::may_search,
    wire::Wire,
};

/// `unknown_psk_identity`: the daemon begins to fetch the key.
const UNKNOWN: u8 = 115;

async fn dial(endpoint: &Endpoint, config: quinn::ClientConfig, wire: &Wire) -> Connection {
    let deadline = Instant::now() + PATIENCE;
    loop {
        match endpoint.connect_with(config.clone(), wire.address, "axon").unwrap().await {
            Ok(connection) => return connection,
            Err(error) if tls_alert(&error) == Some(UNKNOWN) && Instant::now() < deadline => {
                tokio::time::sleep(Duration::from_millis(200)).await;
            }
            Err(error) => panic!("{error}"),
        }
    }
}

/// A link of the daemon of host A with this process, which is host B.
struct Link {
    name: String,
    runtime: Runtime,
    // In front of the KMEs, whose files are read once more when it ends.
    hosts: [Host; 2],
    kmes: Arc<Kmes>,
    told: Told,
}

/// The connection, its wire and endpoint, and its control stream.
struct Stands {
    wire: Wire,
    endpoint: Endpoint,
    connection: Connection,
    control: (SendStream, RecvStream),
}

impl Link {
    fn new(cipher: Cipher) -> Self {
        let (kmes, name) = (Arc::new(Kmes::start()), cipher.to_string());
        let settings = [
            ("AXON_QKD_KEY_MODE", "session"),
            ("AXON_QKD_KEX", "psk_dhe_ke"),
            ("AXON_QUIC_CIPHER", &name),
        ];
        let mut hosts = Plan::new([0, 1].map(|host| kmes.settings(host, &settings))).prepare();
        hosts[0].start();
        let runtime = Runtime::new().unwrap();
        Self { name, runtime, hosts, kmes, told: Told::default() }
    }

    /// Dials the daemon.
    fn dial(&self, cipher: Cipher) -> Stands {
        let local = (Ipv4Addr::LOCALHOST, 0).into();
        let [host, _] = &self.hosts;
        let daemon = SocketAddr::from((host.address, host.status().port.unwrap()));
        let wire = Wire::between(local, local, daemon);
        let (key_id, key) = self.kmes.draw(1);
        let [server, client] = SAE;
        let terms =
            Terms { cipher, mode: tapped::MODE, key: &key, key_id: &key_id, client, server };
        let config = tapped::client(terms, &self.told);
        self.runtime.block_on(async {
            let endpoint = Endpoint::client(local).unwrap();
            let connection = dial(&endpoint, config, &wire).await;
            let control = begin_hello(&connection).await;
            Stands { wire, endpoint, connection, control }
        })
    }

    /// Accepts the dial of the daemon.
    fn accept(&self, cipher: Cipher) -> Stands {
        let [host, other] = &self.hosts;
        let config = tapped::server(cipher, &self.kmes, &self.told);
        let suite = match cipher {
            Cipher::ChaCha20Poly1305 => 0,
            Cipher::Aes256Gcm => 1,
        };
        let terms = wire::SecurityTerms { mode: 1, key_mode: 1, kex: 2, cipher: suite, auth: None };
        let _session = host.session("searched");
        self.runtime.block_on(async {
            let endpoint = lure::server(config, Ipv4Addr::LOCALHOST);
            let [near, far] = [other.address, Ipv4Addr::LOCALHOST].map(|ip| (ip, 0).into());
            let wire = Wire::between(near, far, endpoint.local_addr().unwrap());
            let at = wire.address;
            let connection = lure::accept_dial(&endpoint, host, at, terms, Some(SAE[1])).await;
            let control = hear_hello(&connection).await;
            Stands { wire, endpoint, connection, control }
        })
    }
}

fn of_a_link(cipher: Cipher, daemon_dials: bool) {
    if !may_search() {
        return;
    }
    let link = Link::new(cipher);
    let stands = if daemon_dials { link.accept(cipher) } else { link.dial(cipher) };
    let pid = link.hosts[0].status().pid;
    let Stands { wire, endpoint, connection, control } = stands;
    let shared = link.told.lock().unwrap().clone();
    let connections = recorded::connections(&wire, cipher, &link.kmes.drawn(), Some(&shared));
    let [recorded] = &connections[..] else { panic!("{} connections", connections.len()) };
    let mut exported = [0; 32];
    let label = recorded::EXPORTERS[0];
    connection.export_keying_material(&mut exported, label.as_bytes(), b"").unwrap();
    assert_eq!(recorded.context, exported, "these are the secrets of the connection");
    let (mut needles, mut names) = (Needles::default(), Vec::new());
    for (kind, secrets) in [(IN_USE, &recorded.in_use), (USED_UP, &recorded.used_up)] {
        for secret in secrets {
            needles.add(kind, names.len(), &secret.bytes);
            names.push(&secret.name);
        }
    }
    let alive = search(pid, &needles);
    let found: BTreeSet<_> = alive.iter().map(|find| names[find.secret.number]).collect();
    eprintln!("{}: while the link stands, in live memory: {found:?}", link.name);
    assert!(alive.iter().any(|find| find.secret.kind == IN_USE), "what is in use is found");
    let is_known = |find: &Find| {
        let is_psk = names[find.secret.number] == "pre-shared key";
        find.secret.kind == IN_USE || daemon_dials && is_psk
    };
    let name = &link.name;
    assert_eq!(unexpected("the daemon", &alive, is_known), 0, "{name}: while the link stands");
    drop(control);
    link.runtime.block_on(close(&endpoint, &connection));
    wait_until_nowhere(name, || search(pid, &needles));
}

#[test]
fn keys_of_a_link_that_ended_are_nowhere_in_the_daemon_that_accepted_with_chacha20() {
    of_a_link(Cipher::ChaCha20Poly1305, false);
}

#[test]
fn keys_of_a_link_that_ended_are_nowhere_in_the_daemon_that_accepted_with_aes() {
    of_a_link(Cipher::Aes256Gcm, false);
}

#[test]
fn keys_of_a_link_that_ended_are_nowhere_in_the_daemon_that_dialled_with_chacha20() {
    of_a_link(Cipher::ChaCha20Poly1305, true);
}

#[test]
fn keys_of_a_link_that_ended_are_nowhere_in_the_daemon_that_dialled_with_aes() {
    of_a_link(Cipher::Aes256Gcm, true);
}
