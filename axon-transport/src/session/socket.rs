//! One packet of the session socket: bytes and descriptors, sent and received without blocking.

use std::{
    io::{IoSlice, IoSliceMut},
    mem::MaybeUninit,
    os::fd::{AsFd, BorrowedFd, OwnedFd},
};

use rustix::{
    io::Errno,
    net::{
        RecvAncillaryBuffer, RecvAncillaryMessage, RecvFlags, ReturnFlags, SendAncillaryBuffer,
        SendAncillaryMessage, SendFlags, recvmsg, sendmsg, sockopt,
    },
};

use super::message::{CodecError, MAX_DESCRIPTORS, MAX_PACKET, Message};

/// A message that arrived, and what came with it.
#[derive(Debug)]
pub struct Received {
    /// The message.
    pub message: Message,
    /// Its descriptors, close-on-exec.
    pub descriptors: Vec<OwnedFd>,
}

/// Why a packet was not sent or received.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum SocketError {
    /// The other end is gone.
    #[error("the other end closed the connection")]
    Closed,
    /// Nothing to receive, or no room to send; try again when the socket is ready.
    #[error("the socket is not ready")]
    NotReady,
    /// A packet that breaks the protocol.
    #[error("{0}")]
    Codec(#[from] CodecError),
    /// More descriptors, or a longer packet, than the protocol allows.
    #[error("a packet with more bytes or descriptors than the protocol allows")]
    Truncated,
    /// The system refused.
    #[error("{0}")]
    System(Errno),
}

impl From<Errno> for SocketError {
    fn from(errno: Errno) -> Self {
        match errno {
            // Too many descriptors in flight passes as soon as somebody receives some.
            Errno::AGAIN | Errno::NOBUFS | Errno::TOOMANYREFS => Self::NotReady,
            Errno::CONNRESET | Errno::PIPE | Errno::NOTCONN => Self::Closed,
            other => Self::System(other),
        }
    }
}

/// The process at the other end, as the kernel recorded it at connect time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Peer {
    /// Its user.
    pub uid: u32,
    /// Its process.
    pub pid: u32,
}

/// Who is at the other end (SO_PEERCRED).
///
/// # Errors
/// What the system says.
pub fn peer(socket: impl AsFd) -> Result<Peer, SocketError> {
    let credentials = sockopt::socket_peercred(socket).map_err(SocketError::System)?;
    let pid = u32::try_from(credentials.pid.as_raw_nonzero().get()).unwrap_or(0);
    Ok(Peer { uid: credentials.uid.as_raw(), pid })
}

/// Sends one packet.
///
/// # Errors
/// [`SocketError::NotReady`] when the socket has no room; nothing was sent then.
pub fn send(
    socket: impl AsFd,
    packet: &[u8],
    descriptors: &[BorrowedFd<'_>],
) -> Result<(), SocketError> {
    let mut space = [MaybeUninit::uninit(); rustix::cmsg_space!(ScmRights(MAX_DESCRIPTORS))];
    let mut control = SendAncillaryBuffer::new(&mut space);
    if descriptors.len() > MAX_DESCRIPTORS {
        return Err(SocketError::Truncated);
    }
    if !descriptors.is_empty() && !control.push(SendAncillaryMessage::ScmRights(descriptors)) {
        return Err(SocketError::Truncated);
    }
    let flags = SendFlags::DONTWAIT | SendFlags::NOSIGNAL;
    loop {
        match sendmsg(&socket, &[IoSlice::new(packet)], &mut control, flags) {
            Ok(_) => return Ok(()),
            Err(Errno::INTR) => {}
            Err(errno) => return Err(errno.into()),
        }
    }
}

/// Receives one packet. `buffer` is room to reuse; it need not have any length.
///
/// # Errors
/// [`SocketError::NotReady`] when there is none. Every other error is final for the connection.
pub fn receive(socket: impl AsFd, buffer: &mut Vec<u8>) -> Result<Received, SocketError> {
    buffer.resize(MAX_PACKET + 1, 0);
    let mut space = [MaybeUninit::uninit(); rustix::cmsg_space!(ScmRights(MAX_DESCRIPTORS))];
    let mut control = RecvAncillaryBuffer::new(&mut space);
    let flags = RecvFlags::DONTWAIT | RecvFlags::CMSG_CLOEXEC;
    let got = loop {
        match recvmsg(&socket, &mut [IoSliceMut::new(buffer)], &mut control, flags) {
            Err(Errno::INTR) => {}
            other => break other?,
        }
    };
    let mut descriptors = Vec::new();
    for message in control.drain() {
        if let RecvAncillaryMessage::ScmRights(received) = message {
            descriptors.extend(received);
        }
    }
    if got.flags.intersects(ReturnFlags::TRUNC | ReturnFlags::CTRUNC) {
        return Err(SocketError::Truncated);
    }
    if got.bytes == 0 {
        return Err(SocketError::Closed);
    }
    Ok(Received { message: Message::decode(&buffer[..got.bytes])?, descriptors })
}

#[cfg(test)]
mod tests {
    use rustix::net::{AddressFamily, SocketFlags, SocketType, socketpair};

    use super::*;

    fn pair() -> (OwnedFd, OwnedFd) {
        socketpair(AddressFamily::UNIX, SocketType::SEQPACKET, SocketFlags::CLOEXEC, None).unwrap()
    }

    fn null() -> OwnedFd {
        std::fs::File::open("/dev/null").unwrap().into()
    }

    #[test]
    fn too_many_descriptors_are_refused_by_both_ends() {
        let (a, b) = pair();
        let many: Vec<OwnedFd> = (0..MAX_DESCRIPTORS * 4).map(|_| null()).collect();
        let many: Vec<BorrowedFd<'_>> = many.iter().map(AsFd::as_fd).collect();
        assert!(matches!(send(&a, &[14, 0xa0], &many), Err(SocketError::Truncated)));

        let mut space = [MaybeUninit::uninit(); rustix::cmsg_space!(ScmRights(16))];
        let mut control = SendAncillaryBuffer::new(&mut space);
        assert!(control.push(SendAncillaryMessage::ScmRights(&many)));
        sendmsg(&a, &[IoSlice::new(&[14, 0xa0])], &mut control, SendFlags::empty()).unwrap();
        assert!(matches!(receive(&b, &mut Vec::new()), Err(SocketError::Truncated)));
    }

    #[test]
    fn a_packet_longer_than_allowed_is_refused() {
        let (a, b) = pair();
        send(&a, &vec![14; MAX_PACKET + 2], &[]).unwrap();
        assert!(matches!(receive(&b, &mut Vec::new()), Err(SocketError::Truncated)));
    }

    #[test]
    fn packets_carry_descriptors_and_the_end_is_seen() {
        let (a, b) = pair();
        assert!(matches!(receive(&b, &mut Vec::new()), Err(SocketError::NotReady)));
        let fds = [null(), null()];
        let fds: Vec<BorrowedFd<'_>> = fds.iter().map(AsFd::as_fd).collect();
        send(&a, &Message::Resync.encode().unwrap(), &fds).unwrap();
        let got = receive(&b, &mut Vec::new()).unwrap();
        assert_eq!(got.message, Message::Resync);
        assert_eq!(got.descriptors.len(), 2);
        assert_eq!(peer(&b).unwrap().pid, std::process::id());
        drop(a);
        assert!(matches!(receive(&b, &mut Vec::new()), Err(SocketError::Closed)));
    }
}
