//! A server with a certificate and a client that checks it, over TCP with rustls: X25519MLKEM768 alone.
//!
//! `cargo run --example hybrid`

#![allow(clippy::print_stdout, reason = "an example shows what it did")]

use std::error::Error;
use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};
use std::sync::Arc;
use std::thread;

use axon_tls::rustls::pki_types::{PrivateKeyDer, PrivatePkcs8KeyDer};
use axon_tls::rustls::{
    ClientConnection, RootCertStore, ServerConfig, ServerConnection, StreamOwned,
};
use axon_tls::{KeyExchange, hybrid};

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

pub(crate) fn main() -> Result<(), Box<dyn Error + Send + Sync>> {
    // a certificate that is its own authority; yours comes from a file or from ACME
    let made = rcgen::generate_simple_self_signed(["localhost".to_owned()])?;
    let certificate = made.cert.der().clone();
    let key = PrivateKeyDer::from(PrivatePkcs8KeyDer::from(made.signing_key.serialize_der()));

    let server = hybrid::server_builder()
        .with_no_client_auth()
        .with_single_cert(vec![certificate.clone()], key)?;
    let listener = TcpListener::bind("127.0.0.1:0")?;
    let addr = listener.local_addr()?;
    let serving = thread::spawn(move || serve(&listener, server));

    let mut roots = RootCertStore::empty();
    roots.add(certificate)?;
    let client = hybrid::client_builder().with_root_certificates(roots).with_no_client_auth();
    let conn = ClientConnection::new(Arc::new(client), "localhost".try_into()?)?;
    let mut stream = StreamOwned::new(conn, TcpStream::connect(addr)?);
    stream.write_all(b"ping")?;
    let mut answer = Vec::new();
    stream.read_to_end(&mut answer)?;
    assert_eq!(answer, b"pong");

    let negotiated = hybrid::negotiated(&stream.conn).ok_or("the handshake is not complete")?;
    assert_eq!(negotiated.key_exchange, KeyExchange::X25519MlKem768);
    println!("{}, {}", negotiated.key_exchange, negotiated.cipher);
    serving.join().expect("the server does not panic")?;
    Ok(())
}
