//! A quinn client and server in one process, and what the tests ask of them.
#![allow(dead_code, reason = "each test file uses its own part")]

pub(crate) mod hello;
pub(crate) mod meddle;
pub(crate) mod pair;
pub(crate) mod pki;
pub(crate) mod stock;
pub(crate) mod wire;

use std::fmt;
use std::net::{Ipv4Addr, SocketAddr};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use axon_tls::qkd::{Psk, PskResolver, derive_psk};
use axon_tls::{Cipher, Negotiated, quic};
use quinn::{ClientConfig, ConnectionError, Endpoint, ServerConfig, TransportConfig};

pub(crate) const CLIENT_SAE: &str = "sae-client";
pub(crate) const SERVER_SAE: &str = "sae-server";
pub(crate) const KEY_ID: &str = "bc490419-7d60-487f-adc1-4ddcc177c139";

/// Returns the key of both ends, or another one, as each end derives it.
pub(crate) fn psk(key: u8, cipher: Cipher) -> Arc<Psk> {
    Arc::new(derive_psk(&[key; 32], KEY_ID, CLIENT_SAE, SERVER_SAE, cipher).unwrap())
}

/// Knows one key, and counts how often it was asked.
pub(crate) struct OneKey {
    psk: Option<Arc<Psk>>,
    pub(crate) asked: AtomicUsize,
}

impl OneKey {
    pub(crate) fn new(psk: Arc<Psk>) -> Arc<Self> {
        Arc::new(Self { psk: Some(psk), asked: AtomicUsize::new(0) })
    }

    pub(crate) fn none() -> Arc<Self> {
        Arc::new(Self { psk: None, asked: AtomicUsize::new(0) })
    }
}

impl fmt::Debug for OneKey {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("OneKey")
    }
}

impl PskResolver for OneKey {
    fn resolve(&self, identity: &[u8]) -> Option<Arc<Psk>> {
        self.asked.fetch_add(1, Ordering::Relaxed);
        self.psk.clone().filter(|psk| psk.identity() == identity)
    }
}

/// The result of each end of a connection.
pub(crate) struct Outcome {
    pub(crate) client: Result<Negotiated, ConnectionError>,
    pub(crate) server: Result<Negotiated, ConnectionError>,
}

impl Outcome {
    /// Returns the alert that both ends saw. Fails if one of them completed the handshake.
    #[track_caller]
    pub(crate) fn alert(&self) -> u8 {
        let client = self.client.as_ref().expect_err("the client must not complete");
        let server = self.server.as_ref().expect_err("the server must not complete");
        let client_alert = quic::tls_alert(client).unwrap_or_else(|| panic!("client: {client:?}"));
        let server_alert = quic::tls_alert(server).unwrap_or_else(|| panic!("server: {server:?}"));
        assert_eq!(client_alert, server_alert);
        client_alert
    }

    #[track_caller]
    pub(crate) fn agreed(self) -> (Negotiated, Negotiated) {
        (self.client.expect("client"), self.server.expect("server"))
    }
}

/// Connects, through a Retry, and if that works has both ends export a secret and send data both ways,
/// with a key update in between.
pub(crate) async fn connect(mut client: ClientConfig, mut server: ServerConfig) -> Outcome {
    // how long a closed connection is waited for depends on it
    let mut transport = TransportConfig::default();
    transport.initial_rtt(Duration::from_millis(20));
    let transport = Arc::new(transport);
    client.transport_config(Arc::clone(&transport));
    server.transport_config(transport);

    let localhost = SocketAddr::from((Ipv4Addr::LOCALHOST, 0));
    let server = Endpoint::server(server, localhost).unwrap();
    let addr = server.local_addr().unwrap();

    let serving = tokio::spawn(async move {
        // the first packet is answered with a Retry, as by a server under load
        server.accept().await.unwrap().retry().unwrap();
        let conn = server.accept().await.unwrap().await?;
        let negotiated = quic::negotiated(&conn);
        serve(&conn).await?;
        conn.closed().await;
        Ok(negotiated.expect("a server's finished connection says what was negotiated"))
    });

    let endpoint = Endpoint::client(localhost).unwrap();
    let dialled = async {
        let conn = endpoint.connect_with(client, addr, "axon").unwrap().await?;
        let negotiated = quic::negotiated(&conn).expect("and so does a client's");
        dial(&conn).await?;
        conn.close(0u32.into(), b"done");
        Ok(negotiated)
    }
    .await;
    endpoint.wait_idle().await;
    Outcome { client: dialled, server: serving.await.unwrap() }
}

const LABEL: &[u8] = b"EXPORTER-axon-test";

async fn dial(conn: &quinn::Connection) -> Result<(), ConnectionError> {
    let mut exported = [0; 32];
    conn.export_keying_material(&mut exported, LABEL, b"context").unwrap();
    let (mut send, mut receive) = conn.open_bi().await?;
    send.write_all(&exported).await.map_err(lost)?;
    send.finish().unwrap();
    conn.force_key_update();
    let echoed = receive.read_to_end(100_000).await.map_err(lost_reading)?;
    assert_eq!(echoed.len(), 70_000, "enough for some packets each way");
    Ok(())
}

async fn serve(conn: &quinn::Connection) -> Result<(), ConnectionError> {
    let mut exported = [0; 32];
    conn.export_keying_material(&mut exported, LABEL, b"context").unwrap();
    let (mut send, mut receive) = conn.accept_bi().await?;
    let received = receive.read_to_end(1_000).await.map_err(lost_reading)?;
    assert_eq!(received, exported, "both ends export the same");
    send.write_all(&[7; 70_000]).await.map_err(lost)?;
    send.finish().unwrap();
    Ok(())
}

fn lost(err: quinn::WriteError) -> ConnectionError {
    match err {
        quinn::WriteError::ConnectionLost(err) => err,
        err => panic!("{err}"),
    }
}

fn lost_reading(err: quinn::ReadToEndError) -> ConnectionError {
    match err {
        quinn::ReadToEndError::Read(quinn::ReadError::ConnectionLost(err)) => err,
        err => panic!("{err}"),
    }
}
