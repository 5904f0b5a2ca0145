//! Samples of a peer beyond a limit.

use axon_transport::access::Verb;

use super::*;
use crate::engine::limits::{IdentityLimits, tests::permissions};

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
    let limits = IdentityLimits::default().of(Verb::Publish, "/t", &permissions(&rules), &config);
    let mut way = Way::new(Kind::Topic, false, room);
    way.inbound.routes().get_mut(&ROUTE).unwrap().limit.set(limits);
    way
}

impl Way {
    /// A sample comes.
    fn come(&mut self, number: u64, now: Duration) -> StepOutcome {
        let payload = Bytes::copy_from_slice(&number.to_be_bytes());
        let meta = Meta::at_nanos(number, 1000);
        let message = OpenedMessage { writer: PUBLISHER, number, meta, payload };
        self.inbound.deliver(key(), &mut self.stream, message, now, now)
    }

    /// A sample comes each 10 ms for a second.
    fn come_100(&mut self) {
        for ms in 0..1000 {
            if ms % 10 == 0 {
                assert!(matches!(self.come(ms / 10 + 1, at(ms)), StepOutcome::Go));
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
fn samples_beyond_a_limit_are_dropped_as_they_come_and_the_peer_is_told() {
    for over in ["drop-oldest", "drop-newest", "hold"] {
        let mut way = way(over, 1000);
        way.come_100();
        let came = way.numbers();
        assert_eq!((came.len(), &came[..2]), (11, &[1, 2][..]), "{over} {came:?}");
        assert_eq!(way.told(at(1000)), Some((100, 89)), "the publisher waits for none");
        assert_eq!(way.limited(), [("limit", 89)]);
        assert_eq!(way.inbound.limited.len(), 0);
    }
}

#[test]
fn samples_that_were_dropped_and_come_again_are_not_delivered_and_counted_once() {
    let mut way = way("drop-oldest", 1000);
    for number in 1..=5 {
        way.come(number, NOW);
    }
    assert_eq!((way.numbers(), way.told(at(10))), (vec![1, 2], Some((5, 3))));
    // The link breaks before the peer is told. By the time that all come again the limit has opened.
    for number in 1..=7 {
        way.come(number, at(1000));
    }
    assert_eq!((way.numbers(), way.told(at(1010))), (vec![1, 2, 6, 7], Some((7, 3))));
    assert_eq!(way.limited(), [("limit", 3)]);
}

#[test]
fn limited_keep_all_stream_is_read_on_when_its_sample_may_pass() {
    let mut way = way("hold", 1000);
    way.inbound.routes().get_mut(&ROUTE).unwrap().keeps_all = true;
    for number in 1..=2 {
        assert!(matches!(way.come(number, NOW), StepOutcome::Go));
    }
    assert!(matches!(way.come(3, NOW), StepOutcome::Wait));
    assert!(matches!(way.stream.step, StreamStep::Ring(_)));
    way.inbound.streams.insert(key(), std::mem::take(&mut way.stream));
    way.inbound.handle_timeout(at(99));
    assert!(!way.inbound.has_work());
    let due = way.inbound.limited.poll_timeout().unwrap();
    assert!(due <= at(101));
    way.inbound.handle_timeout(due);
    assert_eq!(way.inbound.next_ready(), Some(key()));
    assert_eq!((way.inbound.limited.len(), way.limited()), (0, vec![]));
}

#[test]
fn a_best_effort_sample_of_a_keep_all_topic_is_never_held() {
    let mut way = way("hold", 1000);
    way.inbound.routes().get_mut(&ROUTE).unwrap().keeps_all = true;
    way.stream.header.as_mut().unwrap().0.reliable = false;
    for number in 1..=3 {
        assert!(matches!(way.come(number, NOW), StepOutcome::Over));
    }
    assert_eq!((way.numbers(), way.limited()), (vec![1, 2], vec![("limit", 1)]));
}

#[test]
fn limits_that_are_gone_and_streams_that_end_hold_nothing() {
    let mut way = way("hold", 1000);
    way.inbound.routes().get_mut(&ROUTE).unwrap().keeps_all = true;
    for number in 1..=3 {
        way.come(number, NOW);
    }
    way.inbound.streams.insert(key(), std::mem::take(&mut way.stream));
    way.inbound.routes().get_mut(&ROUTE).unwrap().limit.set(Vec::new());
    way.inbound.handle_limits();
    assert_eq!((way.inbound.next_ready(), way.inbound.limited.len()), (Some(key()), 0));
    way.inbound.limited.hold(key(), at(50));
    way.inbound.forget_stream(key());
    assert_eq!((way.inbound.limited.len(), way.inbound.limited.poll_timeout()), (0, None));
}
