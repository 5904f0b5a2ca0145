//! What a connection in `psk_dhe_ke` leaves behind in the memory of a daemon.
//!
//! This process is the dialling end. It draws the key, and a group of its own tells the shared secret of the key exchange;
//! with both, the recorded handshake gives all other secrets ([`recorded`](super::recorded)). A daemon that dials has its
//! secrets from the same code: `tests/tests/tls_memory` searches both ends.

mod tapped;

use std::{
    net::Ipv4Addr,
    time::{Duration, Instant},
};

use axon_tests::{
    memory::{Find, Needles},
    schedule::{Mode, Terms},
    unexpected,
};
use axon_tls::{Cipher, PskKex, quic::tls_alert};
use quinn::{Connection, Endpoint};

use self::tapped::Told;
use super::{
    link_memory::{begin_hello, close, search, wait_until_nowhere},
    mode::{Kmes, SAE},
    pair::Plan,
    process::PATIENCE,
    recorded::{self, IN_USE},
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

fn of_a_link(cipher: Cipher) {
    if !may_search() {
        return;
    }
    let kmes = Kmes::start();
    let name = cipher.to_string();
    let settings = [("AXON_QKD_KEX", "psk_dhe_ke"), ("AXON_QUIC_CIPHER", &name)];
    let settings = [0, 1].map(|host| kmes.settings(host, &settings));
    let [mut host, _] = Plan::new(settings).prepare();
    host.start();
    let status = host.status();
    let local = (Ipv4Addr::LOCALHOST, 0).into();
    let wire = Wire::between(local, local, (host.address, status.port.unwrap()).into());
    let (key_id, key) = kmes.draw(1);
    let [server, client] = SAE;
    let mode = Mode::Psk(PskKex::PskDheKe);
    let terms = Terms { cipher, mode, key: &key, key_id: &key_id, client, server };
    let told = Told::default();
    let config = tapped::client(terms, &told);
    let runtime = tokio::runtime::Runtime::new().unwrap();
    let (endpoint, connection, control) = runtime.block_on(async {
        let endpoint = Endpoint::client((Ipv4Addr::LOCALHOST, 0).into()).unwrap();
        let connection = dial(&endpoint, config, &wire).await;
        let control = begin_hello(&connection).await;
        (endpoint, connection, control)
    });
    let shared = told.lock().unwrap().clone();
    let connections = recorded::connections(&wire, cipher, &kmes.drawn(), Some(&shared));
    let [recorded] = &connections[..] else { panic!("{} connections", connections.len()) };
    let mut exported = [0; 32];
    let label = recorded::EXPORTERS[0];
    connection.export_keying_material(&mut exported, label.as_bytes(), b"").unwrap();
    assert_eq!(recorded.context, exported, "these are the secrets of the connection");
    let mut needles = Needles::default();
    recorded.add_to(&mut needles, 0);
    let alive = search(status.pid, &needles);
    assert!(alive.iter().any(|find| find.secret.kind == IN_USE), "what is in use is found");
    let is_in_use = |find: &Find| find.secret.kind == IN_USE;
    assert_eq!(unexpected("the daemon", &alive, is_in_use), 0, "{name}: while the link stands");
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
