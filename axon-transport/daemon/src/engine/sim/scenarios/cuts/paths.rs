//! Hosts with two interfaces: a second link stands by over the second path, and takes over when the first is cut.

#![allow(clippy::print_stdout, reason = "a scenario prints its figures")]

use std::{net::Ipv4Addr, time::Duration};

use axon_shm::qos::Qos;
use axon_transport::{
    access::TopicPattern,
    config::{Config, KeyMode, Security, TopicPriority, TopicRule},
};
use rand::RngExt;

use crate::engine::{
    keyring::tests::config as qkd,
    sim::{
        network::Path,
        rng::{Stream, stream},
        tests::{Settings, millis, modes, secs},
        world::{Pair, World},
    },
};

/// Traffic goes on within this time after a path is cut, if the other one works.
const SWITCHED: Duration = Duration::from_millis(500);

/// Two hosts with two interfaces each and a KEEP_ALL publisher each.
struct TwoPaths {
    world: World,
    pairs: [Pair; 2],
    published: [u64; 2],
    /// The addresses of host 1, by path.
    addresses: [Ipv4Addr; 2],
    /// The addresses of both hosts on the second path.
    second: [Ipv4Addr; 2],
    /// Time between two samples of a publisher, in milliseconds. The history has 256.
    every: u32,
    /// The time of publication and the age at arrival of each sample, by publisher, in milliseconds.
    published_at: [Vec<u64>; 2],
    ages: [Vec<u64>; 2],
}

/// Returns settings with this number of paths.
fn with_paths(
    config: impl Fn(usize) -> Config,
    paths: impl Fn(usize) -> u8,
) -> impl Fn(usize) -> Config {
    move |host| {
        let mut config = config(host);
        config.link.paths = paths(host);
        config
    }
}

/// Returns settings with two paths, both of which small samples cross, if that is `redundant`; `None`: without a rule.
fn with_rule(
    config: impl Fn(usize) -> Config,
    redundant: Option<bool>,
) -> impl Fn(usize) -> Config {
    with_paths(
        move |host| {
            let mut config = config(host);
            let rule = TopicRule::new(TopicPattern::new("/*").unwrap(), TopicPriority::Normal);
            config.topics = vec![match redundant {
                Some(true) => rule.over_both_paths(),
                Some(false) => rule.over_one_path(),
                None => rule,
            }];
            config
        },
        |_| 2,
    )
}

/// Returns settings whose links are renewed after ten seconds.
fn short_lived(mode: KeyMode) -> impl Fn(usize) -> Config {
    move |host| {
        let mut config = qkd(&format!("sae-{host}"), mode);
        if let Security::Qkd(qkd) = &mut config.security {
            qkd.session_max_age = secs(20);
        }
        config
    }
}

impl TwoPaths {
    fn new(seed: u64, config: &Settings) -> Self {
        Self::with(seed, with_paths(config, |_| 2))
    }

    fn with(seed: u64, config: impl Fn(usize) -> Config) -> Self {
        Self::over(seed, config, Path { delay: millis(2), ..Path::default() })
    }

    /// Returns links two hosts over a first path of this quality.
    fn over(seed: u64, config: impl Fn(usize) -> Config, first: Path) -> Self {
        let mut world = World::new(seed, 2, config);
        world.network.set_default_path(Path { delay: millis(2), ..Path::default() });
        let ends = [0, 1].map(|host| world.hosts[host].address);
        for (from, to) in [(0, 1), (1, 0)] {
            world.network.set_path_between(ends[from], ends[to], Some(first.clone()));
        }
        let second = [0, 1].map(|host| world.add_second_interface(host));
        let pairs =
            [world.pair(0, 1, "/out", Qos::keep_all()), world.pair(1, 0, "/in", Qos::keep_all())];
        world.until(secs(20), World::is_whole);
        world.hear_all_addresses();
        world.run_for(secs(4));
        let addresses = [world.hosts[1].address, second[1]];
        let [published_at, ages] = [[Vec::new(), Vec::new()], [Vec::new(), Vec::new()]];
        let (published, every) = ([0; 2], 10);
        Self { world, pairs, published, addresses, second, every, published_at, ages }
    }

    /// Returns which path host 0 uses.
    fn in_use(&self) -> usize {
        let status = self.world.hosts[0].status.values().next().expect("a link");
        self.addresses.iter().position(|a| status.address.starts_with(&format!("{a}:"))).unwrap()
    }

    /// Returns whether each host has a link that stands by.
    fn stands_by(&self) -> [bool; 2] {
        [0, 1].map(|host| self.world.hosts[host].status.values().any(|link| link.standby.is_some()))
    }

    fn set_path(&mut self, path: usize, works: bool) {
        self.world.network.set_interface_up(self.addresses[path], works);
    }

    /// Publishes samples in both directions for so long. Returns the longest time without an arrival.
    fn publish(&mut self, time: Duration) -> Duration {
        let end = self.world.now + time;
        let mut gap = Duration::ZERO;
        let before = self.pairs.map(|pair| self.world.received(pair).len());
        let mut last = before.map(|received| (self.world.now, received));
        while self.world.now < end {
            for (side, pair) in self.pairs.into_iter().enumerate() {
                let published_one = self.world.publish(pair, 1000);
                assert!(published_one, "the history is full: {}", self.world.describe());
                self.published[side] += 1;
                self.published_at[side].push(self.world.now.as_millis() as u64);
            }
            for _ in 0..self.every {
                self.world.run_for(millis(1));
                for (side, last) in last.iter_mut().enumerate() {
                    let received = self.world.received(self.pairs[side]).len();
                    if received > last.1 {
                        *last = (self.world.now, received);
                    }
                    gap = gap.max(self.world.now - last.0);
                    self.note_ages(side, received);
                }
            }
        }
        gap
    }

    /// Notes the ages of the samples that arrived in the last millisecond.
    fn note_ages(&mut self, side: usize, received: usize) {
        let now = self.world.now.as_millis() as u64;
        for sample in self.ages[side].len()..received.min(self.published_at[side].len()) {
            self.ages[side].push(now - self.published_at[side][sample]);
        }
    }

    /// Returns the age at arrival, in milliseconds, that this share of all samples did not exceed.
    fn age_of(&self, share: f64) -> u64 {
        let mut ages = self.ages.concat();
        ages.sort_unstable();
        ages[((ages.len() - 1) as f64 * share) as usize]
    }

    /// Checks that everything arrives, once and in order, and that no host took the other one for gone.
    fn is_complete(&mut self, case: &str) {
        self.world.run_for(secs(5));
        for (pair, published) in self.pairs.iter().zip(self.published) {
            let complete = self.world.received(*pair).into_iter().eq(1..=published);
            assert!(complete, "{case}: {}", self.world.describe());
        }
        let refusals = self.world.hosts.iter().flat_map(|host| &host.refusals);
        let flaps = refusals.filter(|(_, text)| text.starts_with("down") || text == "silent");
        assert_eq!(flaps.count(), 0, "{case}: {}", self.world.describe());
    }
}

#[test]
fn traffic_moves_to_the_second_path_when_the_first_is_cut() {
    for (mode, config) in modes() {
        let mut paths = TwoPaths::new(60, &config);
        assert_eq!((paths.in_use(), paths.stands_by()), (0, [true; 2]), "{mode}");
        for round in 0..6 {
            paths.publish(secs(1));
            let in_use = paths.in_use();
            paths.set_path(in_use, false);
            let gap = paths.publish(secs(2));
            assert!(gap <= SWITCHED, "{mode}, round {round}: nothing arrived for {gap:?}");
            assert_eq!(paths.in_use(), 1 - in_use, "{mode}, round {round}");
            paths.set_path(in_use, true);
            paths.publish(secs(3));
            assert_eq!(paths.stands_by(), [true; 2], "{mode}, round {round}: the path is back");
        }
        paths.is_complete(mode);
    }
}

#[test]
fn paths_that_are_cut_in_turn_at_random_lose_nothing() {
    let cases = [None, Some(true)]
        .into_iter()
        .flat_map(|copied| modes().into_iter().map(move |mode| (copied, mode)));
    for (number, (copied, (mode, config))) in (0..).zip(cases) {
        let mut paths = TwoPaths::with(61, with_rule(&config, copied));
        let mut random = stream(61 + number, Stream::Script);
        let mut longest = Duration::ZERO;
        for _ in 0..20 {
            let (path, cut) = (random.random_range(0..2), random.random_range(200..5000));
            paths.set_path(path, false);
            longest = longest.max(paths.publish(millis(cut)));
            paths.set_path(path, true);
            longest = longest.max(paths.publish(millis(random.random_range(1000..4000))));
        }
        let [p50, p99, p999] = [0.5, 0.99, 0.999].map(|share| paths.age_of(share));
        println!(
            "{mode}, redundant {copied:?}: nothing arrived for {longest:?} at most; ages p50 {p50} ms, p99 {p99} ms, \
             p99.9 {p999} ms"
        );
        assert!(longest <= SWITCHED, "{mode}: nothing arrived for {longest:?}");
        if mode != "messages10" || copied == Some(true) {
            // No sample waits for a take-over: it crosses both paths.
            assert!(p99 < 30, "{mode}: {p99} ms");
        }
        paths.is_complete(mode);
    }
}

/// Returns the copies that host 0 sent, and the samples that it received as copies first.
fn copies(paths: &TwoPaths) -> (u64, u64) {
    let links: Vec<_> = paths.world.hosts[0].status.values().collect();
    let sent =
        links.iter().filter_map(|link| link.standby.as_ref()).map(|standby| standby.copies_out);
    (sent.sum(), links.iter().map(|link| link.copies_in).sum())
}

#[test]
fn small_samples_cross_both_paths_by_default_or_by_a_rule() {
    for (mode, config) in modes() {
        for redundant in [None, Some(true), Some(false)] {
            let mut paths = TwoPaths::with(72, with_rule(&config, redundant));
            paths.publish(secs(3));
            let (sent, _) = copies(&paths);
            let expected = redundant.unwrap_or(mode != "messages10");
            assert_eq!(sent > 200, expected, "{mode}, {redundant:?}: {sent}");
            assert!(sent > 200 || sent == 0, "{mode}, {redundant:?}: {sent}");
            // The link in use loses half of its packets: copies come first.
            let bad = Path { loss: 0.5, delay: millis(2), ..Path::default() };
            let ends = [0, 1].map(|host| paths.world.hosts[host].address);
            for (from, to) in [(0, 1), (1, 0)] {
                paths.world.network.set_path_between(ends[from], ends[to], Some(bad.clone()));
            }
            paths.publish(secs(3));
            let (_, first) = copies(&paths);
            assert_eq!(first > 50, expected, "{mode}, {redundant:?}: {first}");
            paths.is_complete(mode);
        }
    }
}

#[test]
fn lossy_paths_that_are_cut_in_turn_lose_nothing_and_repeat_nothing() {
    for (mode, config) in modes() {
        let mut paths = TwoPaths::with(73, with_rule(&config, Some(true)));
        paths.every = 20;
        let lossy = Path { loss: 0.2, jitter: millis(8), delay: millis(2), ..Path::default() };
        paths.world.network.set_default_path(lossy);
        let mut random = stream(73, Stream::Script);
        for _ in 0..15 {
            let path = random.random_range(0..2);
            paths.set_path(path, false);
            paths.publish(millis(random.random_range(50..1500)));
            paths.set_path(path, true);
            paths.publish(millis(random.random_range(2000..5000)));
        }
        println!("{mode}: ages p50 {} ms, p99 {} ms", paths.age_of(0.5), paths.age_of(0.99));
        paths.is_complete(mode);
    }
}

#[test]
fn better_path_is_used_and_a_worse_one_is_left() {
    for (mode, config) in modes() {
        let mut paths = TwoPaths::new(74, &config);
        let set = |paths: &mut TwoPaths, path: usize, quality: &Path| {
            let ends = match path {
                0 => [0, 1].map(|host| paths.world.hosts[host].address),
                _ => paths.second,
            };
            for (from, to) in [(0, 1), (1, 0)] {
                let quality = Some(quality.clone());
                paths.world.network.set_path_between(ends[from], ends[to], quality);
            }
        };
        paths.publish(secs(20));
        assert_eq!(paths.in_use(), 0, "{mode}: both paths are alike");
        // The path in use loses a third of its packets.
        set(&mut paths, 0, &Path { loss: 0.3, delay: millis(2), ..Path::default() });
        paths.publish(secs(40));
        // Copies show how much the second path loses. In messages10 there are none.
        let expected = usize::from(mode != "messages10");
        assert_eq!(paths.in_use(), expected, "{mode}: {}", paths.world.describe());
        set(&mut paths, 0, &Path { delay: millis(2), ..Path::default() });
        paths.publish(secs(70));
        assert_eq!(paths.in_use(), expected, "{mode}: both paths are alike again");
        paths.is_complete(mode);
    }
}

#[test]
fn shorter_path_is_used() {
    for (mode, config) in modes() {
        let slow = Path { delay: millis(20), ..Path::default() };
        let mut paths = TwoPaths::over(75, with_paths(&config, |_| 2), slow);
        // The second path has the usual delay.
        paths.publish(secs(20));
        assert_eq!(paths.in_use(), 1, "{mode}: {}", paths.world.describe());
        assert_eq!(paths.stands_by(), [true; 2], "{mode}: {}", paths.world.describe());
        paths.publish(secs(100));
        assert_eq!(paths.in_use(), 1, "{mode}: it stays");
        paths.is_complete(mode);
    }
}

#[test]
fn both_paths_cut_at_once_lose_nothing() {
    for (mode, config) in modes() {
        let mut paths = TwoPaths::new(62, &config);
        paths.every = 100;
        for (first_back, cut) in [(0, 300), (1, 700), (0, 8000), (1, 3000)] {
            (0..2).for_each(|path| paths.set_path(path, false));
            paths.publish(millis(cut));
            paths.set_path(first_back, true);
            paths.publish(secs(3));
            paths.set_path(1 - first_back, true);
            paths.publish(secs(6));
            assert_eq!(paths.stands_by(), [true; 2], "{mode}: both are back");
        }
        paths.is_complete(mode);
    }
}

#[test]
fn path_that_is_cut_in_one_direction_is_left() {
    for (mode, config) in modes() {
        for direction in 0..2 {
            let mut paths = TwoPaths::new(63, &config);
            let ends = [0, 1].map(|host| paths.world.hosts[host].address);
            let (from, to) = (ends[direction], ends[1 - direction]);
            let none = Path { loss: 1.0, ..Path::default() };
            paths.world.network.set_path_between(from, to, Some(none));
            let gap = paths.publish(secs(3));
            assert!(gap <= SWITCHED, "{mode}, {direction}: nothing arrived for {gap:?}");
            assert_eq!(paths.in_use(), 1, "{mode}, {direction}");
            paths.is_complete(mode);
        }
    }
}

#[test]
fn host_that_is_stopped_does_not_make_the_other_one_switch() {
    let (mode, config) = modes().remove(0);
    let mut paths = TwoPaths::new(64, &config);
    for _ in 0..5 {
        paths.publish(millis(500));
        paths.world.stop(1, true);
        paths.publish(secs(2));
        paths.world.stop(1, false);
        paths.publish(secs(1));
        assert_eq!(paths.in_use(), 0, "{mode}: both paths work");
    }
    paths.is_complete(mode);
}

#[test]
fn one_host_with_one_path_has_no_second_link() {
    for (mode, config) in modes() {
        for single in 0..2 {
            let config = with_paths(&config, |host| if host == single { 1 } else { 2 });
            let mut paths = TwoPaths::with(65, config);
            assert_eq!(paths.stands_by(), [false; 2], "{mode}");
            paths.publish(secs(1));
            paths.is_complete(mode);
        }
    }
}

#[test]
fn renewals_of_both_links_lose_nothing_and_leave_a_second_link() {
    for mode in [KeyMode::Session, KeyMode::Messages10] {
        let mut paths = TwoPaths::with(66, with_rule(short_lived(mode), Some(true)));
        for _ in 0..12 {
            paths.publish(secs(10));
        }
        let stand = (0..40).filter(|_| {
            paths.publish(millis(500));
            paths.stands_by() == [true; 2]
        });
        assert!(stand.count() > 20, "{mode:?}: a second link stands by most of the time");
        let in_use = paths.in_use();
        paths.publish(secs(3));
        paths.set_path(in_use, false);
        paths.publish(secs(6));
        paths.set_path(in_use, true);
        paths.is_complete(&format!("{mode:?}"));
    }
}

#[test]
fn daemon_that_is_killed_links_again_over_two_paths() {
    for (mode, config) in modes() {
        for host in 0..2 {
            let mut paths = TwoPaths::new(67, &config);
            paths.publish(secs(1));
            paths.world.kill(host, host == 0);
            paths.world.run_for(millis(100));
            paths.world.restart(host);
            paths.world.until(secs(10), World::is_whole);
            paths.world.hear_all_addresses();
            paths.world.run_for(secs(5));
            assert_eq!(paths.stands_by(), [true; 2], "{mode}, {host}: {}", paths.world.describe());
        }
    }
}

#[test]
fn renewal_of_a_link_without_data_in_flight_delays_no_sample() {
    for mode in [KeyMode::Session, KeyMode::Messages10] {
        let mut paths = TwoPaths::with(68, short_lived(mode));
        for _ in 0..4 {
            // The history holds less than two seconds of samples.
            let gap = paths.publish(secs(10));
            assert!(gap < millis(100), "{mode:?}: nothing arrived for {gap:?}");
        }
        paths.is_complete(&format!("{mode:?}"));
    }
}

#[test]
fn second_path_that_appears_during_a_cut_takes_over() {
    for (mode, config) in modes() {
        // QUIC keeps a link without an answer for 120 s.
        for before in [20, 140] {
            let mut paths = TwoPaths::new(69, &config);
            paths.every = 100;
            paths.set_path(1, false);
            paths.publish(secs(before));
            assert_eq!(paths.stands_by(), [false; 2], "{mode}: {}", paths.world.describe());
            paths.set_path(0, false);
            paths.publish(secs(3));
            paths.set_path(1, true);
            let gap = paths.publish(secs(6));
            println!("{mode}, {before} s: nothing arrived for {gap:?} after the path appeared");
            assert!(gap < secs(3), "{mode}, {before} s: nothing arrived for {gap:?}");
            assert_eq!(paths.in_use(), 1, "{mode}: {}", paths.world.describe());
            paths.set_path(0, true);
            paths.publish(secs(10));
            paths.is_complete(mode);
        }
    }
}

#[test]
fn hosts_that_shut_down_with_a_second_link_do_not_spin() {
    for (mode, config) in modes() {
        for stands_by in [true, false] {
            let mut paths = TwoPaths::new(70, &config);
            if !stands_by {
                // A second path is being looked for.
                paths.set_path(1, false);
                paths.publish(secs(1));
            }
            let before = paths.world.passes.clone();
            paths.world.close(0);
            paths.world.run_for(secs(5));
            for (before, after) in before.iter().zip(&paths.world.passes) {
                assert!(after - before < 200, "{mode}: {} passes in five seconds", after - before);
            }
        }
    }
}

#[test]
fn successor_over_the_path_of_the_second_link_ends_that_link() {
    let (mode, config) = modes().remove(0);
    let mut paths = TwoPaths::new(71, &config);
    // The beacons of host 1 come only from its second address, and both hosts probe each other there.
    let daemon = paths.world.hosts[1].daemon;
    paths.world.hosts[0].moved(daemon, paths.addresses[1]);
    paths.set_path(0, false);
    paths.publish(secs(2));
    assert_eq!(paths.in_use(), 1, "{mode}");
    paths.set_path(0, true);
    paths.publish(secs(10));
    assert_eq!(paths.stands_by(), [true; 2], "{mode}: {}", paths.world.describe());
    let standby = paths.world.hosts[0].status.values().find_map(|link| link.standby.clone());
    let first = format!("{}:", paths.addresses[0]);
    assert!(standby.unwrap().address.starts_with(&first), "{mode}: over the other path");
    paths.is_complete(mode);
}
