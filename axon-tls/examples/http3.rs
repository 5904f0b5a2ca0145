//! An HTTP/3 server with a web certificate and a client without one, over quinn: X25519MLKEM768 alone.
//!
//! `cargo run --example http3 --features quic`

#![allow(clippy::print_stdout, reason = "an example shows what it did")]

use std::error::Error;

use axon_tls::quinn::Endpoint;
use axon_tls::rustls::RootCertStore;
use axon_tls::rustls::pki_types::{PrivateKeyDer, PrivatePkcs8KeyDer};
use axon_tls::{KeyExchange, hybrid, quic};
use bytes::{Buf, Bytes};

type Failure = Box<dyn Error + Send + Sync>;

#[tokio::main]
pub(crate) async fn main() -> Result<(), Failure> {
    // a certificate that is its own authority; yours comes from a file or from ACME
    let made = rcgen::generate_simple_self_signed(["localhost".to_owned()])?;
    let certificate = made.cert.der().clone();
    let key = PrivateKeyDer::from(PrivatePkcs8KeyDer::from(made.signing_key.serialize_der()));

    let mut tls = hybrid::server_builder()
        .with_no_client_auth()
        .with_single_cert(vec![certificate.clone()], key)?;
    tls.alpn_protocols = vec![b"h3".to_vec()];
    let server = Endpoint::server(quic::hybrid_server_with(tls)?, "127.0.0.1:0".parse()?)?;
    let addr = server.local_addr()?;
    let serving = tokio::spawn(serve(server));

    let mut roots = RootCertStore::empty();
    roots.add(certificate)?;
    let mut tls = hybrid::client_builder().with_root_certificates(roots).with_no_client_auth();
    tls.alpn_protocols = vec![b"h3".to_vec()];
    let endpoint = Endpoint::client("127.0.0.1:0".parse()?)?;
    let conn = endpoint.connect_with(quic::hybrid_client_with(tls)?, addr, "localhost")?.await?;
    let negotiated = quic::negotiated(&conn).ok_or("the handshake is not complete")?;
    assert_eq!(negotiated.key_exchange, KeyExchange::X25519MlKem768);

    let (mut driver, mut requests) = h3::client::new(h3_quinn::Connection::new(conn)).await?;
    let driving = tokio::spawn(async move { driver.wait_idle().await });
    let request = http::Request::get("https://localhost/greeting").body(())?;
    let mut stream = requests.send_request(request).await?;
    stream.finish().await?;
    let response = stream.recv_response().await?;
    let mut body = Vec::new();
    while let Some(part) = stream.recv_data().await? {
        body.extend_from_slice(part.chunk());
    }
    assert_eq!((response.status(), &body[..]), (http::StatusCode::OK, &b"hello"[..]));
    println!(
        "HTTP/3 over {}, {}: {}",
        negotiated.key_exchange,
        negotiated.cipher,
        response.status()
    );

    drop((stream, requests));
    driving.await?;
    endpoint.wait_idle().await;
    serving.await?
}

/// Answers the requests of one connection.
async fn serve(server: Endpoint) -> Result<(), Failure> {
    let conn = server.accept().await.ok_or("closed")?.await?;
    let mut conn: h3::server::Connection<_, Bytes> =
        h3::server::Connection::new(h3_quinn::Connection::new(conn)).await?;
    loop {
        let resolver = match conn.accept().await {
            Ok(Some(resolver)) => resolver,
            Ok(None) => return Ok(()),
            // the client has what it wanted
            Err(err) if err.is_h3_no_error() => return Ok(()),
            Err(err) => return Err(err.into()),
        };
        let (request, mut stream) = resolver.resolve_request().await?;
        assert_eq!(request.uri().path(), "/greeting");
        // to its end: what is dropped before tells the client to stop sending, which fails its request
        while stream.recv_data().await?.is_some() {}
        stream.send_response(http::Response::builder().body(())?).await?;
        stream.send_data(Bytes::from_static(b"hello")).await?;
        stream.finish().await?;
    }
}
