//! A client and a server that share a key, over TCP with tokio: no certificates.
//!
//! `cargo run --example psk --features tokio`

#![allow(clippy::print_stdout, reason = "an example shows what it did")]

use std::error::Error;
use std::sync::Arc;

use axon_tls::psk::{self, Psk, PskTable};
use axon_tls::secrecy::SecretSlice;
use axon_tls::stream::{TlsAcceptor, TlsConnector};
use axon_tls::{Cipher, PskKex};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};

/// In a program of your own: 32 bytes from a provisioning step, the same on both ends.
fn secret() -> SecretSlice<u8> {
    vec![0x2a; 32].into()
}

#[tokio::main]
pub(crate) async fn main() -> Result<(), Box<dyn Error + Send + Sync>> {
    // together with X25519MLKEM768, so that who learns the key later cannot read what was recorded
    let (cipher, kex) = (Cipher::default(), PskKex::PskDheKe);
    // the identity is sent in the clear, and the key is for this client and this server alone
    let key = || Psk::new("robot-7 to base", secret(), cipher).map(Arc::new);

    let known = PskTable::new([key()?])?;
    let server = psk::server_config(Arc::new(known), cipher, kex, b"example/1")?;
    let acceptor = TlsAcceptor::from(Arc::new(server));
    let listener = TcpListener::bind("127.0.0.1:0").await?;
    let addr = listener.local_addr()?;
    let serving = tokio::spawn(async move {
        let mut stream = acceptor.accept(listener.accept().await?.0).await?;
        let mut question = Vec::new();
        stream.read_to_end(&mut question).await?;
        stream.write_all(&question).await?;
        stream.shutdown().await
    });

    let client = psk::client_config(vec![key()?], kex, b"example/1")?;
    let connector = TlsConnector::from(Arc::new(client));
    let socket = TcpStream::connect(addr).await?;
    let mut stream = connector.connect("base".try_into()?, socket).await?;
    stream.write_all(b"hello").await?;
    stream.shutdown().await?;
    let mut answer = Vec::new();
    stream.read_to_end(&mut answer).await?;
    assert_eq!(answer, b"hello");

    let negotiated = stream.negotiated().ok_or("not on a pre-shared key")?;
    let identity = negotiated.psk_identity.unwrap_or_default();
    println!("{}, {}, {}", negotiated.key_exchange, negotiated.cipher, identity.escape_ascii());
    serving.await??;
    Ok(())
}
