//! The UDP socket that QUIC shares with discovery.
//!
//! The first two bits of a datagram tell them apart: 00 is discovery, everything else is QUIC
//! (`docs/formats.md`, section 5). Discovery datagrams are taken out before quinn sees the batch,
//! segment by segment where the kernel coalesced several into one buffer.

use std::{
    io::{self, IoSliceMut},
    net::SocketAddr,
    pin::Pin,
    sync::Arc,
    task::{Context, Poll},
};

use quinn::{
    AsyncUdpSocket, Runtime, TokioRuntime, UdpPoller,
    udp::{RecvMeta, Transmit},
};
use tokio::sync::mpsc;

use crate::discovery::is_discovery;

/// A discovery datagram longer than this is nobody's.
const MAX_DISCOVERY: usize = 512;

/// A discovery datagram that came in on the QUIC port.
#[derive(Clone, Debug)]
pub(crate) struct Datagram {
    /// Who sent it.
    pub(super) from: SocketAddr,
    /// What it says; at most 512 bytes.
    pub(super) bytes: Vec<u8>,
}

/// quinn's socket with the discovery datagrams taken out.
#[derive(Debug)]
pub(super) struct DemuxSocket {
    inner: Arc<dyn AsyncUdpSocket>,
    discovery: mpsc::Sender<Datagram>,
}

impl DemuxSocket {
    /// Wraps a bound, non-blocking socket. Datagrams that find `discovery` full are dropped, as
    /// any datagram may be.
    pub(super) fn new(
        socket: std::net::UdpSocket,
        discovery: mpsc::Sender<Datagram>,
    ) -> io::Result<Arc<Self>> {
        let inner = TokioRuntime.wrap_udp_socket(socket)?;
        Ok(Arc::new(Self { inner, discovery }))
    }

    /// Takes discovery datagrams out of `buffer[..meta.len]`, moving what is QUIC's together.
    fn split(&self, buffer: &mut [u8], meta: &mut RecvMeta) {
        let length = meta.len.min(buffer.len());
        let stride = meta.stride.max(1);
        if !buffer[..length].chunks(stride).any(|d| is_discovery(d[0])) {
            return;
        }
        let mut kept = 0;
        let mut at = 0;
        while at < length {
            let end = (at + stride).min(length);
            if is_discovery(buffer[at]) {
                if end - at <= MAX_DISCOVERY {
                    let bytes = buffer[at..end].to_vec();
                    let _ = self.discovery.try_send(Datagram { from: meta.addr, bytes });
                }
            } else {
                buffer.copy_within(at..end, kept);
                kept += end - at;
            }
            at = end;
        }
        meta.len = kept;
    }
}

impl AsyncUdpSocket for DemuxSocket {
    fn create_io_poller(self: Arc<Self>) -> Pin<Box<dyn UdpPoller>> {
        Arc::clone(&self.inner).create_io_poller()
    }

    fn try_send(&self, transmit: &Transmit<'_>) -> io::Result<()> {
        self.inner.try_send(transmit)
    }

    fn poll_recv(
        &self,
        cx: &mut Context<'_>,
        buffers: &mut [IoSliceMut<'_>],
        metas: &mut [RecvMeta],
    ) -> Poll<io::Result<usize>> {
        let received = std::task::ready!(self.inner.poll_recv(cx, buffers, metas))?;
        for (buffer, meta) in buffers.iter_mut().zip(metas.iter_mut()).take(received) {
            self.split(buffer, meta);
        }
        Poll::Ready(Ok(received))
    }

    fn local_addr(&self) -> io::Result<SocketAddr> {
        self.inner.local_addr()
    }

    fn max_transmit_segments(&self) -> usize {
        self.inner.max_transmit_segments()
    }

    fn max_receive_segments(&self) -> usize {
        self.inner.max_receive_segments()
    }

    fn may_fragment(&self) -> bool {
        self.inner.may_fragment()
    }
}

#[cfg(test)]
mod tests {
    use std::net::{Ipv4Addr, UdpSocket};

    use super::*;

    fn split(data: &[u8], stride: usize) -> (Vec<u8>, Vec<Vec<u8>>) {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        let _guard = runtime.enter();
        let socket = UdpSocket::bind((Ipv4Addr::LOCALHOST, 0)).unwrap();
        socket.set_nonblocking(true).unwrap();
        let (sender, mut receiver) = mpsc::channel(8);
        let demux = DemuxSocket::new(socket, sender).unwrap();
        let mut buffer = data.to_vec();
        let mut meta = RecvMeta { len: data.len(), stride, ..RecvMeta::default() };
        demux.split(&mut buffer, &mut meta);
        let mut taken = Vec::new();
        while let Ok(d) = receiver.try_recv() {
            taken.push(d.bytes);
        }
        (buffer[..meta.len].to_vec(), taken)
    }

    #[test]
    fn quic_alone_is_left_as_it_is() {
        assert_eq!(split(&[0x40, 1, 0xc0, 2, 0x41], 2), (vec![0x40, 1, 0xc0, 2, 0x41], vec![]));
    }

    #[test]
    fn discovery_is_taken_out_of_a_coalesced_batch() {
        let (quic, taken) = split(&[0x01, 9, 0x40, 1, 0x02, 8, 0xc0, 2, 0x03], 2);
        assert_eq!(quic, vec![0x40, 1, 0xc0, 2]);
        assert_eq!(taken, vec![vec![0x01, 9], vec![0x02, 8], vec![0x03]]);
    }

    #[test]
    fn an_oversized_discovery_datagram_is_dropped_and_nothing_is_left_for_quic() {
        assert_eq!(split(&[0x01; 600], 600), (vec![], vec![]));
        assert_eq!(split(&[], 0), (vec![], vec![]));
    }
}
