//! Readers that never learned of the grant of a publisher that ended.

use axon_shm::internal::Location;

use crate::{
    graph::{Endpoint, EndpointKind},
    ids::{Gid, SessionId},
    registry::{MAX_QUEUE, MAX_UNMET, Registry, Violation},
    wire::session::{Announce, EndpointRole, Gone, Message, SessionRole, Unmet},
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
    registry.handle_connect(id(session), role, name, 1, handed, None).unwrap();
}

fn registry(sessions: &[u8]) -> Registry<&'static str> {
    let mut registry = Registry::default();
    sessions.iter().for_each(|session| connect(&mut registry, *session));
    sessions.iter().for_each(|session| drop(taken(&mut registry, *session)));
    registry
}

fn say(registry: &mut Registry<&'static str>, message: Message) {
    registry.handle_message(&id(WRITER), message, vec![]).unwrap();
}

fn taken(registry: &mut Registry<&'static str>, session: u8) -> Vec<Message> {
    let taken = std::iter::from_fn(|| registry.poll_output(&id(session)));
    taken.map(|output| Message::decode(&output.packet).unwrap()).collect()
}

/// What the reader's session is told of unmet pairs.
fn told(registry: &mut Registry<&'static str>) -> Vec<u64> {
    let samples = taken(registry, READER).into_iter().filter_map(|message| match message {
        Message::Unmet(unmet) => Some(unmet.samples),
        _ => None,
    });
    samples.collect()
}

#[test]
fn a_reader_hears_of_it_once_whether_its_session_is_here_or_comes_later() {
    let mut registry = registry(&[WRITER, READER]);
    say(&mut registry, Message::Unmet(unmet(3)));
    assert_eq!(told(&mut registry), [3]);

    registry.handle_disconnect(&id(READER));
    say(&mut registry, Message::Unmet(unmet(4)));
    say(&mut registry, Message::Unmet(unmet(5)));
    registry.handle_disconnect(&id(WRITER));
    connect(&mut registry, READER);
    assert_eq!(told(&mut registry), [5], "its session has ended");
    assert_eq!(told(&mut registry), [0; 0]);
}

#[test]
fn a_reader_hears_of_it_before_it_hears_that_the_publisher_ended() {
    let mut registry = registry(&[WRITER]);
    let writer = unmet(3).writer;
    let endpoint = Endpoint::example(writer, EndpointKind::Publisher);
    let (role, stands_for) = (EndpointRole::Application, Vec::new());
    let ring = Some(Location { segment: 0, offset: 4096 });
    let announce = Announce { endpoint, role, stands_for, ring, only: None };
    registry.keep_left_memory(1);
    say(&mut registry, Message::Endpoint(announce));
    say(&mut registry, Message::Unmet(unmet(3)));
    say(&mut registry, Message::EndpointGone(Gone { gid: writer }));
    registry.flush();
    connect(&mut registry, READER);
    let told = taken(&mut registry, READER);
    let ends = |m: &Message| matches!(m, Message::Graph(g) if g.ended.as_ref().is_some_and(|e| e.contains(&writer)));
    let at = |is: &dyn Fn(&Message) -> bool| told.iter().position(is).expect("it was told");
    assert!(at(&|m| *m == Message::Unmet(unmet(3))) < at(&ends));
}

#[test]
fn a_session_that_is_told_everything_anew_hears_of_it_all_the_same() {
    let mut registry = registry(&[WRITER, READER]);
    say(&mut registry, Message::Unmet(unmet(3)));
    for _ in 0..=MAX_QUEUE {
        registry.push(&id(READER), &Message::Resync, Vec::new());
    }
    // Its queue was dropped.
    let other = Gid::new(id(WRITER), 2);
    say(&mut registry, Message::Unmet(Unmet { writer: other, ..unmet(4) }));
    assert_eq!(told(&mut registry), [3, 4]);

    say(&mut registry, Message::Unmet(unmet(5)));
    registry.handle_disconnect(&id(READER));
    connect(&mut registry, READER);
    assert_eq!(told(&mut registry), [5], "its connection broke");
}

#[test]
fn the_oldest_pair_is_forgotten_beyond_the_bound() {
    let mut registry = registry(&[WRITER]);
    for number in 0..=MAX_UNMET as u32 {
        let writer = Gid::new(id(WRITER), 1 + number);
        say(&mut registry, Message::Unmet(Unmet { writer, ..unmet(number.into()) }));
    }
    connect(&mut registry, READER);
    assert_eq!(told(&mut registry), [1, 2, 3, 4]);
}

#[test]
fn nobody_speaks_for_the_publishers_of_another_session() {
    let mut registry = registry(&[WRITER, READER]);
    let refused = registry.handle_message(&id(READER), Message::Unmet(unmet(3)), vec![]);
    assert_eq!(refused, Err(Violation::NotItsOwn(unmet(3).writer)));
}
