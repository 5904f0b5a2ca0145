//! The messages by which two sessions share memory, over a socket pair instead of a daemon.

use std::{
    cell::RefCell,
    io::{IoSlice, IoSliceMut},
    mem::MaybeUninit,
    os::fd::{AsFd, BorrowedFd, OwnedFd},
    sync::{Arc, Mutex},
};

use axon_shm::internal::{
    Grant, Lane, Location, PeerDescriptors, PeerSession, Reader, ReaderInfo, ReaderOptions,
    RingPeer, SegmentEvent, SegmentInfo, SegmentKind, SessionSegment, Writer,
    descriptors::PassedFd,
};
use axon_transport::{
    ids::{Gid, SessionId},
    qos::Qos,
};
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::net::{
    AddressFamily, RecvAncillaryBuffer, RecvAncillaryMessage, RecvFlags, SendAncillaryBuffer,
    SendAncillaryMessage, SendFlags, SocketFlags, SocketType, recvmsg, sendmsg, socketpair,
};

use crate::operation::LARGEST;

/// One end of the socket pair.
pub(crate) struct Wire {
    socket: OwnedFd,
    /// Segments that were received and not mapped yet.
    pending: RefCell<Vec<(Vec<u8>, OwnedFd)>>,
}

/// The publisher's data, as its reader's process gets them before it asks.
pub(crate) struct Offer {
    pub(crate) peer: Arc<PeerSession>,
    pub(crate) writer: Gid,
    pub(crate) ring: Location,
    /// The descriptors of the publisher's segments, to read them from outside.
    pub(crate) seen: Vec<OwnedFd>,
}

/// A reader that can be mapped.
pub(crate) struct Granted {
    pub(crate) peer: Arc<PeerSession>,
    options: ReaderOptions,
}

impl Wire {
    pub(crate) fn pair() -> (Self, Self) {
        let (a, b) =
            socketpair(AddressFamily::UNIX, SocketType::SEQPACKET, SocketFlags::CLOEXEC, None)
                .expect("a socket pair");
        (Self::of(a), Self::of(b))
    }

    fn of(socket: OwnedFd) -> Self {
        Self { socket, pending: RefCell::default() }
    }

    /// Sends a word that means "go on".
    pub(crate) fn go(&self) {
        self.send(&[0], &[]);
    }

    /// Waits for the word of [`go`](Self::go).
    pub(crate) fn wait(&self) {
        self.receive();
    }

    /// Sends the publisher's first message: its session and its ring. Segments that it opens later
    /// follow at once, as from a daemon.
    pub(crate) fn offer(&self, session: &SessionSegment, writer: &Writer) {
        self.introduce(session, writer.gid(), writer.location());
        let to = Self::of(self.socket.try_clone().expect("a descriptor"));
        let to = Mutex::new(to);
        session.on_segment(move |event| {
            let to = to.lock().expect("a wire");
            match event {
                SegmentEvent::Opened(info, fd) => to.hand(info, fd),
                SegmentEvent::Gone(info) => {
                    // A dead process does not need it.
                    let _ = to.try_send(&info.number.to_le_bytes(), &[]);
                }
                SegmentEvent::Low(_) => {}
            }
        });
    }

    pub(crate) fn take_offer(&self) -> Offer {
        let (peer, writer, ring, seen) = self.meet();
        Offer { peer, writer, ring, seen }
    }

    /// Sends the reader's answer: its session and its lane.
    pub(crate) fn ask(&self, session: &SessionSegment, lane: &Lane) {
        self.introduce(session, Gid::new(session.id(), 1), lane.location());
    }

    /// Receives the reader that the publisher attaches, and the reader's segments, to read them
    /// from outside.
    pub(crate) fn take_request(&self, qos: Qos) -> (ReaderInfo, Vec<OwnedFd>) {
        let (peer, gid, lane, seen) = self.meet();
        let (peer, stands_for) = (RingPeer::Remote(peer), None);
        (ReaderInfo { gid, lane, qos, peer, stands_for }, seen)
    }

    pub(crate) fn grant(&self, grant: Grant) {
        let words = [grant.generation.to_le_bytes(), grant.first.to_le_bytes()];
        self.send(words.as_flattened(), &[]);
    }

    pub(crate) fn take_grant(&self) -> Option<Grant> {
        let (bytes, _) = self.receive();
        let [generation, first] = bytes.as_chunks::<8>().0 else { return None };
        let (generation, first) = (u64::from_le_bytes(*generation), u64::from_le_bytes(*first));
        Some(Grant { generation, first })
    }

    /// Returns whether nothing is left to receive from a dead process whose socket a fork keeps
    /// open.
    pub(crate) fn is_empty(&self) -> bool {
        !self.is_ready()
    }

    /// Sends the counters of a reader.
    pub(crate) fn count(&self, counts: [u64; 4]) {
        self.send(counts.map(u64::to_le_bytes).as_flattened(), &[]);
    }

    pub(crate) fn take_count(&self) -> [u64; 4] {
        let (bytes, _) = self.receive();
        let words = bytes.as_chunks::<8>().0.iter().map(|word| u64::from_le_bytes(*word));
        words.collect::<Vec<_>>().try_into().expect("four numbers")
    }

    /// Runs the publisher's side of an attachment. Returns the reader's segments.
    pub(crate) fn serve(
        &self,
        session: &SessionSegment,
        writer: &Writer,
        qos: Qos,
    ) -> Vec<OwnedFd> {
        self.offer(session, writer);
        let (info, segments) = self.take_request(qos);
        self.grant(writer.attach(info).expect("an attachment"));
        segments
    }

    /// Runs the reader's side of an attachment, except for the last step. Returns the grant and the
    /// publisher's segments.
    pub(crate) fn join(&self, session: &Arc<SessionSegment>, qos: Qos) -> (Granted, Vec<OwnedFd>) {
        let Offer { peer, writer, ring, seen } = self.take_offer();
        let lane = session.allocate_lane().expect("a lane");
        self.ask(session, &lane);
        let grant = self.take_grant().expect("a grant");
        let options = options(session, peer.clone(), writer, ring, lane, grant, qos);
        (Granted { peer, options }, seen)
    }

    /// Sends a segment.
    fn hand(&self, info: SegmentInfo, fd: BorrowedFd<'_>) {
        let publisher = match info.kind {
            SegmentKind::Samples(gid) => gid,
            SegmentKind::Session | SegmentKind::Heap => Gid([0; 16]),
        };
        self.send(&[&info.number.to_le_bytes()[..], &publisher.0].concat(), &[fd]);
    }

    /// Maps all segments that have arrived, and returns their descriptors.
    pub(crate) fn take_segments(&self, peer: &PeerSession) -> Vec<OwnedFd> {
        while self.is_ready() {
            let (bytes, mut fds) = self.receive_any();
            match (fds.pop(), bytes.try_into()) {
                (Some(fd), Err(bytes)) => self.pending.borrow_mut().push((bytes, fd)),
                (None, Ok(gone)) => peer.remove_segment(u32::from_le_bytes(gone)),
                _ => break,
            }
        }
        let pending = self.pending.take();
        pending.into_iter().map(|(bytes, fd)| take_in(peer, &bytes, fd)).collect()
    }

    fn is_ready(&self) -> bool {
        let mut fds = [PollFd::new(&self.socket, PollFlags::IN)];
        poll(&mut fds, Some(&Timespec::default())).is_ok_and(|ready| ready > 0)
    }

    /// Sends a session with its segments, and the location of an object in it.
    fn introduce(&self, session: &SessionSegment, gid: Gid, at: Location) {
        let descriptors = session.descriptors().expect("descriptors");
        let fds =
            [descriptors.segment.as_fd(), descriptors.doorbell.as_fd(), descriptors.pidfd.as_fd()];
        let place = [&at.segment.to_le_bytes()[..], &at.offset.to_le_bytes()].concat();
        self.send(&[&session.id().0[..], &gid.0, &place].concat(), &fds);
        for info in session.segments() {
            let (info, fd) = session.segment(info.number).expect("a descriptor").expect("it");
            self.hand(info, fd.as_fd());
        }
        self.go();
    }

    /// Receives a session: its view, the GID and the location of the object, and the descriptors of
    /// its segments.
    fn meet(&self) -> (Arc<PeerSession>, Gid, Location, Vec<OwnedFd>) {
        let (bytes, fds) = self.receive();
        let (ids, place) = bytes.split_at(32);
        let (segment, offset) = place.split_at(4);
        let at = Location {
            segment: u32::from_le_bytes(segment.try_into().expect("a number")),
            offset: u64::from_le_bytes(offset.try_into().expect("an offset")),
        };
        let mut fds = fds.into_iter();
        let mut next = || PassedFd::from(fds.next().expect("a descriptor"));
        let descriptors = PeerDescriptors { segment: next(), doorbell: next(), pidfd: next() };
        let segment = descriptors.segment.as_fd().try_clone_to_owned();
        let mut seen = vec![segment.expect("a descriptor")];
        let id = SessionId(ids[..16].try_into().expect("a session id"));
        let peer = PeerSession::map(id, descriptors).expect("a session");
        loop {
            let (bytes, mut fds) = self.receive_any();
            let Some(fd) = fds.pop() else { break };
            seen.push(take_in(&peer, &bytes, fd));
        }
        (peer, Gid(ids[16..].try_into().expect("a GID")), at, seen)
    }

    fn send(&self, bytes: &[u8], fds: &[BorrowedFd<'_>]) {
        self.try_send(bytes, fds).expect("a packet sent");
    }

    fn try_send(&self, bytes: &[u8], fds: &[BorrowedFd<'_>]) -> rustix::io::Result<usize> {
        let mut space = [MaybeUninit::uninit(); rustix::cmsg_space!(ScmRights(4))];
        let mut control = SendAncillaryBuffer::new(&mut space);
        assert!(fds.is_empty() || control.push(SendAncillaryMessage::ScmRights(fds)));
        let flags = SendFlags::NOSIGNAL;
        sendmsg(&self.socket, &[IoSlice::new(bytes)], &mut control, flags)
    }

    /// Receives the next packet that is not a segment.
    fn receive(&self) -> (Vec<u8>, Vec<OwnedFd>) {
        loop {
            let (bytes, mut fds) = self.receive_any();
            match fds.pop() {
                Some(fd) if fds.is_empty() => self.pending.borrow_mut().push((bytes, fd)),
                last => {
                    fds.extend(last);
                    return (bytes, fds);
                }
            }
        }
    }

    fn receive_any(&self) -> (Vec<u8>, Vec<OwnedFd>) {
        let mut bytes = vec![0; 64];
        let mut space = [MaybeUninit::uninit(); rustix::cmsg_space!(ScmRights(4))];
        let mut control = RecvAncillaryBuffer::new(&mut space);
        let flags = RecvFlags::CMSG_CLOEXEC;
        let got = recvmsg(&self.socket, &mut [IoSliceMut::new(&mut bytes)], &mut control, flags)
            .expect("a packet");
        bytes.truncate(got.bytes);
        let mut fds = Vec::new();
        for message in control.drain() {
            if let RecvAncillaryMessage::ScmRights(rights) = message {
                fds.extend(rights);
            }
        }
        (bytes, fds)
    }
}

/// Maps a segment that was received.
fn take_in(peer: &PeerSession, bytes: &[u8], fd: OwnedFd) -> OwnedFd {
    let (number, publisher) = bytes.split_at(4);
    let number = u32::from_le_bytes(number.try_into().expect("a number"));
    let publisher = Gid(publisher.try_into().expect("a GID"));
    let kind =
        if publisher.0 == [0; 16] { SegmentKind::Heap } else { SegmentKind::Samples(publisher) };
    peer.add_segment(SegmentInfo { number, kind }, &fd).expect("a segment");
    fd
}

/// Returns the options to map a reader of `writer`.
pub(crate) fn options(
    session: &SessionSegment,
    peer: Arc<PeerSession>,
    writer: Gid,
    ring: Location,
    lane: Lane,
    grant: Grant,
    qos: Qos,
) -> ReaderOptions {
    let reader = Gid::new(session.id(), 1);
    let (peer, max_message) = (RingPeer::Remote(peer), LARGEST);
    ReaderOptions { reader, writer, peer, ring, lane, grant, qos, max_message }
}

impl Granted {
    pub(crate) fn map(self) -> Reader {
        Reader::map(self.options).expect("a ring")
    }
}
