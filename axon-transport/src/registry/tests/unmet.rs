//! Readers that never learned of the grant of a publisher that ended.

use axon_shm::internal::Location;

use crate::{
    graph::{Endpoint, EndpointKind},
    ids::{Gid, SessionId},
    qos::Qos,
    registry::{
        MAX_QUEUE, Registry, Violation,
        limits::{MAX_EARLIER_GRANTS, MAX_LEFT, MAX_UNMET},
    },
    wire::session::{
        Announce, Attach, EndpointRole, Gone, Granted, Segment, SegmentOpened, SessionMessage,
        SessionRole, Unmet,
    },
};

const WRITER: u8 = 1;
const READER: u8 = 2;

fn id(number: u8) -> SessionId {
    SessionId([number; 16])
}

fn unmet(samples: u64) -> Unmet {
    Unmet { reader: Gid::new(id(READER), 1), writer: Gid::new(id(WRITER), 1), samples }
}

fn connect(registry: &mut Registry<&'static str>, session: u8) {
    let handed = Some(["segment", "doorbell", "pidfd"]);
    let (role, name) = (SessionRole::Application, String::new());
    // Each session has its own process.
    registry.handle_connect(id(session), role, name, session.into(), handed, None).unwrap();
}

fn registry(sessions: &[u8]) -> Registry<&'static str> {
    let mut registry = Registry::default();
    sessions.iter().for_each(|session| connect(&mut registry, *session));
    sessions.iter().for_each(|session| drop(taken(&mut registry, *session)));
    registry
}

fn say(registry: &mut Registry<&'static str>, message: SessionMessage) {
    registry.handle_message(&id(WRITER), message, vec![]).unwrap();
}

/// Announces the publisher.
fn announce(registry: &mut Registry<&'static str>) {
    let endpoint = Endpoint::example(unmet(0).writer, EndpointKind::Publisher);
    let (role, stands_for) = (EndpointRole::Application, Vec::new());
    let ring = Some(Location { segment: 0, offset: 4096 });
    let announce = Announce { endpoint, role, stands_for, ring, only: None };
    say(registry, SessionMessage::Endpoint(announce));
}

fn taken(registry: &mut Registry<&'static str>, session: u8) -> Vec<SessionMessage> {
    let taken = std::iter::from_fn(|| registry.poll_output(&id(session)));
    taken.map(|output| SessionMessage::decode(&output.packet).unwrap()).collect()
}

/// Returns the sample counts of the unmet pairs that the reader's session is told.
fn told(registry: &mut Registry<&'static str>) -> Vec<u64> {
    let samples = taken(registry, READER).into_iter().filter_map(|message| match message {
        SessionMessage::Unmet(unmet) => Some(unmet.samples),
        _ => None,
    });
    samples.collect()
}

#[test]
fn a_reader_hears_of_it_once_whether_its_session_is_here_or_comes_later() {
    let mut registry = registry(&[WRITER, READER]);
    say(&mut registry, SessionMessage::Unmet(unmet(3)));
    assert_eq!(told(&mut registry), [3]);

    registry.handle_disconnect(&id(READER));
    say(&mut registry, SessionMessage::Unmet(unmet(5)));
    say(&mut registry, SessionMessage::Unmet(unmet(5)));
    registry.handle_disconnect(&id(WRITER));
    connect(&mut registry, READER);
    assert_eq!(told(&mut registry), [5], "its session has ended");
    assert_eq!(told(&mut registry), [0; 0]);
}

#[test]
fn a_reader_hears_of_it_before_it_hears_that_the_publisher_ended() {
    let mut registry = registry(&[WRITER]);
    let writer = unmet(3).writer;
    registry.keep_left_memory(1);
    announce(&mut registry);
    say(&mut registry, SessionMessage::Unmet(unmet(3)));
    say(&mut registry, SessionMessage::EndpointGone(Gone { gid: writer }));
    registry.flush();
    connect(&mut registry, READER);
    let told = taken(&mut registry, READER);
    let ends = |m: &SessionMessage| matches!(m, SessionMessage::Graph(g) if g.ended.as_ref().is_some_and(|e| e.contains(&writer)));
    let at = |is: &dyn Fn(&SessionMessage) -> bool| told.iter().position(is).expect("it was told");
    assert!(at(&|m| *m == SessionMessage::Unmet(unmet(3))) < at(&ends));
}

#[test]
fn a_session_that_is_told_everything_anew_hears_of_it_all_the_same() {
    let mut registry = registry(&[WRITER, READER]);
    say(&mut registry, SessionMessage::Unmet(unmet(3)));
    for _ in 0..=MAX_QUEUE {
        registry.push(&id(READER), &SessionMessage::Resync, Vec::new());
    }
    // Its queue was dropped.
    let other = Gid::new(id(WRITER), 2);
    say(&mut registry, SessionMessage::Unmet(Unmet { writer: other, ..unmet(4) }));
    assert_eq!(told(&mut registry), [3, 4]);

    say(&mut registry, SessionMessage::Unmet(unmet(5)));
    registry.handle_disconnect(&id(READER));
    connect(&mut registry, READER);
    assert_eq!(told(&mut registry), [5], "its connection broke");
}

#[test]
fn the_oldest_pair_is_forgotten_beyond_the_bound() {
    let mut registry = registry(&[WRITER]);
    for number in 0..=MAX_UNMET as u32 {
        let writer = Gid::new(id(WRITER), 1 + number);
        say(&mut registry, SessionMessage::Unmet(Unmet { writer, ..unmet(number.into()) }));
    }
    connect(&mut registry, READER);
    assert_eq!(told(&mut registry), [1, 2, 3, 4]);
}

#[test]
fn a_loss_report_for_the_publisher_of_another_session_is_refused() {
    let mut registry = registry(&[WRITER, READER]);
    let refused = registry.handle_message(&id(READER), SessionMessage::Unmet(unmet(3)), vec![]);
    assert_eq!(refused, Err(Violation::NotItsOwn(unmet(3).writer)));
}

fn grant(reader: Gid, writer: Gid) -> Granted {
    let (session, ring) = (id(WRITER), Location { segment: 1, offset: 4096 });
    let (segments, after, relayed) = (Vec::new(), Some(3), None);
    Granted { reader, writer, generation: 7, first: 3, session, ring, segments, after, relayed }
}

/// Returns the grants that the reader's session is sent, with their descriptors. Checks that no pair ends before its
/// grant.
fn handed(registry: &mut Registry<&'static str>) -> Vec<(Granted, Vec<&'static str>)> {
    let packets: Vec<_> = std::iter::from_fn(|| registry.poll_output(&id(READER))).collect();
    let mut handed = Vec::new();
    for output in packets {
        match SessionMessage::decode(&output.packet).unwrap() {
            SessionMessage::Grant(granted) => handed.push((granted, output.descriptors)),
            SessionMessage::Unmatch(end) => {
                let over =
                    |(of, _): &(Granted, _)| (of.reader, of.writer) == (end.reader, end.writer);
                assert!(handed.iter().any(over), "it is over before it was granted");
            }
            _ => {}
        }
    }
    handed
}

/// Returns a registry whose publisher has come from an earlier daemon, which did not pass its grant on.
fn with_earlier_grants(sessions: &[u8]) -> Registry<&'static str> {
    let mut registry = registry(sessions);
    let segment = Segment { number: 1, publisher: None };
    let opened = SessionMessage::Segment(SegmentOpened { session: id(WRITER), segment });
    registry.handle_message(&id(WRITER), opened, vec!["heap"]).unwrap();
    announce(&mut registry);
    say(&mut registry, SessionMessage::Grant(grant(unmet(0).reader, unmet(0).writer)));
    registry
}

#[test]
fn reader_receives_the_ring_of_a_publisher_that_was_killed_before() {
    let segments = vec![Segment { number: 1, publisher: None }];
    let expected = Granted { segments, ..grant(unmet(0).reader, unmet(0).writer) };
    let descriptors = vec!["segment", "doorbell", "pidfd", "heap"];
    for comes_before in [false, true] {
        let mut registry = with_earlier_grants(&[WRITER]);
        if comes_before {
            connect(&mut registry, READER);
            assert_eq!(handed(&mut registry), []);
        }
        registry.handle_disconnect(&id(WRITER));
        if !comes_before {
            connect(&mut registry, READER);
        }
        assert_eq!(handed(&mut registry), [(expected.clone(), descriptors.clone())]);
        assert_eq!(handed(&mut registry), []);
    }
}

#[test]
fn a_publisher_that_ended_itself_has_reported_its_readers_losses() {
    let mut registry = with_earlier_grants(&[WRITER]);
    say(&mut registry, SessionMessage::Unmet(unmet(3)));
    registry.handle_disconnect(&id(WRITER));
    connect(&mut registry, READER);
    assert_eq!(told(&mut registry), [3]);

    let mut registry = with_earlier_grants(&[WRITER]);
    // Its reader has taken up the grant meanwhile.
    say(&mut registry, SessionMessage::EndpointGone(Gone { gid: unmet(0).writer }));
    registry.handle_disconnect(&id(WRITER));
    connect(&mut registry, READER);
    assert_eq!(handed(&mut registry), []);
}

#[test]
fn late_grant_arrives_although_the_publisher_was_killed() {
    let mut registry = registry(&[WRITER, READER]);
    announce(&mut registry);
    let Unmet { reader, writer, .. } = unmet(0);
    let endpoint = Endpoint::example(reader, EndpointKind::Subscription);
    let (role, stands_for) = (EndpointRole::Application, Vec::new());
    let announce = Announce { endpoint, role, stands_for, ring: None, only: None };
    registry.handle_message(&id(READER), SessionMessage::Endpoint(announce), vec![]).unwrap();
    let (lane, session) = (Location { segment: 0, offset: 64 }, id(READER));
    let (stands_for, segments, after, carries) = (None, Vec::new(), None, None);
    let qos = Qos::default();
    let attach =
        Attach { reader, writer, lane, qos, session, stands_for, segments, after, carries };
    registry.handle_message(&id(READER), SessionMessage::Attach(attach), vec![]).unwrap();
    say(&mut registry, SessionMessage::Grant(grant(reader, writer)));
    for _ in 0..=MAX_QUEUE {
        registry.push(&id(READER), &SessionMessage::Resync, Vec::new());
    }
    registry.handle_disconnect(&id(WRITER));
    assert_eq!(handed(&mut registry).len(), 1);
}

#[test]
fn oldest_waiting_ring_is_given_up_beyond_the_bound() {
    let mut registry = registry(&[WRITER]);
    let reader = unmet(0).reader;
    let writers: Vec<Gid> = (0..=MAX_LEFT as u32).map(|n| Gid::new(id(WRITER), 1 + n)).collect();
    writers
        .iter()
        .for_each(|writer| say(&mut registry, SessionMessage::Grant(grant(reader, *writer))));
    registry.handle_disconnect(&id(WRITER));
    connect(&mut registry, READER);
    let packets: Vec<_> = std::iter::from_fn(|| registry.poll_output(&id(READER))).collect();
    let packets = packets.iter().map(|output| SessionMessage::decode(&output.packet).unwrap());
    let granted = packets.filter_map(|message| match message {
        SessionMessage::Grant(granted) => Some(granted.writer),
        _ => None,
    });
    assert_eq!(granted.collect::<Vec<_>>(), writers[1..]);
}

#[test]
fn memory_is_handed_to_the_session_of_the_reader_alone() {
    type Claims = fn(&mut Registry<&'static str>);
    let tool: Claims = |registry| {
        let role = SessionRole::Tool;
        registry.handle_connect(id(READER), role, String::new(), 1, None, None).unwrap();
    };
    let user: Claims = |registry| {
        connect(registry, READER);
        registry.set_user(&id(READER), 1001);
    };
    for claim in [tool, user] {
        for claimed_before in [false, true] {
            let mut registry = with_earlier_grants(&[WRITER]);
            if claimed_before {
                claim(&mut registry);
            }
            registry.handle_disconnect(&id(WRITER));
            if !claimed_before {
                claim(&mut registry);
            }
            assert_eq!(handed(&mut registry), [], "claimed before: {claimed_before}");
            // The reader itself gets it, once it connects.
            registry.handle_disconnect(&id(READER));
            connect(&mut registry, READER);
            assert_eq!(handed(&mut registry).len(), 1, "claimed before: {claimed_before}");
        }
    }
    // Memory of another user is not passed on either.
    let mut registry = with_earlier_grants(&[WRITER]);
    registry.set_user(&id(WRITER), 1001);
    registry.handle_disconnect(&id(WRITER));
    connect(&mut registry, READER);
    assert_eq!(handed(&mut registry), []);
}

/// Sends this UNMET or grant many times from another process.
fn others_say(
    registry: &mut Registry<&'static str>,
    times: usize,
    what: impl Fn(u32) -> SessionMessage,
) {
    for number in 1..=times as u32 {
        registry.handle_message(&id(OTHER), what(number), vec![]).unwrap();
    }
}

const OTHER: u8 = 7;

#[test]
fn a_process_that_floods_loss_reports_displaces_none_of_another_process() {
    let mut registry = registry(&[WRITER, OTHER]);
    say(&mut registry, SessionMessage::Unmet(unmet(3)));
    let of = |number| Unmet {
        reader: Gid::new(id(8), number),
        writer: Gid::new(id(OTHER), number),
        samples: 1,
    };
    others_say(&mut registry, 3 * MAX_UNMET, |number| SessionMessage::Unmet(of(number)));
    connect(&mut registry, READER);
    assert_eq!(told(&mut registry), [3]);
}

#[test]
fn rings_of_a_process_that_leaves_many_displace_no_ring_of_another_one() {
    let mut registry = with_earlier_grants(&[WRITER, OTHER]);
    let of = |number| grant(Gid::new(id(8), number), Gid::new(id(OTHER), number));
    others_say(&mut registry, 3 * MAX_LEFT, |number| SessionMessage::Grant(of(number)));
    registry.handle_disconnect(&id(WRITER));
    registry.handle_disconnect(&id(OTHER));
    connect(&mut registry, READER);
    assert_eq!(handed(&mut registry).len(), 1);
}

#[test]
fn grants_of_a_process_that_repeats_many_displace_no_grant_of_another_one() {
    let mut registry = with_earlier_grants(&[WRITER, OTHER]);
    let of = |number| grant(Gid::new(id(8), number), Gid::new(id(OTHER), number));
    others_say(&mut registry, 3 * MAX_EARLIER_GRANTS, |number| SessionMessage::Grant(of(number)));
    registry.handle_disconnect(&id(WRITER));
    connect(&mut registry, READER);
    assert_eq!(handed(&mut registry).len(), 1);
}

#[test]
fn stopped_reader_receives_its_grant_despite_a_flood_from_another_process() {
    let mut registry = registry(&[WRITER, OTHER, READER]);
    let of = |number| Unmet { writer: Gid::new(id(OTHER), number), ..unmet(1) };
    others_say(&mut registry, 2000, |number| SessionMessage::Unmet(of(number)));
    say(&mut registry, SessionMessage::Unmet(unmet(3)));
    others_say(&mut registry, 2000, |number| SessionMessage::Unmet(of(2000 + number)));
    assert!(told(&mut registry).contains(&3));
}

#[test]
fn session_that_comes_back_on_another_connection_hands_no_ring_to_its_readers() {
    let mut registry = with_earlier_grants(&[WRITER, READER]);
    connect(&mut registry, WRITER);
    assert_eq!(handed(&mut registry), [], "its process lives");
    // The publisher reports its grant again.
    announce(&mut registry);
    say(&mut registry, SessionMessage::Grant(grant(unmet(0).reader, unmet(0).writer)));
    registry.handle_disconnect(&id(WRITER));
    assert_eq!(handed(&mut registry).len(), 1);
}

fn hang_up(registry: &mut Registry<&'static str>, session: u8) {
    while registry.handle_hang_up_in_parts(&id(session)) {}
}

#[test]
fn ring_of_a_disconnected_session_is_handed_over_after_its_process_ended() {
    for comes_before in [false, true] {
        let mut registry = with_earlier_grants(&[WRITER]);
        if comes_before {
            connect(&mut registry, READER);
        }
        hang_up(&mut registry, WRITER);
        if !comes_before {
            connect(&mut registry, READER);
        }
        assert_eq!(handed(&mut registry), [], "its process may write to the ring");
        assert!(registry.awaits_process(&id(WRITER)));
        registry.handle_process_end(&id(WRITER));
        assert_eq!(handed(&mut registry).len(), 1);
        assert!(!registry.awaits_process(&id(WRITER)));
    }
}

#[test]
fn the_ring_of_a_reconnected_session_is_handed_to_no_reader() {
    let mut registry = with_earlier_grants(&[WRITER, READER]);
    hang_up(&mut registry, WRITER);
    connect(&mut registry, WRITER);
    assert!(!registry.awaits_process(&id(WRITER)));
    registry.handle_process_end(&id(WRITER));
    assert_eq!(handed(&mut registry), []);
}
