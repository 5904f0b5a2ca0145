//! Connections of rustls-axon over byte streams of tokio.
//!
//! [`TlsConnector`], [`TlsAcceptor`] and [`TlsStream`] are for [`rustls_axon`] what
//! [tokio-rustls](https://docs.rs/tokio-rustls) is for the released rustls. They work over a `TcpStream`, a
//! `UnixStream` or any type that is `AsyncRead + AsyncWrite + Unpin`. They take any configuration of rustls-axon.
//! Configurations of [`crate::psk`] and [`crate::qkd`] complete on a pre-shared key or fail.
//!
//! ```
//! use std::sync::Arc;
//!
//! use axon_tls::psk::{self, Psk, PskTable};
//! use axon_tls::stream::{TlsAcceptor, TlsConnector};
//! use axon_tls::{Cipher, PskKex};
//! use tokio::io::{AsyncReadExt, AsyncWriteExt};
//!
//! # #[tokio::main(flavor = "current_thread")]
//! # async fn main() -> Result<(), Box<dyn std::error::Error>> {
//! let (cipher, kex) = (Cipher::default(), PskKex::PskDheKe);
//! let key = || Psk::new("key 1", vec![7; 32].into(), cipher).map(Arc::new);
//! let client = psk::client_config(vec![key()?], kex, b"")?;
//! let server = psk::server_config(Arc::new(PskTable::new([key()?])?), cipher, kex, b"")?;
//!
//! let (near, far) = tokio::io::duplex(1024);
//! let served = tokio::spawn(async move {
//!     let mut stream = TlsAcceptor::from(Arc::new(server)).accept(far).await?;
//!     stream.write_all(b"hello").await?;
//!     stream.shutdown().await
//! });
//! let connector = TlsConnector::from(Arc::new(client));
//! let mut stream = connector.connect("base".try_into()?, near).await?;
//! let mut received = Vec::new();
//! stream.read_to_end(&mut received).await?;
//! assert_eq!(received, b"hello");
//! served.await??;
//! # Ok(())
//! # }
//! ```
//!
//! # The end of a stream
//!
//! - `shutdown()` sends a close_notify alert and then shuts the underlying stream down for writing. Reading continues
//!   until the peer does the same (RFC 8446 section 6.1).
//! - A read of 0 bytes means that the peer sent close_notify: nothing is missing.
//! - An underlying stream that ends without close_notify was cut off, by a crash or an attacker. What arrived before is
//!   read first, and then the error is [`io::ErrorKind::UnexpectedEof`].
//! - A stream that is dropped sends no close_notify: its peer sees that error. Data that was accepted for writing is
//!   certainly sent only after `flush()` or `shutdown()` has returned.
//! - A violation of the protocol, for example a changed record, is [`io::ErrorKind::InvalidData`] with the
//!   [`rustls_axon::Error`] inside. The peer receives an alert, and the stream can no longer be used.
//!
//! # Cancel safety
//!
//! Dropping a future of [`connect()`](TlsConnector::connect) or [`accept()`](TlsAcceptor::accept) drops the underlying
//! stream. Use a timeout around it, because a peer may never answer. Reads and writes are as cancel safe as those of a
//! `TcpStream`: `read()` and `write()` are, and `read_exact()` and `write_all()` are not.

use std::fmt;
use std::io::{self, IoSlice, Read, Write};
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll, ready};

use rustls_axon::pki_types::ServerName;
use rustls_axon::{
    ClientConfig, ClientConnection, Connection, Error, ServerConfig, ServerConnection,
};
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};

use crate::Negotiated;
use crate::erase::{erasing_stack, erasing_stack_of_record};

/// Connects to servers.
#[derive(Clone)]
pub struct TlsConnector {
    config: Arc<ClientConfig>,
}

impl TlsConnector {
    /// Performs the handshake over `io` as the client.
    ///
    /// `name` is for configurations that check or send the server's name, which those of this crate do not.
    ///
    /// The server may still refuse the client after this has returned. The first read reports that.
    ///
    /// # Errors
    /// Those of `io`; [`io::ErrorKind::UnexpectedEof`] if it ends during the handshake; [`io::ErrorKind::InvalidData`]
    /// if either end refuses the other; [`io::ErrorKind::InvalidInput`] if the configuration cannot make a connection,
    /// for example because its keys are erased.
    pub async fn connect<IO>(&self, name: ServerName<'static>, io: IO) -> io::Result<TlsStream<IO>>
    where
        IO: AsyncRead + AsyncWrite + Unpin,
    {
        // the ClientHello has a binder, which is computed with the pre-shared key
        let new = || ClientConnection::new(Arc::clone(&self.config), name).map(Connection::from);
        TlsStream::new(erasing_stack(new), io)?.shake_hands().await
    }
}

impl From<Arc<ClientConfig>> for TlsConnector {
    fn from(config: Arc<ClientConfig>) -> Self {
        Self { config }
    }
}

impl fmt::Debug for TlsConnector {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("TlsConnector").finish_non_exhaustive()
    }
}

/// Accepts the connections of clients.
#[derive(Clone)]
pub struct TlsAcceptor {
    config: Arc<ServerConfig>,
}

impl TlsAcceptor {
    /// Performs the handshake over `io` as the server. The client's Finished has been verified when this returns.
    ///
    /// # Errors
    /// The same as for [`TlsConnector::connect()`].
    pub async fn accept<IO>(&self, io: IO) -> io::Result<TlsStream<IO>>
    where
        IO: AsyncRead + AsyncWrite + Unpin,
    {
        let conn = ServerConnection::new(Arc::clone(&self.config)).map(Connection::from);
        TlsStream::new(conn, io)?.shake_hands().await
    }
}

impl From<Arc<ServerConfig>> for TlsAcceptor {
    fn from(config: Arc<ServerConfig>) -> Self {
        Self { config }
    }
}

impl fmt::Debug for TlsAcceptor {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("TlsAcceptor").finish_non_exhaustive()
    }
}

/// A TLS connection over `IO` whose handshake is complete.
///
/// The [module](self) describes how it ends and which operations are cancel safe.
pub struct TlsStream<IO> {
    io: IO,
    conn: Connection,
    /// The reason why the connection can no longer be used.
    failed: Option<Error>,
    /// Whether writing has ended.
    shut_down: bool,
    /// Whether `io` holds the waker of a task that waits to write. A task that reads must not replace it.
    writer_waits: bool,
}

impl<IO> TlsStream<IO> {
    /// Returns the result of the handshake. Returns `None` if the connection is not on an external pre-shared key. A
    /// connection of [`crate::psk`] always is.
    pub fn negotiated(&self) -> Option<Negotiated> {
        crate::psk::negotiated(&self.conn)
    }

    /// Returns the connection, for queries and to export keying material.
    pub fn connection(&self) -> &Connection {
        &self.conn
    }

    /// Returns the underlying stream.
    pub fn get_ref(&self) -> &IO {
        &self.io
    }

    /// Returns the underlying stream, without the connection. Bytes that were read from it, or not yet written to it,
    /// are lost.
    pub fn into_inner(self) -> IO {
        self.io
    }

    fn new(conn: Result<Connection, Error>, io: IO) -> io::Result<Self> {
        let conn = conn.map_err(|err| io::Error::new(io::ErrorKind::InvalidInput, err))?;
        Ok(Self { io, conn, failed: None, shut_down: false, writer_waits: false })
    }
}

impl<IO: AsyncRead + AsyncWrite + Unpin> TlsStream<IO> {
    async fn shake_hands(mut self) -> io::Result<Self> {
        std::future::poll_fn(|cx| self.poll_handshake(cx)).await?;
        Ok(self)
    }

    fn poll_handshake(&mut self, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        loop {
            let sent = match self.poll_send(cx) {
                Poll::Ready(Err(err)) => {
                    // a peer that refused this end and closed the stream may have sent the reason before
                    let _ = self.poll_receive(cx);
                    return Poll::Ready(Err(self.failure().unwrap_or(err)));
                }
                sent => sent,
            };
            if !self.conn.is_handshaking() {
                ready!(sent)?;
                return self.poll_flush_io(cx);
            }
            match self.poll_receive(cx)? {
                Poll::Ready(0) => {
                    let why = "the peer ended the stream during the TLS handshake";
                    return Poll::Ready(Err(io::Error::new(io::ErrorKind::UnexpectedEof, why)));
                }
                Poll::Ready(_) => {}
                Poll::Pending => {
                    // the peer cannot answer bytes that are still in a buffer of `io`
                    if sent.is_ready() {
                        let _ = self.poll_flush_io(cx)?;
                    }
                    return Poll::Pending;
                }
            }
        }
    }

    /// Reads once from `io`, and processes the received bytes. Ready with 0 at the end of `io`.
    fn poll_receive(&mut self, cx: &mut Context<'_>) -> Poll<io::Result<usize>> {
        let mut from = Blocking { io: &mut self.io, cx };
        let len = match self.conn.read_tls(&mut from) {
            Err(err) if err.kind() == io::ErrorKind::WouldBlock => return Poll::Pending,
            read => read?,
        };
        let conn = &mut self.conn;
        let handled = if conn.is_handshaking() {
            erasing_stack(|| conn.process_new_packets().map(drop))
        } else {
            erasing_stack_of_record(|| conn.process_new_packets().map(drop))
        };
        if let Err(err) = handled {
            self.failed = Some(err);
            // This sends the alert. If a task waits to write, that task sends the alert as soon as it can.
            if !self.writer_waits {
                let _ = self.poll_send(cx);
            }
            return Poll::Ready(Err(self.failure().expect("it was set above")));
        }
        Poll::Ready(Ok(len))
    }

    /// Writes all bytes that the connection has for the peer.
    fn poll_send(&mut self, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        while self.conn.wants_write() {
            match self.conn.write_tls(&mut Blocking { io: &mut self.io, cx }) {
                Ok(0) => return Poll::Ready(Err(io::ErrorKind::WriteZero.into())),
                Ok(_) => {}
                Err(err) if err.kind() == io::ErrorKind::WouldBlock => {
                    self.writer_waits = true;
                    return Poll::Pending;
                }
                Err(err) => return Poll::Ready(Err(err)),
            }
        }
        self.writer_waits = false;
        Poll::Ready(Ok(()))
    }

    fn poll_flush_io(&mut self, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        let flushed = Pin::new(&mut self.io).poll_flush(cx);
        self.writer_waits = flushed.is_pending();
        flushed
    }

    /// Gives the connection data to write. `take` passes the data.
    fn poll_take(
        &mut self,
        cx: &mut Context<'_>,
        take: impl FnOnce(&mut rustls_axon::Writer<'_>) -> io::Result<usize>,
    ) -> Poll<io::Result<usize>> {
        if self.shut_down {
            let why = "the stream was shut down for writing";
            return Poll::Ready(Err(io::Error::new(io::ErrorKind::BrokenPipe, why)));
        }
        // new data is accepted only after the previous data has been sent, so at most one buffer is held back
        let sent = self.poll_send(cx);
        if let Some(failure) = self.failure() {
            return Poll::Ready(Err(failure));
        }
        ready!(sent)?;
        let conn = &mut self.conn;
        let taken = erasing_stack_of_record(|| take(&mut conn.writer()))?;
        // Data that is not sent now is sent by the next call. It was accepted, so the result is its length.
        match self.poll_send(cx) {
            Poll::Ready(Err(err)) => Poll::Ready(Err(err)),
            _ => Poll::Ready(Ok(taken)),
        }
    }

    fn failure(&self) -> Option<io::Error> {
        self.failed.clone().map(|err| io::Error::new(io::ErrorKind::InvalidData, err))
    }
}

impl<IO: AsyncRead + AsyncWrite + Unpin> AsyncRead for TlsStream<IO> {
    fn poll_read(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        buf: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        loop {
            match self.conn.reader().read(buf.initialize_unfilled()) {
                Ok(len) => {
                    buf.advance(len);
                    return Poll::Ready(Ok(()));
                }
                Err(err) if err.kind() == io::ErrorKind::WouldBlock => {}
                Err(err) => return Poll::Ready(Err(err)),
            }
            if let Some(failure) = self.failure() {
                return Poll::Ready(Err(failure));
            }
            match ready!(self.poll_receive(cx)) {
                // valid data is returned first, and the error on the next iteration
                Err(err) if self.failed.is_none() => return Poll::Ready(Err(err)),
                _ => {}
            }
        }
    }
}

impl<IO: AsyncRead + AsyncWrite + Unpin> AsyncWrite for TlsStream<IO> {
    fn poll_write(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        buf: &[u8],
    ) -> Poll<io::Result<usize>> {
        self.poll_take(cx, |writer| writer.write(buf))
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        bufs: &[IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        self.poll_take(cx, |writer| writer.write_vectored(bufs))
    }

    fn is_write_vectored(&self) -> bool {
        true
    }

    fn poll_flush(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        ready!(self.poll_send(cx))?;
        ready!(self.poll_flush_io(cx))?;
        Poll::Ready(self.failure().map_or(Ok(()), Err))
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        if !self.shut_down {
            self.shut_down = true;
            // after a failure the peer receives the alert of the failure instead
            if self.failed.is_none() {
                let conn = &mut self.conn;
                erasing_stack_of_record(|| conn.send_close_notify());
            }
        }
        ready!(self.poll_send(cx))?;
        let shut = Pin::new(&mut self.io).poll_shutdown(cx);
        self.writer_waits = shut.is_pending();
        match ready!(shut) {
            // the peer closed the stream first, so there is nothing left to shut down
            Err(err) if err.kind() == io::ErrorKind::NotConnected => Poll::Ready(Ok(())),
            shut => Poll::Ready(shut),
        }
    }
}

impl<IO> fmt::Debug for TlsStream<IO> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("TlsStream").finish_non_exhaustive()
    }
}

/// Adapts an asynchronous stream to the blocking traits for one call. It returns `WouldBlock` instead of waiting.
struct Blocking<'a, 'cx, IO> {
    io: &'a mut IO,
    cx: &'a mut Context<'cx>,
}

impl<IO: AsyncRead + Unpin> Read for Blocking<'_, '_, IO> {
    fn read(&mut self, buf: &mut [u8]) -> io::Result<usize> {
        let mut buf = ReadBuf::new(buf);
        match Pin::new(&mut *self.io).poll_read(self.cx, &mut buf) {
            Poll::Ready(read) => read.map(|()| buf.filled().len()),
            Poll::Pending => Err(io::ErrorKind::WouldBlock.into()),
        }
    }
}

impl<IO: AsyncWrite + Unpin> Write for Blocking<'_, '_, IO> {
    fn write(&mut self, buf: &[u8]) -> io::Result<usize> {
        or_would_block(Pin::new(&mut *self.io).poll_write(self.cx, buf))
    }

    fn write_vectored(&mut self, bufs: &[IoSlice<'_>]) -> io::Result<usize> {
        or_would_block(Pin::new(&mut *self.io).poll_write_vectored(self.cx, bufs))
    }

    fn flush(&mut self) -> io::Result<()> {
        or_would_block(Pin::new(&mut *self.io).poll_flush(self.cx))
    }
}

fn or_would_block<T>(poll: Poll<io::Result<T>>) -> io::Result<T> {
    match poll {
        Poll::Ready(result) => result,
        Poll::Pending => Err(io::ErrorKind::WouldBlock.into()),
    }
}
