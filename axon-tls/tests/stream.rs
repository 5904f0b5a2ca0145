//! Connections over byte streams of tokio: whole, cut off, stuck, half closed, in small pieces.
#![cfg(feature = "tokio")]

mod pieces;

use std::io::ErrorKind;
use std::pin::pin;
use std::sync::Arc;
use std::task::{Context, Waker};

use axon_tls::psk::{self, Psk, PskTable};
use axon_tls::rustls_axon::{AlertDescription, ClientConfig, Error, PeerMisbehaved, ServerConfig};
use axon_tls::stream::{TlsAcceptor, TlsConnector, TlsStream};
use axon_tls::{Cipher, KeyExchange, PskKex};
use pieces::{Pieces, Shared};
use tokio::io::{
    AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt, BufWriter, DuplexStream, duplex, split,
};
use tokio::net::{TcpListener, TcpStream};

fn key(secret: u8, cipher: Cipher) -> Arc<Psk> {
    Arc::new(Psk::new("a key", vec![secret; 32].into(), cipher).unwrap())
}

fn client(secret: u8, cipher: Cipher, kex: PskKex) -> Arc<ClientConfig> {
    Arc::new(psk::client_config(vec![key(secret, cipher)], kex, b"test/1").unwrap())
}

fn server(secret: u8, cipher: Cipher, kex: PskKex) -> Arc<ServerConfig> {
    let table = PskTable::new([key(secret, cipher)]).unwrap();
    Arc::new(psk::server_config(Arc::new(table), cipher, kex, b"test/1").unwrap())
}

fn connector() -> TlsConnector {
    client(1, Cipher::default(), PskKex::PskDheKe).into()
}

fn acceptor() -> TlsAcceptor {
    server(1, Cipher::default(), PskKex::PskDheKe).into()
}

async fn dial<IO: AsyncRead + AsyncWrite + Unpin>(io: IO) -> std::io::Result<TlsStream<IO>> {
    connector().connect("server".try_into().unwrap(), io).await
}

/// Returns both ends of a connection over `near` and `far`.
async fn connected<N, F>(near: N, far: F) -> (TlsStream<N>, TlsStream<F>)
where
    N: AsyncRead + AsyncWrite + Unpin,
    F: AsyncRead + AsyncWrite + Unpin,
{
    let acceptor = acceptor();
    let (near, far) = tokio::join!(dial(near), acceptor.accept(far));
    (near.unwrap(), far.unwrap())
}

/// Returns the error of rustls in an error of a stream.
#[track_caller]
fn tls_error(err: &std::io::Error) -> &Error {
    assert_eq!(err.kind(), ErrorKind::InvalidData, "{err}");
    err.get_ref().unwrap().downcast_ref().unwrap()
}

/// Sends and receives `len` bytes on both ends at once, ends both directions, and checks it all.
async fn exchange<N, F>(near: TlsStream<N>, far: TlsStream<F>, len: usize)
where
    N: AsyncRead + AsyncWrite + Unpin + Send + 'static,
    F: AsyncRead + AsyncWrite + Unpin + Send + 'static,
{
    async fn end<IO>(stream: TlsStream<IO>, sends: u8, len: usize)
    where
        IO: AsyncRead + AsyncWrite + Unpin + Send + 'static,
    {
        let (mut read, mut write) = split(stream);
        let writing = tokio::spawn(async move {
            let data: Vec<u8> = (0..len).map(|at| (at % 251) as u8 ^ sends).collect();
            write.write_all(&data).await.unwrap();
            write.shutdown().await.unwrap();
        });
        let mut received = Vec::new();
        read.read_to_end(&mut received).await.unwrap();
        assert_eq!(received.len(), len);
        let expected = |(at, byte): (usize, &u8)| *byte == (at % 251) as u8 ^ sends ^ 0xff;
        assert!(received.iter().enumerate().all(expected));
        writing.await.unwrap();
    }
    tokio::join!(end(near, 0x0f, len), end(far, 0xf0, len));
}

#[tokio::test]
async fn every_mode_works_over_tcp() {
    for cipher in Cipher::ALL {
        for (kex, key_exchange) in
            [(PskKex::PskKe, KeyExchange::PskKe), (PskKex::PskDheKe, KeyExchange::PskDheKe)]
        {
            let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
            let near = TcpStream::connect(listener.local_addr().unwrap()).await.unwrap();
            let far = listener.accept().await.unwrap().0;
            let connector = TlsConnector::from(client(1, cipher, kex));
            let acceptor = TlsAcceptor::from(server(1, cipher, kex));
            let name = "server".try_into().unwrap();
            let (near, far) = tokio::join!(connector.connect(name, near), acceptor.accept(far));
            let (near, far) = (near.unwrap(), far.unwrap());

            let negotiated = near.negotiated().unwrap();
            assert_eq!(far.negotiated().as_ref(), Some(&negotiated));
            assert_eq!((negotiated.key_exchange, negotiated.cipher), (key_exchange, cipher));
            assert_eq!(negotiated.psk_identity.unwrap(), b"a key");
            assert_eq!(negotiated.alpn, b"test/1");
            let export = |stream: &TlsStream<_>| {
                stream.connection().export_keying_material([0; 32], b"EXPORTER-test", None).unwrap()
            };
            assert_eq!(export(&near), export(&far));
            exchange(near, far, 1_000_000).await;
        }
    }
}

#[tokio::test]
async fn pipes_of_any_size_work_in_both_directions_at_once() {
    for (size, len) in [(1, 3_000), (7, 20_000), (1_000, 300_000), (100_000, 1_000_000)] {
        let (near, far) = duplex(size);
        let (near, far) = connected(near, far).await;
        exchange(near, far, len).await;
    }
}

#[tokio::test]
async fn pending_and_partial_calls_lose_nothing() {
    for most in [1, 5, 4_096] {
        let (near, far) = duplex(10_000);
        let (near, far) = connected(Pieces::new(near, most), Pieces::new(far, most)).await;
        exchange(near, far, 20_000).await;
    }
}

/// An underlying stream that keeps what is written until it is flushed.
#[tokio::test]
async fn underlying_stream_with_a_buffer_is_flushed() {
    let (near, far) = duplex(100_000);
    let (mut near, mut far) = connected(BufWriter::new(near), BufWriter::new(far)).await;
    near.write_all(b"question").await.unwrap();
    near.flush().await.unwrap();
    let mut question = [0; 8];
    far.read_exact(&mut question).await.unwrap();
    far.write_all(b"answer").await.unwrap();
    far.shutdown().await.unwrap();
    let mut answer = Vec::new();
    near.read_to_end(&mut answer).await.unwrap();
    assert_eq!((&question, &answer[..]), (b"question", &b"answer"[..]));
}

#[tokio::test]
async fn half_closed_stream_goes_on_in_the_other_direction() {
    let (near, far) = duplex(1_000);
    let (mut near, mut far) = connected(near, far).await;
    near.write_all(b"last words").await.unwrap();
    near.shutdown().await.unwrap();
    near.shutdown().await.unwrap();
    let err = near.write(b"more").await.unwrap_err();
    assert_eq!(err.kind(), ErrorKind::BrokenPipe);

    let mut received = Vec::new();
    far.read_to_end(&mut received).await.unwrap();
    assert_eq!(received, b"last words");
    assert_eq!(far.read(&mut [0; 8]).await.unwrap(), 0, "the end stays the end");

    let answer = vec![7; 50_000];
    let (sent, received) = tokio::join!(
        async {
            far.write_all(&answer).await?;
            far.shutdown().await
        },
        async {
            let mut received = Vec::new();
            near.read_to_end(&mut received).await.map(|_| received)
        }
    );
    sent.unwrap();
    assert_eq!(received.unwrap(), answer);
}

#[tokio::test]
async fn truncated_stream_returns_the_received_bytes_then_unexpected_eof() {
    let (near, far) = duplex(100_000);
    let (mut near, mut far) = connected(near, far).await;
    far.write_all(b"the first half").await.unwrap();
    drop(far);
    let mut received = [0; 14];
    near.read_exact(&mut received).await.unwrap();
    assert_eq!(&received, b"the first half");
    for _ in 0..2 {
        let err = near.read(&mut [0; 8]).await.unwrap_err();
        assert_eq!(err.kind(), ErrorKind::UnexpectedEof);
    }
}

/// An attacker can end the byte stream, and cannot forge the close_notify.
#[tokio::test]
async fn plain_end_of_the_underlying_stream_is_no_end_of_data() {
    let (near, far) = duplex(100_000);
    let (mut near, far) = connected(near, far).await;
    let mut raw = far.into_inner();
    // close_notify as it is without encryption
    raw.write_all(&[21, 3, 3, 0, 2, 1, 0]).await.unwrap();
    raw.shutdown().await.unwrap();
    let err = near.read(&mut [0; 8]).await.unwrap_err();
    assert_eq!(err.kind(), ErrorKind::InvalidData);
    assert!(near.read(&mut [0; 8]).await.is_err(), "and it stays an error");
}

#[tokio::test]
async fn forged_record_is_an_error_after_valid_data_and_alerts_the_peer() {
    let (near, far) = duplex(100_000);
    let far = Shared::new(far);
    let mut past_tls = far.clone();
    let (mut near, mut far) = connected(near, far).await;
    far.write_all(b"good").await.unwrap();
    far.flush().await.unwrap();
    let mut forged = vec![23, 3, 3, 0, 40];
    forged.resize(5 + 40, 0x55);
    past_tls.write_all(&forged).await.unwrap();

    let mut received = [0; 4];
    near.read_exact(&mut received).await.unwrap();
    assert_eq!(&received, b"good");
    for _ in 0..2 {
        let err = near.read(&mut [0; 8]).await.unwrap_err();
        assert_eq!(tls_error(&err), &Error::DecryptError);
    }
    assert_eq!(tls_error(&near.write(b"x").await.unwrap_err()), &Error::DecryptError);
    assert!(near.flush().await.is_err());
    near.shutdown().await.unwrap();

    let told = far.read(&mut [0; 8]).await.unwrap_err();
    assert_eq!(tls_error(&told), &Error::AlertReceived(AlertDescription::BadRecordMac));
}

#[tokio::test]
async fn peer_that_stops_in_the_handshake_is_an_error_or_can_be_given_up() {
    // what a client sends first, in part: nothing, a part of a header, of a record, all of it
    let (near, mut far) = duplex(100_000);
    let mut hello = vec![0; 10_000];
    let sent = {
        let mut dialling = pin!(dial(near));
        let mut cx = Context::from_waker(Waker::noop());
        assert!(dialling.as_mut().poll(&mut cx).is_pending());
        far.read(&mut hello).await.unwrap()
    };
    for len in [0, 3, sent / 2, sent] {
        let (mut near, far) = duplex(100_000);
        near.write_all(&hello[..len]).await.unwrap();
        let acceptor = acceptor();
        let mut accepting = pin!(acceptor.accept(far));
        // as long as the client is there, it is waited for
        let mut cx = Context::from_waker(Waker::noop());
        assert!(accepting.as_mut().poll(&mut cx).is_pending());
        near.shutdown().await.unwrap();
        let err = accepting.await.unwrap_err();
        assert_eq!(err.kind(), ErrorKind::UnexpectedEof, "after {len} bytes");
    }

    // giving a handshake up closes the underlying stream
    let (mut near, far) = duplex(100_000);
    near.write_all(&hello[..3]).await.unwrap();
    let acceptor = acceptor();
    {
        let mut accepting = pin!(acceptor.accept(far));
        let mut cx = Context::from_waker(Waker::noop());
        assert!(accepting.as_mut().poll(&mut cx).is_pending());
    }
    assert_eq!(near.read(&mut [0; 8]).await.unwrap(), 0);
}

#[tokio::test]
async fn acceptor_refuses_a_plaintext_request() {
    let (mut near, far) = duplex(100_000);
    near.write_all(b"GET / HTTP/1.1\r\n\r\n").await.unwrap();
    let err = acceptor().accept(far).await.unwrap_err();
    assert_eq!(err.kind(), ErrorKind::InvalidData);
}

/// Returns the errors of both ends of a handshake that fails.
async fn refused(
    client: Arc<ClientConfig>,
    server: Arc<ServerConfig>,
) -> (std::io::Error, std::io::Error) {
    let (near, far) = duplex(100_000);
    let (connector, acceptor) = (TlsConnector::from(client), TlsAcceptor::from(server));
    let name = "server".try_into().unwrap();
    let (near, far) = tokio::join!(connector.connect(name, near), acceptor.accept(far));
    (near.unwrap_err(), far.unwrap_err())
}

#[tokio::test]
async fn wrong_key_and_unknown_identity_and_another_mode_are_refused() {
    let [cipher, other] = Cipher::ALL;
    for kex in PskKex::ALL {
        let (near, far) = refused(client(1, cipher, kex), server(2, cipher, kex)).await;
        let alert = Error::AlertReceived(AlertDescription::DecryptError);
        assert_eq!(tls_error(&near), &alert);
        let wrong = Error::PeerMisbehaved(PeerMisbehaved::IncorrectBinder);
        assert_eq!(tls_error(&far), &wrong);

        let nobody = PskTable::default();
        let nobody = psk::server_config(Arc::new(nobody), cipher, kex, b"test/1").unwrap();
        let (near, _) = refused(client(1, cipher, kex), Arc::new(nobody)).await;
        let alert = Error::AlertReceived(AlertDescription::UnknownPSKIdentity);
        assert_eq!(tls_error(&near), &alert);

        let (near, _) = refused(client(1, cipher, kex), server(1, other, kex)).await;
        assert!(matches!(tls_error(&near), Error::AlertReceived(_)));
    }
    let (near, _) =
        refused(client(1, cipher, PskKex::PskKe), server(1, cipher, PskKex::PskDheKe)).await;
    assert!(matches!(tls_error(&near), Error::AlertReceived(_)));
}

#[tokio::test]
async fn client_with_an_erased_key_does_not_begin() {
    let key = key(1, Cipher::default());
    let config = psk::client_config(vec![Arc::clone(&key)], PskKex::PskKe, b"").unwrap();
    key.erase();
    let (near, mut far) = duplex(1_000);
    let connector = TlsConnector::from(Arc::new(config));
    let err = connector.connect("server".try_into().unwrap(), near).await.unwrap_err();
    assert_eq!(err.kind(), ErrorKind::InvalidInput);
    assert_eq!(far.read(&mut [0; 8]).await.unwrap(), 0, "nothing was sent");
}

#[tokio::test]
async fn dropped_reads_and_writes_lose_nothing() {
    let (near, far) = duplex(3);
    let (mut near, mut far) = connected(near, far).await;
    let data: Vec<u8> = (0..5_000).map(|at| (at % 251) as u8).collect();
    let sent = data.clone();
    let writing = tokio::spawn(async move {
        let mut at = 0;
        while at < sent.len() {
            // the losing future is dropped, in the middle of a record
            tokio::select! {
                biased;
                written = far.write(&sent[at..]) => at += written.unwrap(),
                () = tokio::task::yield_now() => {}
            }
        }
        loop {
            tokio::select! {
                biased;
                done = far.shutdown() => break done.unwrap(),
                () = tokio::task::yield_now() => {}
            }
        }
    });
    let mut received = Vec::new();
    let mut buf = [0; 100];
    loop {
        tokio::select! {
            biased;
            read = near.read(&mut buf) => match read.unwrap() {
                0 => break,
                len => received.extend_from_slice(&buf[..len]),
            },
            () = tokio::task::yield_now() => {}
        }
    }
    writing.await.unwrap();
    assert_eq!(received, data);
}

/// A task that waits to write is woken although another that reads met an error meanwhile.
#[tokio::test]
async fn reader_that_fails_does_not_take_the_waker_of_a_writer() {
    let (near, far) = duplex(2_000);
    let (near, far) = connected(near, far).await;
    let mut raw = far.into_inner();
    let (mut read, mut write) = split(near);
    let writing = tokio::spawn(async move {
        loop {
            if let Err(err) = write.write_all(&[7; 10_000]).await {
                return err;
            }
        }
    });
    let reading = tokio::spawn(async move { read.read(&mut [0; 8]).await.unwrap_err() });
    tokio::task::yield_now().await;

    let mut forged = vec![23, 3, 3, 0, 40];
    forged.resize(5 + 40, 0x55);
    raw.write_all(&forged).await.unwrap();
    assert_eq!(tls_error(&reading.await.unwrap()), &Error::DecryptError);
    // nobody read so far, so the writer is stuck in a full pipe
    let draining =
        tokio::spawn(async move { while raw.read(&mut [0; 1_000]).await.unwrap() > 0 {} });
    assert_eq!(tls_error(&writing.await.unwrap()), &Error::DecryptError);
    draining.await.unwrap();
}

#[test]
fn nothing_inside_is_printed() {
    assert_eq!(format!("{:?}", connector()), "TlsConnector { .. }");
    assert_eq!(format!("{:?}", acceptor()), "TlsAcceptor { .. }");
}

#[test]
fn streams_can_be_sent_to_other_tasks() {
    fn is_send<T: Send + Sync + Unpin>() {}
    is_send::<TlsStream<DuplexStream>>();
    is_send::<(TlsConnector, TlsAcceptor)>();
}
