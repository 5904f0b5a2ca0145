//! The two ends in two processes: this test binary runs itself as the other one, and the
//! descriptors go over a socket pair as they do between sessions.

use std::{
    env,
    io::{IoSlice, IoSliceMut, Write as _},
    mem::MaybeUninit,
    os::fd::{AsFd, BorrowedFd, OwnedFd},
    process::{Child, Command, Stdio},
    thread,
    time::Duration,
};

use rustix::net::{
    AddressFamily, RecvAncillaryBuffer, RecvAncillaryMessage, RecvFlags, SendAncillaryBuffer,
    SendAncillaryMessage, SendFlags, SocketFlags, SocketType, recvmsg, sendmsg, socketpair,
};

use super::*;

/// Tells this binary that it is the other process, and which part it plays.
const PART: &str = "SHM_TEST_PART";
const LARGE: u64 = 25_000_000;

/// One end of the socket pair.
struct Wire(OwnedFd);

impl Wire {
    fn send(&self, bytes: &[u8], fds: &[BorrowedFd<'_>]) {
        let mut space = [MaybeUninit::uninit(); rustix::cmsg_space!(ScmRights(4))];
        let mut control = SendAncillaryBuffer::new(&mut space);
        assert!(fds.is_empty() || control.push(SendAncillaryMessage::ScmRights(fds)));
        sendmsg(&self.0, &[IoSlice::new(bytes)], &mut control, SendFlags::empty()).unwrap();
    }

    fn receive(&self) -> (Vec<u8>, Vec<OwnedFd>) {
        let mut bytes = vec![0; 256];
        let mut space = [MaybeUninit::uninit(); rustix::cmsg_space!(ScmRights(4))];
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

    fn send_numbers(&self, numbers: &[u64]) {
        let bytes: Vec<u8> = numbers.iter().flat_map(|number| number.to_le_bytes()).collect();
        self.send(&bytes, &[]);
    }

    fn receive_numbers(&self) -> Vec<u64> {
        let bytes = self.receive().0;
        bytes.as_chunks::<8>().0.iter().map(|chunk| u64::from_le_bytes(*chunk)).collect()
    }

    fn send_session(&self, session: &SessionSegment, more: &[u8], ring: Option<OwnedFd>) {
        let descriptors = session.descriptors().unwrap();
        let mut fds = vec![
            descriptors.segment.as_fd(),
            descriptors.doorbell.as_fd(),
            descriptors.pidfd.as_fd(),
        ];
        fds.extend(ring.as_ref().map(AsFd::as_fd));
        let mut bytes = session.id().0.to_vec();
        bytes.extend_from_slice(more);
        self.send(&bytes, &fds);
    }

    fn receive_session(&self) -> (Arc<PeerSession>, Vec<u8>, Option<OwnedFd>) {
        let (bytes, fds) = self.receive();
        let (id, more) = bytes.split_at(16);
        let mut fds = fds.into_iter();
        let mut next = || fds.next().expect("a descriptor");
        let descriptors = PeerDescriptors { segment: next(), doorbell: next(), pidfd: next() };
        assert!(descriptors.process().is_some_and(|pid| pid != std::process::id()));
        let id = SessionId(id.try_into().unwrap());
        (PeerSession::map(id, descriptors).unwrap(), more.to_vec(), fds.next())
    }

    /// The publisher's half of an attachment.
    fn serve(&self, session: &SessionSegment, writer: &Writer, qos: Qos) {
        self.send_session(session, &writer.gid().0, Some(writer.descriptor().unwrap()));
        let (peer, lane, _) = self.receive_session();
        let info = ReaderInfo {
            gid: Gid::new(peer.id(), 1),
            lane: u32::from_le_bytes(lane.try_into().unwrap()),
            qos,
            peer: Peer::Remote(peer),
            stands_for: Vec::new(),
        };
        let grant = writer.attach(info).unwrap();
        self.send_numbers(&[grant.generation, grant.first]);
    }

    /// The reader's half.
    fn join(&self, session: &Arc<SessionSegment>, qos: Qos) -> Reader {
        let (peer, writer, ring) = self.receive_session();
        let lane = session.allocate_lane().unwrap();
        self.send_session(session, &lane.index().to_le_bytes(), None);
        let grant = self.receive_numbers();
        let options = ReaderOptions {
            reader: Gid::new(session.id(), 1),
            writer: Gid(writer.try_into().unwrap()),
            peer: Peer::Remote(peer),
            lane,
            grant: Grant { generation: grant[0], first: grant[1] },
            qos,
            max_message: LARGE,
        };
        Reader::map(ring.expect("a ring"), options).unwrap()
    }
}

/// The other process; killed when dropped.
struct Other {
    child: Child,
    wire: Wire,
}

impl Other {
    fn start(part: &str) -> Self {
        let (ours, theirs) =
            socketpair(AddressFamily::UNIX, SocketType::SEQPACKET, SocketFlags::CLOEXEC, None)
                .unwrap();
        // The harness names tests without the crate.
        let (_, module) = module_path!().split_once("::").unwrap();
        let child = Command::new(env::current_exe().unwrap())
            .args(["--exact", &format!("{module}::the_other_process"), "--nocapture"])
            .env(PART, part)
            .stdin(Stdio::from(theirs))
            .stdout(Stdio::null())
            .spawn()
            .unwrap();
        Self { child, wire: Wire(ours) }
    }

    fn kill(&mut self) {
        self.child.kill().unwrap();
        self.child.wait().unwrap();
    }

    fn succeed(mut self) {
        assert!(self.child.wait().unwrap().success());
    }
}

impl Drop for Other {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn large_writer(session: &Arc<SessionSegment>, qos: Qos, budget: u64) -> Writer {
    let gid = Gid::new(session.id(), 1);
    Writer::create(session.clone(), RingOptions { gid, qos, budget, max_message: LARGE }).unwrap()
}

/// Publishes whatever it takes: a host under load may keep a reader from running for longer than
/// a publish waits.
fn publish(writer: &Writer, sequence: u64, payload: &[u8]) {
    while let Err(error) = writer.publish(meta(sequence), payload) {
        assert!(matches!(error, PublishError::Blocked { .. }), "{error}");
    }
}

/// Takes the next sample and checks it.
fn take(reader: &mut Reader, session: &SessionSegment, out: &mut Vec<u8>) -> u64 {
    loop {
        await_data(session, reader);
        if let Some(taken) = reader.take(out).unwrap() {
            let sequence = taken.meta.sequence;
            assert_eq!(taken.meta, meta(sequence));
            assert!(*out == pattern(sequence, out.len()), "sample {sequence} is torn");
            return sequence;
        }
    }
}

/// Not a test of its own: what the other process does.
#[test]
fn the_other_process() {
    let Ok(part) = env::var(PART) else { return };
    let wire = Wire(std::io::stdin().as_fd().try_clone_to_owned().unwrap());
    let session = session();
    let mut out = Vec::new();
    match part.as_str() {
        "take all" => {
            let mut reader = wire.join(&session, Qos::keep_all());
            let (total, pause) = (wire.receive_numbers()[0], 97);
            for sequence in 0..total {
                assert_eq!(take(&mut reader, &session, &mut out), sequence);
                if sequence % pause == 0 {
                    thread::yield_now();
                }
            }
            wire.send_numbers(&[reader.received(), reader.lost(), reader.skipped()]);
        }
        "take the last" => {
            let mut reader = wire.join(&session, keep_last(1));
            let total = wire.receive_numbers()[0];
            for sequence in 0..total {
                assert_eq!(take(&mut reader, &session, &mut out), sequence);
                wire.send_numbers(&[out.len() as u64]);
            }
        }
        "take what is there at the end" => {
            let mut reader = wire.join(&session, keep_last(20));
            wire.receive_numbers();
            while reader.has_data() {
                take(&mut reader, &session, &mut out);
            }
            wire.send_numbers(&[reader.received(), reader.lost(), reader.skipped()]);
        }
        "take nothing" => {
            let _reader = wire.join(&session, Qos::keep_all());
            wire.send_numbers(&[]);
            thread::sleep(Duration::from_secs(600));
        }
        "publish for ever" => {
            let writer = large_writer(&session, keep_last(2), 1 << 20);
            wire.serve(&session, &writer, keep_last(2));
            for sequence in 0.. {
                // In steps, so that a kill in the middle of a sample is likely.
                let payload = pattern(sequence, 100_000);
                let mut loan = writer.loan(payload.len()).unwrap();
                for piece in payload.chunks(1000) {
                    loan.write_all(piece).unwrap();
                }
                loan.publish(meta(sequence)).unwrap();
                writer.publish(meta(sequence), &payload[..90]).unwrap();
            }
        }
        "fork" => {
            let writer = large_writer(&session, keep_last(1), 1 << 20);
            let mut reader = attach(&writer, &session, &session, keep_last(1));
            writer.publish(meta(0), b"before").unwrap();
            // SAFETY: the child makes no call but what follows, which takes no lock that another
            // thread may have held, and leaves by _exit.
            let child = unsafe { libc::fork() };
            if child == 0 {
                let poisoned = writer.publish(meta(1), b"child") == Err(PublishError::Forked)
                    && reader.take(&mut out) == Err(TakeError::Forked)
                    && matches!(session.allocate_lane(), Err(ShmError::Forked))
                    && !session.wait(|| false, None);
                drop((reader, writer, session));
                // SAFETY: ends the process without running anything else.
                unsafe { libc::_exit(if poisoned { 0 } else { 1 }) };
            }
            let mut status = -1;
            // SAFETY: waits for the child just made; `status` outlives the call.
            assert_eq!(unsafe { libc::waitpid(child, &mut status, 0) }, child);
            assert_eq!(status, 0, "the child was refused, and killed by nothing");
            // The parent goes on as if nothing had been.
            assert_eq!(reader.take(&mut out).unwrap().unwrap().meta, meta(0));
            writer.publish(meta(1), b"after").unwrap();
            assert_eq!(reader.take(&mut out).unwrap().unwrap().meta, meta(1));
        }
        "echo" => {
            let mut ping = wire.join(&session, Qos::keep_all());
            let writer = large_writer(&session, Qos::keep_all(), 1 << 20);
            wire.serve(&session, &writer, Qos::keep_all());
            let total = wire.receive_numbers()[0];
            for sequence in 0..total {
                assert_eq!(take(&mut ping, &session, &mut out), sequence);
                publish(&writer, sequence, &out);
            }
            // The last one must be read before this process goes.
            wire.receive();
        }
        other => panic!("no such part: {other}"),
    }
}

#[test]
fn each_length_crosses() {
    let session = session();
    let writer = large_writer(&session, Qos::keep_all(), 1 << 20);
    let other = Other::start("take all");
    other.wire.serve(&session, &writer, Qos::keep_all());
    let lengths = lengths();
    let total = lengths.len() as u64;
    other.wire.send_numbers(&[total]);
    for (sequence, len) in lengths.into_iter().enumerate() {
        publish(&writer, sequence as u64, &pattern(sequence as u64, len));
    }
    assert_eq!(other.wire.receive_numbers(), [total, 0, 0]);
    other.succeed();
}

#[test]
fn keep_all_loses_nothing_to_a_slow_reader() {
    let session = session();
    // Room for 64 samples.
    let writer = large_writer(&session, Qos::keep_all(), 64 * 1024);
    let other = Other::start("take all");
    other.wire.serve(&session, &writer, Qos::keep_all());
    let total = 20_000;
    other.wire.send_numbers(&[total]);
    for sequence in 0..total {
        publish(&writer, sequence, &pattern(sequence, 1024));
    }
    assert_eq!(other.wire.receive_numbers(), [total, 0, 0]);
    other.succeed();
}

#[test]
fn the_largest_message_crosses_at_depth_one() {
    let session = session();
    let writer = large_writer(&session, keep_last(1), 1 << 20);
    let other = Other::start("take the last");
    other.wire.serve(&session, &writer, keep_last(1));
    other.wire.send_numbers(&[3]);
    for sequence in 0..3 {
        publish(&writer, sequence, &pattern(sequence, LARGE as usize));
        assert_eq!(other.wire.receive_numbers(), [LARGE]);
    }
    other.succeed();
}

#[test]
fn what_a_keep_last_reader_did_not_get_is_counted_exactly() {
    let session = session();
    // Room for eight samples, of which the reader would like 20.
    let writer = large_writer(&session, keep_last(1), 8 * 1024);
    let other = Other::start("take what is there at the end");
    other.wire.serve(&session, &writer, keep_last(20));
    for sequence in 0..1000 {
        publish(&writer, sequence, &pattern(sequence, 1024));
    }
    other.wire.send_numbers(&[]);
    assert_eq!(other.wire.receive_numbers(), [8, 12, 980]);
    other.succeed();
}

#[test]
fn a_reader_killed_while_it_holds_the_publisher_lets_it_go() {
    let session = session();
    let writer = large_writer(&session, Qos::keep_all(), 64 * 1024);
    let mut other = Other::start("take nothing");
    other.wire.serve(&session, &writer, Qos::keep_all());
    other.wire.receive_numbers();
    let mut sequence = 0;
    while writer.try_publish(meta(sequence), &pattern(sequence, 1024)).is_ok() {
        sequence += 1;
    }
    assert!(matches!(
        writer.publish(meta(sequence), &pattern(sequence, 1024)),
        Err(PublishError::Blocked { .. })
    ));
    thread::scope(|scope| {
        scope.spawn(|| publish(&writer, sequence, &pattern(sequence, 1024)));
        other.kill();
    });
    assert_eq!(writer.readers().len(), 1);
    assert_eq!(writer.drop_dead().len(), 1);
    assert!(!writer.has_readers());
    for sequence in 0..1000 {
        writer.try_publish(meta(sequence), &pattern(sequence, 1024)).unwrap();
    }
}

#[test]
fn a_publisher_killed_in_the_middle_of_a_sample_leaves_no_torn_one() {
    let session = session();
    let mut out = Vec::new();
    for round in 0..20 {
        let mut other = Other::start("publish for ever");
        let mut reader = other.wire.join(&session, keep_last(2));
        for _ in 0..10 + round * 3 {
            take(&mut reader, &session, &mut out);
        }
        assert!(!reader.writer_dead());
        other.kill();
        assert!(reader.writer_dead());
        // What it published before stands and is drained.
        while reader.has_data() {
            take(&mut reader, &session, &mut out);
        }
        assert_eq!(reader.take(&mut out), Ok(None));
        assert_eq!(reader.lost(), 0);
    }
}

#[test]
fn no_wake_up_is_lost_between_two_that_sleep() {
    let session = session();
    let writer = large_writer(&session, Qos::keep_all(), 1 << 20);
    let other = Other::start("echo");
    other.wire.serve(&session, &writer, Qos::keep_all());
    let mut echo = other.wire.join(&session, Qos::keep_all());
    let total = 20_000;
    other.wire.send_numbers(&[total]);
    let mut out = Vec::new();
    for sequence in 0..total {
        publish(&writer, sequence, &pattern(sequence, 40));
        assert_eq!(take(&mut echo, &session, &mut out), sequence);
    }
    other.wire.send(b"done", &[]);
    other.succeed();
}

#[test]
fn a_forked_child_is_refused_and_harms_nothing() {
    Other::start("fork").succeed();
}
