//! One direction of a path: its rate, its queue, its delay and its losses. Holds no packet and reads no clock.

use std::time::{Duration, Instant};

use rand::{RngExt, rngs::StdRng};
use serde::Serialize;

/// Which packets are lost on the air. They take their time there, as the frames of a radio do.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Loss {
    /// The share of packets that is lost.
    pub(crate) share: f64,
    /// Mean length of a burst of lost packets. 1: packets are lost independently.
    pub(crate) burst: f64,
}

impl Loss {
    pub(crate) const NONE: Self = Self { share: 0.0, burst: 1.0 };
}

/// The effects of a path on packets.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Settings {
    /// Bits a second.
    pub(crate) rate: f64,
    /// Bytes that may wait for their turn.
    pub(crate) queue: usize,
    /// Time from the end of a packet on this side to its arrival.
    pub(crate) delay: Duration,
    pub(crate) loss: Loss,
    /// Whether no packet gets through.
    pub(crate) is_cut: bool,
}

/// Counters of packets, by their fate.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub(crate) struct Counters {
    pub(crate) packets: u64,
    pub(crate) lost: u64,
    pub(crate) overflowed: u64,
}

impl Counters {
    /// Returns the differences to the counters `before`.
    pub(crate) fn since(&self, before: &Self) -> Self {
        Self {
            packets: self.packets - before.packets,
            lost: self.lost - before.lost,
            overflowed: self.overflowed - before.overflowed,
        }
    }

    /// Returns the lost packets as a percentage of those that the path took.
    pub(crate) fn lost_percent(&self) -> f64 {
        100.0 * self.lost as f64 / (self.packets - self.overflowed).max(1) as f64
    }
}

/// One direction.
pub(crate) struct Path {
    pub(crate) settings: Settings,
    pub(crate) counters: Counters,
    /// When the last packet in the queue has left.
    free_at: Instant,
    /// A burst of losses is under way.
    is_bad: bool,
    random: StdRng,
}

impl Path {
    pub(crate) fn new(settings: Settings, random: StdRng, now: Instant) -> Self {
        Self { settings, counters: Counters::default(), free_at: now, is_bad: false, random }
    }

    /// Returns when a packet of this many bytes, which comes now, reaches the other end; `None` if it is lost.
    pub(crate) fn handle_packet(&mut self, now: Instant, bytes: usize) -> Option<Instant> {
        self.counters.packets += 1;
        if self.settings.is_cut {
            self.counters.lost += 1;
            return None;
        }
        let begins = self.free_at.max(now);
        let waiting = (begins - now).as_secs_f64() * self.settings.rate / 8.0;
        if waiting as usize + bytes > self.settings.queue {
            self.counters.overflowed += 1;
            return None;
        }
        self.free_at = begins + Duration::from_secs_f64(bytes as f64 * 8.0 / self.settings.rate);
        if self.is_lost() {
            self.counters.lost += 1;
            return None;
        }
        Some(self.free_at + self.settings.delay)
    }

    /// Returns whether a packet is lost, by Gilbert's model: none between bursts, every one within a burst.
    fn is_lost(&mut self) -> bool {
        let Loss { share, burst } = self.settings.loss;
        if burst <= 1.0 {
            return self.random.random_bool(share);
        }
        let ends = 1.0 / burst;
        let turns = if self.is_bad { ends } else { (ends * share / (1.0 - share)).min(1.0) };
        self.is_bad ^= self.random.random_bool(turns);
        self.is_bad
    }
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;

    use super::*;

    const PACKET: usize = 1_000;

    fn path(loss: Loss) -> (Path, Instant) {
        let now = Instant::now();
        let delay = Duration::from_millis(5);
        // A packet a millisecond.
        let settings = Settings { rate: 8e6, queue: 4 * PACKET, delay, loss, is_cut: false };
        (Path::new(settings, StdRng::seed_from_u64(7), now), now)
    }

    #[test]
    fn packets_leave_at_the_rate_and_queue_overflow_is_dropped() {
        let (mut path, now) = path(Loss::NONE);
        let at: Vec<_> = (0..6).map(|_| path.handle_packet(now, PACKET)).collect();
        let ms = |ms| Some(now + Duration::from_millis(ms));
        assert_eq!(at, [ms(6), ms(7), ms(8), ms(9), None, None]);
        assert_eq!(path.counters.overflowed, 2);
        // A while later one of them has left.
        let later = now + Duration::from_millis(1);
        assert_eq!(path.handle_packet(later, PACKET), ms(10));
    }

    #[test]
    fn as_many_are_lost_as_asked_for_in_bursts_as_long_as_asked_for() {
        for (share, burst) in [(0.1, 1.0), (0.4, 1.0), (0.1, 8.0), (0.4, 8.0)] {
            let (mut path, now) = path(Loss { share, burst });
            let (count, every) = (200_000, Duration::from_millis(1));
            let lost: Vec<bool> = (0..count)
                .map(|number| path.handle_packet(now + every * number, PACKET).is_none())
                .collect();
            let all = lost.iter().filter(|lost| **lost).count() as f64;
            let begins = lost.windows(2).filter(|pair| !pair[0] && pair[1]).count() as f64;
            assert!((all / f64::from(count) - share).abs() < 0.02, "{share}, {burst}: {all}");
            // Independent losses follow each other by chance.
            let mean = if burst > 1.0 { burst } else { 1.0 / (1.0 - share) };
            assert!((all / begins / mean - 1.0).abs() < 0.1, "{share}, {burst}: {}", all / begins);
        }
    }

    #[test]
    fn nothing_passes_a_path_that_is_cut() {
        let (mut path, now) = path(Loss::NONE);
        path.settings.is_cut = true;
        assert_eq!(path.handle_packet(now, PACKET), None);
        path.settings.is_cut = false;
        assert!(path.handle_packet(now, PACKET).is_some());
    }
}
