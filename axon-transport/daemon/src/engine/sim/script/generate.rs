//! Generates scripts from a seed.

use std::time::Duration;

use rand::{RngExt, seq::SliceRandom};

use super::{Fault, Kind, KmeFailure, PathChange, Qos, Script};
use crate::engine::sim::rng::{SimRng, Stream, stream};

/// Parameters of generated scripts.
#[derive(Clone, Debug)]
pub(crate) struct Recipe {
    pub(crate) hosts: usize,
    pub(crate) interfaces: usize,
    pub(crate) topics: usize,
    pub(crate) faults: usize,
    /// Latest beginning and end of a fault. Some publishers, subscriptions and path changes have no end.
    pub(crate) until: Duration,
    /// Longest duration of a fault.
    pub(crate) longest: Duration,
    pub(crate) weights: Weights,
}

/// The relative frequency of each kind of fault. A kind with weight 0 is not drawn.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Weights {
    pub(crate) partition: u32,
    pub(crate) cut: u32,
    pub(crate) kill: u32,
    pub(crate) pause: u32,
    pub(crate) path: u32,
    pub(crate) rebind: u32,
    pub(crate) change_address: u32,
    pub(crate) interface_down: u32,
    pub(crate) kme: u32,
    pub(crate) publisher: u32,
    pub(crate) subscription: u32,
    pub(crate) publish: u32,
}

impl Default for Weights {
    fn default() -> Self {
        Self {
            partition: 2,
            cut: 1,
            kill: 3,
            pause: 2,
            path: 4,
            rebind: 1,
            change_address: 1,
            interface_down: 1,
            kme: 1,
            publisher: 4,
            subscription: 4,
            publish: 8,
        }
    }
}

impl Weights {
    /// No kind at all, as a base.
    pub(crate) const NONE: Self = Self {
        partition: 0,
        cut: 0,
        kill: 0,
        pause: 0,
        path: 0,
        rebind: 0,
        change_address: 0,
        interface_down: 0,
        kme: 0,
        publisher: 0,
        subscription: 0,
        publish: 0,
    };
}

impl Script {
    /// Generates the script of a seed, sorted by time.
    ///
    /// # Panics
    /// If all weights are 0, or there is no host, interface or topic.
    pub(crate) fn generate(seed: u64, recipe: &Recipe) -> Self {
        let Recipe { hosts, faults, .. } = *recipe;
        let mut rng = stream(seed, Stream::Script);
        let mut faults: Vec<Fault> = (0..faults).map(|_| recipe.fault(&mut rng)).collect();
        faults.sort_by_key(|fault| fault.at);
        Self { seed, hosts, faults }
    }
}

type Draw = fn(&Recipe, &mut SimRng) -> Kind;

impl Recipe {
    fn fault(&self, rng: &mut SimRng) -> Fault {
        let w = &self.weights;
        // A cut, and a path, need two hosts.
        let pair = u32::from(self.hosts > 1);
        let kinds: [(u32, Draw); 12] = [
            (w.partition * pair, Self::partition),
            (w.cut * pair, |recipe, rng| {
                let [from, to] = recipe.two_hosts(rng);
                Kind::Cut { from, to }
            }),
            (w.kill, |recipe, rng| Kind::Kill {
                host: recipe.host(rng),
                orderly: rng.random_bool(0.25),
            }),
            (w.pause, |recipe, rng| Kind::Pause { host: recipe.host(rng) }),
            (w.path * pair, Self::path),
            (w.rebind, |recipe, rng| Kind::Rebind { host: recipe.host(rng) }),
            (w.change_address, |recipe, rng| Kind::Move {
                host: recipe.host(rng),
                interface: rng.random_range(0..recipe.interfaces),
            }),
            (w.interface_down, |recipe, rng| Kind::InterfaceDown {
                host: recipe.host(rng),
                interface: rng.random_range(0..recipe.interfaces),
            }),
            (w.kme, |recipe, rng| Kind::Kme {
                host: recipe.host(rng),
                failure: any(rng, &KmeFailure::ALL),
            }),
            (w.publisher, |recipe, rng| {
                let (host, topic) = recipe.endpoint(rng);
                Kind::Publisher { host, topic, qos: any(rng, &Qos::ALL) }
            }),
            (w.subscription, |recipe, rng| {
                let (host, topic) = recipe.endpoint(rng);
                Kind::Subscription { host, topic, qos: any(rng, &Qos::ALL) }
            }),
            (w.publish, Self::publish),
        ];
        let total: u32 = kinds.iter().map(|(weight, _)| weight).sum();
        assert!(total > 0, "no kind of fault has a weight");
        let mut pick = rng.random_range(0..total);
        let (_, draw) = kinds
            .iter()
            .find(|(weight, _)| match pick.checked_sub(*weight) {
                Some(rest) => {
                    pick = rest;
                    false
                }
                None => true,
            })
            .expect("below the sum of all");
        let kind = draw(self, rng);
        let at = millis(rng, Duration::ZERO, self.until);
        let lasts = millis(rng, Duration::from_millis(1), self.longest).min(self.until - at);
        let lasts = match &kind {
            Kind::Rebind { .. } | Kind::Move { .. } | Kind::Publish { .. } => None,
            Kind::Publisher { .. } | Kind::Subscription { .. } => {
                rng.random_bool(0.5).then_some(lasts)
            }
            Kind::Path { .. } => rng.random_bool(0.75).then_some(lasts),
            _ => Some(lasts),
        };
        Fault { at, lasts, kind }
    }

    fn host(&self, rng: &mut SimRng) -> usize {
        rng.random_range(0..self.hosts)
    }

    fn endpoint(&self, rng: &mut SimRng) -> (usize, usize) {
        (self.host(rng), rng.random_range(0..self.topics))
    }

    fn two_hosts(&self, rng: &mut SimRng) -> [usize; 2] {
        let from = self.host(rng);
        let step = rng.random_range(1..self.hosts);
        [from, (from + step) % self.hosts]
    }

    /// Takes a side of one host as often as a larger one.
    fn partition(&self, rng: &mut SimRng) -> Kind {
        let size = if rng.random_bool(0.5) { 1 } else { rng.random_range(1..=self.hosts / 2) };
        let mut hosts: Vec<usize> = (0..self.hosts).collect();
        hosts.shuffle(rng);
        hosts.truncate(size);
        hosts.sort_unstable();
        Kind::Partition { hosts }
    }

    fn path(&self, rng: &mut SimRng) -> Kind {
        let [from, to] = self.two_hosts(rng);
        let mut change = PathChange { delay: tenths(rng, 0..2_000), ..PathChange::default() };
        // A fault does not combine all impairments: single ones find more.
        if rng.random_bool(0.5) {
            change.loss = any(rng, &[1, 10, 50, 200, 400, 1_000]);
        }
        if rng.random_bool(0.3) {
            change.jitter = tenths(rng, 0..500);
        }
        if rng.random_bool(0.2) {
            change.duplicate = any(rng, &[10, 100, 500]);
        }
        if rng.random_bool(0.2) {
            change.reorder = any(rng, &[10, 100, 500]);
        }
        if rng.random_bool(0.3) {
            change.rate = Some(any(rng, &[1_000, 16_000, 125_000, 1_250_000, 12_500_000]));
        }
        Kind::Path { from, to, change }
    }

    fn publish(&self, rng: &mut SimRng) -> Kind {
        let (host, topic) = self.endpoint(rng);
        // Sizes at which something changes: empty, one packet and a little more, many packets.
        let size = any(rng, &[0, 1, 64, 1_000, 1_200, 1_400, 8_000, 65_536, 1_000_000]);
        let most = (4_000_000 / (size + 1)).clamp(1, 500);
        let count = rng.random_range(1..=most);
        let every = if rng.random_bool(0.5) { Duration::ZERO } else { tenths(rng, 1..100) };
        Kind::Publish { host, topic, count, size, every }
    }
}

fn any<T: Copy>(rng: &mut SimRng, all: &[T]) -> T {
    all[rng.random_range(0..all.len())]
}

/// Draws a number of tenths of milliseconds.
fn tenths(rng: &mut SimRng, range: std::ops::Range<u64>) -> Duration {
    Duration::from_micros(100 * rng.random_range(range))
}

/// Draws whole milliseconds between two times.
fn millis(rng: &mut SimRng, from: Duration, to: Duration) -> Duration {
    let [from, to] = [from, to].map(|time| time.as_millis() as u64);
    Duration::from_millis(rng.random_range(from..=to.max(from)))
}
