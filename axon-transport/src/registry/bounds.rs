//! Tests the limits on the requests of one session to the daemon, however often the session asks.

use axon_shm::internal::Location;

use super::*;
use crate::{
    graph::EndpointKind,
    qos::Qos,
    wire::session::{
        Announce, Attach, EndpointRole, Gone, Granted, Segment, SegmentName, SegmentOpened,
        SessionMessage, StatusPart, Unmatch, WriterLeaving,
    },
};

type Label = &'static str;

fn id(number: u8) -> SessionId {
    SessionId([number; 16])
}

fn registry(roles: &[SessionRole]) -> Registry<Label> {
    let mut registry = Registry::default();
    for (number, role) in (1..).zip(roles) {
        let handed = (*role != SessionRole::Tool).then_some(["segment", "doorbell", "pidfd"]);
        registry.handle_connect(id(number), *role, String::new(), 1, handed, None).unwrap();
        drain(&mut registry, number);
    }
    registry
}

fn drain(registry: &mut Registry<Label>, number: u8) -> Vec<SessionMessage> {
    std::iter::from_fn(|| registry.poll_output(&id(number)))
        .map(|output| SessionMessage::decode(&output.packet).unwrap())
        .collect()
}

fn announce(registry: &mut Registry<Label>, session: u8, number: u32, kind: EndpointKind) {
    let endpoint = Endpoint::example(Gid::new(id(session), number), kind);
    announce_as(registry, session, endpoint, EndpointRole::Application);
}

fn announce_as(
    registry: &mut Registry<Label>,
    session: u8,
    endpoint: Endpoint,
    role: EndpointRole,
) {
    let place = Location { segment: 0, offset: 4096 };
    let ring = (endpoint.kind == EndpointKind::Publisher).then_some(place);
    let announce = Announce { endpoint, role, stands_for: vec![], ring, only: None };
    let message = SessionMessage::Endpoint(announce);
    registry.handle_message(&id(session), message, vec![]).unwrap();
}

fn graphs(messages: &[SessionMessage]) -> usize {
    messages.iter().filter(|m| matches!(m, SessionMessage::Graph(_))).count()
}

fn whole_graphs(messages: &[SessionMessage]) -> usize {
    messages.iter().filter(|m| matches!(m, SessionMessage::Graph(graph) if graph.whole)).count()
}

#[test]
fn the_pairs_that_a_session_makes_are_bounded_and_others_make_theirs() {
    let mut registry = registry(&[SessionRole::Application; 2]);
    for number in 0..32 {
        announce(&mut registry, 1, number, EndpointKind::Publisher);
    }
    for number in 32..64 {
        announce(&mut registry, 1, number, EndpointKind::Subscription);
    }
    assert_eq!(registry.pairs.len(), MAX_PAIRS);
    drain(&mut registry, 1);
    assert!(registry.take_refused().is_empty());
    for number in 64..66 {
        announce(&mut registry, 1, number, EndpointKind::Subscription);
    }
    assert_eq!(registry.pairs.len(), MAX_PAIRS, "one too many");
    let refused = drain(&mut registry, 1);
    assert!(
        refused.iter().any(|m| matches!(m, SessionMessage::Refused(r) if r.text.contains("pairs")))
    );
    let shown = registry.take_refused();
    assert!(matches!(&shown[..], [(of, why)] if *of == id(1) && why.contains("pairs")), "once");

    // The status shows both where they were announced, until they end or are accepted.
    let refused = |registry: &Registry<Label>| -> Vec<(Gid, String)> {
        let all = registry.session(&id(1)).unwrap().refused_endpoints();
        all.map(|(endpoint, why)| (endpoint.gid, why.to_owned())).collect()
    };
    let [first, second] = [64, 65].map(|number| Gid::new(id(1), number));
    let why = "its session has 1024 pairs of publishers and subscriptions, and would have 32 more: the most are 1024";
    assert_eq!(refused(&registry), [(first, why.to_owned()), (second, why.to_owned())]);
    let gone = |gid| SessionMessage::EndpointGone(Gone { gid });
    registry.handle_message(&id(1), gone(first), vec![]).unwrap();
    assert_eq!(refused(&registry).len(), 1);
    registry.handle_message(&id(1), gone(Gid::new(id(1), 63)), vec![]).unwrap();
    announce(&mut registry, 1, 65, EndpointKind::Subscription);
    assert_eq!((refused(&registry).len(), registry.pairs.len()), (0, MAX_PAIRS));

    announce(&mut registry, 2, 1, EndpointKind::Subscription);
    assert_eq!(registry.pairs.len(), MAX_PAIRS + 32);
    registry.handle_disconnect(&id(1));
    assert!((registry.pairs.len() == 0));
    assert_eq!(registry.pairs.made_by(&id(2)), 0, "what is gone does not count");
}

#[test]
fn the_gateway_brings_the_publishers_of_other_hosts_to_every_reader() {
    let mut registry = registry(&[SessionRole::Gateway, SessionRole::Application]);
    let (readers, remote) = (200, 600);
    for number in 0..readers {
        announce(&mut registry, 2, number, EndpointKind::Subscription);
    }
    let stand_in = |number: u32| {
        let mut gid = [9; 16];
        gid[12..].copy_from_slice(&number.to_be_bytes());
        Gid(gid)
    };
    for number in 0..remote {
        let endpoint = Endpoint::example(stand_in(number), EndpointKind::Publisher);
        announce_as(&mut registry, 1, endpoint, EndpointRole::StandIn);
    }
    assert_eq!(registry.pairs.len(), (readers * remote) as usize);
    assert!(registry.pairs.len() > MAX_PAIRS && registry.take_refused().is_empty());

    // The pairs of all sessions together are bounded. The gateway gets a refusal and stays.
    for number in remote..=u32::try_from(MAX_ALL_PAIRS).unwrap() / readers {
        let endpoint = Endpoint::example(stand_in(number), EndpointKind::Publisher);
        announce_as(&mut registry, 1, endpoint, EndpointRole::StandIn);
    }
    assert!(registry.pairs.len() <= MAX_ALL_PAIRS);
    assert_eq!(registry.take_refused().len(), 1);
    let last = stand_in(u32::try_from(MAX_ALL_PAIRS).unwrap() / readers);
    assert!(registry.endpoints.get(&last).is_none(), "it was refused");
    let gone = |gid| SessionMessage::EndpointGone(Gone { gid });
    assert_eq!(registry.handle_message(&id(1), gone(last), vec![]), Ok(()));
    let other = registry.handle_message(&id(2), gone(last), vec![]);
    assert_eq!(other, Err(Violation::NotItsOwn(last)), "nobody else speaks for other hosts");
}

#[test]
fn the_gateway_is_told_of_this_host_alone() {
    let mut registry = registry(&[SessionRole::Gateway, SessionRole::Application]);
    let elsewhere = Endpoint::example(Gid([9; 16]), EndpointKind::Publisher);
    registry.remote_graph(DaemonId([1; 16]), true, [elsewhere.clone()], vec![]);
    registry.flush();
    assert!(drain(&mut registry, 1).is_empty());
    assert_eq!(graphs(&drain(&mut registry, 2)), 1);
    announce(&mut registry, 2, 1, EndpointKind::Publisher);
    registry.flush();
    assert_eq!(graphs(&drain(&mut registry, 1)), 1);
    registry.handle_message(&id(1), SessionMessage::Resync, vec![]).unwrap();
    let told = drain(&mut registry, 1);
    let items =
        told.iter().filter_map(|m| if let SessionMessage::Graph(g) = m { Some(g) } else { None });
    let gids: Vec<_> = items.flat_map(|g| &g.added).map(|item| item.endpoint.gid).collect();
    assert_eq!(gids, [Gid::new(id(2), 1)]);
    registry.remote_gone(&DaemonId([1; 16]));
    registry.flush();
    assert!(drain(&mut registry, 1).is_empty());
    assert!(graphs(&drain(&mut registry, 2)) > 0);
}

#[test]
fn sessions_that_are_told_everything_share_its_packets() {
    let mut registry = registry(&[SessionRole::Application; 2]);
    let many = (0..100).map(|n| Endpoint::example(Gid::new(id(9), n), EndpointKind::Publisher));
    registry.remote_graph(DaemonId([1; 16]), true, many, vec![]);
    registry.flush();
    let mut first = [1, 2].map(|number| {
        registry.handle_message(&id(number), SessionMessage::Resync, vec![]).unwrap();
        while registry.session(&id(number)).is_some_and(|s| s.queued() > 0) {
            registry.poll_output(&id(number));
        }
        registry.poll_output(&id(number)).unwrap().packet
    });
    assert!(Arc::ptr_eq(&first[0], &first[1]));
    // Packets of another version are not shared.
    announce(&mut registry, 1, 1, EndpointKind::Subscription);
    registry.handle_message(&id(2), SessionMessage::Resync, vec![]).unwrap();
    while registry.session(&id(2)).is_some_and(|s| s.queued() > 0) {
        registry.poll_output(&id(2));
    }
    first[1] = registry.poll_output(&id(2)).unwrap().packet;
    assert!(!Arc::ptr_eq(&first[0], &first[1]));
}

#[test]
fn everything_is_told_anew_once_however_often_it_is_asked_for() {
    let mut registry = registry(&[SessionRole::Application]);
    for _ in 0..100 {
        registry.handle_message(&id(1), SessionMessage::Resync, vec![]).unwrap();
    }
    assert_eq!(whole_graphs(&drain(&mut registry, 1)), 1);
    registry.handle_message(&id(1), SessionMessage::Resync, vec![]).unwrap();
    assert_eq!(whole_graphs(&drain(&mut registry, 1)), 1);
}

#[test]
fn a_sessions_queue_is_bounded_in_bytes() {
    let mut registry = registry(&[SessionRole::Application]);
    let part = SessionMessage::Status(StatusPart { part: 0, parts: 1, text: vec![0; 24 << 10] });
    for _ in 0..1000 {
        registry.push(&id(1), &part, vec![]);
        let entry = registry.session(&id(1)).unwrap();
        assert!(entry.outbox.check() <= MAX_QUEUE_BYTES + (25 << 10));
    }
    assert_eq!(whole_graphs(&drain(&mut registry, 1)), 1, "it is told everything instead");
    assert_eq!(registry.session(&id(1)).unwrap().outbox.check(), 0);
}

/// Joins the parts of a status that a session is sent.
fn put_together(messages: &[SessionMessage]) -> Vec<u8> {
    let mut text = Vec::new();
    for (number, message) in (0..).zip(messages) {
        let SessionMessage::Status(part) = message else { panic!("{message:?}") };
        assert_eq!(part.part, number);
        text.extend_from_slice(&part.text);
        assert_eq!(number + 1 == part.parts, text.len() == 6_000_000, "the last is the last");
    }
    text
}

#[test]
fn a_status_larger_than_the_queue_is_told_whole() {
    for role in [SessionRole::Tool, SessionRole::Application] {
        let mut registry = registry(&[role]);
        // As large as the status of 40,000 pairs.
        let status: Vec<u8> = (0..6_000_000u32).map(|n| (n % 251) as u8).collect();
        assert!(status.len() > MAX_QUEUE_BYTES);
        registry.tell_status(&id(1), status.clone().into());
        assert_eq!(registry.take_ready(), [id(1)].into());
        assert_eq!(registry.session(&id(1)).unwrap().queued(), 0, "it waits in no queue");
        // A socket that has no room for one of the parts, and then for the last.
        let first = registry.poll_output(&id(1)).unwrap();
        registry.return_output(&id(1), first);
        let mut all = Vec::new();
        while let Some(output) = registry.poll_output(&id(1)) {
            registry.return_output(&id(1), output);
            let output = registry.poll_output(&id(1)).unwrap();
            all.push(SessionMessage::decode(&output.packet).unwrap());
        }
        assert!(put_together(&all) == status);
        assert!(!registry.repeat_status(&id(1)), "it has been told");
    }
}

#[test]
fn a_tool_that_asks_again_is_told_the_same_status_from_its_beginning() {
    let mut registry = registry(&[SessionRole::Tool]);
    registry.tell_status(&id(1), vec![7; 6_000_000].into());
    for _ in 0..20 {
        registry.poll_output(&id(1)).unwrap();
    }
    assert!(registry.repeat_status(&id(1)));
    assert_eq!(put_together(&drain(&mut registry, 1)).len(), 6_000_000);
    registry.tell_status(&id(1), Vec::new().into());
    let one = drain(&mut registry, 1);
    assert!(matches!(&one[..], [SessionMessage::Status(part)] if part.parts == 1));
}

#[test]
fn a_pair_that_cannot_share_memory_is_shown_with_the_reason() {
    let mut registry = registry(&[SessionRole::Application; 3]);
    announce(&mut registry, 1, 1, EndpointKind::Publisher);
    announce(&mut registry, 2, 1, EndpointKind::Subscription);
    let (writer, reader) = (Gid::new(id(1), 1), Gid::new(id(2), 1));
    let fail = |registry: &mut Registry<Label>, session| {
        let reason = "not \u{1b}[1mmapped".to_owned() + &"!".repeat(10_000);
        let unmatch = SessionMessage::Unmatch(Unmatch { reader, writer, reason });
        registry.handle_message(&id(session), unmatch, vec![])
    };
    assert_eq!(fail(&mut registry, 3), Err(Violation::NotItsOwn(reader)));
    assert!(registry.take_refused().is_empty());
    // The publisher's side reports the failure. The pair stays, because the reader may ask again.
    fail(&mut registry, 1).unwrap();
    assert_eq!(registry.pairs.len(), 1);
    let shown = registry.take_refused();
    assert_eq!(shown[0].0, id(1));
    let text = &shown[0].1;
    assert!(
        text.contains("\"/t\"") && text.contains("AXON_SHM") && text.contains("not  [1mmapped")
    );
    assert!(text.len() < 600 && !text.contains('\u{1b}'), "{text}");
    // A failure that the reader's side reports ends the pair.
    drain(&mut registry, 1);
    fail(&mut registry, 2).unwrap();
    assert!((registry.pairs.len() == 0));
    assert_eq!(registry.take_refused()[0].0, id(2));
    let over = drain(&mut registry, 1);
    assert!(
        over.iter().any(|m| matches!(m, SessionMessage::Detach(pair) if pair.reader == reader))
    );
    // A failure of a pair that no longer exists is not reported.
    fail(&mut registry, 2).unwrap();
    assert!(registry.take_refused().is_empty());
}

/// Attaches a reader of session 2 to a publisher of session 1, and returns the publisher.
fn attached(registry: &mut Registry<Label>) -> Gid {
    announce(registry, 1, 1, EndpointKind::Publisher);
    announce(registry, 2, 1, EndpointKind::Subscription);
    let (writer, reader) = (Gid::new(id(1), 1), Gid::new(id(2), 1));
    let (lane, qos) = (Location { segment: 0, offset: 4096 }, Qos::default());
    let (session, stands_for, segments) = (id(2), None, vec![]);
    let (after, carries) = (None, None);
    let attach =
        Attach { reader, writer, lane, qos, session, stands_for, segments, after, carries };
    registry.handle_message(&id(2), SessionMessage::Attach(attach), vec![]).unwrap();
    let relayed = None;
    let (generation, first, segments, session) = (1, 0, vec![], id(1));
    let granted = Granted {
        reader,
        writer,
        generation,
        first,
        session,
        ring: lane,
        segments,
        after,
        relayed,
    };
    registry.handle_message(&id(1), SessionMessage::Grant(granted), vec![]).unwrap();
    drain(registry, 2);
    writer
}

#[test]
fn segments_given_up_are_not_queued_for_a_stopped_session() {
    let mut registry = registry(&[SessionRole::Application; 2]);
    let writer = attached(&mut registry);
    let mut turn = |number| {
        let (session, publisher) = (id(1), Some(writer));
        let segment = Segment { number, publisher };
        let opened = SessionMessage::Segment(SegmentOpened { session, segment });
        registry.handle_message(&session, opened, vec!["map"]).unwrap();
        // The first segment is taken before it is given up.
        let taken = (number == 1).then(|| drain(&mut registry, 2).len());
        let gone = SessionMessage::SegmentGone(SegmentName { session, number });
        registry.handle_message(&session, gone, vec![]).unwrap();
        taken
    };
    assert_eq!(turn(1), Some(1));
    (2..1000).for_each(|number| assert_eq!(turn(number), None));
    let waiting = drain(&mut registry, 2);
    assert!(
        matches!(&waiting[..], [SessionMessage::SegmentGone(gone)] if gone.number == 1),
        "{} packets wait",
        waiting.len()
    );
}

#[test]
fn a_session_that_asked_again_for_memory_hears_that_it_is_given_up() {
    let mut registry = registry(&[SessionRole::Application; 2]);
    let publisher = Some(attached(&mut registry));
    let (session, number) = (id(1), 1);
    let segment = Segment { number, publisher };
    let opened = SessionMessage::Segment(SegmentOpened { session, segment });
    registry.handle_message(&session, opened, vec!["map"]).unwrap();
    assert_eq!(drain(&mut registry, 2).len(), 1);
    // The session asks for it although it has it, and the segment is in flight once more.
    let name = SegmentName { session, number };
    registry.handle_message(&id(2), SessionMessage::Need(name), vec![]).unwrap();
    registry.handle_message(&session, SessionMessage::SegmentGone(name), vec![]).unwrap();
    let waiting = drain(&mut registry, 2);
    assert!(
        matches!(&waiting[..], [SessionMessage::SegmentGone(gone)] if *gone == name),
        "{waiting:?}"
    );
}

#[test]
fn the_segments_of_a_session_are_bounded_and_it_is_told() {
    let mut registry = registry(&[SessionRole::Application]);
    let session = id(1);
    for number in 1..=MAX_SEGMENTS as u32 + 1 {
        let segment = Segment { number, publisher: None };
        let opened = SessionMessage::Segment(SegmentOpened { session, segment });
        registry.handle_message(&session, opened, vec!["map"]).unwrap();
    }
    assert_eq!(registry.session(&session).unwrap().segments.len(), MAX_SEGMENTS);
    let refused = drain(&mut registry, 1);
    assert!(
        refused
            .iter()
            .any(|m| matches!(m, SessionMessage::Refused(r) if r.text.contains("memory")))
    );
    let gone = SessionMessage::SegmentGone(SegmentName { session, number: 1 });
    registry.handle_message(&session, gone, vec![]).unwrap();
    assert_eq!(registry.session(&session).unwrap().segments.len(), MAX_SEGMENTS - 1);
}

#[test]
fn a_leaving_writer_is_hidden_and_read_to_its_end() {
    let mut registry = registry(&[SessionRole::Application; 3]);
    announce(&mut registry, 1, 1, EndpointKind::Publisher);
    announce(&mut registry, 2, 1, EndpointKind::Subscription);
    let [writer, reader] = [1, 2].map(|session| Gid::new(id(session), 1));
    let place = Location { segment: 0, offset: 4096 };
    let attach = Attach {
        reader,
        writer,
        lane: place,
        qos: Qos::default(),
        session: id(2),
        stands_for: None,
        segments: Vec::new(),
        after: None,
        carries: None,
    };
    registry.handle_message(&id(2), SessionMessage::Attach(attach), vec![]).unwrap();
    let grant = Granted {
        reader,
        writer,
        generation: 1,
        first: 0,
        session: id(1),
        ring: place,
        segments: Vec::new(),
        after: None,
        relayed: None,
    };
    registry.handle_message(&id(1), SessionMessage::Grant(grant), vec![]).unwrap();
    registry.flush();
    (1..=3).for_each(|session| drop(drain(&mut registry, session)));
    let before = registry.digest();

    let leave = |registry: &mut Registry<Label>, session, leaving| {
        let leaving = SessionMessage::Leaving(WriterLeaving { gid: writer, leaving });
        registry.handle_message(&id(session), leaving, vec![])
    };
    assert_eq!(leave(&mut registry, 2, true), Err(Violation::NotItsOwn(writer)));
    for _ in 0..2 {
        leave(&mut registry, 1, true).unwrap();
    }
    registry.flush();
    let is_leaving = |m: &&SessionMessage| matches!(m, SessionMessage::Leaving(l) if l.gid == writer && l.leaving);
    let removed =
        |m: &SessionMessage| matches!(m, SessionMessage::Graph(graph) if graph.removed == [writer]);
    let told = drain(&mut registry, 2);
    assert_eq!(told.iter().filter(is_leaving).count(), 1);
    assert!(!told.iter().any(|m| matches!(m, SessionMessage::Unmatch(_))));
    assert!(told.iter().any(removed) && drain(&mut registry, 3).iter().any(removed));
    assert_ne!(registry.digest(), before);

    // No new reader gets it. A session that is sent the complete state is told again that the
    // endpoint leaves, after the grant.
    announce(&mut registry, 3, 1, EndpointKind::Subscription);
    assert!(!drain(&mut registry, 3).iter().any(|m| matches!(m, SessionMessage::Match(_))));
    drain(&mut registry, 2);
    registry.handle_message(&id(2), SessionMessage::Resync, vec![]).unwrap();
    let told = drain(&mut registry, 2);
    let granted = told.iter().position(|m| matches!(m, SessionMessage::Grant(_))).unwrap();
    assert!(told[granted..].iter().any(|m| is_leaving(&m)));
    let shows = |m: &SessionMessage| matches!(m, SessionMessage::Graph(graph) if graph.added.iter().any(|i| i.endpoint.gid == writer));
    assert!(!told.iter().any(shows));

    // The session has come back.
    leave(&mut registry, 1, false).unwrap();
    registry.flush();
    let told = drain(&mut registry, 3);
    assert!(told.iter().any(shows) && told.iter().any(|m| matches!(m, SessionMessage::Match(_))));
    assert_eq!(registry.pairs.len(), 2);
    leave(&mut registry, 1, true).unwrap();
    registry
        .handle_message(&id(1), SessionMessage::EndpointGone(Gone { gid: writer }), vec![])
        .unwrap();
    assert!((registry.pairs.len() == 0));
    assert_eq!(registry.pairs.made_by(&id(1)), 0);
}
