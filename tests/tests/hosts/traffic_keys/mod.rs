//! Tests which secrets a link in `classic` leaves in the memory of a daemon that accepted it, and of one that dialled:
//! the secrets of the key schedule of TLS, and the keys of QUIC's packets.
//!
//! This process is the other end of the link. A key exchange group of the test reveals the shared secret of the key
//! exchange, and the data that this process reads and writes contain the messages of the handshake. All other secrets
//! follow from these (RFC 8446, section 7.1, and RFC 9001, section 5.1). While the link stands its keys must be in
//! memory: that they are found shows that the search works. They are on no stack. Once the link has ended they are
//! nowhere: neither in the heap, nor in freed heap, nor on stacks.

mod tapped;

use std::{
    collections::BTreeSet,
    fs,
    net::{Ipv4Addr, SocketAddr},
    path::Path,
};

use axon_daemon::internal::wire;
use axon_tests::{
    memory::{Find, Needles},
    schedule::{Mode, Schedule, Terms},
    unexpected,
};
use axon_tls::{
    Cipher,
    identity::{KeyAlgorithm, SigningKey},
};
use hkdf::Hkdf;
use quinn::{Connection, Endpoint, RecvStream, SendStream};
use sha2::{Sha256, Sha384};
use tokio::runtime::Runtime;

use self::tapped::{Learnt, Own};
use super::{
    identity::authority::{self, Authority},
    link_memory::{begin_hello, close, hear_hello, search, wait_until_nowhere},
    lure,
    mode::{Settings, classic, pinned},
    pair::{Host, Plan},
    recorded::{IN_USE, USED_UP},
    secrets::may_search,
};

/// Secrets that the TLS library, which is rustls as released, keeps until the connection ends (`docs/security.md`).
const HELD: &str = "secret that rustls holds";
const HELD_BY_RUSTLS: [&str; 4] = [
    "client handshake traffic secret",
    "server handshake traffic secret",
    "client traffic secret 0",
    "server traffic secret 0",
];
/// The label that these tests export, to show that the secrets are those of the connection.
const EXPORTER: &str = "EXPORTER-axon-test";

/// Computes HKDF-Expand-Label of RFC 8446, section 7.1, without a context.
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

/// `AXON_CLASSIC_AUTH`.
#[derive(Clone, Copy, PartialEq)]
enum Auth {
    None,
    Pinned,
    Ca,
}

/// Returns the settings of two hosts, and the credentials of this process as the second of them.
fn settings(dir: &Path, auth: Auth) -> ([Settings; 2], Own) {
    let pem = || SigningKey::generate_pem_with(KeyAlgorithm::Ed25519).unwrap().to_string();
    match auth {
        Auth::None => {
            let settings = || classic(&[("AXON_CLASSIC_AUTH", "none")]);
            ([settings(), settings()], Own { key: pem(), certificate: None })
        }
        Auth::Pinned => {
            let (settings, key) = (pinned(dir, [[true; 2]; 2]), pem());
            let trust = dir.join("host-0.trust");
            let digest = SigningKey::from_pem(&key).unwrap().spki_digest();
            let lines = fs::read_to_string(&trust).unwrap() + &format!("searcher {digest}\n");
            fs::write(&trust, lines).unwrap();
            (settings, Own { key, certificate: None })
        }
        Auth::Ca => {
            let ca = Authority::new("Test CA");
            let [a, b] = ["host-a", "host-b"].map(|name| ca.issue(name, 1, 2100));
            let settings = [("a", &a), ("b", &b)]
                .map(|(host, own)| authority::settings(dir, host, &ca.pem, own, None));
            (settings, Own { key: b.key, certificate: Some(b.pem) })
        }
    }
}

/// A link that stands.
struct Stands {
    endpoint: Endpoint,
    connection: Connection,
    control: (SendStream, RecvStream),
}

/// Dials the daemon of `host` from this process.
async fn dial(host: &Host, config: quinn::ClientConfig) -> Stands {
    let daemon = SocketAddr::from((host.address, host.status().port.unwrap()));
    let endpoint = Endpoint::client((Ipv4Addr::UNSPECIFIED, 0).into()).unwrap();
    let connection = endpoint.connect_with(config, daemon, "axon").unwrap().await.unwrap();
    let control = begin_hello(&connection).await;
    Stands { endpoint, connection, control }
}

/// Accepts the dial of the first host's daemon in this process.
async fn accept(
    hosts: &[Host; 2],
    config: quinn::ServerConfig,
    terms: wire::SecurityTerms,
) -> Stands {
    let endpoint = lure::server(config, hosts[1].address);
    let at = endpoint.local_addr().unwrap();
    let connection = lure::accept_dial(&endpoint, &hosts[0], at, terms, None).await;
    let control = hear_hello(&connection).await;
    Stands { endpoint, connection, control }
}

/// Returns the secrets of the connection, each as a number, and their names.
fn needles(cipher: Cipher, learnt: &Learnt, connection: &Connection) -> (Needles, Vec<String>) {
    let terms = Terms { cipher, mode: Mode::Hybrid, key: b"", key_id: "", client: "", server: "" };
    let [shared, transcript] = [&learnt.shared, &learnt.transcript].map(|m| m.lock().unwrap());
    let schedule = Schedule::new(terms, &transcript, Some(&shared));
    let mut exported = [0; 32];
    connection.export_keying_material(&mut exported, EXPORTER.as_bytes(), b"").unwrap();
    let [_, computed] = schedule.export(EXPORTER).unwrap();
    assert_eq!(computed, exported, "these are the secrets of the connection");
    let (mut needles, mut names) = (Needles::default(), Vec::new());
    for (kind, secrets) in [(IN_USE, schedule.in_use()), (USED_UP, schedule.used_up())] {
        for secret in secrets {
            let kind = if HELD_BY_RUSTLS.contains(&&*secret.name) { HELD } else { kind };
            needles.add(kind, names.len(), &secret.bytes);
            names.push(secret.name.clone());
        }
    }
    (needles, names)
}

fn of_a_link(auth: Auth, cipher: Cipher, daemon_dials: bool) {
    if !may_search() {
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    let name = cipher.to_string();
    let (mut settings, own) = settings(dir.path(), auth);
    for settings in &mut settings {
        settings.push(("AXON_QUIC_CIPHER", name.clone()));
    }
    let mut hosts = Plan::new(settings).prepare();
    hosts[0].start();
    let runtime = Runtime::new().unwrap();
    let learnt = Learnt::default();
    let session = daemon_dials.then(|| hosts[0].session("searched"));
    let cipher_number = u8::from(cipher == Cipher::Aes256Gcm);
    let terms = wire::SecurityTerms {
        mode: 0,
        key_mode: 0,
        kex: 0,
        cipher: cipher_number,
        auth: Some(auth as u8),
    };
    let Stands { endpoint, connection, control } = runtime.block_on(async {
        if daemon_dials {
            accept(&hosts, tapped::server(cipher, &own, &learnt), terms).await
        } else {
            dial(&hosts[0], tapped::client(cipher, &own, &learnt)).await
        }
    });
    let (needles, names) = needles(cipher, &learnt, &connection);
    let pid = hosts[0].status().pid;
    let alive = search(pid, &needles);
    let found: BTreeSet<_> = alive.iter().map(|find| &names[find.secret.number]).collect();
    eprintln!("{name}: while the link stands, in live memory: {found:?}");
    assert!(alive.iter().any(|find| find.secret.kind == IN_USE), "the search finds nothing");
    let is_known = |find: &Find| [IN_USE, HELD].contains(&find.secret.kind);
    assert_eq!(unexpected("the daemon", &alive, is_known), 0, "{name}: while the link stands");
    drop(control);
    runtime.block_on(close(&endpoint, &connection));
    wait_until_nowhere(&name, || search(pid, &needles));
    drop(session);
}

/// Runs each test of a cipher: the daemon accepts a link, and dials one.
fn of_links(auth: Auth, cipher: Cipher) {
    for daemon_dials in [false, true] {
        of_a_link(auth, cipher, daemon_dials);
    }
}

#[test]
fn keys_of_a_link_that_ended_are_nowhere_in_the_daemon_with_chacha20() {
    of_links(Auth::None, Cipher::ChaCha20Poly1305);
}

#[test]
fn keys_of_a_link_that_ended_are_nowhere_in_the_daemon_with_aes() {
    of_links(Auth::None, Cipher::Aes256Gcm);
}

#[test]
fn keys_of_an_ended_link_with_a_pinned_peer_are_erased() {
    of_links(Auth::Pinned, Cipher::default());
}

#[test]
fn keys_of_a_link_under_a_ca_that_ended_are_nowhere_in_the_daemon() {
    of_links(Auth::Ca, Cipher::default());
}
