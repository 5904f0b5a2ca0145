//! Tests `[[topic]] priority`: the order over a link that cannot carry all samples.

#![allow(clippy::print_stdout, reason = "a scenario prints its figures")]

use std::time::Duration;

use axon_shm::qos::Qos;
use axon_transport::config::{Config, TopicPattern, TopicPriority, TopicRule};

use super::radio::{Stream, drive, radio, secs};
use crate::engine::sim::world::World;

/// Creates two hosts over `mbits` Mbit/s, where topics below `/high` and `/low` have that priority.
fn hosts(mbits: u64) -> World {
    let mut world = World::new(22, 2, |_| {
        let mut config = Config::default();
        for (name, priority) in [("/high/**", TopicPriority::High), ("/low/**", TopicPriority::Low)]
        {
            config.topics.push(TopicRule::new(TopicPattern::new(name).unwrap(), priority));
        }
        config
    });
    world.network.set_default_path(radio(mbits, 0.0));
    world
}

/// Waits until both hosts know each stream, and a second more.
fn ready(world: &mut World) {
    world.until(secs(20), World::is_whole);
    world.run_for(secs(1));
}

#[test]
fn streams_have_the_link_by_their_priority_and_none_starves() {
    let mut world = hosts(54);
    let every = Duration::from_millis(1);
    let mut streams = ["/high/log", "/log", "/low/log"]
        .map(|topic| Stream::new(&mut world, topic, Qos::keep_all(), 16 << 10, every));
    ready(&mut world);
    drive(&mut world, &mut streams, secs(4));
    let before = streams.each_ref().map(|stream| stream.seen);
    drive(&mut world, &mut streams, secs(8));
    let bytes = |number: usize| (streams[number].seen - before[number]) * streams[number].length;
    let [high, normal, low] = [0, 1, 2].map(|number| bytes(number) as f64 * 8.0 / 8.0 / 54e6);
    println!("high {high:.2}, normal {normal:.2}, low {low:.2} of the rate");
    assert!(high > 0.6 && normal > 0.01 && low > 0.01, "{high} {normal} {low}");
    assert!(high + normal + low > 0.85, "{high} {normal} {low}");
}

#[test]
fn short_samples_that_fill_a_link_share_it_with_long_ones() {
    let mut world = hosts(10);
    let mut streams = [
        Stream::new(&mut world, "/short", Qos::keep_all(), 2 << 10, Duration::from_millis(1)),
        Stream::new(&mut world, "/long", Qos::keep_all(), 64 << 10, Duration::from_millis(1)),
    ];
    ready(&mut world);
    drive(&mut world, &mut streams, secs(2));
    let before = streams.each_ref().map(|stream| stream.seen);
    drive(&mut world, &mut streams, secs(4));
    let bytes = |number: usize| (streams[number].seen - before[number]) * streams[number].length;
    let [short, long] = [0, 1].map(|number| bytes(number) as f64 * 8.0 / 4.0 / 10e6);
    println!("short {short:.2}, long {long:.2} of the rate");
    assert!(short > 0.35 && long > 0.35, "{short} {long}");
}

#[test]
fn a_topic_of_high_priority_is_fresh_beside_a_flood() {
    let camera = |topic: &str, flood: &str| {
        let mut world = hosts(54);
        // 16 Mbit/s beside as much as the link takes.
        let every = Duration::from_millis(33);
        let mut streams = [
            Stream::new(&mut world, topic, Qos::default(), 64 << 10, every),
            Stream::new(&mut world, flood, Qos::keep_all(), 64 << 10, Duration::from_millis(1)),
        ];
        ready(&mut world);
        drive(&mut world, &mut streams, secs(3));
        let (from, published) = (world.now, streams[0].published());
        drive(&mut world, &mut streams, secs(8));
        let ages = streams[0].ages(from);
        let share = ages.len() as f64 / (streams[0].published() - published) as f64;
        println!(
            "{topic} beside {flood}: {share:.2} arrive, median age {:?}",
            ages[ages.len() / 2]
        );
        (share, ages[ages.len() / 2])
    };
    let (_, same) = camera("/camera", "/log");
    for (topic, flood) in [("/high/camera", "/log"), ("/camera", "/low/log")] {
        let (share, age) = camera(topic, flood);
        assert!(share > 0.99 && age < same, "{share} {age:?}, without priority {same:?}");
        assert!(age < Duration::from_millis(60), "{age:?}");
    }
}
