//! Scenarios.

use std::time::Duration;

use axon_shm::qos::Qos;
use axon_transport::config::{Config, KeyMode};

use super::{network::Path, world::World};
use crate::engine::keyring::tests::config as qkd;

fn secs(seconds: u64) -> Duration {
    Duration::from_secs(seconds)
}

fn millis(millis: u64) -> Duration {
    Duration::from_millis(millis)
}

fn classic(_host: usize) -> Config {
    Config::default()
}

/// All modes that a link can have here.
fn modes() -> Vec<(&'static str, Box<dyn Fn(usize) -> Config>)> {
    let of = |mode| move |host: usize| qkd(&format!("sae-{host}"), mode);
    vec![
        ("classic", Box::new(classic)),
        ("session", Box::new(of(KeyMode::Session))),
        ("messages10", Box::new(of(KeyMode::Messages10))),
    ]
}

#[test]
fn two_hosts_link_and_know_each_other() {
    for (mode, config) in modes() {
        let mut world = World::new(1, 2, config);
        world.hosts[0].rings.create_publisher("/t", Qos::default());
        world.until(secs(5), World::is_whole);
        assert!(world.hosts[0].refusals.is_empty(), "{mode}: {}", world.describe());
    }
}

#[test]
fn all_samples_of_keep_all_arrive_in_order() {
    for (mode, config) in modes() {
        let mut world = World::new(2, 2, config);
        let pair = world.pair(0, 1, "/t", Qos::keep_all());
        world.until(secs(5), World::is_whole);
        world.run_for(secs(1));
        for _ in 0..500 {
            world.publish(pair, 100);
            world.run_for(millis(2));
        }
        world.run_for(secs(5));
        let expected: Vec<u64> = (1..=500).collect();
        assert_eq!(world.received(pair), expected, "{mode}: {}", world.describe());
    }
}

#[test]
fn all_samples_arrive_over_a_lossy_path() {
    let mut world = World::new(3, 2, classic);
    let path = Path { loss: 0.05, delay: millis(10), jitter: millis(2), ..Path::default() };
    world.network.set_default_path(path);
    let pair = world.pair(0, 1, "/t", Qos::keep_all());
    world.until(secs(20), World::is_whole);
    world.run_for(secs(1));
    let mut published = 0;
    for _ in 0..300 {
        published += u64::from(world.publish(pair, 3000));
        world.run_for(millis(5));
    }
    world.run_for(secs(20));
    assert_eq!(world.received(pair).len() as u64, published, "{}", world.describe());
}

#[test]
fn a_daemon_that_is_killed_and_started_again_links_again() {
    let mut world = World::new(4, 3, classic);
    world.pair(0, 1, "/t", Qos::default());
    world.until(secs(5), World::is_whole);
    world.kill(1);
    world.run_for(millis(500));
    world.restart(1);
    world.until(secs(30), World::is_whole);
}
