//! Tests how descriptors are received and closed.

use std::{
    io::{IoSlice, Write},
    mem::MaybeUninit,
    net::{TcpListener, TcpStream},
    os::fd::{AsFd, AsRawFd, OwnedFd},
    time::Duration,
};

use rustix::{
    fs::{MemfdFlags, memfd_create},
    io::Errno,
    net::{
        AddressFamily, RecvFlags, SendAncillaryBuffer, SendAncillaryMessage, SendFlags,
        SocketFlags, SocketType, sendmsg, socketpair, sockopt,
    },
};

use super::*;
use crate::os::closer::FdClass;

/// Creates a socket whose last close takes hours, because it lingers over data that its peer does not read.
pub(crate) fn reluctant() -> (OwnedFd, TcpStream) {
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

/// Sends a packet with a descriptor, to which only the receiver then has a reference.
pub(crate) fn send_away(socket: impl AsFd, bytes: &[u8], fd: OwnedFd) {
    let mut space = [MaybeUninit::uninit(); rustix::cmsg_space!(ScmRights(1))];
    let mut control = SendAncillaryBuffer::new(&mut space);
    let rights = [fd.as_fd()];
    assert!(control.push(SendAncillaryMessage::ScmRights(&rights)));
    sendmsg(socket, &[IoSlice::new(bytes)], &mut control, SendFlags::empty()).unwrap();
}

pub(crate) fn pair() -> (OwnedFd, OwnedFd) {
    socketpair(AddressFamily::UNIX, SocketType::SEQPACKET, SocketFlags::CLOEXEC, None).unwrap()
}

/// Creates a unix socket whose queue has the last reference to a reluctant socket.
fn hiding() -> (OwnedFd, TcpStream) {
    let (fd, peer) = reluctant();
    let (ours, theirs) = pair();
    send_away(&theirs, b"x", fd);
    (ours, peer)
}

fn await_end(of: &OwnedFd) {
    let mut byte = [0];
    assert_eq!(rustix::io::read(of, &mut byte), Ok(0), "it is closed in the end");
}

#[test]
fn blocked_descriptor_closes_delay_no_other_descriptor_class() {
    let mut peers = Vec::new();
    for _ in 0..FdClass::Session.threads() + 2 {
        let (fd, peer) = hiding();
        drop(PassedFd::received(fd));
        peers.push(peer);
    }
    // All threads are blocked. A connection's other end learns of its end all the same.
    let (ours, theirs) = pair();
    drop(PassedFd::connection(ours).trusted());
    await_end(&theirs);
    // Memory has a thread of its own: a map that was never read is gone with its memfd.
    let memfd = memfd_create("test", MemfdFlags::CLOEXEC).unwrap();
    rustix::io::write(&memfd, &vec![1; 2 << 20]).unwrap();
    let path = format!("/proc/self/fd/{}", memfd.as_raw_fd());
    drop(PassedFd::received(memfd));
    while std::fs::read_link(&path).is_ok_and(|to| to.to_string_lossy().contains("memfd:test")) {
        std::thread::yield_now();
    }
    // Strangers have their own threads, too; they have as many connections.
    for _ in 0..FdClass::Stranger.threads() + 2 {
        let (fd, peer) = hiding();
        drop(PassedFd::connection(fd));
        peers.push(peer);
    }
    // Threads that were blocked go on when they can.
    peers.clear();
    let (ours, theirs) = pair();
    drop(PassedFd::received(ours));
    await_end(&theirs);
}

#[test]
fn shared_descriptor_is_closed_with_its_last_value() {
    let (ours, theirs) = pair();
    let number = ours.as_raw_fd();
    let first = PassedFd::received(ours);
    let second = first.share();
    assert_eq!(second.as_raw_fd(), number, "no further descriptor");
    drop(first);
    rustix::io::write(&second, b"x").unwrap();
    let mut byte = [0];
    assert_eq!(rustix::io::read(&theirs, &mut byte), Ok(1));
    drop(second);
    await_end(&theirs);
    // The end of a connection is not put off by a shared value.
    let (ours, theirs) = pair();
    let connection = PassedFd::connection(ours).trusted();
    let shared = connection.share();
    drop(connection);
    await_end(&theirs);
    drop(shared);
}

#[test]
fn copy_of_a_held_descriptor_is_closed_though_the_closing_threads_are_blocked() {
    let mut peers = Vec::new();
    for _ in 0..FdClass::Session.threads() + 2 {
        let (fd, peer) = hiding();
        drop(PassedFd::received(fd));
        peers.push(peer);
    }
    let (ours, theirs) = pair();
    let held = PassedFd::from(ours);
    PassedFd::received(held.as_fd().try_clone_to_owned().unwrap()).close_copy_of(&held);
    drop(held);
    await_end(&theirs);
}

#[test]
fn a_socket_does_not_linger() {
    // More than there are threads: none of them is blocked.
    let mut peers = Vec::new();
    for _ in 0..FdClass::Session.threads() + 2 {
        let (fd, peer) = reluctant();
        drop(PassedFd::received(fd));
        peers.push(peer);
    }
    let (ours, theirs) = pair();
    drop(PassedFd::received(ours));
    await_end(&theirs);
}

#[test]
fn to_ask_whether_descriptors_come_closes_none() {
    let (ours, theirs) = pair();
    assert!(!carries_descriptors(&ours), "nothing stands there");
    rustix::net::send(&theirs, b"x", SendFlags::empty()).unwrap();
    let (sent, kept) = pair();
    send_away(&theirs, b"x", sent);
    assert!(!carries_descriptors(&ours));
    receive(&ours, &mut [0; 1]).unwrap();
    assert!(carries_descriptors(&ours) && carries_descriptors(&ours));
    let flags = RecvFlags::DONTWAIT;
    assert_eq!(rustix::net::recv(&kept, &mut [0; 1], flags).err(), Some(Errno::AGAIN));
    let packet = receive(&ours, &mut [0; 1]).unwrap();
    assert!(packet.descriptors.len() == 1 && !packet.lost && !packet.truncated);
}

#[test]
fn few_descriptors_are_received_with_their_packet_and_more_stay_where_they_are() {
    let (ours, theirs) = pair();
    let send = |count: usize| {
        let files: Vec<_> = (0..count).map(|_| tempfile::tempfile().unwrap()).collect();
        let rights: Vec<_> = files.iter().map(AsFd::as_fd).collect();
        let mut space =
            [MaybeUninit::uninit(); rustix::cmsg_space!(ScmRights(FEW_DESCRIPTORS * 2))];
        let mut control = SendAncillaryBuffer::new(&mut space);
        assert!(control.push(SendAncillaryMessage::ScmRights(&rights)));
        sendmsg(&theirs, &[IoSlice::new(b"xy")], &mut control, SendFlags::empty()).unwrap();
    };
    send(FEW_DESCRIPTORS);
    send(FEW_DESCRIPTORS + 1);
    let mut buffer = [0; 2];
    let packet = receive_few(&ours, &mut buffer).unwrap();
    assert_eq!((packet.bytes, packet.descriptors.len(), packet.lost), (2, FEW_DESCRIPTORS, false));
    for _ in 0..2 {
        let packet = receive_few(&ours, &mut buffer).unwrap();
        assert!(packet.truncated && packet.lost, "it is still there");
    }
}

#[test]
fn open_descriptors_are_counted() {
    let before = open();
    let files: Vec<_> = (0..50).map(|_| tempfile::tempfile().unwrap()).collect();
    // Other tests open and close meanwhile.
    assert!(open() >= before.saturating_sub(20) + 50 - 20, "{} of {before}", open());
    drop(files);
}

#[test]
fn memfds_and_files_are_closed_in_their_class() {
    let memfd = memfd_create("test", MemfdFlags::CLOEXEC).unwrap();
    let memfd = PassedFd::received(memfd);
    assert_eq!(memfd.lane(), None);
    rustix::io::write(&memfd, &vec![1; 2 << 20]).unwrap();
    assert_eq!(memfd.lane(), Some(FdClass::Memory), "it gives much memory back");
    let file = PassedFd::received(tempfile::tempfile().unwrap().into());
    assert_eq!(file.lane(), Some(FdClass::Session));
}

#[test]
fn only_a_pidfd_is_one() {
    use rustix::{
        event::{EventfdFlags, epoll, eventfd},
        process::{PidfdFlags, getpid, getppid, pidfd_open},
    };
    let of = |pid| PassedFd::received(pidfd_open(pid, PidfdFlags::empty()).unwrap());
    assert_eq!(of(getpid()).lane(), None);
    assert!(of(getpid()).is_pidfd() && of(getppid().unwrap()).is_pidfd());
    let mut child = std::process::Command::new("true").spawn().unwrap();
    let ended = of(rustix::process::Pid::from_child(&child));
    assert!(ended.is_pidfd());
    child.wait().unwrap();
    assert!(ended.is_pidfd(), "also of one that has ended");
    let others: [OwnedFd; 5] = [
        epoll::create(epoll::CreateFlags::CLOEXEC).unwrap(),
        eventfd(0, EventfdFlags::CLOEXEC).unwrap(),
        std::fs::File::open("/dev/null").unwrap().into(),
        // Its directory names a process, too.
        std::fs::File::open("/proc/self").unwrap().into(),
        pair().0,
    ];
    others.map(PassedFd::received).iter().for_each(|fd| assert!(!fd.is_pidfd(), "{fd:?}"));
}
