//! Tests the announcement of a publisher's memory to subscribers without a daemon.

#![allow(unsafe_code)]

use std::{
    collections::BTreeSet,
    os::fd::{AsFd, OwnedFd},
    process::Command,
    sync::atomic::AtomicBool,
    thread,
};

use rustix::process::{Pid, PidfdFlags, pidfd_open};

use super::*;
use crate::{
    alloc::heap::Need,
    direct::connect::{AttachRequest, ConnectChannel, PublisherAnswer, SegmentUpdate},
    os::descriptors::PassedFd,
    tests::api::{SOON, pair, publisher, together},
};

fn contexts() -> (Context, Context) {
    (Context::new().unwrap(), Context::new().unwrap())
}

fn at_once(socket: &impl AsFd) -> ConnectChannel<'_> {
    ConnectChannel::new(socket.as_fd(), Some(Duration::ZERO))
}

/// Creates a subscriber whose publisher announces nothing, and the line over which the test may.
fn untold(
    (session, writer): (&Arc<SessionSegment>, &Writer),
    context: &Context,
    process: Option<OwnedFd>,
) -> (PassedFd, Subscriber) {
    let (ours, theirs) = pair();
    let options = SubscriberOptions::new(keep_last(5));
    thread::scope(|scope| {
        let subscriber = scope.spawn(|| Subscriber::connect(context, theirs, options, SOON));
        let channel = ConnectChannel::new(ours.as_fd(), SOON);
        let (asked, descriptors, line) = channel.await_asked().unwrap();
        let AttachRequest { session: id, reader, lane, qos } = asked;
        let peer = RingPeer::Remote(PeerSession::map(id, descriptors).unwrap());
        let info = ReaderInfo { gid: reader, lane, qos, peer, stands_for: None };
        let Grant { generation, first } = writer.attach(info).unwrap();
        let (session_id, ring) = (session.id(), writer.location());
        let writer = writer.gid();
        let granted =
            PublisherAnswer { reader, session: session_id, writer, generation, first, ring };
        let mut own = session.descriptors().unwrap();
        if let Some(process) = process {
            own.pidfd = process.into();
        }
        channel.grant(&granted, &own).unwrap();
        (line, subscriber.join().unwrap().unwrap())
    })
}

#[test]
fn a_full_first_segment_does_not_prevent_connections() {
    let (here, there) = contexts();
    let publisher = publisher(&here, keep_last(1));
    let full = |context: &Context| {
        let block = context.session().allocate(1, Need::Now, |_| true).unwrap().unwrap().block;
        block.at.segment != 0
    };
    for context in [&here, &there] {
        while !full(context) {}
    }
    let mut subscriber = together(&publisher, &there, keep_last(1)).1.unwrap();
    publisher.publish(&pattern(1, 1000)).unwrap();
    assert_eq!(subscriber.recv(SOON).unwrap().unwrap().len(), 1000);
}

#[test]
fn a_subscriber_whose_segment_channel_was_full_is_told_later() {
    let (here, there) = contexts();
    let publisher = publisher(&here, keep_last(1));
    let mut subscriber = together(&publisher, &there, keep_last(1)).1.unwrap();
    let open = || here.session().open_samples(publisher.gid(), 2 * layout::ALIGN).unwrap();
    let _many: Vec<_> = (0..100).map(|_| open()).collect();
    publisher.publish(&pattern(1, 5000)).unwrap();
    assert!(subscriber.take().unwrap().is_none());
    let over = AtomicBool::new(false);
    thread::scope(|scope| {
        scope.spawn(|| {
            while !over.load(Relaxed) {
                publisher.reclaim_idle();
                thread::yield_now();
            }
        });
        let taken = subscriber.recv(SOON);
        over.store(true, Relaxed);
        assert_eq!(taken.unwrap().expect("it was told").len(), 5000);
    });
    assert_eq!(subscriber.lost(), 0);
}

#[test]
fn withdrawn_segments_do_not_fill_an_unread_channel() {
    let (here, there) = contexts();
    let publisher = publisher(&here, keep_last(1));
    let lane = there.session().allocate_lane().unwrap();
    let (ours, theirs) = pair();
    let (line, far) = connect::line().unwrap();
    let reader = Gid::new(there.id(), 1);
    let asked =
        AttachRequest { session: there.id(), reader, lane: lane.location(), qos: keep_last(1) };
    let descriptors = there.session().descriptors().unwrap();
    ConnectChannel::new(theirs.as_fd(), SOON).ask(&asked, &descriptors, far).unwrap();
    publisher.serve(ours, SOON).unwrap();
    for _ in 0..500 {
        let segment = here.session().open_samples(publisher.gid(), 2 * layout::ALIGN).unwrap();
        here.session().close_samples(segment.number());
    }
    let mut kept = BTreeSet::new();
    let mut drain = || {
        let mut packets = 0;
        while let Ok(news) = at_once(&line).take_update() {
            packets += 1;
            match news {
                SegmentUpdate::Opened(opened, _) => assert!(kept.insert(opened.segment.number)),
                SegmentUpdate::Gone(gone) => assert!(kept.remove(&gone.number)),
            }
        }
        (packets, kept.len())
    };
    let (packets, _) = drain();
    assert!((1..50).contains(&packets), "{packets} packets stood in the line");
    // Finally the subscriber learns that all segments are gone.
    let start = Instant::now();
    while drain().1 > 0 {
        assert!(start.elapsed() < EVER);
        publisher.reclaim_idle();
    }
}

#[test]
fn memory_of_a_publisher_that_is_gone_is_let_go_of() {
    let (here, there) = contexts();
    let [first, second] = [(); 2].map(|()| publisher(&here, keep_last(1)));
    let mut readers = [&first, &second].map(|publisher| {
        let subscriber = together(publisher, &there, keep_last(1)).1.unwrap();
        publisher.publish(&pattern(1, 5000)).unwrap();
        subscriber
    });
    for subscriber in &mut readers {
        assert_eq!(subscriber.recv(SOON).unwrap().unwrap().len(), 5000);
    }
    let number = |publisher: &Publisher| {
        let of = |info: &SegmentInfo| info.kind == SegmentKind::Samples(publisher.gid());
        here.session().segments().into_iter().find(of).unwrap().number
    };
    let (gone, stays) = (number(&first), number(&second));
    let seen = there.peer(here.id(), here.session().descriptors().unwrap()).unwrap();
    let seen = Arc::clone(seen.remote().unwrap());
    drop(first);
    let [left, right] = readers;
    assert!(seen.has_segment(gone), "it may be read still");
    drop(left);
    let start = Instant::now();
    while seen.has_segment(gone) {
        assert!(start.elapsed() < EVER);
        second.reclaim_idle();
        right.reclaim_idle();
    }
    assert!(seen.has_segment(stays));
}

#[test]
fn memory_of_an_unread_publisher_is_unmapped_while_own_samples_are_read() {
    let (here, there) = contexts();
    let (ours, theirs) = (publisher(&here, keep_last(1)), publisher(&there, keep_last(1)));
    // A connection in the other direction.
    let _back = together(&theirs, &here, keep_last(1)).1.unwrap();
    let mut readers = [(); 2].map(|()| together(&ours, &there, keep_last(1)).1.unwrap());
    let mut take = |reader: &mut Subscriber| {
        ours.publish(&pattern(1, 5000)).unwrap();
        reader.recv(SOON).unwrap().expect("a sample")
    };
    let kept = readers.each_mut().map(&mut take);
    let seen = there.peer(here.id(), here.session().descriptors().unwrap()).unwrap();
    let seen = Arc::clone(seen.remote().unwrap());
    let of = |info: &SegmentInfo| info.kind == SegmentKind::Samples(ours.gid());
    let number = here.session().segments().into_iter().find(of).unwrap().number;
    let [first, second] = readers;
    drop(first);
    assert!(seen.has_segment(number), "one still reads it");
    drop(second);
    assert!(!seen.has_segment(number));
    let mut out = Vec::new();
    for sample in &kept {
        sample.copy_to(&mut out).unwrap();
        assert!(out == pattern(1, 5000), "what is in use stays");
    }
    // It is mapped again with the next subscriber.
    let mut late = together(&ours, &there, keep_last(1)).1.unwrap();
    take(&mut late);
}

#[test]
fn memory_that_could_not_be_mapped_is_mapped_when_there_is_room() {
    let (here, there) = contexts();
    let publisher = publisher(&here, keep_last(1));
    let mut subscriber = together(&publisher, &there, keep_last(1)).1.unwrap();
    // Takes all the address space that one context may take from another, except for a mebibyte.
    let open = |bytes| here.session().open_samples(publisher.gid(), bytes).unwrap().number();
    let mut numbers: Vec<_> = (0..63).map(|_| open(crate::limits::MAX_SEGMENT)).collect();
    numbers.push(open(crate::limits::MAX_SEGMENT - layout::SESSION_BYTES - (1 << 20)));
    let seen = there.peer(here.id(), here.session().descriptors().unwrap()).unwrap();
    let seen = seen.remote().unwrap();
    let start = Instant::now();
    while !numbers.iter().all(|number| seen.has_segment(*number)) {
        assert!(start.elapsed() < EVER);
        subscriber.reclaim_idle();
        publisher.reap();
    }
    publisher.publish(&pattern(1, 5000)).unwrap();
    assert!(subscriber.take().unwrap().is_none() && subscriber.take().unwrap().is_none());
    here.session().close_samples(numbers[0]);
    let sample = subscriber.take().unwrap().expect("there is room for it now");
    assert_eq!(sample.len(), 5000);
}

#[test]
fn samples_whose_memory_never_came_are_lost_with_their_publishers_process() {
    let (session, there) = (silent_session(), Context::new().unwrap());
    let writer = writer(&session, keep_last(5), 1 << 20);
    let mut process = Command::new("sleep").arg("600").spawn().unwrap();
    let pidfd = pidfd_open(Pid::from_child(&process), PidfdFlags::empty()).unwrap();
    let (_line, mut subscriber) = untold((&session, &writer), &there, Some(pidfd));
    for sequence in 1..=3 {
        writer.publish(meta(sequence), &pattern(sequence, 5000)).unwrap();
    }
    assert!(subscriber.take().unwrap().is_none());
    process.kill().unwrap();
    process.wait().unwrap();
    assert!(subscriber.recv(SOON).unwrap().is_none());
    assert_eq!((subscriber.received(), subscriber.lost()), (0, 3));
}

/// Sends packets that the receiver ignores until the socket is full. Returns their number.
fn fill(socket: &impl AsFd) -> u32 {
    let mut sent = 0;
    while at_once(socket).withdraw(SessionId([7; 16]), 9).is_ok() {
        sent += 1;
    }
    sent
}

#[test]
fn a_peer_that_floods_packets_does_not_block_waits_or_takes() {
    // A call whose deadline has passed takes one packet, however many there are.
    let (ours, theirs) = pair();
    let sent = fill(&ours);
    let answer = at_once(&theirs).await_granted(Gid([1; 16]));
    assert!(matches!(answer, Err(ConnectError::Timeout)), "{answer:?}");
    assert!((1..sent).contains(&fill(&ours)));
    // A take does not read all packets either.
    let (session, there) = (silent_session(), Context::new().unwrap());
    let writer = writer(&session, keep_last(5), 1 << 20);
    let (line, mut subscriber) = untold((&session, &writer), &there, None);
    writer.publish(meta(1), &pattern(1, 5000)).unwrap();
    let sent = fill(&line);
    assert!(subscriber.take().unwrap().is_none());
    assert!((1..sent).contains(&fill(&line)));
}

#[test]
fn a_forged_session_id_does_not_replace_its_owner() {
    let (here, there) = contexts();
    let hostile = SessionSegment::create(there.id()).unwrap();
    let first = here.peer(there.id(), hostile.descriptors().unwrap()).unwrap();
    let publisher = publisher(&here, keep_last(1));
    let (served, connected) = together(&publisher, &there, keep_last(1));
    assert!(matches!(served, Err(ConnectError::Memory(ShmError::Refused { .. }))), "{served:?}");
    assert!(matches!(connected, Err(ConnectError::Refused(_))), "{connected:?}");
    drop(first);
    assert!(together(&publisher, &there, keep_last(1)).1.is_ok());
}

#[test]
fn an_answer_in_our_name_needs_our_own_grant() {
    let (here, _) = contexts();
    let ring = writer(here.session(), keep_last(5), MAX);
    let (ours, theirs) = pair();
    let options = SubscriberOptions::new(keep_last(5));
    let refused = thread::scope(|scope| {
        let subscriber = scope.spawn(|| Subscriber::connect(&here, theirs, options, SOON));
        let channel = ConnectChannel::new(ours.as_fd(), SOON);
        let (asked, descriptors, _line) = channel.await_asked().unwrap();
        let (reader, session) = (asked.reader, here.id());
        let (generation, first) = (1, 0);
        let (writer, ring) = (ring.gid(), ring.location());
        let granted = PublisherAnswer { reader, session, writer, generation, first, ring };
        channel.grant(&granted, &descriptors).unwrap();
        subscriber.join().unwrap().map(drop)
    });
    assert!(matches!(refused, Err(ConnectError::Memory(ShmError::Refused { .. }))), "{refused:?}");
}

#[test]
fn a_reader_with_our_session_id_is_served_only_if_we_ask() {
    let (here, _) = contexts();
    let publisher = publisher(&here, keep_last(1));
    let lane = here.session().allocate_lane().unwrap();
    let (ours, theirs) = pair();
    let (_line, far) = connect::line().unwrap();
    let (session, reader) = (here.id(), Gid::new(here.id(), 77));
    let asked = AttachRequest { session, reader, lane: lane.location(), qos: keep_last(1) };
    let descriptors = here.session().descriptors().unwrap();
    ConnectChannel::new(theirs.as_fd(), SOON).ask(&asked, &descriptors, far).unwrap();
    let served = publisher.serve(ours, SOON);
    assert!(matches!(served, Err(ConnectError::Memory(ShmError::Refused { .. }))), "{served:?}");
    assert!(publisher.subscribers().is_empty());
    // Subscribers of this context that really ask are served, and the failed ones left nothing
    // behind.
    let mut subscriber = together(&publisher, &here, keep_last(1)).1.unwrap();
    publisher.publish(b"own").unwrap();
    assert_eq!(subscriber.recv(SOON).unwrap().unwrap().len(), 3);
}

#[test]
fn a_publisher_cannot_withdraw_anothers_segments() {
    let (here, there) = contexts();
    let publisher = publisher(&here, keep_last(1));
    let mut subscriber = together(&publisher, &there, keep_last(1)).1.unwrap();
    publisher.publish(&pattern(1, 5000)).unwrap();
    assert_eq!(subscriber.recv(SOON).unwrap().unwrap().len(), 5000);

    let hostile = session();
    let ring = writer(&hostile, keep_last(1), MAX);
    let (line, mut other) = untold((&hostile, &ring), &there, None);
    for number in 1..8 {
        at_once(&line).withdraw(here.id(), number).unwrap();
    }
    // A publisher announces its own memory as a segment of another context.
    let forged = SessionSegment::create(here.id()).unwrap();
    let segment = forged.open_samples(publisher.gid(), 2 * layout::ALIGN).unwrap();
    let (info, fd) = forged.segment(segment.number()).unwrap().unwrap();
    at_once(&line).hand(here.id(), info, fd.as_fd()).unwrap();
    ring.publish(meta(1), &pattern(1, 5000)).unwrap();
    assert!(other.take().unwrap().is_none(), "it is told nothing of its publisher's memory");

    publisher.publish(&pattern(2, 5000)).unwrap();
    let sample = subscriber.take().unwrap().expect("its memory is where it was");
    let mut bytes = Vec::new();
    sample.copy_to(&mut bytes).unwrap();
    assert_eq!(bytes, pattern(2, 5000));
}

#[test]
fn a_forked_child_cuts_no_line_of_its_parents_and_takes_nothing_from_it() {
    let (here, there) = contexts();
    let publisher = publisher(&here, keep_last(1));
    let mut subscriber = together(&publisher, &there, keep_last(1)).1.unwrap();
    // An announcement is in the line when the process forks.
    publisher.publish(&pattern(1, 5000)).unwrap();
    // SAFETY: the child only makes the following calls, which take no lock that another thread may
    // have held, and leaves by _exit.
    let child = unsafe { libc::fork() };
    if child == 0 {
        subscriber.reclaim_idle();
        let idle = !subscriber.has_data();
        drop(subscriber);
        // SAFETY: ends the process without running anything else.
        unsafe { libc::_exit(i32::from(!idle)) };
    }
    let mut status = -1;
    // SAFETY: waits for the child just made; `status` outlives the call.
    assert_eq!(unsafe { libc::waitpid(child, &mut status, 0) }, child);
    assert_eq!(status, 0);
    assert_eq!(subscriber.recv(SOON).unwrap().expect("the news are there").len(), 5000);
    // The line still works: it announces more memory.
    let _more = here.session().open_samples(publisher.gid(), 2 * layout::ALIGN).unwrap();
    publisher.reclaim_idle();
    subscriber.reclaim_idle();
    let peer = there.peer(here.id(), here.session().descriptors().unwrap()).unwrap();
    let numbers: Vec<u32> = here.session().segments().iter().map(|info| info.number).collect();
    assert!(peer.remote().is_some_and(|peer| numbers.iter().all(|n| peer.has_segment(*n))));
}
