//! Scenarios.

#![allow(clippy::print_stdout, reason = "a scenario prints its figures")]

use std::{
    rc::Rc,
    time::{Duration, UNIX_EPOCH},
};

use axon_shm::qos::Qos;
use axon_transport::config::{Config, KeyMode};

use super::{
    host::BATCH,
    network::Path,
    run::run,
    script::{Recipe, Script, Weights},
    world::World,
};
use crate::engine::{keyring::tests::config as qkd, quic::transport::STREAMS_OPEN};

pub(super) fn secs(seconds: u64) -> Duration {
    Duration::from_secs(seconds)
}

pub(super) fn millis(millis: u64) -> Duration {
    Duration::from_millis(millis)
}

pub(super) fn classic(_host: usize) -> Config {
    Config::default()
}

/// Makes the settings of a host.
pub(super) type Settings = Box<dyn Fn(usize) -> Config>;

/// Returns all modes that a link can have here.
pub(super) fn modes() -> Vec<(&'static str, Settings)> {
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
fn a_lone_sample_leaves_in_pieces_and_a_stream_in_whole_batches() {
    let mut world = World::new(5, 2, classic);
    let pair = world.pair(0, 1, "/t", Qos::keep_all());
    world.until(secs(5), World::is_whole);
    world.run_for(secs(1));
    let lone = |world: &mut World| {
        world.batches.insert(0, Vec::new());
        assert!(world.publish(pair, 64 << 10));
        world.run_for(millis(20));
        world.batches.remove(&0).unwrap()
    };
    // These samples widen the congestion window until a whole sample can leave at once.
    for _ in 0..20 {
        lone(&mut world);
    }
    for _ in 0..3 {
        let batches = lone(&mut world);
        assert!(batches.len() >= 3 && batches.iter().all(|batch| *batch <= 16), "{batches:?}");
    }
    world.batches.insert(0, Vec::new());
    for _ in 0..20 {
        while world.publish(pair, 64 << 10) {}
        world.run_for(millis(1));
    }
    let batches = &world.batches[&0];
    let sent: usize = batches.iter().sum();
    let whole = batches.iter().filter(|batch| **batch == BATCH).count() * BATCH;
    println!("{sent} datagrams of a stream, {whole} of them in whole batches");
    // Each pass ends with a rest.
    assert!(whole * 10 > sent * 7, "{batches:?}");
}

#[test]
fn a_daemon_that_is_killed_and_started_again_links_again() {
    let mut world = World::new(4, 3, classic);
    world.pair(0, 1, "/t", Qos::default());
    world.until(secs(5), World::is_whole);
    world.kill(1, false);
    world.run_for(millis(500));
    world.restart(1);
    world.until(secs(30), World::is_whole);
}

#[test]
fn a_full_keep_all_ring_holds_the_publisher_back_and_loses_nothing() {
    let mut world = World::new(6, 2, classic);
    let publisher = world.hosts[0].rings.create_publisher("/t", Qos::keep_all());
    let subscription = world.hosts[1].rings.create_subscription("/t", Qos::keep_all(), Some(10));
    world.hosts[0].touch_graph();
    world.hosts[1].touch_graph();
    world.until(secs(5), World::is_whole);
    world.run_for(secs(1));
    let mut published = 0;
    for _ in 0..2000 {
        published += u64::from(world.hosts[0].rings.publish(publisher, 20_000));
        world.hosts[0].ring();
        world.run_for(millis(2));
    }
    assert!(published < 2000, "the publisher was held back");
    assert_eq!(world.hosts[1].rings.received(subscription, publisher).len(), 10);
    assert!(world.hosts[1].rings.waits_for_room());
    world.hosts[1].rings.make_room(subscription);
    world.hosts[1].ring();
    world.run_for(secs(10));
    let received = world.hosts[1].rings.received(subscription, publisher);
    assert_eq!(received, (1..=published).collect::<Vec<_>>());
    assert!(!world.hosts[1].rings.waits_for_room());
}

/// Offers best-effort samples of 512 KiB to a path of 54 Mbit/s for 20 s, at `load` times the path's rate. Returns the
/// share that arrives, and the median of their ages.
fn best_effort_overload(load: f64, depth: u32) -> (f64, Duration) {
    let mut world = World::new(7, 2, classic);
    let rate = super::network::Rate::new(54_000_000 / 8, millis(50));
    world.network.set_default_path(Path { delay: millis(1), rate: Some(rate), ..Path::default() });
    let pair = world.pair(0, 1, "/camera", Qos::sensor_data().with_depth(depth));
    world.until(secs(10), World::is_whole);
    world.run_for(secs(1));
    let length = 512 << 10;
    let every = Duration::from_secs_f64(length as f64 * 8.0 / (54e6 * load));
    let (mut published, mut ages, mut seen) = (Vec::new(), Vec::new(), 0);
    let (end, mut next) = (world.now + secs(20), world.now);
    while world.now < end {
        if world.now >= next {
            world.publish(pair, length);
            published.push(world.now);
            next += every;
        }
        world.run_for(millis(1));
        let received = world.received(pair);
        let of = |number: &u64| world.now - published[*number as usize - 1];
        ages.extend(received[seen..].iter().map(of));
        seen = received.len();
    }
    ages.sort_unstable();
    (seen as f64 / published.len() as f64, ages[ages.len() / 2])
}

#[test]
fn best_effort_beyond_the_rate_delivers_whole_samples_near_the_ceiling() {
    for (load, depth) in [(1.01, 5), (2.33, 5), (2.33, 1)] {
        let (share, median) = best_effort_overload(load, depth);
        println!("{load} of the rate, depth {depth}: {share:.2} arrive, median age {median:?}");
        assert!(share > 0.8 / load, "{load}, depth {depth}: {share}");
        assert!(median < millis(500), "{load}, depth {depth}: {median:?}");
    }
}

#[test]
fn more_best_effort_samples_than_a_link_has_streams_arrive() {
    let mut world = World::new(11, 2, classic);
    let pair = world.pair(0, 1, "/t", Qos::sensor_data());
    world.until(secs(5), World::is_whole);
    world.run_for(secs(1));
    let samples = u64::from(STREAMS_OPEN) + 500;
    for _ in 0..samples {
        world.publish(pair, 10);
        world.run_for(millis(1));
    }
    assert_eq!(world.received(pair).len() as u64, samples, "{}", world.describe());
}

#[test]
fn a_partition_that_outlasts_the_links_heals() {
    let mut world = World::new(9, 4, classic);
    let pair = world.pair(0, 3, "/t", Qos::keep_all());
    world.until(secs(5), World::is_whole);
    let cut = world.network.partition(&[0, 1], None);
    world.run_for(secs(150));
    assert!(!world.is_linked());
    world.network.heal(cut);
    world.until(secs(10), World::is_whole);
    world.run_for(secs(2));
    assert!(world.publish(pair, 10));
    world.run_for(secs(1));
    assert_eq!(world.received(pair).len(), 1, "{}", world.describe());
}

#[test]
fn a_wall_clock_that_jumps_on_one_host_changes_nothing() {
    let year = Duration::from_secs(365 * 24 * 3600);
    for (mode, config) in modes() {
        let mut world = World::new(10, 2, config);
        // Monotonic time begins elsewhere than at zero, too.
        world.run_until(secs(10_000));
        let mut short_lived = Qos::keep_all();
        short_lived.lifespan = Some(secs(1));
        let pairs = [
            world.pair(0, 1, "/a", Qos::keep_all()),
            world.pair(1, 0, "/b", Qos::keep_all()),
            world.pair(0, 1, "/c", short_lived),
            world.pair(1, 0, "/d", short_lived),
        ];
        world.until(secs(5), World::is_whole);
        world.run_for(secs(1));
        let wall = Rc::clone(&world.hosts[1].rings.wall);
        let today = wall.get();
        let jumps = [today + year, today, today - year, UNIX_EPOCH, today + year];
        for (number, time) in (1..).zip(jumps) {
            let publish = |world: &mut World| {
                pairs.iter().for_each(|pair| assert!(world.publish(*pair, 10), "{mode}"));
            };
            publish(&mut world);
            wall.set(time);
            publish(&mut world);
            world.run_for(secs(2));
            let arrived = pairs.map(|pair| world.received(pair).len());
            assert_eq!(arrived, [2 * number; 4], "{mode}, jump {number}: {}", world.describe());
        }
        // A handshake between two hosts whose clocks differ by a year.
        let cut = world.network.partition(&[0], None);
        world.run_for(secs(150));
        assert!(!world.is_linked(), "{mode}");
        world.network.heal(cut);
        world.until(secs(10), World::is_whole);
        let since = |host: usize| {
            let links = world.hosts[host].status.values();
            links.filter_map(|link| link.since).collect::<Vec<_>>()
        };
        assert_eq!((since(0), since(1)), (vec![today], vec![today + year]), "{mode}");
    }
}

/// Returns the script of a seed, with mixed faults of `hosts` hosts.
fn script(seed: u64, hosts: usize) -> Script {
    let recipe = Recipe {
        hosts,
        interfaces: 1,
        topics: 3,
        faults: 40,
        until: secs(30),
        longest: secs(12),
        // quinn-proto 0.11.19 has a debug assertion that fails when the loss timer of a server expires after the
        // client's address changed: the new path has nothing in flight, and the timer is the old path's. Without
        // debug assertions it sends one probe.
        weights: Weights {
            rebind: 0,
            change_address: u32::from(!cfg!(debug_assertions)),
            ..Weights::default()
        },
    };
    Script::generate(seed, &recipe)
}

/// Runs the script of a seed. A seed that fails is shrunk to a short script, which is printed.
fn try_seed(seed: u64, hosts: usize) {
    let fails = |script: &Script| {
        let mode = (script.seed % 3) as usize;
        let config = modes().swap_remove(mode).1;
        let run = std::panic::AssertUnwindSafe(|| run(script, config));
        std::panic::catch_unwind(run).err()
    };
    let script = script(seed, hosts);
    let Some(why) = fails(&script) else { return };
    let text = why.downcast_ref::<&str>().map(|text| (*text).to_owned());
    let why = why.downcast_ref::<String>().cloned().or(text).unwrap_or_default();
    let shrunk = script.shrink(200, |script| fails(script).is_some());
    panic!("seed {seed} with {hosts} hosts fails: {why}\nshrunk to:\n{}", shrunk.script);
}

/// Returns whether all cases of a scenario are to be run, or only a sample of them.
pub(super) fn all_cases() -> bool {
    setting("SIMULATE_ALL", 0) == 1
}

/// Returns a number from the environment, as `cargo xtask simulate` sets it.
pub(super) fn setting(name: &str, default: u64) -> u64 {
    std::env::var(name).ok().and_then(|value| value.parse().ok()).unwrap_or(default)
}

#[test]
fn mixed_faults_break_no_promise() {
    let (first, seeds) = (setting("SIMULATE_FIRST", 1), setting("SIMULATE_SEEDS", 12));
    let hosts = setting("SIMULATE_HOSTS", 3) as usize;
    for seed in first..first + seeds {
        try_seed(seed, hosts);
    }
}

#[test]
fn keep_last_that_is_behind_is_fresh() {
    let mut world = World::new(5, 2, classic);
    // 54 Mbit/s, a round trip of 3 ms.
    let rate = super::network::Rate::new(54_000_000 / 8, millis(50));
    let path = Path { delay: millis(1), rate: Some(rate), ..Path::default() };
    world.network.set_default_path(path);
    let pair = world.pair(0, 1, "/camera", Qos::default().with_depth(1));
    world.until(secs(10), World::is_whole);
    world.run_for(secs(1));
    // 126 Mbit/s of 512 KiB samples.
    let (length, every) = (512 << 10, Duration::from_micros(33_290));
    let mut published = Vec::new();
    let mut ages = Vec::new();
    let mut seen = 0;
    let end = world.now + secs(20);
    let mut next = world.now;
    while world.now < end {
        if world.now >= next {
            world.publish(pair, length);
            published.push(world.now);
            next += every;
        }
        world.run_for(millis(1));
        let received = world.received(pair);
        for number in &received[seen..] {
            ages.push(world.now - published[*number as usize - 1]);
        }
        seen = received.len();
    }
    // The start, in which a burst is lossless, is left out.
    let mut ages = ages.split_off(ages.len() / 2);
    ages.sort_unstable();
    let median = ages[ages.len() / 2];
    let serialization = Duration::from_secs_f64(length as f64 * 8.0 / 54e6);
    println!(
        "{seen} of {} arrived, median age {median:?}, serialization {serialization:?}",
        published.len()
    );
    assert!(seen as f64 > 0.35 * published.len() as f64, "{seen} of {}", published.len());
    // A round trip, and the step of this loop.
    let most = serialization.mul_f64(1.6) + millis(3 + 1);
    assert!(median < most, "{median:?}, not {most:?}");
}
