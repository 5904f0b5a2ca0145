use std::{rc::Rc, sync::Arc, time::Duration};

use axon_envelope::Kind;
use axon_shm::{ids::Gid, qos::Qos};

use super::taking::FlowRings;
use crate::engine::{
    counters::Counters,
    limits::{RouteLimit, tests::limits},
    outbound::{budget::Budget, model::ModelRing, queue::Queue, source::Source},
};

const PUBLISHER: Gid = Gid([1; 16]);

fn at(millis: u64) -> Duration {
    Duration::from_millis(millis)
}

/// The way of one publisher's samples from its ring to QUIC.
struct Way {
    ring: Rc<ModelRing>,
    sources: Vec<Source>,
    queue: Queue,
    taking: FlowRings,
    topic: Arc<str>,
    counters: Counters,
}

impl Way {
    fn new(qos: Qos) -> Self {
        Self::limited(qos, RouteLimit::default())
    }

    fn limited(qos: Qos, limit: RouteLimit) -> Self {
        let ring = ModelRing::new(Gid([2; 16]), PUBLISHER);
        let sources = vec![ring.source(qos)];
        let mut taking = FlowRings::new(PUBLISHER, Kind::Topic, None, limit);
        taking.set_sources(&sources, None);
        Self {
            ring,
            sources,
            queue: Queue::new(&qos, Budget::new(256 << 20).of_peer()),
            taking,
            topic: "/t".into(),
            counters: Counters::default(),
        }
    }

    fn fill(&mut self, now: Duration) -> u32 {
        self.taking.handle_samples();
        let Self { taking, sources, queue, topic, counters, .. } = self;
        taking.fill(sources, queue, topic, counters, now)
    }

    /// The numbers of the samples that wait, which all leave and are acknowledged.
    fn send_all(&mut self) -> Vec<u64> {
        let queue = &mut self.queue;
        let sent: Vec<_> =
            std::iter::from_fn(|| queue.send().map(|sample| sample.info.sequence)).collect();
        if let Some(last) = sent.last() {
            queue.acknowledge(*last);
        }
        sent
    }

    fn dropped(&self) -> u64 {
        self.counters.take_lost().iter().map(|loss| loss.samples).sum()
    }
}

/// What a limit of ten samples a second, two at once, lets pass of 100 samples in a second. The numbers, and when they were
/// sent.
fn passes(qos: Qos, over: &str) -> (Way, Vec<(u64, u64)>) {
    let limit = limits(&format!("topic = \"/t\"\nrate = 10\nburst = 2\nover = \"{over}\""));
    let mut way = Way::limited(qos, RouteLimit::new(limit));
    let mut sent = Vec::new();
    for ms in 0..1000 {
        if ms % 10 == 0 {
            way.ring.publish(1, 8);
        }
        way.fill(at(ms));
        sent.extend(way.send_all().into_iter().map(|number| (number, ms)));
    }
    (way, sent)
}

fn keep_last(depth: u32) -> Qos {
    Qos::default().with_depth(depth)
}

/// A KEEP_LAST flow that had samples waiting for longer than a burst lasts. One sample was sent.
fn behind(depth: u32) -> Way {
    let mut way = Way::new(keep_last(depth));
    way.ring.publish(1, 1 << 20);
    assert_eq!(way.fill(at(0)), 1);
    way.ring.publish(1000, 1 << 20);
    assert_eq!(way.send_all(), [1]);
    way
}

#[test]
fn keep_last_that_is_behind_copies_only_samples_that_it_sends() {
    let mut way = behind(3);
    let mut sent = vec![1];
    // The publisher goes on while the flow takes its samples, and is faster.
    way.ring.meanwhile.set((10, 50));
    for turn in 0..100 {
        way.fill(at(600 + turn));
        sent.extend(way.send_all());
    }
    assert_eq!(way.ring.copied.get(), sent.len() as u64, "each copied sample was sent");
    assert!(sent.is_sorted_by(|one, next| one < next));
    let published = way.ring.published.get();
    assert_eq!(published, 1501);
    assert_eq!(sent[sent.len() - 3..], [1499, 1500, 1501], "the newest of the depth arrive");
    assert_eq!(way.dropped(), published - sent.len() as u64, "all others are counted once");
}

#[test]
fn slow_keep_last_flow_leaves_long_samples_in_the_ring() {
    let mut way = behind(10);
    assert_eq!(way.fill(at(600)), 1);
    assert_eq!(way.fill(at(601)), 0, "one waits");
    // Newer samples replace the older ones in the ring.
    way.ring.publish(100, 1 << 20);
    assert_eq!(way.send_all(), [992]);
    assert_eq!(way.fill(at(602)), 1);
    assert_eq!(way.send_all(), [1092]);
    assert_eq!(way.ring.copied.get(), 3);
}

#[test]
fn a_burst_of_keep_last_that_exceeds_its_bytes_stays_in_the_ring() {
    let mut way = Way::new(keep_last(10));
    way.ring.publish(100, 1 << 20);
    let mut queued = 0;
    for _ in 0..100 {
        queued += way.fill(at(0));
    }
    // 8 MiB, less what a sample takes besides its bytes.
    assert_eq!((queued, way.ring.copied.get(), way.dropped()), (7, 7, 0));
    assert_eq!(way.send_all(), (1..=7).collect::<Vec<_>>());
    assert!(way.fill(at(1)) > 0);
    assert_eq!(way.send_all()[0], 8, "nothing of the burst is lost");
}

#[test]
fn a_burst_of_a_publisher_that_never_rests_ends() {
    let mut way = Way::new(keep_last(10));
    way.ring.meanwhile.set((1, u64::MAX));
    way.ring.publish(1, 16);
    let Way { taking, sources, queue, topic, counters, .. } = &mut way;
    assert_eq!(taking.take_burst(sources, queue, topic, counters, at(0)), 4 * 1024);
    assert!(taking.has_more());
}

#[test]
fn best_effort_that_is_behind_looks_at_no_more_than_its_depth() {
    let mut way = Way::new(Qos::sensor_data().with_depth(5));
    way.ring.publish(1, 1 << 20);
    assert_eq!(way.fill(at(0)), 1);
    way.ring.publish(1000, 1 << 20);
    way.fill(at(600));
    assert_eq!(way.ring.copied.get(), 6);
    let left: Vec<_> = std::iter::from_fn(|| way.queue.pop_best_effort()).collect();
    assert_eq!(
        left.iter().map(|s| s.info.sequence).collect::<Vec<_>>(),
        [997, 998, 999, 1000, 1001]
    );
    assert_eq!(way.dropped(), 996);
}

#[test]
fn flow_takes_no_more_samples_than_its_queue_keeps() {
    // A sample that waits holds the memory of all that were taken with it.
    for (qos, sent_before) in [(keep_last(3), true), (Qos::sensor_data().with_depth(3), false)] {
        let mut way = Way::new(qos);
        way.ring.publish(1, 10);
        way.fill(at(0));
        if sent_before {
            way.ring.publish(1, 10);
            way.send_all();
        }
        way.ring.publish(500, 10);
        way.ring.meanwhile.set((1, 500));
        way.fill(at(600));
        assert!(way.ring.most_together.get() <= 3, "{qos:?}: {}", way.ring.most_together.get());
        assert!(way.queue.waiting() <= 3);
    }
}

#[test]
fn keep_all_leaves_no_sample_behind() {
    let mut way = Way::new(Qos::keep_all());
    way.ring.publish(3000, 1000);
    let mut sent = Vec::new();
    for turn in 0..100 {
        way.fill(at(turn * 100));
        sent.extend(way.send_all());
    }
    assert_eq!(sent, (1..=3000).collect::<Vec<_>>());
    assert_eq!((way.dropped(), way.ring.lost.get()), (0, 0));
}

#[test]
fn samples_that_the_peer_has_are_not_queued() {
    let mut way = Way::new(Qos::keep_all());
    way.taking.set_sources(&way.sources, Some(20_000));
    way.ring.publish(20_003, 10);
    let mut turns = 0;
    while way.fill(at(0)) == 0 {
        turns += 1;
        assert!(turns < 10, "it goes on after each turn");
    }
    assert_eq!(way.send_all(), [20_001, 20_002, 20_003]);
}

#[test]
fn a_flow_without_room_takes_one_sample_and_keeps_it() {
    let mut way = Way::new(Qos::keep_all());
    // All the memory that the daemon has is another flow's.
    let budget = Budget::new(1024);
    budget.overtake(1024);
    way.queue = Queue::new(&Qos::keep_all(), budget.of_peer());
    way.ring.publish(10, 100);
    assert_eq!(way.fill(at(0)), 1, "one sample may always wait");
    assert_eq!((way.fill(at(0)), way.ring.copied.get()), (0, 2));
    assert!(way.taking.is_held() && !way.taking.is_idle());
    assert_eq!((way.fill(at(0)), way.ring.copied.get()), (0, 2));
    assert_eq!(way.send_all(), [1]);
    assert_eq!(way.fill(at(0)), 1);
    assert_eq!(way.send_all(), [2]);
    assert_eq!(way.taking.end(), 1);
}

#[test]
fn keep_last_without_room_sends_the_newest_of_its_depth() {
    let mut way = Way::new(keep_last(10));
    // All the memory that the daemon has is another flow's.
    let budget = Budget::new(1024);
    budget.overtake(1024);
    way.queue = Queue::new(&keep_last(10), budget.of_peer());
    way.ring.publish(1, 100);
    assert_eq!(way.fill(at(0)), 1);
    way.ring.publish(100, 100);
    let mut sent = Vec::new();
    for turn in 0..100 {
        way.fill(at(600 + turn));
        sent.extend(way.send_all());
    }
    assert_eq!(sent, [1].into_iter().chain(92..=101).collect::<Vec<_>>());
    assert_eq!(way.dropped(), 90);
    assert!(way.taking.is_idle() && !way.taking.is_held());
}

#[test]
fn beyond_a_limit_the_newest_sample_waits_and_the_others_are_dropped() {
    for (qos, copies) in [(keep_last(10), 12), (Qos::sensor_data(), 12), (Qos::keep_all(), 100)] {
        let (mut way, sent) = passes(qos, "drop-oldest");
        let numbers: Vec<_> = sent.iter().map(|(number, _)| *number).collect();
        assert_eq!(numbers.len(), 11, "{sent:?}");
        assert_eq!(numbers[..2], [1, 2], "two at once");
        // Each is the newest at its time.
        assert!(sent[2..].iter().all(|(number, ms)| *number == ms / 10 + 1), "{sent:?}");
        // The last one waits, and is sent though nothing comes after it.
        assert_eq!(way.fill(at(1001)), 1);
        assert_eq!(way.send_all(), [100]);
        assert!(way.ring.copied.get() <= copies, "{} copies", way.ring.copied.get());
        let lost = way.counters.take_lost();
        assert!(lost.iter().all(|loss| loss.cause == "limit"), "{lost:?}");
        assert_eq!(lost.iter().map(|loss| loss.samples).sum::<u64>(), 100 - 12);
    }
}

#[test]
fn of_two_relays_the_newest_sample_passes_when_the_limit_opens() {
    for qos in [keep_last(10), Qos::keep_all()] {
        let limit = limits("topic = \"/t\"\nrate = 10\nburst = 1\nover = \"drop-oldest\"");
        let mut way = Way::limited(qos, RouteLimit::new(limit));
        let second = ModelRing::new(Gid([3; 16]), PUBLISHER);
        way.sources.push(second.source(keep_last(1)));
        way.taking.set_sources(&way.sources, None);
        let mut sent = Vec::new();
        for ms in 0..=1000 {
            if ms % 10 == 0 {
                way.ring.publish(1, 8);
                second.publish(1, 8);
            }
            way.fill(at(ms));
            let retry = way.taking.take_retry();
            assert!(retry.is_none_or(|wait| !wait.is_zero()), "it looks again at once, for ever");
            sent.extend(way.send_all().into_iter().map(|number| (number, ms)));
        }
        assert_eq!(sent.len(), 11, "{sent:?}");
        assert!(sent.iter().all(|(number, ms)| *number == ms / 10 + 1), "{sent:?}");
    }
}

#[test]
fn beyond_a_limit_that_drops_the_newest_samples_are_dropped_as_they_come() {
    for qos in [keep_last(10), Qos::sensor_data(), Qos::keep_all()] {
        let (mut way, sent) = passes(qos, "drop-newest");
        assert_eq!(sent.len(), 11, "{sent:?}");
        assert_eq!(sent[..3], [(1, 0), (2, 10), (11, 100)]);
        assert_eq!(way.fill(at(1001)), 0, "none waits");
        assert_eq!(way.dropped(), 100 - 11);
        let told = (way.taking.take_dropped(), way.taking.take_given_up());
        assert_eq!(told, (Some(100), 89), "the publisher does not wait for them");
    }
}

#[test]
fn a_limit_that_holds_samples_loses_none() {
    let (mut way, sent) = passes(Qos::keep_all(), "hold");
    let numbers: Vec<_> = sent.iter().map(|(number, _)| *number).collect();
    assert_eq!(numbers, (1..=11).collect::<Vec<_>>());
    assert!(way.taking.is_limited());
    for ms in 1000..10_000 {
        way.fill(at(ms));
        way.send_all();
    }
    assert_eq!((way.ring.copied.get(), way.dropped()), (100, 0));
    assert!(!way.taking.is_limited());
}

#[test]
fn a_limit_of_bytes_counts_the_length_of_samples() {
    let limit = RouteLimit::new(limits("topic = \"/t\"\nbytes = \"1 MB/s\"\nover = \"hold\""));
    let mut way = Way::limited(Qos::keep_all(), limit);
    way.ring.publish(100, 100_000);
    let mut sent = Vec::new();
    for ms in 0..1000 {
        way.fill(at(ms));
        sent.extend(way.send_all());
    }
    // The first one passes at once, and each is made up for before the next.
    assert_eq!(sent.len(), 11, "{sent:?}");
}
