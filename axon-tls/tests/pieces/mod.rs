//! Underlying streams that make it hard.

use std::io;
use std::pin::Pin;
use std::sync::{Arc, Mutex};
use std::task::{Context, Poll};

use tokio::io::{AsyncRead, AsyncWrite, DuplexStream, ReadBuf};

/// Reads and writes a few bytes at a time, and is pending every other time.
pub(crate) struct Pieces<IO> {
    io: IO,
    most: usize,
    ready: [bool; 2],
}

impl<IO> Pieces<IO> {
    pub(crate) fn new(io: IO, most: usize) -> Self {
        Self { io, most, ready: [false; 2] }
    }

    fn pending(&mut self, direction: usize, cx: &mut Context<'_>) -> bool {
        let ready = &mut self.ready[direction];
        *ready = !*ready;
        if !*ready {
            cx.waker().wake_by_ref();
        }
        !*ready
    }
}

impl<IO: AsyncRead + Unpin> AsyncRead for Pieces<IO> {
    fn poll_read(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        buf: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        if self.pending(0, cx) {
            return Poll::Pending;
        }
        let most = self.most.min(buf.remaining());
        let mut few = ReadBuf::new(buf.initialize_unfilled_to(most));
        let read = Pin::new(&mut self.io).poll_read(cx, &mut few);
        let len = few.filled().len();
        buf.advance(len);
        read
    }
}

impl<IO: AsyncWrite + Unpin> AsyncWrite for Pieces<IO> {
    fn poll_write(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        buf: &[u8],
    ) -> Poll<io::Result<usize>> {
        if self.pending(1, cx) {
            return Poll::Pending;
        }
        let few = &buf[..self.most.min(buf.len())];
        Pin::new(&mut self.io).poll_write(cx, few)
    }

    fn poll_flush(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        if self.pending(1, cx) {
            return Poll::Pending;
        }
        Pin::new(&mut self.io).poll_flush(cx)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        if self.pending(1, cx) {
            return Poll::Pending;
        }
        Pin::new(&mut self.io).poll_shutdown(cx)
    }
}

/// A stream that a test can write to past the connection over it.
#[derive(Clone)]
pub(crate) struct Shared(Arc<Mutex<DuplexStream>>);

impl Shared {
    pub(crate) fn new(io: DuplexStream) -> Self {
        Self(Arc::new(Mutex::new(io)))
    }
}

impl AsyncRead for Shared {
    fn poll_read(
        self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        buf: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        Pin::new(&mut *self.0.lock().unwrap()).poll_read(cx, buf)
    }
}

impl AsyncWrite for Shared {
    fn poll_write(
        self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        buf: &[u8],
    ) -> Poll<io::Result<usize>> {
        Pin::new(&mut *self.0.lock().unwrap()).poll_write(cx, buf)
    }

    fn poll_flush(self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut *self.0.lock().unwrap()).poll_flush(cx)
    }

    fn poll_shutdown(self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut *self.0.lock().unwrap()).poll_shutdown(cx)
    }
}
