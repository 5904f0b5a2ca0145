//! Tests two hosts with very many topics: counts the cost of a sample, and the cost of an idle host.

use std::time::Duration;

use axon_shm::{ids::Gid, qos::Qos};
use axon_transport::config::Config;

use super::world::World;
use crate::engine::quic::transport::STREAMS_OPEN;

const MANY: usize = 10_000;

/// Two hosts, and topics with a publisher on one and a subscription on the other.
struct Topics {
    world: World,
    pairs: Vec<(Gid, Gid)>,
}

impl Topics {
    /// Creates `count` matched topics.
    fn matched(count: usize, qos: Qos) -> Self {
        let mut world = World::new(7, 2, |_| Config::default());
        let pair = |topic| {
            let name = format!("/topic_{topic:05}");
            let publisher = world.hosts[0].rings.create_publisher(&name, qos);
            (publisher, world.hosts[1].rings.create_subscription(&name, qos, None))
        };
        let pairs: Vec<_> = (0..count).map(pair).collect();
        world.hosts.iter_mut().for_each(|host| host.touch_graph());
        let all = |world: &World| world.hosts[0].rings.relays() == count;
        world.until(Duration::from_secs(60), all);
        // The relays that have just come are looked at.
        world.hosts[0].ring();
        world.run_for(Duration::from_secs(5));
        Self { world, pairs }
    }

    fn publish(&mut self, topic: usize) {
        assert!(self.world.hosts[0].rings.publish(self.pairs[topic].0, 64));
        self.world.hosts[0].ring();
    }

    fn received(&self, topic: usize) -> Vec<u64> {
        let (publisher, subscription) = self.pairs[topic];
        self.world.hosts[1].rings.received(subscription, publisher)
    }
}

#[test]
fn a_sample_has_one_relay_looked_at_however_many_topics_there_are() {
    for count in [1, MANY] {
        let mut topics = Topics::matched(count, Qos::default());
        let before = topics.world.hosts[0].rings.looks();
        for round in 0..100 {
            topics.publish(round * 97 % count);
            topics.world.run_for(Duration::from_millis(1));
        }
        topics.world.run_for(Duration::from_secs(1));
        assert_eq!(topics.world.hosts[0].rings.looks() - before, 100, "of {count} topics");
        let all = (0..count).map(|topic| topics.received(topic).len()).sum::<usize>();
        assert_eq!(all, 100, "of {count} topics");
    }
}

#[test]
fn topics_without_samples_cost_an_idle_link_nothing() {
    let [one, many] = [1, MANY].map(|count| {
        let mut topics = Topics::matched(count, Qos::keep_all());
        topics.publish(0);
        topics.world.run_for(Duration::from_secs(60));
        let passes = |world: &World| world.passes.iter().sum::<u64>();
        let before = (passes(&topics.world), topics.world.hosts[0].rings.looks());
        topics.world.run_for(Duration::from_secs(60));
        (passes(&topics.world) - before.0, topics.world.hosts[0].rings.looks() - before.1)
    });
    assert_eq!((one.1, many.1), (0, 0), "nothing is looked at");
    // Keep-alives and reports, whose times differ a little.
    assert!(many.0 <= one.0 + one.0 / 10 && one.0 < 400, "{} and {} passes", many.0, one.0);
}

#[test]
fn more_topics_than_streams_get_their_samples_soon() {
    let count = 4 * STREAMS_OPEN as usize;
    let mut topics = Topics::matched(count, Qos::keep_all());
    for round in 1..=2 {
        (0..count).for_each(|topic| topics.publish(topic));
        topics.world.run_for(Duration::from_secs(5));
        let missing = (0..count).filter(|topic| topics.received(*topic).len() != round).count();
        assert_eq!(missing, 0, "in round {round}: {}", topics.world.describe());
    }
}

#[test]
fn a_topic_whose_ring_is_to_be_looked_at_again_keeps_its_stream() {
    let streams = STREAMS_OPEN as usize;
    let mut topics = Topics::matched(2 * streams, Qos::keep_all());
    // Each stream is open, and carries nothing.
    (0..streams).for_each(|topic| topics.publish(topic));
    topics.world.run_for(Duration::from_secs(2));
    // Topic 0 has more samples than one look passes over, and a valid one behind them, while other flows ask for
    // streams.
    (0..160).for_each(|_| topics.publish(0));
    topics.world.hosts[0].rings.expire(topics.pairs[0].0);
    topics.publish(0);
    (streams..2 * streams).for_each(|topic| topics.publish(topic));
    topics.world.run_for(Duration::from_secs(5));
    assert_eq!(topics.received(0), [1, 162], "{}", topics.world.describe());
}
