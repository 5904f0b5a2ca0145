//! Tests compression: compressed samples cross a slow link faster, and none is lost or out of order. A fast link
//! carries samples as they are.
//!
//! Samples of topics below `/text` become about a third as long, samples of other topics do not become shorter.

#![allow(clippy::print_stdout, reason = "a scenario prints its figures")]

use std::time::Duration;

use axon_shm::qos::Qos;
use axon_transport::{
    access::TopicPattern,
    config::{Config, LinkCompression, TopicPriority, TopicRule},
};

use super::radio::{Stream, drive, radio};
use crate::engine::sim::{
    network::{Path, Rate},
    tests::{Settings, classic, millis, modes, secs},
    world::World,
};

/// Starts a stream of samples of `length` bytes over a link of `mbits` Mbit/s, and waits until it flows.
fn stream(
    config: impl Fn(usize) -> Config,
    mbits: u64,
    topic: &str,
    qos: Qos,
    length: usize,
) -> (World, [Stream; 1]) {
    let mut world = World::new(90, 2, config);
    world.network.set_default_path(radio(mbits, 0.0));
    // The stream has twice the link's rate.
    let every = Duration::from_secs_f64(length as f64 * 4.0 / (mbits as f64 * 1e6));
    let mut streams = [Stream::new(&mut world, topic, qos, length, every)];
    world.until(secs(20), World::is_whole);
    world.run_for(secs(1));
    drive(&mut world, &mut streams, secs(2));
    (world, streams)
}

/// Returns the rate of the stream in the next four seconds, as a share of the link's rate. The samples' uncompressed
/// length counts.
fn share(world: &mut World, streams: &mut [Stream; 1], mbits: u64) -> f64 {
    let before = streams[0].seen;
    drive(world, streams, secs(4));
    let bytes = (streams[0].seen - before) * streams[0].length;
    bytes as f64 * 8.0 / 4.0 / (mbits as f64 * 1e6)
}

/// Returns the number of samples that the first host compressed.
fn compressions(world: &World) -> u64 {
    world.hosts[0].compressions
}

#[test]
fn compressible_samples_cross_slow_links_faster_and_others_as_fast_as_before() {
    for (mode, config) in modes() {
        for (mbits, length) in [(8, 6_000), (54, 20_000), (54, 300_000)] {
            let (mut world, mut text) = stream(&config, mbits, "/text", Qos::keep_all(), length);
            let of_text = share(&mut world, &mut text, mbits);
            let (mut world, mut noise) = stream(&config, mbits, "/noise", Qos::keep_all(), length);
            let (before, seen) = (compressions(&world), noise[0].seen);
            let of_noise = share(&mut world, &mut noise, mbits);
            let tried = compressions(&world) - before;
            let sent = (noise[0].seen - seen) as u64;
            let case = format!("{mode}, {mbits} Mbit/s, {length} bytes");
            println!("{case}: {of_text:.2} and {of_noise:.2}; {tried} of {sent} were tried");
            // Twice the link's rate is published.
            assert!(of_text > 1.9, "{case}: {of_text}");
            assert!(of_noise > 0.85, "{case}: {of_noise}");
            assert!(tried <= sent / 60 + 2, "{case}: {tried} of {sent}");
        }
    }
}

#[test]
fn compressed_samples_of_best_effort_are_as_fresh_as_others() {
    for depth in [1, 5] {
        let qos = Qos::sensor_data().with_depth(depth);
        let (mut world, mut text) = stream(classic, 54, "/text", qos, 512_000);
        let begun = world.now;
        let of_text = share(&mut world, &mut text, 54);
        let ages = text[0].ages(begun);
        let median = ages[ages.len() / 2];
        println!("depth {depth}: {of_text:.2}, median age {median:.1?}");
        assert!(of_text > 1.8, "depth {depth}: {of_text}");
        // One takes 76 ms as it is.
        assert!(median < millis(76), "depth {depth}: {median:?}");
    }
}

/// Samples that come faster than one is compressed: each newer one takes the place of the last, and some are sent all the same.
#[test]
fn samples_that_are_replaced_while_they_are_compressed_arrive_nevertheless() {
    for qos in [Qos::sensor_data().with_depth(1), Qos::default().with_depth(1)] {
        let mut world = World::new(91, 2, classic);
        world.network.set_default_path(radio(8, 0.0));
        // 300 kB take a millisecond to compress, and three come in it.
        let every = Duration::from_micros(300);
        let mut streams = [Stream::new(&mut world, "/text", qos, 300_000, every)];
        world.until(secs(20), World::is_whole);
        world.run_for(secs(1));
        drive(&mut world, &mut streams, secs(3));
        assert!(compressions(&world) > 0);
        let before = streams[0].seen;
        drive(&mut world, &mut streams, secs(2));
        let seen = streams[0].seen - before;
        // Three samples a second cross uncompressed, and more than twice as many compressed.
        assert!(seen > 12, "{qos:?}: {seen}");
    }
}

#[test]
fn a_fast_link_and_one_that_is_not_full_carry_samples_as_they_are() {
    let (mut world, mut streams) = stream(classic, 2_000, "/text", Qos::keep_all(), 100_000);
    drive(&mut world, &mut streams, secs(1));
    assert_eq!(compressions(&world), 0, "2 Gbit/s");
    let mut world = World::new(92, 2, classic);
    world.network.set_default_path(radio(54, 0.0));
    let mut streams = [Stream::new(&mut world, "/text", Qos::keep_all(), 10_000, millis(20))];
    world.until(secs(20), World::is_whole);
    world.run_for(secs(1));
    drive(&mut world, &mut streams, secs(5));
    assert_eq!(compressions(&world), 0, "4 of 54 Mbit/s");
}

#[test]
fn nothing_is_compressed_where_the_settings_say_so() {
    let of_link = |_| {
        let mut config = Config::default();
        config.link.compression = LinkCompression::Never;
        config
    };
    let of_topic = |_| {
        let mut config = Config::default();
        let name = TopicPattern::new("/text/**").unwrap();
        config.topics = vec![TopicRule::new(name, TopicPriority::Normal).uncompressed()];
        config
    };
    let settings: [Settings; 2] = [Box::new(of_link), Box::new(of_topic)];
    for config in settings {
        let (mut world, mut streams) = stream(config, 54, "/text/secret", Qos::keep_all(), 20_000);
        let share = share(&mut world, &mut streams, 54);
        assert!(compressions(&world) == 0 && share < 1.0, "{share}");
    }
}

#[test]
fn a_sample_for_several_peers_is_compressed_once() {
    let mut world = World::new(93, 4, classic);
    world.network.set_default_path(radio(54, 0.0));
    let mut streams = [Stream::new(&mut world, "/text", Qos::keep_all(), 20_000, millis(1))];
    for host in [2, 3] {
        world.hosts[host].rings.create_subscription("/text", Qos::keep_all(), None);
        world.hosts[host].touch_graph();
    }
    world.until(secs(20), World::is_whole);
    world.run_for(secs(1));
    drive(&mut world, &mut streams, secs(4));
    let (samples, compressions) = (streams[0].published() as u64, compressions(&world));
    println!("{samples} samples for three peers, {compressions} compressions");
    assert!(samples > 500 && compressions <= samples + samples / 10, "{compressions} of {samples}");
}

/// Short ones of the same publisher are not compressed, and go over streams with short headers until the first long one.
#[test]
fn short_and_compressed_samples_of_a_publisher_keep_their_order() {
    for (mode, config) in modes() {
        let mut world = World::new(94, 2, config);
        let rate = Some(Rate::new(2_000_000, millis(40)));
        world.network.set_default_path(Path {
            rate,
            delay: millis(10),
            loss: 0.02,
            ..Path::default()
        });
        let pair = world.pair(0, 1, "/text", Qos::keep_all());
        world.until(secs(20), World::is_whole);
        world.run_for(secs(2));
        let mut published = 0;
        for round in 0..4_000_u64 {
            let length = [10, 500, 2_000, 40_000, 100][(round % 5) as usize];
            published += u64::from(world.publish(pair, length));
            world.run_for(millis(1));
        }
        world.run_for(secs(20));
        let received = world.received(pair);
        assert!(received.iter().copied().eq(1..=published), "{mode}: {}", world.describe());
        assert!(compressions(&world) > 100, "{mode}: {}", compressions(&world));
    }
}

/// A path that is cut for longer than a second is replaced: another link goes on with the samples.
#[test]
fn a_link_that_is_replaced_while_samples_are_compressed_loses_none() {
    for (mode, config) in modes() {
        for seed in 95..98 {
            let mut world = World::new(seed, 2, &config);
            world.network.set_default_path(radio(8, 0.0));
            let pair = world.pair(0, 1, "/text", Qos::keep_all());
            world.until(secs(20), World::is_whole);
            world.run_for(secs(2));
            let mut published = 0;
            for round in 0..6_000 {
                published += u64::from(world.publish(pair, 200_000));
                if round % 1_500 == 700 {
                    let cut = world.network.partition(&[0], None);
                    world.run_for(millis(1_500));
                    world.network.heal(cut);
                }
                world.run_for(millis(2) + Duration::from_micros(seed * 7));
            }
            world.until(secs(120), |world| world.received(pair).len() as u64 >= published);
            let received = world.received(pair);
            let whole = received.iter().copied().eq(1..=published);
            assert!(whole, "{mode}, {seed}: {}", world.describe());
            assert!(compressions(&world) > 10, "{mode}, {seed}");
        }
    }
}

/// The first sample of a flow is short, and a packet with the beginning of its stream may be lost. The next one is compressed
/// and needs a stream without short headers.
#[test]
fn a_compressed_sample_overtakes_no_short_one_before_it() {
    let mut world = World::new(99, 2, classic);
    let path = Path { loss: 0.2, ..radio(8, 0.0) };
    world.network.set_default_path(path);
    let every = millis(20);
    let mut noise = [Stream::new(&mut world, "/noise", Qos::sensor_data(), 40_000, every)];
    world.until(secs(60), World::is_whole);
    world.run_for(secs(1));
    drive(&mut world, &mut noise, secs(3));
    let mut flows = Vec::new();
    for number in 0..60 {
        let pair = world.pair(0, 1, &format!("/text/{number}"), Qos::keep_all());
        drive(&mut world, &mut noise, millis(700));
        let before = compressions(&world);
        assert!(world.publish(pair, 500) && world.publish(pair, 40_000));
        drive(&mut world, &mut noise, millis(300));
        flows.push((pair, compressions(&world) > before));
    }
    world.run_for(secs(20));
    let compressed = flows.iter().filter(|(_, compressed)| *compressed).count();
    println!("{compressed} of 60 were compressed");
    assert!(compressed > 20, "{compressed} of 60");
    for (number, (pair, _)) in flows.iter().enumerate() {
        assert_eq!(world.received(*pair), [1, 2], "/text/{number}: {}", world.describe());
    }
}

/// Other samples take their turns on the link, and QUIC takes them at once.
#[test]
fn samples_are_compressed_beside_those_of_a_topic_that_never_waits() {
    let mut world = World::new(100, 2, classic);
    world.network.set_default_path(radio(54, 0.0));
    let every = millis(3);
    let mut streams = [
        Stream::new(&mut world, "/text", Qos::keep_all(), 40_000, every),
        Stream::new(&mut world, "/tf", Qos::keep_all(), 100, millis(10)),
    ];
    world.until(secs(20), World::is_whole);
    world.run_for(secs(1));
    drive(&mut world, &mut streams, secs(2));
    let (before, begun) = (compressions(&world), world.now);
    drive(&mut world, &mut streams, secs(2));
    let of_text = compressions(&world) - before;
    let ages = streams[1].ages(begun);
    println!(
        "{of_text} were compressed; the other topic's median age is {:?}",
        ages[ages.len() / 2]
    );
    assert!(of_text > 500, "{of_text}");
}
