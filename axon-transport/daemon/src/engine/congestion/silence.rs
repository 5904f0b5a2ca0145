//! The bytes that may be sent beyond the window while nothing is acknowledged.
//!
//! A radio that loses packets in bursts may lose a whole window, and QUIC's probes with it. QUIC sends two probes after
//! a time that doubles each time, and nothing else while the window is full. A few more packets with each probe outlast
//! the burst, and so do the engine's own probes in between.

use std::{
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    time::{Duration, Instant},
};

/// Maximum number of packets that each probe of QUIC lets through, and maximum number beyond the window in all. Neither
/// exceeds the window.
const PACKETS: (u64, u64) = (16, 64);
/// Maximum number of packets that a probe of the engine lets through, and the divisor of the window for this number.
/// The engine's probes are much more frequent.
const OWN: (u64, u64) = (4, 8);
/// Minimum share of lost packets at which a silence may be a burst of losses.
const LOSES: f64 = 0.01;
/// Weight of a new round in the average of losses.
const AVERAGED: f64 = 1.0 / 16.0;
/// Maximum delay of an acknowledgement after the earliest one of the last round.
const LATE: Duration = Duration::from_millis(3);

/// The time since the peer acknowledged something.
#[derive(Debug, Clone)]
pub(super) struct UnansweredTime {
    /// When the last acknowledgement came, or when this side sent after the peer had acknowledged everything.
    since: Instant,
    /// The shortest round trip of the last round.
    round_trip: Duration,
    /// Bytes in flight.
    in_flight: u64,
    /// When the last probe was sent.
    probed_at: Option<Instant>,
    /// Bytes that were in flight then.
    before: u64,
    /// Whether the engine sent the last probe.
    is_own: bool,
    /// Whether one packet may leave although the window is full. All copies of a controller share it, since QUIC gives
    /// access only to copies. Relaxed suffices, because one thread uses all copies.
    probe: Arc<AtomicBool>,
    /// The share of packets that is lost.
    loss: f64,
}

impl UnansweredTime {
    pub(super) fn new(now: Instant) -> Self {
        Self {
            since: now,
            round_trip: Duration::MAX,
            in_flight: 0,
            probed_at: None,
            before: 0,
            is_own: false,
            probe: Arc::default(),
            loss: 0.0,
        }
    }

    /// Lets one packet leave although the window is full.
    pub(super) fn let_probe_through(&self) {
        self.probe.store(true, Ordering::Relaxed);
    }

    /// Sets the shortest round trip of a round.
    pub(super) fn set_round_trip(&mut self, round_trip: Duration) {
        self.round_trip = round_trip;
    }

    /// Handles sent bytes. If nothing was acknowledged for longer than a round trip, they are a probe.
    pub(super) fn handle_sent(&mut self, now: Instant, bytes: u64) {
        if self.in_flight == 0 {
            self.since = now;
        }
        let is_own = self.probe.swap(false, Ordering::Relaxed);
        let silent = now.saturating_duration_since(self.since);
        if silent > self.round_trip.saturating_add(LATE) && self.probed_at.is_none_or(|at| at < now)
        {
            (self.probed_at, self.before, self.is_own) = (Some(now), self.in_flight, is_own);
        }
        self.in_flight += bytes;
    }

    /// Handles lost bytes, which are no longer in flight.
    pub(super) fn handle_lost(&mut self, bytes: u64) {
        self.in_flight = self.in_flight.saturating_sub(bytes);
    }

    /// Handles acknowledgements, after which `in_flight` bytes are in flight.
    pub(super) fn handle_acks(&mut self, now: Instant, in_flight: u64) {
        (self.since, self.in_flight) = (now, in_flight);
        self.probed_at = None;
    }

    /// Adds the losses of a round, in bytes.
    pub(super) fn add_round(&mut self, acknowledged: u64, lost: u64) {
        let share = lost as f64 / (acknowledged + lost).max(1) as f64;
        self.loss += (share - self.loss) * AVERAGED;
    }

    /// Returns the maximum number of bytes in flight, which would be `window` without a silence.
    pub(super) fn widen(&self, window: u64, mtu: u64) -> u64 {
        if self.loss < LOSES {
            return window;
        }
        let more = match (self.is_own, self.probed_at) {
            (_, None) => 0,
            (true, _) => self.before + (window / OWN.1).clamp(mtu, OWN.0 * mtu),
            (false, _) => self.before + window.min(PACKETS.0 * mtu),
        };
        // QUIC sends while less than the window is in flight.
        let probe = if self.probe.load(Ordering::Relaxed) { self.in_flight + mtu + 1 } else { 0 };
        more.max(probe).min(window + window.min(PACKETS.1 * mtu)).max(window)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const ROUND_TRIP: Duration = Duration::from_millis(3);
    const MTU: u64 = 1_000;
    const WINDOW: u64 = 20 * MTU;

    /// Returns the state after a whole window was sent at once.
    fn full(start: Instant, lost: u64) -> UnansweredTime {
        let mut silence = UnansweredTime::new(start);
        for _ in 0..4 {
            silence.add_round(1_000 - lost, lost);
        }
        silence.set_round_trip(ROUND_TRIP);
        silence.handle_sent(start, WINDOW);
        silence
    }

    fn at(start: Instant, ms: u64) -> Instant {
        start + Duration::from_millis(ms)
    }

    #[test]
    fn each_probe_of_a_silent_path_lets_more_packets_through_until_one_is_acknowledged() {
        let start = Instant::now();
        let mut silence = full(start, 100);
        assert_eq!(silence.widen(WINDOW, MTU), WINDOW);
        for (ms, packets) in [(7, 36), (15, 40), (30, 40)] {
            // These are two probes and the rest of the window.
            silence.handle_sent(at(start, ms), 2 * MTU);
            assert_eq!(silence.widen(WINDOW, MTU), packets * MTU, "after {ms} ms");
            silence.handle_sent(at(start, ms), 14 * MTU);
            assert_eq!(silence.widen(WINDOW, MTU), packets * MTU, "one probe at a time");
        }
        silence.handle_acks(at(start, 200), MTU);
        assert_eq!(silence.widen(WINDOW, MTU), WINDOW);
    }

    #[test]
    fn a_probe_of_the_engine_lets_few_packets_through() {
        let start = Instant::now();
        let mut silence = full(start, 100);
        // QUIC gives access only to copies of a controller.
        silence.clone().let_probe_through();
        assert_eq!(silence.widen(WINDOW, MTU), WINDOW + MTU + 1);
        // While nothing is acknowledged, each probe lets an eighth of the window through, but at most four packets.
        for (number, ms) in (1..).zip([8, 11, 14]) {
            silence.handle_sent(at(start, ms), MTU);
            let more = silence.widen(WINDOW, MTU) - WINDOW;
            // Two and a half packets: an eighth of the window.
            assert_eq!(more, number * MTU + WINDOW / 8 - MTU, "after {ms} ms");
            silence.let_probe_through();
        }
    }

    #[test]
    fn a_path_that_had_nothing_to_carry_was_not_silent() {
        let start = Instant::now();
        let mut silence = full(start, 100);
        silence.handle_acks(at(start, 3), 0);
        silence.handle_sent(at(start, 5_000), MTU);
        silence.handle_sent(at(start, 5_006), MTU);
        assert_eq!(silence.widen(WINDOW, MTU), WINDOW);
    }

    #[test]
    fn a_path_that_loses_nothing_has_no_more_than_its_window() {
        let start = Instant::now();
        let mut silence = full(start, 1);
        silence.handle_sent(at(start, 100), MTU);
        assert_eq!(silence.widen(WINDOW, MTU), WINDOW);
    }
}
