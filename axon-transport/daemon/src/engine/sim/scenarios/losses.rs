//! Tests samples that are not delivered: samples that the sender passes over, and that each loss is counted once.

use std::time::Duration;

use axon_shm::qos::Qos;

use crate::engine::sim::{
    network::{Path, Rate},
    tests::{classic, millis, secs},
    world::{Pair, World},
};

/// Creates two hosts and a publisher that is attached.
fn attached(seed: u64, qos: Qos, path: Path) -> (World, Pair) {
    let mut world = World::new(seed, 2, classic);
    world.network.set_default_path(path);
    let pair = world.pair(0, 1, "/t", qos);
    world.until(secs(10), World::is_whole);
    world.run_for(secs(2));
    (world, pair)
}

#[test]
fn a_live_sample_behind_many_expired_ones_is_sent_without_another_ring() {
    for qos in [Qos::keep_all(), Qos::default().with_depth(256)] {
        let (mut world, pair) = attached(60, qos, Path::default());
        let (host, publisher) = pair.publisher;
        // These are two and a half times as many samples as one take passes over.
        for _ in 0..160 {
            assert!(world.hosts[host].rings.publish(publisher, 10));
        }
        world.hosts[host].rings.expire(publisher);
        assert!(world.hosts[host].rings.publish(publisher, 10));
        world.hosts[host].ring();
        world.run_for(millis(100));
        assert_eq!(world.received(pair), [161], "{}", world.describe());
    }
}

/// Returns the number of samples of a topic that both hosts together report as lost.
fn counted(world: &World, topic: &str) -> u64 {
    let lost = world.hosts.iter().flat_map(|host| &host.lost);
    lost.filter(|((of, _), _)| of == topic).map(|(_, samples)| samples).sum()
}

#[test]
fn losses_of_one_relay_covered_by_another_are_not_counted() {
    let (mut world, pair) = attached(60, Qos::keep_all(), Path::default());
    // It has a relay of its own, which keeps the last samples alone.
    let last = world.hosts[1].rings.create_subscription("/t", Qos::default(), None);
    world.hosts[1].touch_graph();
    world.run_for(secs(1));
    let (host, publisher) = pair.publisher;
    let (subscriber, subscription) = pair.subscription;
    let burst = |world: &mut World| {
        for _ in 0..200 {
            assert!(world.hosts[host].rings.publish(publisher, 10));
        }
        world.hosts[host].ring();
        world.run_for(secs(1));
    };
    burst(&mut world);
    assert_eq!(world.received(pair).len(), 200);
    // From now on the other relay is the most demanding one.
    world.hosts[subscriber].rings.end(subscription);
    world.hosts[subscriber].touch_graph();
    world.run_for(secs(2));
    assert_eq!(counted(&world, "/t"), 0, "{}", world.describe());
    // The losses of this relay count from the first sample.
    burst(&mut world);
    let came = world.hosts[subscriber].rings.received(last, publisher);
    let after = came.iter().filter(|number| **number > 200).count() as u64;
    assert!(after < 200, "nothing is lost: the test shows nothing");
    assert_eq!(counted(&world, "/t"), 200 - after, "{}", world.describe());
}

#[test]
fn each_sample_that_does_not_arrive_is_counted_once() {
    let slow = Rate::new(2_000_000, millis(50));
    let slow = Path { delay: millis(2), rate: Some(slow), ..Path::default() };
    let lossy = Path { loss: 0.1, ..slow.clone() };
    let depth = |depth, qos: Qos| qos.with_depth(depth);
    let all = [
        (depth(1, Qos::default()), &slow, 20_000),
        (depth(5, Qos::default()), &lossy, 20_000),
        (depth(1, Qos::default()), &slow, 500_000),
        (depth(1, Qos::sensor_data()), &slow, 20_000),
        (depth(5, Qos::sensor_data()), &lossy, 500),
        (depth(5, Qos::sensor_data()), &slow, 500_000),
    ];
    for (seed, (qos, path, length)) in (61..).zip(all) {
        let (mut world, pair) = attached(seed, qos, path.clone());
        // The rate is three times that of the path. Small samples come as fast as the test's clock permits.
        let every = Duration::from_secs_f64(length as f64 / 6_000_000.0).max(millis(1));
        let end = world.now + secs(8);
        while world.now < end {
            assert!(world.publish(pair, length));
            world.run_for(every);
        }
        world.run_for(secs(30));
        let (host, publisher) = pair.publisher;
        let published = world.hosts[host].rings.published(publisher);
        let received = world.received(pair).len() as u64;
        let case = format!("{qos:?}, {length} bytes: {received} of {published}");
        assert_eq!(counted(&world, "/t"), published - received, "{case} {}", world.describe());
    }
}

/// Publishes a burst that fits the depth into a link that is cut for `cut`. `rings` says whether the engine is rung for
/// each sample or only for the last one. Returns the number of samples that arrived.
fn burst_into_a_cut(cut: Duration, rings: bool) -> (u64, u64) {
    let qos = Qos::default().with_depth(1024);
    let (mut world, pair) = attached(70, qos, Path { delay: millis(2), ..Path::default() });
    let broken = world.network.partition(&[0], None);
    let (host, publisher) = pair.publisher;
    for _ in 0..1024 {
        assert!(world.hosts[host].rings.publish(publisher, 4096));
        if rings {
            world.hosts[host].ring();
            world.run_for(Duration::from_micros(20));
        }
    }
    world.hosts[host].ring();
    world.run_for(cut);
    world.network.heal(broken);
    world.run_for(secs(5));
    let received = world.received(pair);
    (received.len() as u64, counted(&world, "/t"))
}

#[test]
fn a_burst_within_the_depth_outlasts_a_cut() {
    for cut in [millis(300), secs(2), secs(5), secs(20), secs(60)] {
        for rings in [false, true] {
            let arrived = burst_into_a_cut(cut, rings);
            assert_eq!(arrived, (1024, 0), "{cut:?}, {rings}");
        }
    }
}
