//! The process whose memory is looked at: both ends of one QUIC connection.

use std::any::Any;
use std::fmt;
use std::fs::File;
use std::io::{Read, Write};
use std::net::{Ipv4Addr, SocketAddr};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use axon_tls::qkd::{Psk, PskResolver, derive_psk};
use axon_tls::{Cipher, PskKex, quic};
use quinn::crypto::{
    self, ExportKeyingMaterialError, HeaderKey, KeyPair, Keys, PacketKey, UnsupportedVersion,
};
use quinn::{Connection, Endpoint, Side, TransportConfig};
use quinn_proto::transport_parameters::TransportParameters;
use quinn_proto::{ConnectionId, TransportError};
use tokio::runtime::{Builder, Runtime};
use zeroize::Zeroizing;

/// Set in the environment of the child: cipher and mode.
pub(crate) const ASKED: &str = "AXON_TLS_MEMORY_CHILD";
/// What the child says in front of its transcript, when it is connected and data was exchanged.
pub(crate) const CONNECTED: &str = "connected: ";
/// What it says when everything that had a secret is dropped.
pub(crate) const DROPPED: &str = "dropped: ";

pub(crate) const KEY_ID: &str = "bc490419-7d60-487f-adc1-4ddcc177c139";
pub(crate) const CLIENT_SAE: &str = "sae-client";
pub(crate) const SERVER_SAE: &str = "sae-server";
pub(crate) const EXPORTER: &str = "EXPORTER-axon-test";
const SENT: usize = 70_000;

/// What the child leaves in memory on purpose, from the key that it is given.
pub(crate) fn marks(key: &[u8; 32]) -> [[u8; 32]; 2] {
    [0x55, 0xaa].map(|mask| key.map(|byte| byte ^ mask))
}

pub(crate) fn run_if_asked() {
    let Ok(asked) = std::env::var(ASKED) else { return };
    let (cipher, kex) = asked.split_once(' ').unwrap();
    let (cipher, kex) = (cipher.parse().unwrap(), kex.parse().unwrap());

    // not through a buffer that keeps it, and not where moves would copy it
    let mut parent = File::open("/dev/stdin").unwrap();
    let mut key = Box::new(Zeroizing::new([0_u8; 32]));
    parent.read_exact(key.as_mut_slice()).unwrap();
    // the first mark
    let held: Vec<u8> = key.iter().map(|byte| byte ^ 0x55).collect();

    let runtime = Builder::new_multi_thread().worker_threads(2).enable_all().build().unwrap();
    let ends = Ends::connect(&runtime, &key, cipher, kex);
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
    client: Endpoint,
    server: Endpoint,
    connections: [Connection; 2],
    messages: Messages,
}

impl Ends {
    fn connect(runtime: &Runtime, key: &[u8; 32], cipher: Cipher, kex: PskKex) -> Self {
        let derive = || Arc::new(derive_psk(key, KEY_ID, CLIENT_SAE, SERVER_SAE, cipher).unwrap());
        let messages = Messages::default();
        let mut server =
            quic::qkd_server(Arc::new(OneKey(derive())), cipher, kex, quic::ALPN).unwrap();
        server.crypto = Arc::new(TappedServer(server.crypto.clone(), messages.clone()));
        let mut client = quic::qkd_client(derive(), kex, quic::ALPN).unwrap();

        // how long a closed connection is waited for depends on it
        let mut transport = TransportConfig::default();
        transport.initial_rtt(Duration::from_millis(20));
        let transport = Arc::new(transport);
        client.transport_config(Arc::clone(&transport));
        server.transport_config(transport);

        runtime.block_on(async move {
            let localhost = SocketAddr::from((Ipv4Addr::LOCALHOST, 0));
            let server = Endpoint::server(server, localhost).unwrap();
            let addr = server.local_addr().unwrap();
            let accepting = server.clone();
            let serving = tokio::spawn(async move {
                let connection = accepting.accept().await.unwrap().await.unwrap();
                serve(&connection).await;
                connection
            });
            let endpoint = Endpoint::client(localhost).unwrap();
            let dialled = endpoint.connect_with(client, addr, "axon").unwrap().await.unwrap();
            dial(&dialled).await;
            let connections = [dialled, serving.await.unwrap()];
            Self { client: endpoint, server, connections, messages }
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
            self.client.wait_idle().await;
            self.server.wait_idle().await;
        });
    }
}

/// Exports, sends and updates the keys, so that every secret was used.
async fn dial(connection: &Connection) {
    let mut exported = Zeroizing::new([0; 32]);
    connection.export_keying_material(&mut *exported, EXPORTER.as_bytes(), b"").unwrap();
    let (mut send, mut receive) = connection.open_bi().await.unwrap();
    send.write_all(b"to the server").await.unwrap();
    send.finish().unwrap();
    connection.force_key_update();
    assert_eq!(receive.read_to_end(SENT).await.unwrap().len(), SENT);
}

async fn serve(connection: &Connection) {
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

type Messages = Arc<Mutex<Vec<u8>>>;

/// A server that notes the handshake messages, none of which is a secret.
struct TappedServer(Arc<dyn crypto::ServerConfig>, Messages);

impl crypto::ServerConfig for TappedServer {
    fn initial_keys(&self, version: u32, id: &ConnectionId) -> Result<Keys, UnsupportedVersion> {
        self.0.initial_keys(version, id)
    }

    fn retry_tag(&self, version: u32, id: &ConnectionId, packet: &[u8]) -> [u8; 16] {
        self.0.retry_tag(version, id, packet)
    }

    fn start_session(
        self: Arc<Self>,
        version: u32,
        params: &TransportParameters,
    ) -> Box<dyn crypto::Session> {
        Box::new(Tapped(self.0.clone().start_session(version, params), self.1.clone()))
    }
}

struct Tapped(Box<dyn crypto::Session>, Messages);

impl crypto::Session for Tapped {
    fn initial_keys(&self, id: &ConnectionId, side: Side) -> Keys {
        self.0.initial_keys(id, side)
    }

    fn handshake_data(&self) -> Option<Box<dyn Any>> {
        self.0.handshake_data()
    }

    fn peer_identity(&self) -> Option<Box<dyn Any>> {
        self.0.peer_identity()
    }

    fn early_crypto(&self) -> Option<(Box<dyn HeaderKey>, Box<dyn PacketKey>)> {
        self.0.early_crypto()
    }

    fn early_data_accepted(&self) -> Option<bool> {
        self.0.early_data_accepted()
    }

    fn is_handshaking(&self) -> bool {
        self.0.is_handshaking()
    }

    fn read_handshake(&mut self, buf: &[u8]) -> Result<bool, TransportError> {
        self.1.lock().unwrap().extend(buf);
        self.0.read_handshake(buf)
    }

    fn transport_parameters(&self) -> Result<Option<TransportParameters>, TransportError> {
        self.0.transport_parameters()
    }

    fn write_handshake(&mut self, buf: &mut Vec<u8>) -> Option<Keys> {
        let before = buf.len();
        let keys = self.0.write_handshake(buf);
        self.1.lock().unwrap().extend(&buf[before..]);
        keys
    }

    fn next_1rtt_keys(&mut self) -> Option<KeyPair<Box<dyn PacketKey>>> {
        self.0.next_1rtt_keys()
    }

    fn is_valid_retry(&self, id: &ConnectionId, header: &[u8], payload: &[u8]) -> bool {
        self.0.is_valid_retry(id, header, payload)
    }

    fn export_keying_material(
        &self,
        output: &mut [u8],
        label: &[u8],
        context: &[u8],
    ) -> Result<(), ExportKeyingMaterialError> {
        self.0.export_keying_material(output, label, context)
    }
}
