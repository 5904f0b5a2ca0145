//! Scenarios of paths that lose packets, become slow, or are filled by a camera.

#![allow(clippy::print_stdout, reason = "a scenario prints its figures")]

use std::time::Duration;

use axon_shm::qos::Qos;
use axon_transport::config::{Config, Congestion};

use crate::engine::sim::{
    network::{BurstLoss, Path, Rate},
    world::{Pair, World},
};

pub(super) fn secs(seconds: u64) -> Duration {
    Duration::from_secs(seconds)
}

/// Returns a radio link of `mbits` Mbit/s, with a round trip of 3 ms, a queue of 40 ms, and the loss `loss` both ways.
pub(super) fn radio(mbits: u64, loss: f64) -> Path {
    let rate = Rate::new(mbits * 1_000_000 / 8, Duration::from_millis(40));
    Path { delay: Duration::from_micros(1_500), rate: Some(rate), loss, ..Path::default() }
}

/// Returns the same link with losses in bursts of `packets` packets on average (Gilbert's model).
fn bursts(mbits: u64, loss: f64, packets: f64) -> Path {
    let bad_to_good = 1.0 / packets;
    let good_to_bad = bad_to_good * loss / (1.0 - loss);
    let burst_loss = Some(BurstLoss { good_to_bad, bad_to_good, loss_in_bad: 1.0 });
    Path { burst_loss, ..radio(mbits, 0.0) }
}

/// Creates two linked hosts with this controller.
fn hosts(congestion: Congestion, path: Path) -> World {
    hosts_of(21, congestion, path)
}

/// Creates the same hosts, with the random numbers of this seed.
fn hosts_of(seed: u64, congestion: Congestion, path: Path) -> World {
    let mut world = World::new(seed, 2, move |_| {
        let mut config = Config::default();
        config.link.congestion = congestion;
        config
    });
    world.network.set_default_path(path);
    world
}

/// Samples that are published at a rate.
pub(super) struct Stream {
    pair: Pair,
    pub(super) length: usize,
    every: Duration,
    next: Duration,
    published: Vec<Duration>,
    pub(super) seen: usize,
    /// When each sample arrived, and its age then.
    arrived: Vec<(Duration, Duration)>,
}

impl Stream {
    pub(super) fn new(
        world: &mut World,
        topic: &str,
        qos: Qos,
        length: usize,
        every: Duration,
    ) -> Self {
        let pair = world.pair(0, 1, topic, qos);
        let (published, arrived) = (Vec::new(), Vec::new());
        Self { pair, length, every, next: Duration::ZERO, published, seen: 0, arrived }
    }

    /// Returns the number of published samples.
    pub(super) fn published(&self) -> usize {
        self.published.len()
    }

    /// Returns the sorted ages of the samples that arrived from `from` on.
    pub(super) fn ages(&self, from: Duration) -> Vec<Duration> {
        let arrived = self.arrived.iter().filter(|(at, _)| *at >= from);
        let mut ages: Vec<_> = arrived.map(|(_, age)| *age).collect();
        ages.sort_unstable();
        ages
    }
}

/// Publishes these streams for a time.
pub(super) fn drive(world: &mut World, streams: &mut [Stream], time: Duration) {
    let end = world.now + time;
    while world.now < end {
        for stream in &mut *streams {
            stream.next = stream.next.max(world.now.saturating_sub(stream.every));
            while stream.next <= world.now {
                if world.publish(stream.pair, stream.length) {
                    stream.published.push(world.now);
                }
                stream.next += stream.every;
            }
        }
        world.run_for(Duration::from_millis(1));
        for stream in &mut *streams {
            let received = world.received(stream.pair);
            for number in &received[stream.seen..] {
                let age = world.now - stream.published[*number as usize - 1];
                stream.arrived.push((world.now, age));
            }
            stream.seen = received.len();
        }
    }
}

/// Starts a stream without a rate of its own, as soon as both hosts know it.
fn flood(world: &mut World) -> [Stream; 1] {
    let every = Duration::from_millis(1);
    let stream = Stream::new(world, "/log", Qos::keep_all(), 16 << 10, every);
    world.until(secs(20), World::is_whole);
    world.run_for(secs(1));
    [stream]
}

/// Returns the share of 54 Mbit/s that a stream gets through in the next four seconds.
fn share(world: &mut World, streams: &mut [Stream; 1]) -> f64 {
    let before = streams[0].seen;
    drive(world, streams, secs(4));
    let bytes = (streams[0].seen - before) * streams[0].length;
    bytes as f64 * 8.0 / 4.0 / 54e6
}

/// Returns the share of 54 Mbit/s that a stream without a rate of its own gets through.
fn goodput(congestion: Congestion, path: Path) -> f64 {
    goodput_of(hosts(congestion, path))
}

fn goodput_of(mut world: World) -> f64 {
    let mut streams = flood(&mut world);
    drive(&mut world, &mut streams, secs(4));
    share(&mut world, &mut streams)
}

#[test]
fn random_loss_leaves_a_link_its_rate() {
    for (loss, least) in [(0.05, 0.75), (0.2, 0.6), (0.4, 0.35)] {
        let [delay, cubic] = [Congestion::Delay, Congestion::Cubic]
            .map(|congestion| goodput(congestion, radio(54, loss)));
        println!("loss {loss}: delay {delay:.2}, cubic {cubic:.2}");
        assert!(delay > least, "loss {loss}: {delay}");
        assert!(cubic < delay / 2.0, "loss {loss}: cubic {cubic}, delay {delay}");
    }
}

#[test]
fn losses_in_bursts_leave_a_link_its_rate() {
    for (loss, least) in [(0.05, 0.7), (0.1, 0.55), (0.2, 0.3)] {
        let of = |seed| goodput_of(hosts_of(seed, Congestion::Delay, bursts(54, loss, 8.0)));
        let shares = [21, 22, 23, 24, 25, 26].map(of);
        println!("{shares:.2?}");
        let share = shares.iter().sum::<f64>() / shares.len() as f64;
        println!("loss {loss} in bursts of 8: {share:.2}");
        assert!(share > least, "loss {loss}: {share}");
    }
}

#[test]
fn a_path_that_becomes_longer_has_its_rate_again() {
    let mut world = hosts(Congestion::Delay, radio(54, 0.02));
    let mut streams = flood(&mut world);
    drive(&mut world, &mut streams, secs(3));
    let longer = Path { delay: Duration::from_millis(40), ..radio(54, 0.02) };
    world.network.set_default_path(longer);
    drive(&mut world, &mut streams, secs(12));
    let share = share(&mut world, &mut streams);
    println!("{share:.2} of the rate over a path of 80 ms");
    assert!(share > 0.5, "{share}");
}

#[test]
fn a_path_of_long_packets_is_used() {
    let mut world = World::new(22, 2, |_| {
        let mut config = Config::default();
        config.link.mtu = 8_952;
        config
    });
    world.network.set_default_path(Path { mtu: 9_000, ..radio(54, 0.0) });
    let mut streams = flood(&mut world);
    drive(&mut world, &mut streams, secs(4));
    let share = share(&mut world, &mut streams);
    println!("{share:.2} of the rate with packets of 8,952 bytes");
    assert!(share > 0.75, "{share}");
}

#[test]
fn a_command_is_quick_beside_a_camera_that_fills_the_link() {
    let mut world = hosts(Congestion::Auto, radio(54, 0.0));
    let camera = Qos::default().with_depth(1);
    let frame = Duration::from_micros(33_333);
    let camera = Stream::new(&mut world, "/camera", camera, 830_000, frame);
    let every = Duration::from_millis(10);
    let command = Stream::new(&mut world, "/cmd_vel", Qos::default(), 100, every);
    world.until(secs(20), World::is_whole);
    world.run_for(secs(1));
    let mut streams = [camera, command];
    drive(&mut world, &mut streams, secs(2));
    // The start, in which the link finds its rate, is left out.
    let start = world.now;
    drive(&mut world, &mut streams, secs(8));
    world.run_for(secs(1));
    let ages = streams[1].ages(start);
    let at = |share: f64| ages[(ages.len() as f64 * share) as usize];
    let sent = streams[1].published.len();
    let command = world.received(streams[1].pair).len();
    println!("command: {command} of {sent}, p50 {:?}, p99 {:?}", at(0.5), at(0.99));
    assert_eq!(command, sent, "{}", world.describe());
    assert!(at(0.5) < Duration::from_millis(8), "{:?}", at(0.5));
    // A full queue would take 40 ms.
    assert!(at(0.99) < Duration::from_millis(35), "{:?}", at(0.99));
}

#[test]
fn a_link_that_becomes_slow_is_fresh_again_within_two_seconds() {
    let mut world = hosts(Congestion::Auto, radio(54, 0.0));
    let qos = Qos::default().with_depth(1);
    let every = Duration::from_micros(33_333);
    let stream = Stream::new(&mut world, "/scan", qos, 64_000, every);
    world.until(secs(20), World::is_whole);
    world.run_for(secs(1));
    let mut streams = [stream];
    drive(&mut world, &mut streams, secs(4));
    world.network.set_default_path(radio(2, 0.0));
    drive(&mut world, &mut streams, secs(2));
    let slow = world.now;
    drive(&mut world, &mut streams, secs(6));
    let ages = streams[0].ages(slow);
    let median = ages[ages.len() / 2];
    println!("at 2 Mbit/s: {} arrive, median age {median:?}", ages.len());
    // One sample takes 256 ms.
    assert!(median < Duration::from_millis(450), "{median:?}");
    assert!(ages.len() >= 15, "{}", ages.len());
    world.network.set_default_path(radio(54, 0.0));
    drive(&mut world, &mut streams, secs(2));
    let back = world.now;
    drive(&mut world, &mut streams, secs(2));
    let ages = streams[0].ages(back);
    println!("back at 54 Mbit/s: {} arrive, median age {:?}", ages.len(), ages[ages.len() / 2]);
    assert!(ages.len() > 50, "{}", ages.len());
    assert!(ages[ages.len() / 2] < Duration::from_millis(30));
}

/// A row of the table in docs/architecture.md.
struct Row {
    name: &'static str,
    qos: Qos,
    length: usize,
    /// The limits of age in ms for which the share is reported.
    within: [u64; 2],
}

/// Publishes samples at 30 Hz for `time` over a path. Returns the share that is not older than each of `within` when it
/// arrives, the share that arrives at all, and the median age.
fn shares(row: &Row, path: Path, time: Duration) -> ([f64; 2], f64, Duration) {
    let mut world = hosts(Congestion::Auto, path);
    let every = Duration::from_micros(33_333);
    let stream = Stream::new(&mut world, "/topic", row.qos, row.length, every);
    world.until(secs(30), World::is_whole);
    world.run_for(secs(2));
    let mut streams = [stream];
    drive(&mut world, &mut streams, time);
    streams[0].next = world.now + secs(3);
    let published = streams[0].published.len() as f64;
    drive(&mut world, &mut streams, secs(2));
    let ages = streams[0].ages(secs(0));
    let share = |most: u64| {
        let most = Duration::from_millis(most);
        ages.iter().filter(|age| **age <= most).count() as f64 / published
    };
    let median = ages.get(ages.len() / 2).copied().unwrap_or_default();
    (row.within.map(share), ages.len() as f64 / published, median)
}

fn rows() -> [Row; 4] {
    let depth = |depth| Qos::default().with_depth(depth);
    [
        Row { name: "1 KB, RELIABLE", qos: depth(10), length: 1_000, within: [100, 300] },
        Row { name: "64 KB, RELIABLE", qos: depth(10), length: 64_000, within: [100, 300] },
        Row {
            name: "1 KB, BEST_EFFORT",
            qos: Qos::sensor_data(),
            length: 1_000,
            within: [100, 300],
        },
        Row { name: "512 KB, RELIABLE", qos: depth(1), length: 512_000, within: [250, 1_000] },
    ]
}

#[test]
fn lone_samples_cross_a_link_that_loses_many_packets_in_time() {
    let [reliable, _, best_effort, _] = rows();
    let ([in_time, _], all, median) = shares(&reliable, radio(54, 0.4), secs(10));
    println!("RELIABLE: {in_time:.3} in time, {all:.3} at all, median age {median:?}");
    assert!(in_time > 0.9, "{in_time}");
    assert!(all > 0.999, "{all}");
    let ([in_time, _], ..) = shares(&best_effort, radio(54, 0.4), secs(10));
    println!("BEST_EFFORT: {in_time:.3} in time");
    assert!(in_time > 0.75, "{in_time}");
}

#[test]
#[ignore = "prints a table, and takes minutes"]
fn arrivals_by_loss_rate_are_printed() {
    for packets in [1, 8] {
        for row in rows() {
            for loss in [0.0, 0.05, 0.1, 0.2, 0.3, 0.4] {
                let path = match packets {
                    1 => radio(54, loss),
                    _ => bursts(54, loss, f64::from(packets)),
                };
                let (shares, all, median) = shares(&row, path, secs(60));
                let [first, second] = shares.map(|share| format!("{:.1} %", share * 100.0));
                let [soon, late] = row.within;
                println!(
                    "{}, loss {loss} in bursts of {packets}: {first} within {soon} ms, {second} within {late} ms, {:.1} % at all, \
                     median {median:?}",
                    row.name,
                    all * 100.0
                );
            }
        }
    }
}

#[test]
fn saturating_publishers_share_a_link_equally_at_any_sample_size() {
    let mut world = hosts(Congestion::Auto, radio(54, 0.0));
    let ms = Duration::from_millis(1);
    let mut streams =
        [(1_000, ms / 10), (30_000, ms), (1_000_000, ms * 30)].map(|(length, every)| {
            Stream::new(&mut world, &format!("/log/{length}"), Qos::keep_all(), length, every)
        });
    world.until(secs(20), World::is_whole);
    world.run_for(secs(1));
    drive(&mut world, &mut streams, secs(3));
    let before = streams.each_ref().map(|stream| stream.seen);
    drive(&mut world, &mut streams, secs(6));
    let bytes =
        [0, 1, 2].map(|which| (streams[which].seen - before[which]) * streams[which].length);
    let all = bytes.iter().sum::<usize>() as f64;
    let shares = bytes.map(|bytes| bytes as f64 / all);
    println!("shares {shares:.2?} of {:.2} of the rate", all * 8.0 / 6.0 / 54e6);
    assert!(shares.iter().all(|share| (0.23..0.45).contains(share)), "{shares:?}");
}

/// Publishes bursts of three best-effort samples of 4 MB over a link that is idle otherwise, on which each sample takes
/// 0.6 s. Returns the numbers of the samples that arrive.
fn bursts_of_images(lifespan: Option<Duration>) -> Vec<u64> {
    let mut world = hosts(Congestion::Auto, radio(54, 0.0));
    let qos = Qos::sensor_data().with_depth(8).with_lifespan(lifespan);
    let pair = world.pair(0, 1, "/image", qos);
    world.until(secs(20), World::is_whole);
    world.run_for(secs(1));
    for _ in 0..2 {
        for _ in 0..3 {
            assert!(world.publish(pair, 4_000_000));
            world.run_for(Duration::from_millis(1));
        }
        world.run_for(secs(10));
    }
    world.received(pair)
}

#[test]
fn a_best_effort_sample_that_takes_long_crosses_an_idle_link() {
    for lifespan in [None, Some(secs(5))] {
        let mut world = hosts(Congestion::Auto, radio(54, 0.0));
        let qos = Qos::sensor_data().with_lifespan(lifespan);
        let pair = world.pair(0, 1, "/image", qos);
        world.until(secs(20), World::is_whole);
        world.run_for(secs(1));
        for number in 1..=2 {
            assert!(world.publish(pair, 4_000_000));
            world.run_for(secs(5));
            assert_eq!(world.received(pair).last(), Some(&number), "{}", world.describe());
        }
    }
}

#[test]
fn best_effort_samples_may_be_as_old_as_their_lifespan() {
    // Once the engine knows how long a sample takes, only the newest of a burst can arrive within 200 ms.
    assert_eq!(bursts_of_images(None), [1, 2, 3, 4, 6]);
    assert_eq!(bursts_of_images(Some(secs(10))), [1, 2, 3, 4, 5, 6]);
}
