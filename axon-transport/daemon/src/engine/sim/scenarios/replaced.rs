//! The last publisher of a topic ends, and another one of the same host comes soon after, or its subscription is out of
//! range meanwhile. A subscription ends at the same time as its daemon.

use axon_shm::qos::Qos;
use axon_transport::config::DiscoveryRange;

use crate::engine::sim::{
    network::Path,
    tests::{classic, millis, modes, secs},
    world::{Pair, World},
};

#[test]
fn no_sample_of_a_new_publisher_is_lost_with_the_route_of_the_one_before() {
    for (mode, config) in modes() {
        let mut world = World::new(90, 2, &config);
        world.network.set_default_path(Path { delay: millis(30), ..Path::default() });
        let first = world.pair(0, 1, "/topic", Qos::keep_all());
        world.until(secs(20), World::is_whole);
        let (subscriber, mut before) = (first.subscription, first.publisher.1);
        for pause in (0..250).step_by(10) {
            world.run_for(secs(3));
            world.hosts[0].rings.end(before);
            world.hosts[0].touch_graph();
            world.run_for(millis(pause));
            let publisher = world.hosts[0].rings.create_publisher("/topic", Qos::keep_all());
            world.hosts[0].touch_graph();
            let pair = Pair { publisher: (0, publisher), subscription: subscriber };
            for _ in 0..30 {
                assert!(world.publish(pair, 100), "{mode}, {pause}: {}", world.describe());
                world.run_for(millis(10));
            }
            world.run_for(secs(3));
            let promised = world.hosts[0].rings.promised(publisher, subscriber.1);
            let (last, given_up) = (promised.last(), world.hosts[0].rings.given_up(publisher));
            assert_eq!(last, Some(&30), "{mode}, {pause}: it was matched");
            assert_eq!(world.received(pair), promised, "{mode}, {pause} ms: {given_up} given up");
            before = publisher;
        }
    }
}

#[test]
fn a_route_without_a_publisher_ends_when_its_subscription_is_out_of_range() {
    for (denies, most) in [(false, 1), (true, 0)] {
        let mut world = World::new(93, 2, classic);
        let pair = world.pair(0, 1, "/topic", Qos::keep_all());
        world.until(secs(20), World::is_whole);
        world.run_for(secs(1));
        world.hosts[0].rings.end(pair.publisher.1);
        world.hosts[0].touch_graph();
        world.run_for(secs(3));
        assert_eq!(world.hosts[0].served_routes(), 1, "the next publisher needs it");
        if denies {
            world.hosts[1].set_range(DiscoveryRange::Localhost);
        }
        world.run_for(secs(3));
        assert_eq!(world.hosts[0].served_routes(), most, "{denies}: {}", world.describe());
    }
}

#[test]
fn samples_for_a_subscription_that_ended_with_its_daemon_are_not_lost() {
    for (mode, config) in modes() {
        for ends in [true, false] {
            let mut world = World::new(94, 2, &config);
            let pair = world.pair(0, 1, "/topic", Qos::keep_all());
            let other = world.pair(0, 1, "/other", Qos::keep_all());
            world.until(secs(20), World::is_whole);
            world.run_for(secs(1));
            world.network.partition(&[1], None);
            for _ in 0..20 {
                assert!(world.publish(pair, 100) && world.publish(other, 100));
                world.run_for(millis(10));
            }
            if ends {
                world.hosts[1].rings.end(pair.subscription.1);
            }
            world.kill(1, false);
            world.run_for(secs(2));
            world.restart(1);
            world.network.heal_all();
            world.run_for(secs(20));
            let rings = &world.hosts[0].rings;
            let case = format!("{mode}, ends: {ends}: {}", world.describe());
            assert_eq!(rings.given_up(pair.publisher.1), 0, "{case}");
            assert_eq!(rings.given_up(other.publisher.1), 0, "{case}");
            assert_eq!(world.received(other).len(), 20, "{case}");
            assert_eq!(world.received(pair).len(), if ends { 0 } else { 20 }, "{case}");
            assert_eq!(world.hosts[0].kept(), 0, "{case}");
        }
    }
}
