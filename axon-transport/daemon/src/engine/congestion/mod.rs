//! The congestion controller of links between robots: it obeys delay and ECN marks, and ignores random loss.
//!
//! Radio links lose packets that no queue dropped, and their queues are deep. CUBIC halves at each loss and fills each
//! queue: at 1 % of loss it leaves most of a link unused, and without loss a command waits behind a full queue.
//!
//! Once a round, which is the time until a packet that was sent at its start is acknowledged, [`Delay`] compares the
//! shortest round trip of the round with the shortest one of the path. The difference is the time in queues.
//! * Up to twice the wanted queue the window grows, faster after quiet rounds.
//! * Beyond it the window shrinks to what drains the queue. All links at one bottleneck see the queue at the same time
//!   and drain it together. So each sees the path without a queue, and all come to equal shares.
//! * Where packets are lost, growth must bring more bytes through: a queue too short to be seen drops instead
//!   ([`growth`]).
//! * While nothing is acknowledged, probes may exceed the window ([`silence`]).
//! * Where the window shrinks and the queue does not, other traffic fills the queue, or the path has become longer.
//!   Until that is known CUBIC decides, which gets its share beside other CUBIC flows ([`competition`]).

mod competition;
mod growth;
pub(in crate::engine) mod marks;
mod path;
mod silence;

use std::{
    any::Any,
    sync::Arc,
    time::{Duration, Instant},
};

use quinn_proto::{
    RttEstimator,
    congestion::{Controller, ControllerFactory, ControllerMetrics},
};

use competition::{Competition, Outcome, PersistentQueue};
use growth::{Growth, TRIAL};
use marks::wrapped;
use path::Path;
use silence::UnansweredTime;

/// The wanted queue is half as long as the path, within these bounds.
const WANTED: (Duration, Duration) = (Duration::from_millis(2), Duration::from_millis(10));
/// The shortest wanted queue in packets: a slow path cannot have a shorter one.
const PACKETS_WANTED: f64 = 2.0;
/// The wanted queue is at least this many times the random variation of round trips.
const BY_CHANCE: u32 = 8;
/// The smallest window in packets. QUIC sends while less than the window is in flight. So this is two whole
/// packets and a third, partial one; the second packet is acknowledged at once.
const FLOOR: u64 = 3;
/// The window at the start in packets and in bytes: the larger of the two (RFC 9002, 7.2).
const INITIAL: (u64, u64) = (10, 14_720);
/// The share of the path that is filled after the window shrank: a little less than all of it, so that the queue
/// empties. A path that is new was perhaps never seen without a queue, and is drained further.
const DRAINED: (f64, f64) = (0.95, 0.75);
/// Reductions of the window until a path is not new any more.
const NEW: u32 = 4;
/// The smallest and the largest share of the window that remains after a reduction.
const SHRUNK: (f64, f64) = (0.25, 0.9);
/// A round trip is urgent if it exceeds the path by this time.
const URGENT: Duration = Duration::from_millis(50);
/// After this many urgent round trips in a row the controller reacts before the round ends.
const URGENT_IN_A_ROW: u32 = 4;
/// Packets at the beginning of a round that show a queue while the window doubles.
const TELLING: u32 = 8;
/// Rounds with more losses and no more bytes after which the start ends.
const IDLE: u32 = 3;
/// The share of the window that remains after an ECN mark, and after a time without any acknowledgement.
const MARKED: (f64, f64) = (0.8, 0.5);

/// The settings of [`Delay`], which has none.
#[derive(Debug, Clone, Copy)]
pub(crate) struct DelayConfig;

impl ControllerFactory for DelayConfig {
    fn build(self: Arc<Self>, now: Instant, current_mtu: u16) -> Box<dyn Controller> {
        Box::new(Delay::new(now, current_mtu))
    }
}

/// Lets the next packet leave although the window is full. It shows which earlier packets are lost.
pub(crate) fn let_probe_through(quic: &quinn_proto::Connection) {
    // Other controllers, CUBIC and BBR, have no such probe.
    if let Some(delay) = wrapped(quic).and_then(|controller| controller.downcast::<Delay>().ok()) {
        delay.silence.let_probe_through();
    }
}

/// The rule that the window follows.
#[derive(Debug, Clone)]
enum WindowPhase {
    /// The window doubles each round until there is a queue, or until doubling brings no more bytes through.
    Start {
        /// The most bytes a second that a round brought through.
        best: f64,
        /// Rounds with losses in which `best` did not grow.
        idle: u32,
    },
    /// The window follows the queue.
    Steady,
    /// The window follows CUBIC.
    Compete(Competition),
}

/// The measurements of a round so far.
#[derive(Debug, Clone)]
struct WindowRound {
    started: Instant,
    /// The packet whose acknowledgement ends the round.
    last_packet: u64,
    shortest: Option<Duration>,
    packets: u32,
    acknowledged: u64,
    lost: u64,
    most_in_flight: u64,
}

impl WindowRound {
    fn new(started: Instant, last_packet: u64) -> Self {
        Self {
            started,
            last_packet,
            shortest: None,
            packets: 0,
            acknowledged: 0,
            lost: 0,
            most_in_flight: 0,
        }
    }

    /// Returns how long the round has lasted. Acknowledgements of several round trips may arrive at once, but
    /// a round is no shorter than a round trip.
    fn time(&self, now: Instant) -> Duration {
        let least = self.shortest.unwrap_or_default().max(Duration::from_micros(1));
        now.saturating_duration_since(self.started).max(least)
    }
}

/// A window that follows the time that packets spend in queues.
#[derive(Debug, Clone)]
pub(crate) struct Delay {
    window: u64,
    mtu: u64,
    phase: WindowPhase,
    path: Path,
    /// Times that the window shrank on this path.
    drains: u32,
    round: WindowRound,
    growth: Growth,
    /// A queue that has remained since the window began to shrink.
    standing: Option<PersistentQueue>,
    silence: UnansweredTime,
    last_sent: u64,
    /// The random variation between the shortest round trips of rounds.
    jitter: Duration,
    last_shortest: Option<Duration>,
    /// Recent throughput in bytes per second.
    rate: f64,
    /// Bytes by which the window may grow in the next round.
    step: u64,
    /// Rounds of packets that were sent before the window shrank: they say nothing about the smaller window.
    settling: u32,
    /// The number of urgent round trips in a row, and the shortest of them.
    urgent: (u32, Duration),
    /// Bytes of the acknowledgements that are being processed.
    acknowledged_now: u64,
    /// The controller has reacted to marks and losses of packets sent before this time.
    obeyed: Option<Instant>,
}

impl Delay {
    fn new(now: Instant, mtu: u16) -> Self {
        let mtu = u64::from(mtu);
        let window = INITIAL.1.max(INITIAL.0 * mtu);
        Self {
            window,
            mtu,
            phase: WindowPhase::Start { best: 0.0, idle: 0 },
            path: Path::new(now),
            drains: 0,
            round: WindowRound::new(now, 0),
            growth: Growth::new(window),
            standing: None,
            silence: UnansweredTime::new(now),
            last_sent: 0,
            jitter: Duration::ZERO,
            last_shortest: None,
            rate: 0.0,
            step: mtu,
            settling: 0,
            urgent: (0, Duration::MAX),
            acknowledged_now: 0,
            obeyed: None,
        }
    }

    /// Returns the queue that this link wants.
    fn wanted(&self) -> Duration {
        let packets = PACKETS_WANTED * self.mtu as f64 / self.rate.max(1e3);
        self.wanted_at_any_rate().max(Duration::from_secs_f64(packets))
    }

    /// Returns the queue that this link wants without regard to the length of packets.
    fn wanted_at_any_rate(&self) -> Duration {
        (self.path.get() / 2).max(self.jitter * BY_CHANCE).clamp(WANTED.0, WANTED.1)
    }

    /// Sets the window so that a queue of this length drains.
    fn drain(&mut self, queue: Duration) {
        let path = self.path.get().as_secs_f64();
        let by_chance = (self.jitter * BY_CHANCE).min(WANTED.1).as_secs_f64();
        let filled = if self.drains < NEW { DRAINED.1 } else { DRAINED.0 };
        let share = (filled * path + by_chance) / (path + queue.as_secs_f64());
        self.drains += 1;
        self.shrink(share.clamp(SHRUNK.0, SHRUNK.1));
    }

    /// Reduces the window to this share.
    fn shrink(&mut self, share: f64) {
        self.set_window((self.window as f64 * share) as u64);
    }

    /// Sets another window. Growth starts anew once the packets in flight have arrived.
    fn set_window(&mut self, window: u64) {
        self.window = window.max(FLOOR * self.mtu);
        self.step = self.mtu;
        self.settling = 1;
        self.urgent = (0, Duration::MAX);
        self.growth.restart(self.window);
    }

    fn end_round(&mut self, now: Instant, is_app_limited: bool) {
        let round = std::mem::replace(&mut self.round, WindowRound::new(now, self.last_sent));
        self.silence.add_round(round.acknowledged, round.lost);
        let Some(shortest) = round.shortest else { return };
        self.silence.set_round_trip(shortest);
        let queue = shortest.saturating_sub(self.path.get());
        if self.settling > 0 {
            self.last_shortest = None;
        } else if let Some(last) = self.last_shortest.replace(shortest) {
            // A queue of this link only grows while the window does, so a decrease in this phase is random.
            self.jitter = (self.jitter * 7 + last.saturating_sub(shortest)) / 8;
        }
        let time = round.time(now);
        let rate = round.acknowledged as f64 / time.as_secs_f64();
        if !is_app_limited {
            self.rate = rate.max(self.rate * 0.8);
        }
        match &self.phase {
            WindowPhase::Start { .. } if is_app_limited => {}
            WindowPhase::Start { .. } => self.end_round_of_start(&round, rate, queue),
            WindowPhase::Compete(_) => self.end_round_of_competition(now, shortest),
            WindowPhase::Steady => {
                if queue <= self.wanted() / 2 {
                    self.standing = None;
                }
                if self.settling > 0 {
                    self.settling -= 1;
                    self.urgent = (0, Duration::MAX);
                } else if is_app_limited {
                    // The window does not fill a queue then, and a lone packet is acknowledged late.
                } else if queue > self.wanted() * 2 {
                    self.end_round_of_queue(now, rate, shortest, queue);
                } else {
                    self.growth.add(round.acknowledged, round.lost, time, self.mtu);
                    // A window that was never half used says nothing about a larger one.
                    if round.most_in_flight >= self.window / 2 {
                        self.grow(queue);
                    }
                }
            }
        }
    }

    /// Returns whether the window doubles and the first packets of this round already were in a queue. At the
    /// end of the round it would have doubled once more.
    fn starts_too_fast(&self) -> bool {
        let is_start = matches!(self.phase, WindowPhase::Start { .. });
        let queue = self.round.shortest.unwrap_or_default().saturating_sub(self.path.get());
        is_start && self.round.packets >= TELLING && queue > self.wanted()
    }

    fn end_round_of_start(&mut self, round: &WindowRound, rate: f64, queue: Duration) {
        let wanted = self.wanted();
        let WindowPhase::Start { best, idle } = &mut self.phase else { return };
        let lost = round.lost as f64 / (round.lost + round.acknowledged).max(1) as f64;
        if rate > *best * TRIAL {
            *idle = 0;
            self.growth.add_random_loss(lost);
        } else if self.growth.is_excessive(lost) {
            *idle += 1;
        }
        *best = best.max(rate);
        if queue > wanted || *idle >= IDLE {
            // The last round doubled the window, and the effect is not measured yet.
            let held = self.growth.held(*best, self.path.get() + queue);
            self.phase = WindowPhase::Steady;
            self.set_window(self.window.min(held.max(self.window / 4)));
        }
    }

    fn end_round_of_queue(&mut self, now: Instant, rate: f64, shortest: Duration, queue: Duration) {
        let window = self.window;
        let standing = self.standing.get_or_insert_with(|| PersistentQueue::new(now, window, rate));
        if let Some(peak) = standing.shrink(now, window, rate, FLOOR * self.mtu) {
            self.standing = None;
            self.phase = WindowPhase::Compete(Competition::new(now, peak, self.mtu, shortest));
        } else {
            self.drain(queue);
        }
    }

    fn end_round_of_competition(&mut self, now: Instant, shortest: Duration) {
        // A small share of the path makes the rate small, and would make any queue look like one of two packets.
        let (path, wanted) = (self.path.get(), self.wanted_at_any_rate());
        let WindowPhase::Compete(competition) = &mut self.phase else { return };
        let share = competition.share();
        match competition.end_round(now, shortest, path, wanted) {
            Outcome::Goes => return,
            Outcome::Over => self.phase = WindowPhase::Steady,
            Outcome::Longer(rtt) => {
                self.path = Path::of(now, rtt);
                self.drains = 0;
                self.phase = WindowPhase::Start { best: 0.0, idle: 0 };
            }
        }
        self.set_window(share);
    }

    /// Lets the window grow by a step, unless the last steps brought no more bytes through.
    fn grow(&mut self, queue: Duration) {
        let rtt = self.path.get() + queue;
        if let Some(smaller) = self.growth.judge(self.window, self.mtu, FLOOR * self.mtu, rtt) {
            self.window = smaller;
            (self.step, self.settling) = (self.mtu, 1);
            return;
        }
        if self.growth.waits(self.window) {
            return;
        }
        let wanted = self.wanted();
        let most = if queue < wanted / 4 {
            self.window / 4
        } else {
            // A quarter of the wanted queue.
            let share = wanted.as_secs_f64() / 4.0 / rtt.as_secs_f64();
            (self.window as f64 * share.min(0.25)) as u64
        };
        self.window += self.step.min(most.max(self.mtu));
        if !self.growth.is_careful() {
            self.step = (self.step * 2).min(self.window / 4).max(self.mtu);
        }
    }
}

impl Controller for Delay {
    fn on_sent(&mut self, now: Instant, bytes: u64, last_packet_number: u64) {
        self.last_sent = last_packet_number;
        self.silence.handle_sent(now, bytes);
        if let WindowPhase::Compete(competition) = &mut self.phase {
            competition.cubic_always().on_sent(now, bytes, last_packet_number);
        }
    }

    fn on_ack(
        &mut self,
        now: Instant,
        sent: Instant,
        bytes: u64,
        app_limited: bool,
        rtt: &RttEstimator,
    ) {
        let taken = now.saturating_duration_since(sent);
        self.path.add(now, taken);
        let shortest = self.round.shortest.map_or(taken, |shortest| shortest.min(taken));
        self.round.shortest = Some(shortest);
        self.round.acknowledged += bytes;
        self.round.packets += 1;
        self.acknowledged_now += bytes;
        match &mut self.phase {
            WindowPhase::Start { .. } if !app_limited => self.window += bytes,
            WindowPhase::Compete(competition) => {
                if let Some(cubic) = competition.cubic() {
                    cubic.on_ack(now, sent, bytes, app_limited, rtt);
                }
            }
            _ => {}
        }
        self.urgent = if taken > self.path.get() + URGENT {
            (self.urgent.0 + 1, self.urgent.1.min(taken))
        } else {
            (0, Duration::MAX)
        };
    }

    fn on_end_acks(
        &mut self,
        now: Instant,
        in_flight: u64,
        app_limited: bool,
        largest_packet_num_acked: Option<u64>,
    ) {
        self.silence.handle_acks(now, in_flight);
        let on_the_way = in_flight + std::mem::take(&mut self.acknowledged_now);
        self.round.most_in_flight = self.round.most_in_flight.max(on_the_way);
        let (in_a_row, shortest) = self.urgent;
        let is_competing = matches!(self.phase, WindowPhase::Compete(_));
        let may_drain = self.settling == 0 && !app_limited && !is_competing;
        if in_a_row >= URGENT_IN_A_ROW && may_drain {
            self.phase = WindowPhase::Steady;
            let queue = shortest.saturating_sub(self.path.get());
            let rate = self.round.acknowledged as f64 / self.round.time(now).as_secs_f64();
            self.end_round_of_queue(now, rate, shortest, queue);
            self.round = WindowRound::new(now, self.last_sent);
        } else if largest_packet_num_acked.is_some_and(|largest| largest >= self.round.last_packet)
            || self.starts_too_fast()
        {
            self.end_round(now, app_limited);
        }
    }

    fn on_congestion_event(
        &mut self,
        now: Instant,
        sent: Instant,
        is_persistent_congestion: bool,
        lost_bytes: u64,
    ) {
        self.round.lost += lost_bytes;
        self.silence.handle_lost(lost_bytes);
        if let WindowPhase::Compete(competition) = &mut self.phase {
            let cubic = competition.cubic_always();
            return cubic.on_congestion_event(now, sent, is_persistent_congestion, lost_bytes);
        }
        // A router's mark arrives as a congestion event without losses.
        let (share, least) = match (is_persistent_congestion, lost_bytes) {
            // Chance does this too where little is sent and much is lost, and a window that has hardly any packet on
            // the way does not learn that it could have more.
            (true, _) => (MARKED.1, self.initial_window()),
            (false, 0) => (MARKED.0, 0),
            (false, _) => return,
        };
        if self.obeyed.is_none_or(|obeyed| sent > obeyed) && self.window > least {
            self.obeyed = Some(now);
            self.phase = WindowPhase::Steady;
            self.shrink(share);
        }
    }

    fn on_mtu_update(&mut self, new_mtu: u16) {
        self.mtu = u64::from(new_mtu);
        self.window = self.window.max(FLOOR * self.mtu);
        if let WindowPhase::Compete(competition) = &mut self.phase {
            competition.cubic_always().on_mtu_update(new_mtu);
        }
    }

    fn window(&self) -> u64 {
        let floor = FLOOR * self.mtu;
        match &self.phase {
            // A probe measures the queue with few packets in flight.
            WindowPhase::Compete(competition) => competition.window().unwrap_or(floor).max(floor),
            _ => self.silence.widen(self.window, self.mtu),
        }
    }

    fn metrics(&self) -> ControllerMetrics {
        let mut metrics = ControllerMetrics::default();
        metrics.congestion_window = self.window();
        metrics
    }

    fn clone_box(&self) -> Box<dyn Controller> {
        Box::new(self.clone())
    }

    fn initial_window(&self) -> u64 {
        INITIAL.1.max(INITIAL.0 * self.mtu)
    }

    fn into_any(self: Box<Self>) -> Box<dyn Any> {
        self
    }
}
