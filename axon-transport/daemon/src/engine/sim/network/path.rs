//! Properties of a path, and their effect on packets.

use std::time::Duration;

use quinn_proto::EcnCodepoint;
use rand::RngExt;

use super::{
    counters::Cause,
    nanos,
    queue::{Backlog, Rate},
};
use crate::engine::sim::rng::SimRng;

/// Bytes of the IPv4 and UDP headers. Rates and MTUs count them; the counters of hosts do not.
pub(crate) const HEADERS: usize = 28;

/// One direction between two interfaces. Probabilities are per packet.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Path {
    pub(crate) delay: Duration,
    /// Largest addition to `delay`, drawn uniformly. Packets stay in order.
    pub(crate) jitter: Duration,
    /// Probability of independent loss.
    pub(crate) loss: f64,
    /// Loss in bursts, besides `loss`.
    pub(crate) burst_loss: Option<BurstLoss>,
    /// Probability that a packet arrives twice.
    pub(crate) duplicate: f64,
    /// Probability that a packet arrives later than its order, by up to `reorder_delay`.
    pub(crate) reorder: f64,
    pub(crate) reorder_delay: Duration,
    pub(crate) rate: Option<Rate>,
    /// Largest IP packet. Longer ones are dropped without a message to the sender.
    pub(crate) mtu: usize,
    /// Clears the ECN field of all packets.
    pub(crate) bleach_ecn: bool,
}

/// Loss by the Gilbert-Elliott model: a good state without loss, a bad state with. A transition is drawn for
/// each packet, before its loss.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct BurstLoss {
    pub(crate) good_to_bad: f64,
    pub(crate) bad_to_good: f64,
    pub(crate) loss_in_bad: f64,
}

/// A quiet Ethernet segment.
impl Default for Path {
    fn default() -> Self {
        Self {
            delay: Duration::from_micros(100),
            jitter: Duration::ZERO,
            loss: 0.0,
            burst_loss: None,
            duplicate: 0.0,
            reorder: 0.0,
            reorder_delay: Duration::ZERO,
            rate: None,
            mtu: 1_500,
            bleach_ecn: false,
        }
    }
}

impl Path {
    /// # Panics
    /// If a probability is outside 0..=1.
    pub(super) fn validate(&self) {
        let burst = self.burst_loss.unwrap_or(BurstLoss {
            good_to_bad: 0.0,
            bad_to_good: 0.0,
            loss_in_bad: 0.0,
        });
        let all = [
            self.loss,
            self.duplicate,
            self.reorder,
            burst.good_to_bad,
            burst.bad_to_good,
            burst.loss_in_bad,
        ];
        assert!(all.iter().all(|p| (0.0..=1.0).contains(p)), "probability outside 0..=1: {self:?}");
    }
}

/// State of one direction between two interfaces. There may be a million of them.
pub(super) struct Link {
    rng: SimRng,
    backlog: Backlog,
    /// Arrival of the last packet that kept its order.
    last_arrival: u64,
    in_bad_state: bool,
    /// Overrides the network's default.
    pub(super) path: Option<Box<Path>>,
}

/// When a packet arrives, in nanoseconds, and how.
#[derive(Clone, Copy, Debug)]
pub(super) struct Fate {
    pub(super) arrival: u64,
    pub(super) second_arrival: Option<u64>,
    pub(super) ecn: Option<EcnCodepoint>,
}

impl Link {
    pub(super) fn new(rng: SimRng) -> Self {
        Self { rng, backlog: Backlog::default(), last_arrival: 0, in_bad_state: false, path: None }
    }

    /// Decides the fate of a packet of `bytes` (headers included) that enters the path at `now`.
    pub(super) fn cross(
        &mut self,
        default: &Path,
        now: u64,
        bytes: usize,
        ecn: Option<EcnCodepoint>,
    ) -> Result<Fate, Cause> {
        let path = self.path.as_deref().unwrap_or(default);
        if bytes > path.mtu {
            return Err(Cause::Mtu);
        }
        let (mut departs, mut ecn) = (now, ecn);
        if let Some(rate) = &path.rate {
            let departure = self.backlog.admit(rate, now, bytes).ok_or(Cause::Queue)?;
            departs = departure.at;
            if departure.mark {
                ecn = mark(ecn);
            }
        }
        if path.bleach_ecn {
            ecn = None;
        }
        if let Some(burst) = path.burst_loss {
            let turn = if self.in_bad_state { burst.bad_to_good } else { burst.good_to_bad };
            self.in_bad_state ^= happens(&mut self.rng, turn);
            if self.in_bad_state && happens(&mut self.rng, burst.loss_in_bad) {
                return Err(Cause::Loss);
            }
        }
        if happens(&mut self.rng, path.loss) {
            return Err(Cause::Loss);
        }
        let (rng, last) = (&mut self.rng, &mut self.last_arrival);
        let arrival = arrival(path, rng, last, departs);
        let twice = happens(rng, path.duplicate);
        let second_arrival = twice.then(|| self::arrival(path, rng, last, departs));
        Ok(Fate { arrival, second_arrival, ecn })
    }
}

fn arrival(path: &Path, rng: &mut SimRng, last: &mut u64, departs: u64) -> u64 {
    let delay = nanos(path.delay).saturating_add(up_to(rng, path.jitter));
    let arrival = departs.saturating_add(delay);
    if happens(rng, path.reorder) {
        return arrival.saturating_add(up_to(rng, path.reorder_delay));
    }
    // Packets that are held up do not overtake each other, and a shorter delay takes effect only behind them.
    *last = arrival.max(*last);
    *last
}

/// Marks an ECN-capable packet as one that met congestion.
pub(super) fn mark(ecn: Option<EcnCodepoint>) -> Option<EcnCodepoint> {
    ecn.map(|_| EcnCodepoint::Ce)
}

fn happens(rng: &mut SimRng, probability: f64) -> bool {
    probability > 0.0 && rng.random_bool(probability)
}

/// Draws a time of at most `limit`, in nanoseconds.
fn up_to(rng: &mut SimRng, limit: Duration) -> u64 {
    if limit.is_zero() { 0 } else { rng.random_range(0..=nanos(limit)) }
}
