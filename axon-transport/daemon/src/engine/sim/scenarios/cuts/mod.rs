//! Paths that are cut for seconds or minutes: when samples flow again, and that none is lost or repeated.

#![allow(clippy::print_stdout, reason = "a scenario prints its figures")]

mod paths;

use std::time::Duration;

use axon_shm::qos::Qos;
use axon_transport::config::Config;

use crate::engine::sim::{
    network::{CutId, Path, Rate},
    tests::{Settings, all_cases, millis, modes, secs},
    world::{Pair, World},
};

/// Samples flow again this long after a path's return, at the latest.
const BACK: Duration = Duration::from_millis(500);
/// The same limit after a cut of one direction: the host that still hears the other notices the cut late.
const BACK_FROM_ONE_WAY: Duration = Duration::from_millis(1000);

/// The load of a host's publishers.
#[derive(Clone, Copy, Debug)]
enum Load {
    /// So few samples that the history can hold those of a one-minute cut.
    Few,
    /// So many samples that the congestion window is full, and during a cut also the history.
    Many,
}

impl Load {
    fn length(self) -> usize {
        match self {
            Self::Few => 500,
            Self::Many => 20_000,
        }
    }

    fn every(self) -> Duration {
        match self {
            Self::Few => millis(300),
            Self::Many => millis(5),
        }
    }
}

/// Which ways a path is cut.
#[derive(Clone, Copy, Debug)]
enum Ways {
    Both,
    From(usize),
}

/// Two hosts with a KEEP_ALL publisher each, linked over a path of 54 Mbit/s and a round trip of 4 ms.
struct Cut {
    world: World,
    pairs: [Pair; 2],
    published: [u64; 2],
    load: Load,
}

impl Cut {
    fn new(seed: u64, config: &Settings, load: Load) -> Self {
        let mut world = World::new(seed, 2, config);
        let rate = Some(Rate::new(54_000_000 / 8, millis(40)));
        world.network.set_default_path(Path { delay: millis(2), rate, ..Path::default() });
        let pairs = [
            world.pair(0, 1, "/text/out", Qos::keep_all()),
            world.pair(1, 0, "/in", Qos::keep_all()),
        ];
        world.until(secs(20), World::is_whole);
        world.run_for(secs(2));
        Self { world, pairs, published: [0; 2], load }
    }

    /// Makes these publishers publish for `time`.
    fn publish(&mut self, who: &[usize], time: Duration) {
        let end = self.world.now + time;
        while self.world.now < end {
            for number in who {
                let published = self.world.publish(self.pairs[*number], self.load.length());
                assert!(published || matches!(self.load, Load::Many), "the history is full");
                self.published[*number] += u64::from(published);
            }
            self.world.run_until(end.min(self.world.now + self.load.every()));
        }
    }

    fn cut(&mut self, ways: Ways) -> CutId {
        match ways {
            Ways::Both => self.world.network.partition(&[0], None),
            Ways::From(host) => self.world.network.cut(&[host], &[1 - host], None),
        }
    }

    /// Runs until a sample of each of these publishers arrives, and returns how long that took.
    fn flows(&mut self, who: &[usize]) -> Duration {
        let (began, pairs) = (self.world.now, self.pairs);
        let before = pairs.map(|pair| self.world.received(pair).len());
        self.world.until(secs(20), |world| {
            who.iter().all(|number| world.received(pairs[*number]).len() > before[*number])
        });
        self.world.now - began
    }

    /// Returns how often a host lost the link, or took the other one for gone.
    fn flaps(&self) -> usize {
        let refusals = self.world.hosts.iter().flat_map(|host| &host.refusals);
        refusals.filter(|(_, text)| text.starts_with("down") || text == "silent").count()
    }

    /// Checks that all published samples arrived, once and in order.
    fn is_complete(&mut self, case: &str) {
        self.world.run_for(secs(5));
        assert!(self.world.is_whole(), "{case}: {}", self.world.describe());
        for (pair, published) in self.pairs.iter().zip(self.published) {
            let received = self.world.received(*pair);
            let complete = received.iter().copied().eq(1..=published);
            assert!(complete, "{case}: {received:?} {}", self.world.describe());
        }
    }
}

/// Cuts the path of each mode for so long, at several instants, while the publishers of none, of either, or of both
/// hosts publish. Prints how long samples took after the path's return, and checks that none is lost or repeated.
fn flows_again_after(cut: Duration, load: Load, ways: Ways) {
    flows_again_with(cut, load, ways, |_| {});
}

/// Runs [`flows_again_after`] with other settings of the hosts.
fn flows_again_with(cut: Duration, load: Load, ways: Ways, set: fn(&mut Config)) {
    let instants: &[u64] = if all_cases() { &[0, 130, 370, 610, 890] } else { &[370] };
    for (mode, config) in modes() {
        let config: Settings = Box::new(move |host| {
            let mut config = config(host);
            set(&mut config);
            config
        });
        for who in [&[][..], &[0], &[1], &[0, 1]] {
            // Samples in the other direction arrive meanwhile.
            let (awaited, most) = match ways {
                Ways::Both => (who, BACK),
                Ways::From(0) => (&[0][..], BACK_FROM_ONE_WAY),
                Ways::From(_) => (&[1][..], BACK_FROM_ONE_WAY),
            };
            if !awaited.iter().all(|host| who.contains(host)) {
                continue;
            }
            let mut all = Vec::new();
            for (seed, instant) in (80..).zip(instants) {
                let case =
                    format!("{mode}, {ways:?} for {cut:?}, {instant} ms, {load:?} of {who:?}");
                let mut of = Cut::new(seed, &config, load);
                of.publish(&[0, 1], secs(1) + millis(*instant));
                let broken = of.cut(ways);
                // An instant later, so that it falls anywhere within a second.
                of.publish(who, cut + 3 * millis(*instant));
                of.world.network.heal(broken);
                let took = if who.is_empty() {
                    // A link on which nothing waits.
                    of.publish(&[0, 1], millis(1));
                    millis(1) + of.flows(&[0, 1])
                } else {
                    of.flows(awaited)
                };
                assert!(took <= most, "{case}: {took:?} {}", of.world.describe());
                all.push(took);
                of.is_complete(&case);
                let flaps = of.flaps();
                assert!(cut > secs(10) || flaps == 0, "{case}: {}", of.world.describe());
            }
            println!("{mode}, {ways:?} for {cut:?} with {load:?} of {who:?}: {all:.0?}");
        }
    }
}

#[test]
fn after_a_cut_of_5_s_samples_flow_within_half_a_second_and_none_is_lost() {
    flows_again_after(secs(5), Load::Few, Ways::Both);
    flows_again_after(secs(5), Load::Many, Ways::Both);
}

#[test]
fn after_a_cut_of_8_s_samples_flow_within_half_a_second_and_none_is_lost() {
    flows_again_after(secs(8), Load::Few, Ways::Both);
    flows_again_after(secs(8), Load::Many, Ways::Both);
}

#[test]
fn after_a_cut_of_20_s_samples_flow_within_half_a_second_and_none_is_lost() {
    flows_again_after(secs(20), Load::Few, Ways::Both);
    flows_again_after(secs(20), Load::Many, Ways::Both);
}

#[test]
fn after_a_cut_of_60_s_samples_flow_within_half_a_second_and_none_is_lost() {
    flows_again_after(secs(60), Load::Few, Ways::Both);
    // With the default limit a host that is gone would hold up a publisher for less time than this cut takes.
    flows_again_with(secs(60), Load::Many, Ways::Both, |config| config.link.stalled = secs(60));
}

/// Cuts the path, lets it return so briefly that no handshake comes through, several times, and then heals it.
#[test]
fn after_several_short_returns_samples_flow_within_half_a_second_of_the_last_and_none_is_lost() {
    for (mode, config) in modes() {
        // All together shorter than the time after which a route counts as one that is not read.
        for (brief, pause, returns) in [(120, 1_500, 5), (350, 1_500, 5), (350, 2_500, 2)] {
            let case = format!("{mode}, {returns} times back for {brief} ms after {pause} ms");
            let mut of = Cut::new(90, &config, Load::Few);
            of.publish(&[0, 1], secs(1));
            for _ in 0..returns {
                let broken = of.cut(Ways::Both);
                of.publish(&[0, 1], millis(pause));
                of.world.network.heal(broken);
                of.world.run_for(millis(brief));
            }
            let broken = of.cut(Ways::Both);
            of.publish(&[0, 1], millis(pause));
            of.world.network.heal(broken);
            let took = of.flows(&[0, 1]);
            println!("{case}: {took:.0?}");
            assert!(took <= BACK, "{case}: {took:?} {}", of.world.describe());
            of.is_complete(&case);
        }
    }
}

#[test]
fn after_a_cut_of_one_way_samples_flow_within_a_second_and_none_is_lost() {
    // After a longer cut the route counts as unread, because the other host is still heard.
    for from in [0, 1] {
        flows_again_after(secs(5), Load::Few, Ways::From(from));
        flows_again_after(secs(5), Load::Many, Ways::From(from));
    }
}
