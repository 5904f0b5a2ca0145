//! What two sessions say to each other to share memory, over a socket pair instead of a daemon.

use std::{
    io::{IoSlice, IoSliceMut},
    mem::MaybeUninit,
    os::fd::{AsFd, BorrowedFd, OwnedFd},
    sync::Arc,
};

use axon_transport::{
    ids::{Gid, SessionId},
    passed::PassedFd,
    qos::Qos,
    shm::{
        Grant, Lane, Peer, PeerDescriptors, PeerSession, Reader, ReaderInfo, ReaderOptions,
        SessionSegment, Writer,
    },
};
use rustix::net::{
    AddressFamily, RecvAncillaryBuffer, RecvAncillaryMessage, RecvFlags, SendAncillaryBuffer,
    SendAncillaryMessage, SendFlags, SocketFlags, SocketType, recvmsg, sendmsg, socketpair,
};

use crate::operation::LARGEST;

/// One end of the socket pair.
pub(crate) struct Wire(OwnedFd);

/// A publisher as its reader's process knows it before it asks.
pub(crate) struct Offer {
    pub(crate) peer: Arc<PeerSession>,
    pub(crate) writer: Gid,
    pub(crate) ring: OwnedFd,
    /// The publisher's segments once more, to be looked at from outside.
    pub(crate) seen: [OwnedFd; 2],
}

/// A reader that may be mapped.
pub(crate) struct Granted {
    pub(crate) ring: OwnedFd,
    pub(crate) options: ReaderOptions,
}

impl Wire {
    pub(crate) fn pair() -> (Self, Self) {
        let (a, b) =
            socketpair(AddressFamily::UNIX, SocketType::SEQPACKET, SocketFlags::CLOEXEC, None)
                .expect("a socket pair");
        (Self(a), Self(b))
    }

    /// Sends a word that means "go on".
    pub(crate) fn go(&self) {
        self.send(&[0], &[]);
    }

    /// Waits for that word.
    pub(crate) fn wait(&self) {
        self.receive();
    }

    /// The publisher's first word: its session and its ring.
    pub(crate) fn offer(&self, session: &SessionSegment, writer: &Writer) {
        self.introduce(session, &writer.gid().0, Some(writer.descriptor().expect("a ring")));
    }

    pub(crate) fn take_offer(&self) -> Offer {
        let (peer, writer, mut others) = self.meet();
        let ring = others.pop().expect("a ring");
        let segment = others.pop().expect("a session segment");
        let seen = [segment, ring.try_clone().expect("a descriptor")];
        Offer { peer, writer: Gid(writer.try_into().expect("a GID")), ring, seen }
    }

    /// The reader's answer: its session and the lane that it reads by.
    pub(crate) fn ask(&self, session: &SessionSegment, lane: &Lane) {
        self.introduce(session, &lane.index().to_le_bytes(), None);
    }

    /// What the publisher attaches; with it the reader's segment, to be looked at from outside.
    pub(crate) fn take_request(&self, qos: Qos) -> (ReaderInfo, OwnedFd) {
        let (peer, lane, mut others) = self.meet();
        let info = ReaderInfo {
            gid: Gid::new(peer.id(), 1),
            lane: u32::from_le_bytes(lane.try_into().expect("a lane")),
            qos,
            peer: Peer::Remote(peer),
            stands_for: Vec::new(),
        };
        (info, others.pop().expect("a session segment"))
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

    /// The publisher's half of an attachment, whole. The reader's segment.
    pub(crate) fn serve(&self, session: &SessionSegment, writer: &Writer, qos: Qos) -> OwnedFd {
        self.offer(session, writer);
        let (info, segment) = self.take_request(qos);
        self.grant(writer.attach(info).expect("an attachment"));
        segment
    }

    /// The reader's half, but for the last step. The publisher's segments.
    pub(crate) fn join(&self, session: &Arc<SessionSegment>, qos: Qos) -> (Granted, [OwnedFd; 2]) {
        let Offer { peer, writer, ring, seen } = self.take_offer();
        let lane = session.allocate_lane().expect("a lane");
        self.ask(session, &lane);
        let grant = self.take_grant().expect("a grant");
        (Granted { ring, options: options(session, peer, writer, lane, grant, qos) }, seen)
    }

    fn introduce(&self, session: &SessionSegment, more: &[u8], ring: Option<OwnedFd>) {
        let descriptors = session.descriptors().expect("descriptors");
        let mut fds = vec![
            descriptors.segment.as_fd(),
            descriptors.doorbell.as_fd(),
            descriptors.pidfd.as_fd(),
        ];
        fds.extend(ring.as_ref().map(AsFd::as_fd));
        self.send(&[&session.id().0, more].concat(), &fds);
    }

    /// A session, what it said, its segment and what else it sent.
    fn meet(&self) -> (Arc<PeerSession>, Vec<u8>, Vec<OwnedFd>) {
        let (bytes, fds) = self.receive();
        let (id, more) = bytes.split_at(16);
        let mut fds = fds.into_iter();
        let mut next = || PassedFd::from(fds.next().expect("a descriptor"));
        let descriptors = PeerDescriptors { segment: next(), doorbell: next(), pidfd: next() };
        let segment = descriptors.segment.as_fd().try_clone_to_owned();
        let mut others = vec![segment.expect("a descriptor")];
        others.extend(fds);
        let id = SessionId(id.try_into().expect("a session id"));
        (PeerSession::map(id, descriptors).expect("a session"), more.to_vec(), others)
    }

    fn send(&self, bytes: &[u8], fds: &[BorrowedFd<'_>]) {
        let mut space = [MaybeUninit::uninit(); rustix::cmsg_space!(ScmRights(4))];
        let mut control = SendAncillaryBuffer::new(&mut space);
        assert!(fds.is_empty() || control.push(SendAncillaryMessage::ScmRights(fds)));
        let flags = SendFlags::NOSIGNAL;
        sendmsg(&self.0, &[IoSlice::new(bytes)], &mut control, flags).expect("a packet sent");
    }

    fn receive(&self) -> (Vec<u8>, Vec<OwnedFd>) {
        let mut bytes = vec![0; 64];
        let mut space = [MaybeUninit::uninit(); rustix::cmsg_space!(ScmRights(4))];
        let mut control = RecvAncillaryBuffer::new(&mut space);
        let flags = RecvFlags::CMSG_CLOEXEC;
        let got = recvmsg(&self.0, &mut [IoSliceMut::new(&mut bytes)], &mut control, flags)
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

/// What it takes to map a reader of `writer`.
pub(crate) fn options(
    session: &SessionSegment,
    peer: Arc<PeerSession>,
    writer: Gid,
    lane: Lane,
    grant: Grant,
    qos: Qos,
) -> ReaderOptions {
    let reader = Gid::new(session.id(), 1);
    let (peer, max_message) = (Peer::Remote(peer), LARGEST);
    ReaderOptions { reader, writer, peer, lane, grant, qos, max_message }
}

impl Granted {
    pub(crate) fn map(self) -> Reader {
        Reader::map(self.ring, self.options).expect("a ring")
    }
}
