//! One packet of the session socket: bytes and descriptors, sent and received without blocking.

use std::{
    io::IoSlice,
    mem::MaybeUninit,
    os::fd::{AsFd, BorrowedFd},
    time::Instant,
};

use axon_shm::internal::descriptors::{self, PassedFd, SocketPacket};
use rustix::{
    event::{PollFd, PollFlags, Timespec, poll},
    io::Errno,
    net::{SendAncillaryBuffer, SendAncillaryMessage, SendFlags, Shutdown, sendmsg, shutdown},
};

use crate::wire::session::{CodecError, MAX_DESCRIPTORS, MAX_PACKET, SessionMessage};

/// A message that arrived, with its descriptors.
#[derive(Debug)]
pub struct ReceivedMessage {
    /// The message.
    pub message: SessionMessage,
    /// The descriptors of the message, close-on-exec.
    pub descriptors: Vec<PassedFd>,
}

/// The reason why a packet was not sent or received.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum SocketError {
    /// The other end is gone.
    #[error("the other end closed the connection")]
    Closed,
    /// There is nothing to receive, or no space to send; try again when the socket is ready.
    #[error("the socket is not ready")]
    NotReady,
    /// A packet that breaks the protocol.
    #[error("{0}")]
    Codec(#[from] CodecError),
    /// More descriptors, or a longer packet, than the protocol allows.
    #[error("a packet with more bytes or descriptors than the protocol allows")]
    Truncated,
    /// A packet lost descriptors, because this process can hold no more.
    #[error(
        "this process has no descriptors left for those that came with a packet: raise its \
         RLIMIT_NOFILE (ulimit -n)"
    )]
    NoDescriptors,
    /// A system call failed.
    #[error("{0}")]
    System(Errno),
}

impl From<Errno> for SocketError {
    fn from(errno: Errno) -> Self {
        match errno {
            // TOOMANYREFS ends when a process receives some of the descriptors in flight.
            Errno::AGAIN | Errno::NOBUFS | Errno::TOOMANYREFS => Self::NotReady,
            Errno::CONNRESET | Errno::PIPE | Errno::NOTCONN => Self::Closed,
            other => Self::System(other),
        }
    }
}

/// Sends one packet.
///
/// # Errors
/// [`SocketError::NotReady`] if the socket has no space; nothing was sent then.
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

/// Receives one packet. `buffer` is memory to reuse; it may be empty.
///
/// # Errors
/// [`SocketError::NotReady`] if there is none. Every other error is final for the connection, except
/// [`SocketError::NoDescriptors`]: the packet is lost, and the next ones may arrive completely.
pub fn receive(socket: impl AsFd, buffer: &mut Vec<u8>) -> Result<ReceivedMessage, SocketError> {
    buffer.resize(MAX_PACKET + 1, 0);
    let packet = match descriptors::receive(&socket, buffer) {
        // Reported once, before the data of the other end: the other end closed without having read all of this end's
        // data.
        Err(Errno::CONNRESET) => descriptors::receive(&socket, buffer),
        received => received,
    };
    received(packet?, buffer)
}

/// Like [`receive`], for a process that is short of descriptors: needs space for no more descriptors than a packet may
/// have, and closes none of them for the last time.
///
/// # Errors
/// As for [`receive`]. A packet stays in the socket if there is no space for its descriptors.
pub fn receive_few(
    socket: impl AsFd,
    buffer: &mut Vec<u8>,
) -> Result<ReceivedMessage, SocketError> {
    const { assert!(MAX_DESCRIPTORS <= descriptors::FEW_DESCRIPTORS) };
    buffer.resize(MAX_PACKET + 1, 0);
    let packet = match descriptors::receive_few(&socket, buffer) {
        Err(Errno::CONNRESET) => descriptors::receive_few(&socket, buffer),
        received => received,
    };
    received(packet?, buffer)
}

/// Returns the next packet's message. The packet and its descriptors stay in the socket.
///
/// # Errors
/// As for [`receive`].
pub fn look(socket: impl AsFd, buffer: &mut Vec<u8>) -> Result<SessionMessage, SocketError> {
    buffer.resize(MAX_PACKET + 1, 0);
    let bytes = descriptors::look(&socket, buffer)?;
    if bytes > MAX_PACKET {
        return Err(SocketError::Truncated);
    }
    Ok(SessionMessage::decode(&buffer[..bytes])?)
}

fn received(packet: SocketPacket, buffer: &[u8]) -> Result<ReceivedMessage, SocketError> {
    let SocketPacket { bytes, truncated, lost, descriptors } = packet;
    if truncated || descriptors.len() > MAX_DESCRIPTORS {
        return Err(SocketError::Truncated);
    }
    if lost {
        return Err(SocketError::NoDescriptors);
    }
    if bytes == 0 {
        return Err(SocketError::Closed);
    }
    Ok(ReceivedMessage { message: SessionMessage::decode(&buffer[..bytes])?, descriptors })
}

/// Shuts down sending, and waits until the other end closes. Returns whether the other end had read everything by then;
/// also true if it has not closed at the `deadline`.
pub fn finish(socket: impl AsFd, deadline: Instant) -> bool {
    if shutdown(&socket, Shutdown::Write).is_err() {
        return false;
    }
    let mut buffer = vec![0; MAX_PACKET + 1];
    loop {
        match descriptors::receive(&socket, &mut buffer) {
            Ok(SocketPacket { bytes: 0, .. }) => return true,
            Ok(_) | Err(Errno::INTR | Errno::AGAIN) => {}
            Err(_) => return false,
        }
        let left = deadline.saturating_duration_since(Instant::now());
        let timeout = Timespec::try_from(left).ok();
        let mut fds = [PollFd::new(&socket, PollFlags::IN)];
        if left.is_zero() || poll(&mut fds, timeout.as_ref()) == Ok(0) {
            return true;
        }
    }
}

#[cfg(test)]
mod tests {
    use std::os::fd::OwnedFd;

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
        let many: Vec<OwnedFd> = (0..MAX_DESCRIPTORS * 2).map(|_| null()).collect();
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
        send(&a, &SessionMessage::Resync.encode().unwrap(), &fds).unwrap();
        let got = receive(&b, &mut Vec::new()).unwrap();
        assert_eq!(got.message, SessionMessage::Resync);
        assert_eq!(got.descriptors.len(), 2);
        drop(a);
        assert!(matches!(receive(&b, &mut Vec::new()), Err(SocketError::Closed)));
    }

    #[test]
    fn messages_of_a_closed_peer_are_received_despite_its_unread_ones() {
        let (a, b) = pair();
        let message = SessionMessage::Resync.encode().unwrap();
        [&b, &a, &a].iter().for_each(|from| send(from, &message, &[]).unwrap());
        drop(a);
        for _ in 0..2 {
            assert_eq!(receive(&b, &mut Vec::new()).unwrap().message, SessionMessage::Resync);
        }
        assert!(matches!(receive(&b, &mut Vec::new()), Err(SocketError::Closed)));
    }

    #[test]
    fn one_that_finishes_knows_whether_the_other_end_has_read_everything() {
        let message = SessionMessage::Resync.encode().unwrap();
        let ever = || Instant::now() + std::time::Duration::from_secs(60);
        let (a, b) = pair();
        send(&a, &message, &[]).unwrap();
        send(&b, &message, &[]).unwrap();
        let reader = std::thread::spawn(move || {
            while !matches!(receive(&b, &mut Vec::new()), Err(SocketError::Closed)) {}
        });
        assert!(finish(&a, ever()));
        reader.join().unwrap();

        let (a, b) = pair();
        send(&a, &message, &[]).unwrap();
        drop(b);
        assert!(!finish(&a, ever()), "it closed with a packet unread");

        let (a, b) = pair();
        assert!(finish(&a, Instant::now()), "it may read it yet");
        drop(b);
    }
}
