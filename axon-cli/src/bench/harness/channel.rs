//! The socket over which the two processes of a measurement coordinate.

use std::{
    io::{IoSlice, IoSliceMut},
    mem::MaybeUninit,
    os::fd::{AsFd, BorrowedFd, OwnedFd},
};

use rustix::{
    event::{PollFd, PollFlags, Timespec, poll},
    io::Errno,
    net::{
        AddressFamily, RecvAncillaryBuffer, RecvAncillaryMessage, RecvFlags, SendAncillaryBuffer,
        SendAncillaryMessage, SendFlags, SocketFlags, SocketType, recvmsg, sendmsg, socketpair,
    },
};
use serde::{Serialize, de::DeserializeOwned};

use super::Result;

const ENDED: &str = "the other process has ended";
const LARGEST: usize = 4096;
const MOST_DESCRIPTORS: usize = 4;

/// One end of a connected socket that preserves packet boundaries.
pub(crate) struct Channel(OwnedFd);

impl Channel {
    /// Creates both ends: one for this process, and one that becomes the standard input of the
    /// other process.
    pub(crate) fn pair() -> Result<(Self, OwnedFd)> {
        let flags = SocketFlags::CLOEXEC;
        let (ours, theirs) = socketpair(AddressFamily::UNIX, SocketType::SEQPACKET, flags, None)?;
        Ok((Self(ours), theirs))
    }

    /// Returns the end that this process received as its standard input.
    pub(crate) fn inherited() -> Result<Self> {
        Ok(Self(std::io::stdin().as_fd().try_clone_to_owned()?))
    }

    /// Sends a packet.
    pub(crate) fn tell(&self, what: &impl Serialize) -> Result<()> {
        self.hand_over(what, &[])
    }

    /// Sends a packet that carries descriptors.
    pub(crate) fn hand_over(&self, what: &impl Serialize, fds: &[BorrowedFd<'_>]) -> Result<()> {
        let bytes = serde_json::to_vec(what)?;
        let mut space = [MaybeUninit::uninit(); rustix::cmsg_space!(ScmRights(MOST_DESCRIPTORS))];
        let mut control = SendAncillaryBuffer::new(&mut space);
        if !fds.is_empty() && !control.push(SendAncillaryMessage::ScmRights(fds)) {
            return Err("too many descriptors for a packet".into());
        }
        match sendmsg(&self.0, &[IoSlice::new(&bytes)], &mut control, SendFlags::NOSIGNAL) {
            Err(Errno::PIPE | Errno::CONNRESET) => Err(ENDED.into()),
            Err(error) => Err(error.into()),
            Ok(_) => Ok(()),
        }
    }

    /// Waits for a packet.
    pub(crate) fn hear<T: DeserializeOwned>(&self) -> Result<T> {
        self.take_over().map(|(packet, _)| packet)
    }

    /// Returns whether a packet has arrived or the other process has ended.
    pub(crate) fn is_readable(&self) -> Result<bool> {
        let mut fds = [PollFd::new(&self.0, PollFlags::IN)];
        Ok(poll(&mut fds, Some(&Timespec::default()))? > 0)
    }

    /// Waits for a packet and the descriptors that it carries.
    pub(crate) fn take_over<T: DeserializeOwned>(&self) -> Result<(T, Vec<OwnedFd>)> {
        let mut bytes = [0; LARGEST];
        let mut space = [MaybeUninit::uninit(); rustix::cmsg_space!(ScmRights(MOST_DESCRIPTORS))];
        let mut control = RecvAncillaryBuffer::new(&mut space);
        let got = loop {
            let mut into = [IoSliceMut::new(&mut bytes)];
            match recvmsg(&self.0, &mut into, &mut control, RecvFlags::CMSG_CLOEXEC) {
                Err(Errno::INTR) => {}
                Err(Errno::CONNRESET) => return Err(ENDED.into()),
                other => break other?.bytes,
            }
        };
        if got == 0 {
            return Err(ENDED.into());
        }
        let mut fds = Vec::new();
        for message in control.drain() {
            if let RecvAncillaryMessage::ScmRights(rights) = message {
                fds.extend(rights);
            }
        }
        Ok((serde_json::from_slice(&bytes[..got])?, fds))
    }
}

impl From<Channel> for OwnedFd {
    fn from(channel: Channel) -> Self {
        channel.0
    }
}

impl AsFd for Channel {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.0.as_fd()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_channel_to_an_ended_process_returns_an_error() {
        let (channel, other) = Channel::pair().unwrap();
        drop(other);
        assert_eq!(channel.tell(&"go on").unwrap_err().to_string(), ENDED);
        assert_eq!(channel.hear::<String>().unwrap_err().to_string(), ENDED);
        // The other end did not read this packet.
        let (channel, other) = Channel::pair().unwrap();
        channel.tell(&"go on").unwrap();
        drop(other);
        assert_eq!(channel.hear::<String>().unwrap_err().to_string(), ENDED);
    }
}
