//! Descriptors whose close takes as long as their sender wants.

use std::{
    fs::File,
    io::{IoSlice, Write as _},
    mem::MaybeUninit,
    net::{TcpListener, TcpStream},
    os::fd::{AsFd, OwnedFd},
    time::Duration,
};

use rustix::net::{
    AddressFamily, SendAncillaryBuffer, SendAncillaryMessage, SendFlags, SocketFlags, SocketType,
    sendmsg, socketpair, sockopt,
};

/// Creates a socket whose last close takes hours, because it lingers over data that its peer does
/// not read.
fn reluctant() -> (OwnedFd, TcpStream) {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    sockopt::set_socket_recv_buffer_size(&listener, 4096).unwrap();
    let mut ours = TcpStream::connect(listener.local_addr().unwrap()).unwrap();
    let (peer, _) = listener.accept().unwrap();
    ours.set_nonblocking(true).unwrap();
    sockopt::set_socket_send_buffer_size(&ours, 4096).unwrap();
    while ours.write(&[0; 1 << 16]).is_ok() {}
    sockopt::set_socket_linger(&ours, Some(Duration::from_secs(10_000))).unwrap();
    (ours.into(), peer)
}

/// Creates a unix socket whose queue holds a packet with such a socket. Closing the unix socket
/// closes it.
pub(crate) fn hiding() -> (OwnedFd, TcpStream) {
    let (unix, packets) = (AddressFamily::UNIX, SocketType::SEQPACKET);
    let (ours, theirs) = socketpair(unix, packets, SocketFlags::CLOEXEC, None).unwrap();
    let (fd, peer) = reluctant();
    send_away(&theirs, b"x", 0, fd);
    (ours, peer)
}

/// Sends a packet. After that, only the receiver has a reference to its last descriptor.
pub(crate) fn send_away(socket: &OwnedFd, bytes: &[u8], before: usize, fd: OwnedFd) {
    let null: OwnedFd = File::open("/dev/null").unwrap().into();
    let mut space = [MaybeUninit::uninit(); rustix::cmsg_space!(ScmRights(8))];
    let mut control = SendAncillaryBuffer::new(&mut space);
    let mut rights = vec![null.as_fd(); before];
    rights.push(fd.as_fd());
    assert!(control.push(SendAncillaryMessage::ScmRights(&rights)));
    let bytes = [IoSlice::new(bytes)];
    sendmsg(socket, &bytes, &mut control, SendFlags::NOSIGNAL).unwrap();
}
