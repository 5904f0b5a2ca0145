//! Connects a subscriber and a publisher over a connected socket, without a daemon. Each side sends one packet. A
//! further socket carries one packet for each segment of memory (`docs/formats.md`, section 9).

use std::{
    cell::Cell,
    io::{self, IoSlice},
    mem::MaybeUninit,
    os::fd::{AsFd, BorrowedFd, OwnedFd},
    time::{Duration, Instant},
};

use minicbor::{Decode, Encode};
use rustix::{
    event::{PollFd, PollFlags, Timespec, poll},
    io::Errno,
    net::{
        AddressFamily, SendAncillaryBuffer, SendAncillaryMessage, SendFlags, SocketFlags,
        SocketType, sendmsg, socketpair, sockopt,
    },
};

use crate::{
    alloc::segments::SegmentInfo,
    error::ShmError,
    ids::{Gid, SessionId},
    os::descriptors::{self, PassedFd},
    qos::{Incompatible, Qos},
    ring::layout::Location,
    session::{
        peer::PeerDescriptors,
        segment_message::{SegmentName, SegmentOpened},
    },
};

/// The protocol version, the first field of each packet.
const VERSION: u32 = 2;
const MAX_PACKET: usize = 1024;
const MAX_DESCRIPTORS: usize = 4;
/// The maximum length of a refusal's reason, in bytes.
const MAX_REASON: usize = 256;

/// A subscriber and a publisher could not connect.
///
/// ```
/// use std::{os::unix::net::UnixDatagram, time::Duration};
/// use axon_shm::{ConnectError, Context, Subscriber, SubscriberOptions, qos::Qos};
///
/// // No publisher serves at the other end.
/// let (ours, _theirs) = UnixDatagram::pair()?;
/// let options = SubscriberOptions::new(Qos::default());
/// let soon = Some(Duration::from_millis(1));
/// let alone = Subscriber::connect(&Context::new()?, &ours, options, soon);
/// assert!(matches!(alone, Err(ConnectError::Timeout)));
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ConnectError {
    /// Memory could not be allocated, or an object that the other end passed was refused.
    #[error(transparent)]
    Memory(#[from] ShmError),
    /// The publisher does not offer the QoS that the subscriber requests.
    #[error(
        "the publisher does not offer the {0} that the subscriber requests: \
         offer more, or request less"
    )]
    Incompatible(Incompatible),
    /// The publisher refused, for this reason.
    #[error("the publisher refused: {0}")]
    Refused(String),
    /// The other end broke the protocol.
    #[error(
        "the other end sent {0}: is there a publisher at one end and a subscriber at the other?"
    )]
    Protocol(&'static str),
    /// The other end did not answer in time.
    #[error(
        "the other end did not answer in time: a publisher must serve while a subscriber connects"
    )]
    Timeout,
    /// The other end of the socket was closed.
    #[error("the other end of the socket was closed: connect by a new one")]
    Closed,
    /// The socket failed.
    #[error("the socket failed: {0}")]
    Socket(#[source] io::Error),
}

impl From<Errno> for ConnectError {
    fn from(errno: Errno) -> Self {
        match errno {
            Errno::PIPE | Errno::CONNRESET | Errno::CONNREFUSED | Errno::NOTCONN => Self::Closed,
            other => Self::Socket(other.into()),
        }
    }
}

/// A subscriber's request to attach to a ring.
#[derive(Clone, Copy, Debug, Encode, Decode)]
pub(crate) struct AttachRequest {
    #[n(0)]
    pub(crate) session: SessionId,
    #[n(1)]
    pub(crate) reader: Gid,
    #[n(2)]
    pub(crate) lane: Location,
    #[n(3)]
    pub(crate) qos: Qos,
}

/// A publisher's answer to an [`AttachRequest`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, Encode, Decode)]
pub(crate) struct PublisherAnswer {
    /// The reader that asked. A reader that gave up a request ignores an answer to it that arrives later.
    #[n(0)]
    pub(crate) reader: Gid,
    #[n(1)]
    pub(crate) session: SessionId,
    #[n(2)]
    pub(crate) writer: Gid,
    #[n(3)]
    pub(crate) generation: u64,
    #[n(4)]
    pub(crate) first: u64,
    #[n(5)]
    pub(crate) ring: Location,
}

/// A segment that the publisher opened or dropped.
#[derive(Debug)]
pub(crate) enum SegmentUpdate {
    Opened(SegmentOpened, PassedFd),
    Gone(SegmentName),
}

#[derive(Debug, Encode, Decode)]
struct ConnectRefusal {
    #[n(0)]
    reader: Gid,
    #[n(1)]
    reason: String,
}

#[derive(Debug, Encode, Decode)]
enum Packet {
    #[n(0)]
    AttachRequest(#[n(0)] AttachRequest),
    #[n(1)]
    Granted(#[n(0)] PublisherAnswer),
    #[n(2)]
    Refused(#[n(0)] ConnectRefusal),
    #[n(3)]
    Opened(#[n(0)] SegmentOpened),
    #[n(4)]
    Gone(#[n(0)] SegmentName),
}

impl Packet {
    fn encode(&self) -> Result<Vec<u8>, ConnectError> {
        minicbor::to_vec((VERSION, self))
            .map_err(|_| ConnectError::Protocol("nothing: the packet cannot be written"))
    }

    fn decode(bytes: &[u8]) -> Result<Self, ConnectError> {
        match minicbor::decode(bytes) {
            Ok((VERSION, packet)) => Ok(packet),
            Ok(_) => Err(ConnectError::Protocol("a packet of another version")),
            Err(_) => Err(ConnectError::Protocol("bytes that are no packet")),
        }
    }
}

/// Decodes a packet and encodes it again; `None` if the decoder refuses it. For this project's fuzz target
/// `connect_packet`.
#[doc(hidden)]
#[must_use]
pub fn reencode_packet(bytes: &[u8]) -> Option<Vec<u8>> {
    Packet::decode(bytes).and_then(|packet| packet.encode()).ok()
}

/// Creates the socket pair over which a publisher passes segments to a subscriber. Only these two use it, so the
/// segments are not mixed with other traffic on the socket over which they connected.
pub(crate) fn line() -> Result<(OwnedFd, OwnedFd), ConnectError> {
    let (family, kind) = (AddressFamily::UNIX, SocketType::SEQPACKET);
    Ok(socketpair(family, kind, SocketFlags::CLOEXEC, None)?)
}

fn no_descriptors() -> ConnectError {
    ShmError::System { what: "receiving descriptors", source: Errno::MFILE.into() }.into()
}

/// One end of the socket, while the two ends connect.
pub(crate) struct ConnectChannel<'a> {
    socket: BorrowedFd<'a>,
    deadline: Option<Instant>,
    /// True once the channel tried to receive.
    heard: Cell<bool>,
}

impl<'a> ConnectChannel<'a> {
    pub(crate) fn new(socket: BorrowedFd<'a>, timeout: Option<Duration>) -> Self {
        let deadline = timeout.and_then(|timeout| Instant::now().checked_add(timeout));
        Self { socket, deadline, heard: Cell::new(false) }
    }

    /// Sends a request, and passes the end of a [line] over which segments will arrive.
    pub(crate) fn ask(
        &self,
        asked: &AttachRequest,
        own: &PeerDescriptors,
        line: impl AsFd,
    ) -> Result<(), ConnectError> {
        let fds = [own.segment.as_fd(), own.doorbell.as_fd(), own.pidfd.as_fd(), line.as_fd()];
        self.send(&Packet::AttachRequest(*asked), &fds)
    }

    pub(crate) fn await_asked(
        &self,
    ) -> Result<(AttachRequest, PeerDescriptors, PassedFd), ConnectError> {
        match self.receive()? {
            (Packet::AttachRequest(asked), fds) => {
                let [segment, doorbell, pidfd, line] = fds
                    .try_into()
                    .map_err(|_| ConnectError::Protocol("another number of descriptors"))?;
                if asked.reader.0[..12] != asked.session.0[..12] {
                    return Err(ConnectError::Protocol("a GID that is not its own"));
                }
                // A send to a socket of another kind could block.
                if sockopt::socket_domain(&line) != Ok(AddressFamily::UNIX)
                    || sockopt::socket_type(&line) != Ok(SocketType::SEQPACKET)
                {
                    return Err(ConnectError::Protocol("no unix socket for its segments"));
                }
                Ok((asked, PeerDescriptors { segment, doorbell, pidfd }, line))
            }
            _ => Err(ConnectError::Protocol("an answer where a question was due")),
        }
    }

    pub(crate) fn grant(
        &self,
        granted: &PublisherAnswer,
        own: &PeerDescriptors,
    ) -> Result<(), ConnectError> {
        let fds = [own.segment.as_fd(), own.doorbell.as_fd(), own.pidfd.as_fd()];
        self.send(&Packet::Granted(*granted), &fds)
    }

    /// Waits for the answer to the request of `reader`.
    pub(crate) fn await_granted(
        &self,
        reader: Gid,
    ) -> Result<(PublisherAnswer, PeerDescriptors), ConnectError> {
        loop {
            match self.receive()? {
                (Packet::Granted(granted), fds) if granted.reader == reader => {
                    let [segment, doorbell, pidfd] = fds
                        .try_into()
                        .map_err(|_| ConnectError::Protocol("another number of descriptors"))?;
                    return Ok((granted, PeerDescriptors { segment, doorbell, pidfd }));
                }
                (Packet::Refused(refused), _) if refused.reader == reader => {
                    return Err(ConnectError::Refused(refused.reason));
                }
                (Packet::Granted(_) | Packet::Refused(_), _) => {}
                (Packet::Opened(_) | Packet::Gone(_), _) => {}
                (Packet::AttachRequest(_), _) => {
                    return Err(ConnectError::Protocol("a question where an answer was due"));
                }
            }
        }
    }

    /// Passes a segment to the subscriber.
    pub(crate) fn hand(
        &self,
        session: SessionId,
        info: SegmentInfo,
        fd: BorrowedFd<'_>,
    ) -> Result<(), ConnectError> {
        self.send(&Packet::Opened(SegmentOpened { session, segment: info.into() }), &[fd])
    }

    /// Tells the subscriber that a segment was dropped.
    pub(crate) fn withdraw(&self, session: SessionId, number: u32) -> Result<(), ConnectError> {
        self.send(&Packet::Gone(SegmentName { session, number }), &[])
    }

    /// Returns the next opened or dropped segment. A packet for whose descriptor this process has no room stays in the
    /// socket. Only one thread at a time may call this.
    pub(crate) fn take_update(&self) -> Result<SegmentUpdate, ConnectError> {
        loop {
            match self.receive_by(descriptors::receive_whole)? {
                (Packet::Opened(opened), mut fds) => {
                    if let (Some(fd), true) = (fds.pop(), fds.is_empty()) {
                        return Ok(SegmentUpdate::Opened(opened, fd));
                    }
                }
                (Packet::Gone(gone), _) => return Ok(SegmentUpdate::Gone(gone)),
                (Packet::AttachRequest(_) | Packet::Granted(_) | Packet::Refused(_), _) => {}
            }
        }
    }

    /// Tells the subscriber that it is not admitted, if it still listens. Ignores errors.
    pub(crate) fn refuse(&self, reader: Gid, why: &ConnectError) {
        let mut reason = why.to_string();
        let end = (0..=MAX_REASON.min(reason.len())).rev().find(|&i| reason.is_char_boundary(i));
        reason.truncate(end.unwrap_or(0));
        let _ = self.send(&Packet::Refused(ConnectRefusal { reader, reason }), &[]);
    }

    fn send(&self, packet: &Packet, fds: &[BorrowedFd<'_>]) -> Result<(), ConnectError> {
        let bytes = packet.encode()?;
        let mut space = [MaybeUninit::uninit(); rustix::cmsg_space!(ScmRights(MAX_DESCRIPTORS))];
        loop {
            let mut control = SendAncillaryBuffer::new(&mut space);
            if !fds.is_empty() && !control.push(SendAncillaryMessage::ScmRights(fds)) {
                return Err(ConnectError::Protocol("nothing: there are too many descriptors"));
            }
            let flags = SendFlags::DONTWAIT | SendFlags::NOSIGNAL;
            match sendmsg(self.socket, &[IoSlice::new(&bytes)], &mut control, flags) {
                Ok(_) => return Ok(()),
                Err(Errno::INTR) => {}
                Err(Errno::AGAIN) => self.until(PollFlags::OUT)?,
                Err(errno) => return Err(errno.into()),
            }
        }
    }

    /// Returns the next packet. The first packet is received even after the deadline if it is already there. Later ones
    /// are not, so an end that sends without pause cannot extend the deadline.
    fn receive(&self) -> Result<(Packet, Vec<PassedFd>), ConnectError> {
        self.receive_by(descriptors::receive)
    }

    fn receive_by(
        &self,
        receive: impl Fn(BorrowedFd<'a>, &mut [u8]) -> Result<descriptors::SocketPacket, Errno>,
    ) -> Result<(Packet, Vec<PassedFd>), ConnectError> {
        if self.heard.replace(true) && self.left().is_some_and(|left| left.is_zero()) {
            return Err(ConnectError::Timeout);
        }
        let mut bytes = [0; MAX_PACKET];
        loop {
            let got = match receive(self.socket, &mut bytes) {
                Ok(got) => got,
                Err(Errno::AGAIN) => {
                    self.until(PollFlags::IN)?;
                    continue;
                }
                Err(Errno::MFILE) => return Err(no_descriptors()),
                Err(errno) => return Err(errno.into()),
            };
            let fds = got.descriptors;
            if got.bytes == 0 {
                return Err(ConnectError::Closed);
            }
            if got.truncated || fds.len() > MAX_DESCRIPTORS {
                return Err(ConnectError::Protocol("more than belongs in a packet"));
            }
            if got.lost {
                return Err(no_descriptors());
            }
            return Ok((Packet::decode(&bytes[..got.bytes])?, fds));
        }
    }

    fn left(&self) -> Option<Duration> {
        self.deadline.map(|deadline| deadline.saturating_duration_since(Instant::now()))
    }

    /// Waits until the socket is ready, at most until the deadline.
    fn until(&self, events: PollFlags) -> Result<(), ConnectError> {
        let left = self.left();
        if left.is_some_and(|left| left.is_zero()) {
            return Err(ConnectError::Timeout);
        }
        let timeout = left.and_then(|left| Timespec::try_from(left).ok());
        match poll(&mut [PollFd::from_borrowed_fd(self.socket, events)], timeout.as_ref()) {
            Ok(_) | Err(Errno::INTR) => Ok(()),
            Err(errno) => Err(errno.into()),
        }
    }
}
