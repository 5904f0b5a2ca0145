//! The second process of a test, and the messages that the test sends to it.

use std::{
    env,
    io::{IoSlice, IoSliceMut},
    mem::MaybeUninit,
    os::fd::{AsFd, BorrowedFd, OwnedFd},
    process::{Child, Command, Stdio},
};

use rustix::net::{
    AddressFamily, RecvAncillaryBuffer, RecvAncillaryMessage, RecvFlags, SendAncillaryBuffer,
    SendAncillaryMessage, SendFlags, SocketFlags, SocketType, recvmsg, sendmsg, socketpair,
};

use super::*;
use crate::os::descriptors::PassedFd;

/// Environment variable that makes this binary the other process, and names its part.
pub(super) const PART: &str = "SHM_TEST_PART";
/// The largest message that the tests send.
pub(super) const LARGE: u64 = 25_000_000;

/// One end of the socket pair.
pub(super) struct Wire(pub(super) OwnedFd);

impl Wire {
    pub(super) fn send(&self, bytes: &[u8], fds: &[BorrowedFd<'_>]) {
        let mut space = [MaybeUninit::uninit(); rustix::cmsg_space!(ScmRights(8))];
        let mut control = SendAncillaryBuffer::new(&mut space);
        assert!(fds.is_empty() || control.push(SendAncillaryMessage::ScmRights(fds)));
        sendmsg(&self.0, &[IoSlice::new(bytes)], &mut control, SendFlags::empty()).unwrap();
    }

    pub(super) fn receive(&self) -> (Vec<u8>, Vec<OwnedFd>) {
        let mut bytes = vec![0; 256];
        let mut space = [MaybeUninit::uninit(); rustix::cmsg_space!(ScmRights(8))];
        let mut control = RecvAncillaryBuffer::new(&mut space);
        let flags = RecvFlags::CMSG_CLOEXEC;
        let got =
            recvmsg(&self.0, &mut [IoSliceMut::new(&mut bytes)], &mut control, flags).unwrap();
        bytes.truncate(got.bytes);
        let mut fds = Vec::new();
        for message in control.drain() {
            if let RecvAncillaryMessage::ScmRights(rights) = message {
                fds.extend(rights);
            }
        }
        (bytes, fds)
    }

    /// Receives one packet with its descriptors, and sends it to another process.
    pub(super) fn pass_on(&self, to: &Self) {
        let (bytes, fds) = self.receive();
        to.send(&bytes, &fds.iter().map(AsFd::as_fd).collect::<Vec<_>>());
    }

    pub(super) fn send_numbers(&self, numbers: &[u64]) {
        let bytes: Vec<u8> = numbers.iter().flat_map(|number| number.to_le_bytes()).collect();
        self.send(&bytes, &[]);
    }

    pub(super) fn receive_numbers(&self) -> Vec<u64> {
        let bytes = self.receive().0;
        bytes.as_chunks::<8>().0.iter().map(|chunk| u64::from_le_bytes(*chunk)).collect()
    }

    /// Sends a session with all its segments, and a location and a GID in it.
    pub(super) fn send_session(&self, session: &SessionSegment, at: Location, gid: Gid) {
        let descriptors = session.descriptors().unwrap();
        let mut fds = vec![descriptors.segment, descriptors.doorbell, descriptors.pidfd];
        let mut bytes = session.id().0.to_vec();
        bytes.extend_from_slice(&gid.0);
        bytes.extend_from_slice(&at.segment.to_le_bytes());
        bytes.extend_from_slice(&at.offset.to_le_bytes());
        for info in session.segments() {
            fds.push(session.segment(info.number).unwrap().unwrap().1.into());
            bytes.extend_from_slice(&info.number.to_le_bytes());
        }
        self.send(&bytes, &fds.iter().map(AsFd::as_fd).collect::<Vec<_>>());
    }

    /// Receives what [`send_session`](Self::send_session) sends.
    pub(super) fn receive_session(&self) -> (Arc<PeerSession>, Location, Gid) {
        let (bytes, fds) = self.receive();
        let (ids, bytes) = bytes.as_slice().split_at(32);
        let (at, numbers) = bytes.split_at(12);
        let (id, gid) = (ids[..16].try_into().unwrap(), Gid(ids[16..].try_into().unwrap()));
        let at = Location {
            segment: u32::from_le_bytes(at[..4].try_into().unwrap()),
            offset: u64::from_le_bytes(at[4..].try_into().unwrap()),
        };
        let mut fds = fds.into_iter();
        let mut next = || PassedFd::received(fds.next().expect("a descriptor"));
        let descriptors = PeerDescriptors { segment: next(), doorbell: next(), pidfd: next() };
        assert!(descriptors.process().unwrap().is_some_and(|pid| pid != std::process::id()));
        let peer = PeerSession::map(SessionId(id), descriptors).unwrap();
        for number in numbers.as_chunks::<4>().0 {
            let (number, kind) = (u32::from_le_bytes(*number), SegmentKind::Samples(gid));
            peer.add_segment(SegmentInfo { number, kind }, next()).unwrap();
        }
        (peer, at, gid)
    }

    /// Runs the publisher's side of an attachment.
    pub(super) fn serve(&self, session: &SessionSegment, writer: &Writer, qos: Qos) {
        self.send_session(session, writer.location(), writer.gid());
        let (peer, lane, gid) = self.receive_session();
        let info = ReaderInfo { gid, lane, qos, peer: RingPeer::Remote(peer), stands_for: None };
        let grant = writer.attach(info).unwrap();
        self.send_numbers(&[grant.generation, grant.first]);
    }

    /// Runs the reader's side of an attachment.
    pub(super) fn join(&self, session: &Arc<SessionSegment>, qos: Qos) -> Reader {
        let (peer, ring, writer) = self.receive_session();
        let lane = session.allocate_lane().unwrap();
        let reader = Gid::new(session.id(), 1);
        self.send_session(session, lane.location(), reader);
        let grant = self.receive_numbers();
        let options = ReaderOptions {
            reader,
            writer,
            peer: RingPeer::Remote(peer),
            ring,
            lane,
            grant: Grant { generation: grant[0], first: grant[1] },
            qos,
            max_message: LARGE,
        };
        Reader::map(options).unwrap()
    }
}

/// The other process; killed when dropped.
pub(super) struct Other {
    pub(super) child: Child,
    pub(super) wire: Wire,
}

impl Other {
    pub(super) fn start(part: &str) -> Self {
        let (ours, theirs) =
            socketpair(AddressFamily::UNIX, SocketType::SEQPACKET, SocketFlags::CLOEXEC, None)
                .unwrap();
        let child = Command::new(env::current_exe().unwrap())
            .args(["--exact", "tests::processes::the_other_process", "--nocapture"])
            .env(PART, part)
            .stdin(Stdio::from(theirs))
            .stdout(Stdio::null())
            .spawn()
            .unwrap();
        Self { child, wire: Wire(ours) }
    }

    pub(super) fn kill(&mut self) {
        self.child.kill().unwrap();
        self.child.wait().unwrap();
    }

    pub(super) fn succeed(mut self) {
        assert!(self.child.wait().unwrap().success());
    }
}

impl Drop for Other {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
