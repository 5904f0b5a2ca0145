//! Limits on the resources that one process can take from another.

use super::*;
use crate::{memory::segment::OwnMapping, session::pin_lanes::OF_PROCESS};

/// A segment as a session would announce it, with much address space and almost no memory.
fn sparse(of: &SessionSegment, number: u32, bytes: u64) -> OwnMapping {
    let segment = OwnMapping::create("test", bytes).unwrap();
    layout::write_segment(segment.words(), of.id(), number, SegmentKind::Heap);
    segment
}

#[test]
fn a_session_fills_no_address_space_but_its_share() {
    let a = session();
    let peer = PeerSession::map(a.id(), a.descriptors().unwrap()).unwrap();
    let add = |number| {
        let info = SegmentInfo { number, kind: SegmentKind::Heap };
        peer.add_segment(info, sparse(&a, number, crate::limits::MAX_SEGMENT).fd())
    };
    // They take four tebibytes of address space together, less the first segment.
    (1..64).for_each(|number| add(number).unwrap());
    let error = add(64).expect_err("one too many");
    assert!(matches!(error, ShmError::AddressSpace { .. }), "{error}");
    assert!(!peer.has_segment(64), "it is missing, and not refused");
    // The limit on the number of maps also holds, however small the maps are.
    let many = (65..2000).find(|&number| {
        let info = SegmentInfo { number, kind: SegmentKind::Heap };
        peer.add_segment(info, sparse(&a, number, layout::ALIGN).fd()).is_err()
    });
    assert_eq!(many, Some(64 + 1024 - 63), "with the first");
    // A segment that was removed makes room.
    peer.remove_segment(1);
    add(64).unwrap();
}

#[test]
fn sessions_of_one_process_share_its_address_space() {
    let (a, b) = (session(), session());
    let one = PeerSession::map(a.id(), a.descriptors().unwrap()).unwrap();
    let other = PeerSession::map_among(b.id(), b.descriptors().unwrap(), [&one]).unwrap();
    let add = |to: &PeerSession, of: &SessionSegment, number| {
        let info = SegmentInfo { number, kind: SegmentKind::Heap };
        to.add_segment(info, sparse(of, number, crate::limits::MAX_SEGMENT).fd())
    };
    (1..40).for_each(|number| add(&one, &a, number).unwrap());
    let first = (1..64).find(|&number| add(&other, &b, number).is_err());
    assert_eq!(first, Some(25), "63 are of both");
    drop(one);
    add(&other, &b, 25).unwrap();
}

#[test]
fn a_reader_that_asks_for_all_numbers_is_kept_short() {
    let a = session();
    let peer = PeerSession::map(a.id(), a.descriptors().unwrap()).unwrap();
    (1..100_000).for_each(|number| peer.want(number));
    assert_eq!(peer.take_wanted().len(), 4096);
}

#[test]
fn a_process_gets_no_more_lanes_of_a_ring_than_it_may() {
    let (a, sessions) = (session(), [session(), session()]);
    let writer = writer(&a, keep_last(1), 0);
    let from = sessions.each_ref().map(|session| peer(&a, session));
    // One subscription asks with one lane after another, and opens each.
    let ask = |lane: &Lane, which: usize| {
        writer.attach(ReaderInfo {
            gid: Gid::new(sessions[which].id(), 7),
            lane: lane.location(),
            qos: keep_last(1),
            peer: from[which].clone(),
            stands_for: None,
        })
    };
    let mut lanes = Vec::new();
    let refused = loop {
        let which = lanes.len() % 2;
        let lane = sessions[which].allocate_lane().unwrap();
        match ask(&lane, which) {
            Ok(grant) => lane.open(grant, Gid::new(sessions[which].id(), 7)),
            Err(error) => break error,
        }
        lanes.push(lane);
        assert!(lanes.len() <= OF_PROCESS, "there is an end");
    };
    assert!(refused.to_string().contains("its process has as many readers"), "{refused}");
    assert_eq!((lanes.len(), writer.lock().reader_set.pin_lanes()), (OF_PROCESS, OF_PROCESS));
    let mut gids = writer.readers();
    gids.sort();
    let mut both = sessions.each_ref().map(|session| Gid::new(session.id(), 7));
    both.sort();
    assert_eq!(gids, both, "those that it had it has");
    // Readers in the publisher's own session have no limit.
    let own: Vec<_> = (0..OF_PROCESS + 1).map(|_| attach(&writer, &a, &a, keep_last(1))).collect();
    drop(own);
    // A reader that leaves makes room.
    drop(lanes.pop());
    let lane = sessions[0].allocate_lane().unwrap();
    assert!(ask(&lane, 0).is_ok());
}
