//! Tests BEST_EFFORT samples beyond a link's rate: as many whole samples arrive as the link carries, and they are
//! fresh.

#![allow(clippy::print_stdout, reason = "a scenario prints its figures")]

use std::time::Duration;

use axon_shm::qos::Qos;
use axon_transport::config::Config;

use super::radio::{Stream, drive, radio, secs};
use crate::engine::sim::{
    tests::{all_cases, millis},
    world::World,
};

/// A stream over a link of `rate` Mbit/s, at `load` times the link's rate.
struct Case {
    rate: u64,
    load: f64,
    length: usize,
    depth: u32,
}

/// The part of the stream that arrived.
#[derive(Debug)]
struct Arrived {
    /// The arrived samples as a share of those that the link could have carried.
    share: f64,
    median: Duration,
    oldest: Duration,
}

impl Case {
    /// Returns how long one sample takes at the link's rate.
    fn crossing(&self) -> Duration {
        Duration::from_secs_f64(self.length as f64 * 8.0 / (self.rate as f64 * 1e6))
    }

    fn run(&self, seed: u64, time: Duration) -> Arrived {
        let Self { rate, load, length, depth } = *self;
        let mut world = World::new(seed, 2, |_| Config::default());
        world.network.set_default_path(radio(rate, 0.0));
        let (qos, every) = (Qos::sensor_data().with_depth(depth), self.crossing().div_f64(load));
        let stream = Stream::new(&mut world, "/image", qos, length, every);
        world.until(secs(20), World::is_whole);
        world.run_for(secs(1));
        let mut streams = [stream];
        // In the beginning the link looks for its rate.
        drive(&mut world, &mut streams, secs(3));
        let (begun, before) = (world.now, streams[0].published());
        drive(&mut world, &mut streams, time);
        let [stream] = &streams;
        // The simulator checks that each of them is whole, and that none comes twice or out of order.
        let ages = stream.ages(begun);
        let published = (stream.published() - before) as f64;
        let share = ages.len() as f64 / published / (1.0 / load).min(1.0);
        Arrived { share, median: ages[ages.len() / 2], oldest: ages[ages.len() - 1] }
    }
}

#[test]
fn best_effort_beyond_the_rate_of_a_link_arrives_at_that_rate_and_fresh() {
    let (time, depths, loads) = if all_cases() {
        (secs(30), &[1, 5, 50][..], &[0.8, 1.01, 1.5, 2.3, 10.0][..])
    } else {
        (secs(6), &[5][..], &[1.01, 2.3][..])
    };
    for rate in [54, 8] {
        for length in [64_000, 512_000] {
            for (load, depth) in loads.iter().flat_map(|l| depths.iter().map(|d| (*l, *d))) {
                let case = Case { rate, load, length, depth };
                let arrived = case.run(31, time);
                let name = format!("{rate} Mbit/s, {length} bytes, depth {depth}, load {load}");
                println!("{name}: {arrived:.2?}");
                // Headers take 4 %.
                assert!(arrived.share > 0.85, "{name}: {arrived:?}");
                // A newer sample replaces one that waits longer than 200 ms, except the sample in flight and the next
                // one.
                let most = 3 * case.crossing() + millis(200);
                assert!(arrived.median < 2 * case.crossing() + millis(200), "{name}: {arrived:?}");
                assert!(arrived.oldest < most, "{name}: {arrived:?}");
            }
        }
    }
}
