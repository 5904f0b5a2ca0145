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

/// First of each packet.
const VERSION: u32 = 2;
const MAX_PACKET: usize = 1024;
const MAX_DESCRIPTORS: usize = 4;
/// The longest reason that is told.
const MAX_REASON: usize = 256;

/// A subscriber and a publisher did not come together.
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
    /// Memory was not to be had, or what the other end handed over was refused.
    #[error(transparent)]
    Memory(#[from] ShmError),
    /// The subscriber requests what the publisher does not offer.
    #[error(
        "the publisher does not offer the {0} that the subscriber requests: \
         offer more, or request less"
    )]
    Incompatible(Incompatible),
    /// The publisher refused, and said why.
    #[error("the publisher refused: {0}")]
    Refused(String),
    /// The other end sent something else than it should.
    #[error(
        "the other end sent {0}: is there a publisher at one end and a subscriber at the other?"
    )]
    Protocol(&'static str),
    /// The other end did nothing in time.
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

/// What a subscriber asks.
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

/// What a publisher answers.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Encode, Decode)]
pub(crate) struct PublisherAnswer {
    /// Who asked: an answer to a question that was given up is not one to the next.
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

/// Decodes a packet and encodes it anew; `None` where it is refused. For this
/// project's fuzz target `connect_packet`.
#[doc(hidden)]
#[must_use]
pub fn reencode_packet(bytes: &[u8]) -> Option<Vec<u8>> {
    Packet::decode(bytes).and_then(|packet| packet.encode()).ok()
}

/// The two ends over which a publisher hands segments to a subscriber: theirs alone, so that what
/// else is said over the socket by which they met stays apart.
pub(crate) fn line() -> Result<(OwnedFd, OwnedFd), ConnectError> {
    let (family, kind) = (AddressFamily::UNIX, SocketType::SEQPACKET);
    Ok(socketpair(family, kind, SocketFlags::CLOEXEC, None)?)
}

fn no_descriptors() -> ConnectError {
    ShmError::System { what: "receiving descriptors", source: Errno::MFILE.into() }.into()
}

/// One end of the socket, for as long as the two need to come together.
pub(crate) struct ConnectChannel<'a> {
    socket: BorrowedFd<'a>,
    deadline: Option<Instant>,
    /// Whether it has received something.
    heard: Cell<bool>,
}

impl<'a> ConnectChannel<'a> {
    pub(crate) fn new(socket: BorrowedFd<'a>, timeout: Option<Duration>) -> Self {
        let deadline = timeout.and_then(|timeout| Instant::now().checked_add(timeout));
        Self { socket, deadline, heard: Cell::new(false) }
    }

    /// Asks, and hands over the end of a [line] over which segments are to come.
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
                // Sending to anything else could block.
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

    /// The answer to what `reader` asked.
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

    /// Hands a segment over.
    pub(crate) fn hand(
        &self,
        session: SessionId,
        info: SegmentInfo,
        fd: BorrowedFd<'_>,
    ) -> Result<(), ConnectError> {
        self.send(&Packet::Opened(SegmentOpened { session, segment: info.into() }), &[fd])
    }

    /// Says that a segment is given up.
    pub(crate) fn withdraw(&self, session: SessionId, number: u32) -> Result<(), ConnectError> {
        self.send(&Packet::Gone(SegmentName { session, number }), &[])
    }

    /// The next segment that is handed over or given up. One for whose descriptor there is no room
    /// stays where it is. For one thread at a time.
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

    /// Tells the subscriber that it is not admitted, if it still listens.
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

    /// The next packet. One that is there is taken whatever the time, but only the first: another end
    /// that sends without pause gains none.
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

    /// Waits until the socket is ready, and not beyond the deadline.
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
