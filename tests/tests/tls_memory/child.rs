//! The process whose memory is looked at: both ends of one QUIC connection, or one end.

use std::fmt;
use std::fs::File;
use std::io::{Read, Write};
use std::net::Ipv4Addr;
use std::sync::Arc;
use std::time::Duration;

use axon_tests::schedule::{Mode, Terms};
use axon_tls::qkd::{Psk, PskResolver, derive_psk};
use axon_tls::{Cipher, hybrid, quic};
use quinn::{ClientConfig, Connection, Endpoint, ServerConfig, TransportConfig};
use rustls::version::TLS13;
use tokio::runtime::{Builder, Runtime};
use zeroize::Zeroizing;

use crate::certificates;
use crate::transcript::{Messages, TappedServer};

/// Set in the environment of the child: cipher, mode, and which ends it has.
pub(crate) const ASKED: &str = "AXON_TLS_MEMORY_CHILD";
/// Prefix of the line with the server's port, if the child has only the server.
pub(crate) const LISTENS: &str = "listens: ";
/// Prefix of the line with the transcript, if the child has both ends. The child prints it when it is connected and
/// data was exchanged.
pub(crate) const CONNECTED: &str = "connected: ";
/// Prefix of the line that the child prints when it has dropped everything with a secret.
pub(crate) const DROPPED: &str = "dropped: ";

pub(crate) const KEY_ID: &str = "bc490419-7d60-487f-adc1-4ddcc177c139";
pub(crate) const CLIENT_SAE: &str = "sae-client";
pub(crate) const SERVER_SAE: &str = "sae-server";
pub(crate) const EXPORTER: &str = "EXPORTER-axon-test";
const SENT: usize = 70_000;

/// Returns the terms that both ends share.
pub(crate) fn terms(cipher: Cipher, mode: Mode, key: &[u8]) -> Terms<'_> {
    Terms { cipher, mode, key, key_id: KEY_ID, client: CLIENT_SAE, server: SERVER_SAE }
}

/// Which ends the child has.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Has {
    Both,
    /// A client, of the server at this port.
    Client(u16),
    Server,
}

impl fmt::Display for Has {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Both => f.write_str("both"),
            Self::Client(port) => port.fmt(f),
            Self::Server => f.write_str("server"),
        }
    }
}

/// Returns the values that the child leaves in memory on purpose, from the key that it gets.
pub(crate) fn marks(key: &[u8; 32]) -> [[u8; 32]; 2] {
    [0x55, 0xaa].map(|mask| key.map(|byte| byte ^ mask))
}

pub(crate) fn run_if_asked() {
    let Ok(asked) = std::env::var(ASKED) else { return };
    let words: Vec<&str> = asked.split(' ').collect();
    let &[cipher, mode, has] = words.as_slice() else { panic!("{asked}") };
    let cipher: Cipher = cipher.parse().unwrap();
    let mode = if mode == "hybrid" { Mode::Hybrid } else { Mode::Psk(mode.parse().unwrap()) };

    // not through a buffer that keeps it, and not where moves would copy it
    let mut parent = File::open("/dev/stdin").unwrap();
    let mut key = Box::new(Zeroizing::new([0_u8; 32]));
    parent.read_exact(key.as_mut_slice()).unwrap();
    // the first mark
    let held: Vec<u8> = key.iter().map(|byte| byte ^ 0x55).collect();

    let runtime = Builder::new_multi_thread().worker_threads(2).enable_all().build().unwrap();
    let ends = match has {
        "both" => Ends::connect(&runtime, &key, cipher, mode),
        "server" => Ends::accept(&runtime, &key, cipher, mode),
        port => Ends::dial(&runtime, &key, cipher, mode, port.parse().unwrap()),
    };
    drop(key);
    say(CONNECTED, &ends.transcript());
    wait(&mut parent);

    ends.close(&runtime);
    drop(runtime);
    free_a_mark(&held);
    say(DROPPED, b"");
    wait(&mut parent);
    drop(std::hint::black_box(held));
}

/// Frees a block with the second mark in it.
fn free_a_mark(held: &[u8]) {
    // at the end of a block that is larger than others ask for
    let mut block = vec![0; 40_000];
    for (at, byte) in held.iter().enumerate() {
        block[39_000 + at] = byte ^ 0x55 ^ 0xaa;
    }
    drop(std::hint::black_box(block));
}

fn say(step: &str, bytes: &[u8]) {
    let hex: String = bytes.iter().map(|byte| format!("{byte:02x}")).collect();
    let mut out = std::io::stdout().lock();
    writeln!(out, "{step}{hex}").unwrap();
    out.flush().unwrap();
}

fn wait(parent: &mut File) {
    let _ = parent.read(&mut [0]);
}

struct Ends {
    endpoints: Vec<Endpoint>,
    connections: Vec<Connection>,
    messages: Messages,
}

fn client_config(key: &[u8; 32], cipher: Cipher, mode: Mode) -> ClientConfig {
    let mut config = match mode {
        Mode::Psk(kex) => quic::qkd_client(Arc::new(psk(key, cipher)), kex, quic::ALPN).unwrap(),
        Mode::Hybrid => {
            let provider = Arc::new(hybrid::provider_with(cipher));
            let builder = rustls::ClientConfig::builder_with_provider(provider);
            let builder = builder.with_protocol_versions(&[&TLS13]).unwrap();
            quic::hybrid_client_with(certificates::client(builder)).unwrap()
        }
    };
    config.transport_config(transport());
    config
}

fn server_config(key: &[u8; 32], cipher: Cipher, mode: Mode) -> ServerConfig {
    let mut config = match mode {
        Mode::Psk(kex) => {
            let keys = Arc::new(OneKey(Arc::new(psk(key, cipher))));
            quic::qkd_server(keys, cipher, kex, quic::ALPN).unwrap()
        }
        Mode::Hybrid => {
            let provider = Arc::new(hybrid::provider_with(cipher));
            let builder = rustls::ServerConfig::builder_with_provider(provider);
            let builder = builder.with_protocol_versions(&[&TLS13]).unwrap();
            quic::hybrid_server_with(certificates::server(builder)).unwrap()
        }
    };
    config.transport_config(transport());
    config
}

fn psk(key: &[u8; 32], cipher: Cipher) -> Psk {
    derive_psk(key, KEY_ID, CLIENT_SAE, SERVER_SAE, cipher).unwrap()
}

/// Returns a transport with a short initial round trip, which determines how long a closed connection is kept.
fn transport() -> Arc<TransportConfig> {
    let mut transport = TransportConfig::default();
    transport.initial_rtt(Duration::from_millis(20));
    Arc::new(transport)
}

const LOCALHOST: Ipv4Addr = Ipv4Addr::LOCALHOST;

impl Ends {
    fn connect(runtime: &Runtime, key: &[u8; 32], cipher: Cipher, mode: Mode) -> Self {
        let messages = Messages::default();
        let mut server = server_config(key, cipher, mode);
        server.crypto = Arc::new(TappedServer(server.crypto.clone(), messages.clone()));
        let client = client_config(key, cipher, mode);

        runtime.block_on(async move {
            let server = Endpoint::server(server, (LOCALHOST, 0).into()).unwrap();
            let addr = server.local_addr().unwrap();
            let accepting = server.clone();
            let serving = tokio::spawn(async move {
                let connection = accepting.accept().await.unwrap().await.unwrap();
                serve(&connection).await;
                connection
            });
            let endpoint = Endpoint::client((LOCALHOST, 0).into()).unwrap();
            let dialled = endpoint.connect_with(client, addr, "axon").unwrap().await.unwrap();
            dial(&dialled).await;
            let connections = vec![dialled, serving.await.unwrap()];
            Self { endpoints: vec![endpoint, server], connections, messages }
        })
    }

    fn dial(runtime: &Runtime, key: &[u8; 32], cipher: Cipher, mode: Mode, port: u16) -> Self {
        let client = client_config(key, cipher, mode);
        runtime.block_on(async move {
            let endpoint = Endpoint::client((LOCALHOST, 0).into()).unwrap();
            let address = (LOCALHOST, port).into();
            let dialled = endpoint.connect_with(client, address, "axon").unwrap().await.unwrap();
            dial(&dialled).await;
            let (endpoints, connections) = (vec![endpoint], vec![dialled]);
            Self { endpoints, connections, messages: Messages::default() }
        })
    }

    fn accept(runtime: &Runtime, key: &[u8; 32], cipher: Cipher, mode: Mode) -> Self {
        let server = server_config(key, cipher, mode);
        runtime.block_on(async move {
            let endpoint = Endpoint::server(server, (LOCALHOST, 0).into()).unwrap();
            say(LISTENS, &endpoint.local_addr().unwrap().port().to_be_bytes());
            let connection = endpoint.accept().await.unwrap().await.unwrap();
            serve(&connection).await;
            let (endpoints, connections) = (vec![endpoint], vec![connection]);
            Self { endpoints, connections, messages: Messages::default() }
        })
    }

    fn transcript(&self) -> Vec<u8> {
        self.messages.lock().unwrap().clone()
    }

    fn close(self, runtime: &Runtime) {
        runtime.block_on(async move {
            for connection in &self.connections {
                connection.close(0_u32.into(), b"done");
            }
            drop(self.connections);
            for endpoint in &self.endpoints {
                endpoint.wait_idle().await;
            }
        });
    }
}

/// Exports, sends and updates the keys, so that every secret was used.
pub(crate) async fn dial(connection: &Connection) {
    let mut exported = Zeroizing::new([0; 32]);
    connection.export_keying_material(&mut *exported, EXPORTER.as_bytes(), b"").unwrap();
    let (mut send, mut receive) = connection.open_bi().await.unwrap();
    send.write_all(b"to the server").await.unwrap();
    send.finish().unwrap();
    connection.force_key_update();
    assert_eq!(receive.read_to_end(SENT).await.unwrap().len(), SENT);
}

pub(crate) async fn serve(connection: &Connection) {
    let mut exported = Zeroizing::new([0; 32]);
    connection.export_keying_material(&mut *exported, EXPORTER.as_bytes(), b"").unwrap();
    let (mut send, mut receive) = connection.accept_bi().await.unwrap();
    receive.read_to_end(1_000).await.unwrap();
    send.write_all(&[7; SENT]).await.unwrap();
    send.finish().unwrap();
}

struct OneKey(Arc<Psk>);

impl fmt::Debug for OneKey {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("OneKey")
    }
}

impl PskResolver for OneKey {
    fn resolve(&self, identity: &[u8]) -> Option<Arc<Psk>> {
        (identity == self.0.identity()).then(|| Arc::clone(&self.0))
    }
}
