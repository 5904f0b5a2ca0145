//! More long messages at one time than the receiver has memory for: all arrive, and small ones do not wait for them.

use std::time::Duration;

use axon_shm::qos::Qos;
use axon_transport::config::Config;
use bytes::Bytes;

use super::memory::{gid, raw_publishers};
use crate::engine::{
    sample::stream_header::StreamHeader,
    sim::{
        network::{Path, Rate},
        tests::{all_cases, millis, secs, setting},
        world::{Pair, World},
    },
};

const MIB: usize = 1 << 20;

/// Seeds of each scenario.
fn seeds() -> std::ops::Range<u64> {
    let first = setting("LONG_FIRST", 84);
    first..first + setting("LONG_SEEDS", if all_cases() { 30 } else { 1 })
}

/// Creates two hosts, the first of which has `publishers` publishers for the second.
fn pairs(seed: u64, publishers: usize) -> (World, Vec<Pair>) {
    let mut world = World::new(seed, 2, |_| Config::default());
    let rate = Rate::new(1_000_000_000, millis(20));
    let path = Path { delay: millis(5), rate: Some(rate), loss: 0.01, ..Path::default() };
    world.network.set_default_path(path);
    let pairs = (0..publishers)
        .map(|number| world.pair(0, 1, &format!("/topic_{number}"), Qos::keep_all()))
        .collect();
    world.until(secs(20), World::is_whole);
    world.run_for(secs(3));
    (world, pairs)
}

/// Returns whether the samples 1 to `samples` of each pair came, in order.
fn have(world: &World, pairs: &[Pair], samples: u64) -> bool {
    pairs.iter().all(|pair| world.received(*pair).iter().copied().eq(1..=samples))
}

fn publish(world: &mut World, pairs: &[Pair], length: usize) {
    for pair in pairs {
        assert!(world.publish(*pair, length));
    }
}

#[test]
fn long_messages_of_many_topics_at_one_time_arrive() {
    for seed in seeds() {
        let of_few = [(20, 8 * MIB, 1), (2, 60 * MIB, 2), (60, 3 * MIB, 2)];
        let sample = [(6, 40 * MIB, 1), (200, 300 << 10, 3)];
        let of_few = of_few.into_iter().filter(|_| all_cases());
        for (publishers, length, rounds) in of_few.chain(sample) {
            let (mut world, pairs) = pairs(seed, publishers);
            (0..rounds).for_each(|_| publish(&mut world, &pairs, length));
            let most = Duration::from_secs(60);
            world.until(most, |world| have(world, &pairs, rounds));
            assert!(
                !world.hosts.iter().any(|h| h.refusals.iter().any(|(_, t)| t.contains("long")))
            );
        }
    }
}

#[test]
fn long_messages_of_different_lengths_do_not_keep_each_other_out() {
    for seed in seeds() {
        let (mut world, pairs) = pairs(seed, 24);
        let (long, short) = pairs.split_at(2);
        let mut rounds = 0;
        // The shorter ones never rest, so that the long ones always find some in flight.
        publish(&mut world, &long[..1], 60 * MIB);
        let until = world.now + secs(20);
        while world.received(long[0]).is_empty() {
            assert!(world.now < until, "{}", world.describe());
            if have(&world, &short[..11], rounds) {
                publish(&mut world, &short[..11], 4 * MIB);
                rounds += 1;
            }
            for pair in &short[11..] {
                world.publish(*pair, 2 * MIB);
            }
            world.run_for(millis(20));
        }
    }
}

/// Publishes commands for so long, and returns how long the slowest took.
fn commands(world: &mut World, command: Pair, count: u64) -> Duration {
    let (mut slowest, first) = (Duration::ZERO, world.received(command).len() as u64);
    for number in 1..=count {
        assert!(world.publish(command, 100));
        let begun = world.now;
        world.until(secs(30), |world| world.received(command).len() as u64 >= first + number);
        slowest = slowest.max(world.now - begun);
        world.run_for(millis(5));
    }
    slowest
}

#[test]
fn commands_overtake_long_messages() {
    for seed in seeds() {
        let (mut world, pairs) = pairs(seed, 21);
        let (command, images) = pairs.split_first().unwrap();
        publish(&mut world, images, 8 * MIB);
        world.run_for(millis(100));
        let slowest = commands(&mut world, *command, 50);
        assert!(slowest < millis(200), "{slowest:?} with seed {seed}");
        world.until(secs(60), |world| have(world, images, 1));
    }
}

#[test]
fn commands_and_long_messages_pass_readers_that_stopped() {
    for seed in seeds() {
        let (mut world, pairs) = pairs(seed, 4);
        let (command, images) = pairs.split_first().unwrap();
        let mut stopped = Vec::new();
        for number in 0..5 {
            let topic = format!("/stopped_{number}");
            let publisher = world.hosts[0].rings.create_publisher(&topic, Qos::keep_all());
            world.hosts[1].rings.create_subscription(&topic, Qos::keep_all(), Some(0));
            stopped.push(publisher);
        }
        (0..2).for_each(|host| world.hosts[host].touch_graph());
        world.run_for(secs(3));
        for publisher in stopped {
            assert!(world.hosts[0].rings.publish(publisher, 8 * MIB));
        }
        world.hosts[0].ring();
        world.run_for(secs(1));
        publish(&mut world, images, 8 * MIB);
        let slowest = commands(&mut world, *command, 50);
        assert!(slowest < millis(200), "{slowest:?} with seed {seed}");
        // Before the readers that stopped are given up.
        world.until(secs(5), |world| have(world, images, 1));
    }
}

#[test]
fn long_messages_arrive_over_a_successor_of_a_link_that_broke_within_them() {
    for seed in seeds() {
        let (mut world, pairs) = pairs(seed, 20);
        for pause in [50, 200, 700] {
            publish(&mut world, &pairs, 8 * MIB);
            world.run_for(millis(pause));
            let cut = world.network.partition(&[0], None);
            world.run_for(secs(3));
            world.network.heal(cut);
            world.run_for(millis(pause));
        }
        world.until(secs(60), |world| have(world, &pairs, 3));
    }
}

#[test]
fn publishers_and_readers_that_end_within_long_messages_keep_no_others_out() {
    for seed in seeds() {
        let (mut world, pairs) = pairs(seed, 30);
        let (ending, staying) = pairs.split_at(10);
        publish(&mut world, &pairs, 8 * MIB);
        for (number, pair) in ending.iter().enumerate() {
            world.run_for(millis(20));
            let (host, gid) = if number % 2 == 0 { pair.publisher } else { pair.subscription };
            world.hosts[host].rings.end(gid);
            world.hosts[host].touch_graph();
        }
        world.until(secs(60), |world| have(world, staying, 1));
    }
}

#[test]
fn peer_with_too_many_long_messages_in_flight_is_named_and_bounded() {
    const MANY: u32 = 200;
    let (mut world, number, route) = raw_publishers(87, MANY);
    let body = Bytes::from(vec![0x5a; 300 << 10]);
    for publisher in 0..MANY {
        world.with_raw(0, |raw, _| {
            let header = StreamHeader::plain(route, gid(0xf0, publisher));
            let mut bytes = header.encode().to_vec();
            bytes.extend_from_slice(&(8_u32 << 20).to_be_bytes());
            bytes.extend_from_slice(&body);
            raw.links[number].open(bytes).expect("a stream");
        });
    }
    world.run_for(secs(5));
    let held = world.hosts[0].held_of_messages();
    assert!(held <= 65 * MIB, "{} MiB", held / MIB);
    let named = |world: &World| {
        world.hosts[0].refusals.iter().filter(|(_, text)| text.contains("long messages")).count()
    };
    assert_eq!(named(&world), 1, "{}", world.describe());
    world.run_for(secs(20));
    assert_eq!(named(&world), 1, "{}", world.describe());
    assert!(world.raws[0].links[number].closed.is_none(), "{}", world.describe());
}
