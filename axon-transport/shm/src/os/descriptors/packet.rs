//! Receives packets with their descriptors.

use std::{io::IoSliceMut, mem::MaybeUninit, os::fd::AsFd};

use rustix::{
    io::Errno,
    net::{RecvAncillaryBuffer, RecvAncillaryMessage, RecvFlags, ReturnFlags, recvmsg},
};

use super::{capacity::FEW_DESCRIPTORS, passed::PassedFd};

/// Maximum number of descriptors that the system allows in a packet.
const SCM_MAX_FD: usize = 253;

/// A packet of a socket.
pub struct SocketPacket {
    /// The received length in bytes.
    pub bytes: usize,
    /// True if the packet was longer than the buffer.
    pub truncated: bool,
    /// True if this process could not hold all of its descriptors.
    pub lost: bool,
    /// The descriptors that came with it.
    pub descriptors: Vec<PassedFd>,
}

/// Receives one packet without waiting, with all descriptors that can come with it.
pub fn receive(socket: impl AsFd, buffer: &mut [u8]) -> Result<SocketPacket, Errno> {
    let mut space = [MaybeUninit::uninit(); rustix::cmsg_space!(ScmRights(SCM_MAX_FD))];
    receive_with(&socket, buffer, RecvFlags::empty(), &mut space)
}

fn receive_with(
    socket: impl AsFd,
    buffer: &mut [u8],
    how: RecvFlags,
    space: &mut [MaybeUninit<u8>],
) -> Result<SocketPacket, Errno> {
    let mut control = RecvAncillaryBuffer::new(space);
    let flags = RecvFlags::DONTWAIT | RecvFlags::CMSG_CLOEXEC | how;
    let got = loop {
        match recvmsg(&socket, &mut [IoSliceMut::new(buffer)], &mut control, flags) {
            Err(Errno::INTR) => {}
            other => break other?,
        }
    };
    let mut descriptors = Vec::new();
    for message in control.drain() {
        if let RecvAncillaryMessage::ScmRights(received) = message {
            descriptors.extend(received.map(PassedFd::received));
        }
    }
    Ok(SocketPacket {
        bytes: got.bytes,
        truncated: got.flags.contains(ReturnFlags::TRUNC),
        // The control buffer has space for the maximum number of descriptors.
        lost: got.flags.contains(ReturnFlags::CTRUNC),
        descriptors,
    })
}

/// Like [`receive`], but a packet stays in the socket if there is no space for its descriptors.
pub(crate) fn receive_whole(socket: impl AsFd, buffer: &mut [u8]) -> Result<SocketPacket, Errno> {
    let mut space = [MaybeUninit::uninit(); rustix::cmsg_space!(ScmRights(SCM_MAX_FD))];
    // Peeking duplicates the descriptors.
    let packet = receive_with(&socket, buffer, RecvFlags::PEEK, &mut space)?;
    if packet.lost {
        return Err(Errno::MFILE);
    }
    take_seen(&socket);
    Ok(packet)
}

/// Like [`receive`], for a packet of at most [`FEW_DESCRIPTORS`] descriptors: closes none of them for the last time,
/// and needs no space for more. A packet with more descriptors is reported as truncated and stays in the socket. If the
/// process has no space for the descriptors of a packet, the packet is reported as lost and stays, too.
pub fn receive_few(socket: impl AsFd, buffer: &mut [u8]) -> Result<SocketPacket, Errno> {
    let mut space = [MaybeUninit::uninit(); rustix::cmsg_space!(ScmRights(FEW_DESCRIPTORS))];
    let packet = receive_with(&socket, buffer, RecvFlags::PEEK, &mut space)?;
    // Because of its alignment, the space may fit one descriptor more.
    let more = packet.descriptors.len() > FEW_DESCRIPTORS;
    if !packet.lost && !more {
        take_seen(&socket);
    }
    let truncated =
        packet.truncated || more || packet.lost && packet.descriptors.len() == FEW_DESCRIPTORS;
    Ok(SocketPacket { truncated, lost: packet.lost || more, ..packet })
}

/// Takes a packet that was peeked at: its descriptors are not closed for the last time here.
fn take_seen(socket: impl AsFd) {
    let mut none = RecvAncillaryBuffer::default();
    let mut byte = [0];
    while let Err(Errno::INTR) =
        recvmsg(&socket, &mut [IoSliceMut::new(&mut byte)], &mut none, RecvFlags::DONTWAIT)
    {}
}

/// Copies the next packet of a socket, which stays there with its descriptors. Returns its length, as far as it fits.
pub fn look(socket: impl AsFd, buffer: &mut [u8]) -> Result<usize, Errno> {
    let flags = RecvFlags::DONTWAIT | RecvFlags::PEEK;
    let mut none = RecvAncillaryBuffer::default();
    Ok(recvmsg(socket, &mut [IoSliceMut::new(buffer)], &mut none, flags)?.bytes)
}

/// Returns whether the next packet of a socket has descriptors, which stay there: this closes nothing.
pub fn carries_descriptors(socket: impl AsFd) -> bool {
    let flags = RecvFlags::DONTWAIT | RecvFlags::PEEK;
    let mut byte = [0];
    let mut none = RecvAncillaryBuffer::default();
    recvmsg(socket, &mut [IoSliceMut::new(&mut byte)], &mut none, flags)
        .is_ok_and(|got| got.flags.contains(ReturnFlags::CTRUNC))
}
