//! A client and a server that share a key, over QUIC with quinn: no certificates.
//!
//! `cargo run --example quic_psk --features quic`

#![allow(clippy::print_stdout, reason = "an example shows what it did")]

use std::error::Error;
use std::sync::Arc;

use axon_tls::psk::{Psk, PskTable};
use axon_tls::quinn::Endpoint;
use axon_tls::secrecy::SecretSlice;
use axon_tls::{Cipher, PskKex, quic};

/// In a program of your own: 32 bytes from a provisioning step, the same on both ends.
fn secret() -> SecretSlice<u8> {
    vec![0x2a; 32].into()
}

#[tokio::main]
pub(crate) async fn main() -> Result<(), Box<dyn Error + Send + Sync>> {
    let (cipher, kex) = (Cipher::default(), PskKex::PskDheKe);
    let key = || Psk::new("robot-7 to base", secret(), cipher).map(Arc::new);

    let known = PskTable::new([key()?])?;
    let server = quic::psk_server(Arc::new(known), cipher, kex, b"example/1")?;
    let server = Endpoint::server(server, "127.0.0.1:0".parse()?)?;
    let addr = server.local_addr()?;
    let serving = tokio::spawn(async move {
        let conn = server.accept().await.ok_or("closed")?.await?;
        let (mut send, mut receive) = conn.accept_bi().await?;
        send.write_all(&receive.read_to_end(1_000).await?).await?;
        send.finish()?;
        conn.closed().await;
        Ok::<_, Box<dyn Error + Send + Sync>>(())
    });

    let client = quic::psk_client(vec![key()?], kex, b"example/1")?;
    let endpoint = Endpoint::client("127.0.0.1:0".parse()?)?;
    // no name is checked: the key says who the server is
    let conn = endpoint.connect_with(client, addr, "base")?.await?;
    let (mut send, mut receive) = conn.open_bi().await?;
    send.write_all(b"hello").await?;
    send.finish()?;
    assert_eq!(receive.read_to_end(1_000).await?, b"hello");

    let negotiated = quic::negotiated(&conn).ok_or("the handshake is not complete")?;
    let identity = negotiated.psk_identity.unwrap_or_default();
    println!("{}, {}, {}", negotiated.key_exchange, negotiated.cipher, identity.escape_ascii());
    conn.close(0_u32.into(), b"done");
    endpoint.wait_idle().await;
    serving.await??;
    Ok(())
}
