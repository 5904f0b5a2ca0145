//! A client and a server that share a key, over TCP: no certificates.
//!
//! `cargo run --example external_psk`

use std::error::Error;
use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};
use std::sync::Arc;
use std::thread;

use rustls_axon::crypto::aws_lc_rs::{default_provider, kx_group};
use rustls_axon::crypto::hash::HashAlgorithm;
use rustls_axon::crypto::CryptoProvider;
use rustls_axon::external_psk::{
    ExternalPsk, ExternalPskOffer, PskKeyExchangeMode, ResolvesExternalPsk,
};
use rustls_axon::zeroize::Zeroizing;
use rustls_axon::{ClientConfig, ClientConnection, ServerConfig, ServerConnection, StreamOwned};

const IDENTITY: &str = "robot-7 to base";

/// In a program of your own: 32 bytes from a provisioning step, the same on both ends.
fn key() -> Result<Arc<ExternalPsk>, rustls_axon::Error> {
    let secret = Zeroizing::new(vec![0x2a; 32]);
    ExternalPsk::new(IDENTITY, secret, HashAlgorithm::SHA256).map(Arc::new)
}

/// Together with X25519MLKEM768, so that who learns the key later cannot read what was recorded.
fn provider() -> Arc<CryptoProvider> {
    Arc::new(CryptoProvider { kx_groups: vec![kx_group::X25519MLKEM768], ..default_provider() })
}

/// A server with one key.
#[derive(Debug)]
struct OneKey;

impl ResolvesExternalPsk for OneKey {
    fn resolve(&self, offer: ExternalPskOffer<'_>) -> Option<Arc<ExternalPsk>> {
        offer.identities().any(|identity| identity == IDENTITY.as_bytes()).then(key)?.ok()
    }
}

fn serve(listener: &TcpListener, config: ServerConfig) -> std::io::Result<()> {
    let (socket, _) = listener.accept()?;
    let conn = ServerConnection::new(Arc::new(config)).map_err(std::io::Error::other)?;
    let mut stream = StreamOwned::new(conn, socket);
    let mut question = [0; 4];
    stream.read_exact(&mut question)?;
    stream.write_all(b"pong")?;
    stream.conn.send_close_notify();
    stream.flush()
}

fn main() -> Result<(), Box<dyn Error>> {
    let server = ServerConfig::builder_with_provider(provider())
        .with_external_psk_resolver(Arc::new(OneKey), PskKeyExchangeMode::PskDheKe)?;
    let listener = TcpListener::bind("127.0.0.1:0")?;
    let addr = listener.local_addr()?;
    let serving = thread::spawn(move || serve(&listener, server));

    let client = ClientConfig::builder_with_provider(provider())
        .with_external_psks(vec![key()?], PskKeyExchangeMode::PskDheKe)?;
    let conn = ClientConnection::new(Arc::new(client), "base".try_into()?)?;
    let mut stream = StreamOwned::new(conn, TcpStream::connect(addr)?);
    stream.write_all(b"ping")?;
    let mut answer = Vec::new();
    stream.read_to_end(&mut answer)?;
    assert_eq!(answer, b"pong");

    let psk = stream.conn.external_psk().ok_or("not on a pre-shared key")?;
    println!("{:?}, {}", psk.mode(), psk.identity().escape_ascii());
    serving.join().expect("the server does not panic")?;
    Ok(())
}
