//! Samples of a peer beyond a limit.

use axon_transport::access::Verb;

use super::*;
use crate::engine::limits::{Limits, tests::permissions};

fn key() -> (u64, StreamId) {
    (1, StreamId::new(Side::Client, Dir::Uni, 0))
}

fn at(ms: u64) -> Duration {
    NOW + Duration::from_millis(ms)
}

/// A stream of a topic that a limit of ten samples a second, two at once, is set for.
fn way(over: &str, room: usize) -> Way {
    let rules =
        format!("[[limit]]\npeer = \"*\"\ntopic = \"/t\"\nrate = 10\nburst = 2\nover = \"{over}\"");
    let config = axon_transport::config::Config::default();
    let limits = Limits::default().of(Verb::Publish, "/t", &permissions(&rules), &config);
    let mut way = Way::new(Kind::Topic, false, room);
    way.inbound.routes().get_mut(&ROUTE).unwrap().limit.set(limits);
    way
}

impl Way {
    /// A sample comes.
    fn come(&mut self, number: u64, now: Duration) -> Next {
        let payload = Bytes::copy_from_slice(&number.to_be_bytes());
        let meta = Meta::at_nanos(number, 1000);
        let message = Message { writer: PUBLISHER, number, meta, payload };
        self.inbound.deliver(key(), &mut self.stream, message, now, now)
    }

    /// These samples come.
    fn come_all(&mut self, numbers: std::ops::RangeInclusive<u64>, now: Duration) {
        for number in numbers {
            self.come(number, now);
        }
    }

    /// A sample comes each 10 ms for a second.
    fn come_100(&mut self) {
        for ms in 0..1000 {
            if ms % 10 == 0 {
                assert!(matches!(self.come(ms / 10 + 1, at(ms)), Next::Go));
            }
            self.inbound.handle_timeout(at(ms));
        }
    }

    /// What is acknowledged by now: up to which number, and how many of these were dropped.
    fn told(&mut self, now: Duration) -> Option<(u64, u64)> {
        let received = self.inbound.poll_receipt(now)?;
        let [of] = &received.flows[..] else { panic!("{received:?}") };
        Some((of.sequence, of.dropped))
    }

    fn limited(&self) -> Vec<(&'static str, u64)> {
        let lost = self.inbound.counters.take_lost();
        lost.iter().map(|loss| (loss.cause, loss.samples)).collect()
    }
}

#[test]
fn the_newest_sample_waits_and_the_others_are_dropped() {
    let mut way = way("drop-oldest", 1000);
    way.come_100();
    let came = way.numbers();
    assert_eq!((came.len(), &came[..2]), (11, &[1, 2][..]), "{came:?}");
    assert_eq!(way.told(at(1000)), Some((99, 88)), "100 waits, and is not acknowledged");
    way.inbound.handle_timeout(at(1100));
    assert_eq!(way.numbers().last(), Some(&100));
    assert_eq!(way.told(at(1200)), Some((100, 0)));
    assert_eq!(way.limited(), [("limit", 88)]);
    assert_eq!(way.inbound.limited.len(), 0);
    assert_eq!(way.ring.quiet.get(), 0, "its readers are woken");
}

#[test]
fn samples_are_dropped_as_they_come() {
    let mut way = way("drop-newest", 1000);
    way.come_100();
    assert_eq!(way.numbers().len(), 11);
    assert_eq!(way.told(at(1000)), Some((100, 89)), "the publisher waits for none");
    assert_eq!(way.limited(), [("limit", 89)]);
}

#[test]
fn a_stream_that_is_held_is_read_on_when_its_sample_may_pass() {
    let mut way = way("hold", 1000);
    for number in 1..=2 {
        assert!(matches!(way.come(number, NOW), Next::Go));
    }
    assert!(matches!(way.come(3, NOW), Next::Wait));
    assert!(matches!(way.stream.step, Step::Ring(_)));
    way.inbound.streams.insert(key(), std::mem::take(&mut way.stream));
    way.inbound.handle_timeout(at(99));
    assert!(!way.inbound.has_work());
    let due = way.inbound.limited.poll_timeout().unwrap();
    way.inbound.handle_timeout(due);
    assert_eq!(way.inbound.next_ready(), Some(key()));
    assert_eq!(way.limited(), []);
}

#[test]
fn a_sample_that_waits_is_not_lost_and_not_repeated_over_a_new_link() {
    let mut way = way("drop-oldest", 1000);
    way.come_all(1..=5, NOW);
    assert_eq!(way.told(at(10)), Some((4, 2)));
    // The link breaks: what is not acknowledged comes again, and so does what was, if the acknowledgement was lost.
    way.come_all(3..=5, at(20));
    assert_eq!(way.told(at(50)), Some((4, 0)));
    way.inbound.handle_timeout(at(101));
    way.come(5, at(110));
    assert_eq!(way.numbers(), [1, 2, 5]);
    assert_eq!(way.told(at(200)), Some((5, 0)));
    assert_eq!(way.limited(), [("limit", 2)]);
}

#[test]
fn a_sample_that_waits_goes_before_the_next_one() {
    let mut way = way("drop-oldest", 1000);
    way.come_all(1..=3, NOW);
    // Nobody looked at the time meanwhile.
    way.come(4, at(250));
    assert_eq!(way.numbers(), [1, 2, 3, 4]);
}

#[test]
fn a_sample_that_waits_for_a_full_ring_is_tried_again() {
    let mut way = way("drop-oldest", 2);
    way.come_all(1..=3, NOW);
    way.inbound.handle_timeout(at(101));
    assert_eq!((way.numbers().len(), way.inbound.limited.len()), (2, 1));
    way.ring.room.set(1);
    way.inbound.handle_timeout(at(300));
    assert_eq!(way.numbers(), [1, 2, 3]);
}

#[test]
fn a_sample_that_waits_when_its_route_ends_is_counted() {
    let mut way = way("drop-oldest", 1000);
    way.come_all(1..=3, NOW);
    way.inbound.routes().remove(&ROUTE);
    way.inbound.handle_timeout(at(101));
    assert_eq!(way.limited(), [("no_route", 1)]);
    assert_eq!(way.inbound.limited.poll_timeout(), None);
}

#[test]
fn limits_that_are_gone_let_pass_what_waited_at_once() {
    let mut way = way("drop-oldest", 1000);
    way.come_all(1..=3, NOW);
    way.inbound.routes().get_mut(&ROUTE).unwrap().limit.set(Vec::new());
    way.inbound.handle_limits();
    assert!(way.inbound.poll_timeout() <= Some(NOW));
    way.inbound.handle_timeout(NOW);
    assert_eq!(way.numbers(), [1, 2, 3]);
}

#[test]
fn samples_that_wait_count_for_the_memory_of_their_peer() {
    let mut way = way("drop-oldest", 1000);
    way.inbound.intake = MessageMemory::new(1 << 20, 20);
    way.come_all(1..=3, NOW);
    let other = Gid([2; 16]);
    let header = way.stream.header.as_mut().unwrap();
    header.0.of = other;
    let route = way.inbound.routes.get_mut(&ROUTE).unwrap();
    let stand_in = Rc::clone(&route.writers[&PUBLISHER]);
    route.writers.insert(other, stand_in);
    let memory = way.inbound.intake.short.left();
    assert_eq!(memory, 12, "8 bytes wait");
    way.come(4, NOW);
    assert_eq!(way.inbound.intake.short.left(), 4);
    way.stream.header.as_mut().unwrap().0.of = Gid([3; 16]);
    way.come(5, NOW);
    assert_eq!(way.limited(), [("limit", 1)], "there is no memory for a third one");
}
