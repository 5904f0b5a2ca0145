//! Copies of samples, which come over the second path.

use super::*;
use crate::engine::inbound::copies::{ReadCopy, permit_length, permit_payload};

fn at(ms: u64) -> Duration {
    NOW + Duration::from_millis(ms)
}

/// Copies come in streams of link 2, one each; a sample of this number in the stream of the same number.
fn key(number: u64) -> (u64, StreamId) {
    (2, StreamId::new(Side::Client, Dir::Uni, number))
}

impl Way {
    fn copy_stream(&self, after: u64) -> IncomingStream {
        let (header, route) = self.stream.header.unwrap();
        let header = StreamHeader { copy: true, short: false, ..header };
        IncomingStream { header: Some((header, route)), after, ..IncomingStream::default() }
    }

    /// The copy of a sample comes, which was sent after another one. Returns its stream.
    fn copy(&mut self, number: u64, after: u64, now: Duration) -> (IncomingStream, StepOutcome) {
        let meta = Meta::at_nanos(number, 1000);
        let payload = Bytes::copy_from_slice(&number.to_be_bytes());
        let message = OpenedMessage { writer: PUBLISHER, number, meta, payload };
        let mut stream = self.copy_stream(after);
        let StreamStep::Copy(copy) = Inbound::copy_step(message, now) else { unreachable!() };
        let next = self.inbound.deliver_copy(key(number), &mut stream, copy, now);
        (stream, next)
    }

    /// Continues with a copy that waits.
    fn go_on(&mut self, number: u64, stream: &mut IncomingStream, now: Duration) -> StepOutcome {
        let StreamStep::Copy(ReadCopy { message, until }) =
            std::mem::replace(&mut stream.step, StreamStep::Length)
        else {
            panic!("{:?}", stream.step);
        };
        self.inbound.deliver_copy(key(number), stream, ReadCopy { message, until }, now)
    }

    /// Samples come over the link in use.
    fn samples(&mut self, numbers: impl IntoIterator<Item = u64>) {
        let piece = self.messages(numbers);
        assert!(matches!(self.read(piece), Ok(None)));
    }
}

#[test]
fn copy_is_delivered_once_and_its_sample_counts_as_delivered() {
    let mut way = Way::new(Kind::Topic, true, 1000);
    way.samples(1..=3);
    assert!(matches!(way.copy(4, 3, NOW).1, StepOutcome::Over));
    // The sample between them was dropped by its host.
    assert!(matches!(way.copy(6, 4, NOW).1, StepOutcome::Over));
    assert_eq!(way.numbers(), [1, 2, 3, 4, 6]);
    assert_eq!(way.acknowledged().unwrap().sequence, 6);
    way.samples([4, 6, 7]);
    assert!(matches!(way.copy(7, 6, NOW).1, StepOutcome::Over));
    assert_eq!(way.numbers(), [1, 2, 3, 4, 6, 7], "each once");
}

#[test]
fn copy_waits_for_the_sample_before_it() {
    let mut way = Way::new(Kind::Topic, true, 1000);
    way.samples(1..=3);
    let (mut second, next) = way.copy(5, 4, NOW);
    assert!(matches!(next, StepOutcome::Wait));
    assert_eq!(way.numbers(), [1, 2, 3]);
    way.inbound.streams.insert(key(5), way.copy_stream(4));
    way.samples([4]);
    assert_eq!(way.inbound.next_ready(), Some(key(5)), "the sample before it wakes it");
    assert!(matches!(way.go_on(5, &mut second, NOW), StepOutcome::Over));
    assert_eq!(way.numbers(), [1, 2, 3, 4, 5]);
}

#[test]
fn copies_that_never_have_their_turn_end_without_a_count() {
    let mut way = Way::new(Kind::Topic, true, 1000);
    way.samples(1..=3);
    let mut waiting: Vec<_> = (10..50).map(|number| way.copy(number, number - 1, NOW)).collect();
    let waits = waiting.iter().filter(|(_, next)| matches!(next, StepOutcome::Wait)).count();
    assert_eq!(waits, 8, "no more of one flow wait");
    let due = way.inbound.poll_timeout().unwrap();
    assert!(due <= at(1000));
    for (number, (stream, _)) in (10..18).zip(&mut waiting) {
        assert!(matches!(way.go_on(number, stream, at(1000)), StepOutcome::Over));
    }
    assert!(matches!(way.copy(60, 59, NOW).1, StepOutcome::Wait), "there is room again");
    assert_eq!(way.numbers(), [1, 2, 3]);
    assert_eq!(way.inbound.counters.take_lost().len(), 0);
    assert_eq!(way.acknowledged().unwrap().sequence, 3);
}

#[test]
fn link_that_ends_takes_its_waiting_copies_with_it() {
    let mut way = Way::new(Kind::Topic, true, 1000);
    let (stream, _) = way.copy(5, 4, NOW);
    way.inbound.streams.insert(key(5), stream);
    way.inbound.link_over(2, NOW);
    assert_eq!(way.inbound.counters.take_lost().len(), 0);
    way.inbound.handle_timeout(at(2000));
    assert!(!way.inbound.has_work());
    way.samples([4]);
    assert!(!way.inbound.has_work());
}

#[test]
fn first_copy_of_a_flow_waits_while_samples_of_another_link_are_unread() {
    let mut way = Way::new(Kind::Topic, true, 1000);
    let flow = (ROUTE, PUBLISHER);
    way.inbound.turns.entry(flow).or_default().push_back((1, key(0).1));
    assert!(matches!(way.copy(1, 0, NOW).1, StepOutcome::Wait));
    way.inbound.turns.remove(&flow);
    assert!(matches!(way.copy(1, 0, NOW).1, StepOutcome::Over));
    assert_eq!(way.numbers(), [1]);
    // A copy of a flow that begins anew is no first one where samples came before.
    assert!(matches!(way.copy(9, 0, NOW).1, StepOutcome::Wait));
}

#[test]
fn copy_without_room_decides_nothing() {
    let mut way = Way::new(Kind::Topic, true, 0);
    assert!(matches!(way.copy(1, 0, NOW).1, StepOutcome::Over));
    way.ring.room.set(1000);
    assert_eq!((way.numbers().len(), way.inbound.counters.take_lost().len()), (0, 0));
    way.samples([1]);
    assert_eq!(way.numbers(), [1]);
}

#[test]
fn copy_for_which_memory_is_short_is_no_lost_sample() {
    let mut way = Way::new(Kind::Topic, true, 1000);
    way.samples([1]);
    assert_eq!(way.acknowledged().unwrap().sequence, 1);
    way.ring.short_from.set(0);
    assert!(matches!(way.copy(2, 1, NOW).1, StepOutcome::Over));
    assert!(way.acknowledged().is_none(), "nothing is said of the sample");
    way.ring.short_from.set(usize::MAX);
    way.samples([2, 3]);
    assert_eq!(way.numbers(), [1, 2, 3]);
    let of = ReceivedOf { route: ROUTE, publisher: PUBLISHER, sequence: 3, dropped: 0 };
    assert_eq!(way.acknowledged(), Some(of));
    assert!(way.inbound.counters.take_lost().is_empty());
}

#[test]
fn copy_of_a_response_to_an_unknown_client_is_dropped() {
    let mut way = Way::new(Kind::Response, false, 1000);
    assert!(matches!(way.copy(1, 0, NOW).1, StepOutcome::Over));
    assert!(way.acknowledged().is_none() && way.numbers().is_empty());
    way.inbound.routes().get_mut(&ROUTE).unwrap().set_clients([PUBLISHER].into_iter());
    assert!(matches!(way.copy(1, 0, NOW).1, StepOutcome::Over));
    assert!(matches!(way.copy(1, 0, NOW).1, StepOutcome::Over));
    assert_eq!(way.numbers(), [1], "once");
}

#[test]
fn sample_whose_copy_was_delivered_is_not_lost_with_its_publisher() {
    let mut way = Way::new(Kind::Topic, false, 1000);
    way.samples([1]);
    assert!(matches!(way.copy(2, 1, NOW).1, StepOutcome::Over));
    way.inbound.routes().get_mut(&ROUTE).unwrap().writers.clear();
    for (number, lost) in [(2, 0), (3, 1)] {
        let meta = Meta::at_nanos(number, 1000);
        let message =
            OpenedMessage { writer: PUBLISHER, number, meta, payload: Bytes::from_static(b"x") };
        way.inbound.routes().get_mut(&ROUTE).unwrap().writers.clear();
        let next = way.inbound.deliver(key(0), &mut way.stream, message, NOW, NOW);
        assert!(matches!(next, StepOutcome::Go));
        assert_eq!(way.inbound.counters.take_lost().len(), lost, "{number}");
    }
}

#[test]
fn copy_of_a_dropped_sample_is_not_delivered_and_the_next_one_is() {
    let mut way = Way::new(Kind::Topic, true, 1000);
    way.samples([1]);
    way.ring.short_from.set(0);
    way.samples([2]);
    way.ring.short_from.set(usize::MAX);
    assert_eq!(way.inbound.counters.take_lost().len(), 1);
    assert!(matches!(way.copy(2, 1, NOW).1, StepOutcome::Over));
    assert!(matches!(way.copy(3, 2, NOW).1, StepOutcome::Over));
    assert_eq!(way.numbers(), [1, 3]);
}

#[test]
fn copy_of_an_unknown_publisher_or_route_is_dropped() {
    let mut way = Way::new(Kind::Topic, true, 1000);
    way.inbound.routes().get_mut(&ROUTE).unwrap().writers.clear();
    assert!(matches!(way.copy(1, 0, NOW).1, StepOutcome::Over));
    way.inbound.routes().clear();
    assert!(matches!(way.copy(1, 0, NOW).1, StepOutcome::Over));
    assert!(way.acknowledged().is_none() && way.inbound.counters.take_lost().is_empty());
}

#[test]
fn long_copy_is_a_violation() {
    permit_length(4096 + 64).unwrap();
    let (code, _) = permit_length(1 << 20).unwrap_err();
    assert_eq!(code, CloseCode::TooLarge);
    permit_payload(4096).unwrap();
    let (code, _) = permit_payload(4097).unwrap_err();
    assert_eq!(code, CloseCode::TooLarge);
}
