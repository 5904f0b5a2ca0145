//! A transmitter of limited rate and the queue in front of it.

use std::time::Duration;

use super::nanos;

/// A rate, and the treatment of packets that exceed it.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Rate {
    /// IP bytes per second. At 0 every packet is dropped.
    pub(crate) bytes_per_second: u64,
    /// Packets that find the queue full are dropped (tail drop). A packet that finds the transmitter idle
    /// always passes.
    pub(crate) limit: QueueLimit,
    /// Waiting time from which on ECN-capable packets are marked CE.
    pub(crate) mark_after: Option<Duration>,
}

/// Capacity of a queue.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum QueueLimit {
    /// IP bytes that wait or are being transmitted, the new packet included.
    Bytes(u64),
    /// Time that the new packet would wait.
    Time(Duration),
}

impl Rate {
    /// Returns a rate whose queue drops packets that would wait longer than `wait`, without ECN marks.
    pub(crate) fn new(bytes_per_second: u64, wait: Duration) -> Self {
        Self { bytes_per_second, limit: QueueLimit::Time(wait), mark_after: None }
    }
}

/// State of a transmitter: when it will have sent all that was admitted.
///
/// A rate that changes holds for packets that come later; the packets that wait leave as was planned.
#[derive(Clone, Debug, Default)]
pub(super) struct Backlog {
    busy_until: u64,
    /// Fraction of a nanosecond beyond `busy_until`, in units of 1 / rate, so that no rounding adds up.
    fraction: u64,
}

/// When an admitted packet has left, and whether it is to be marked CE.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Departure {
    pub(super) at: u64,
    pub(super) mark: bool,
}

impl Backlog {
    /// Admits a packet of `bytes`, or returns `None` if it is dropped. Times are nanoseconds.
    pub(super) fn admit(&mut self, rate: &Rate, now: u64, bytes: usize) -> Option<Departure> {
        const SECOND: u64 = 1_000_000_000;
        let speed = rate.bytes_per_second;
        if speed == 0 {
            return None;
        }
        if self.busy_until <= now {
            *self = Self { busy_until: now, fraction: 0 };
        }
        let wait = self.busy_until - now;
        if wait > 0 {
            let full = match rate.limit {
                QueueLimit::Time(limit) => wait > nanos(limit),
                QueueLimit::Bytes(limit) => {
                    let queued = u128::from(wait) * u128::from(speed) / u128::from(SECOND);
                    queued + bytes as u128 > u128::from(limit)
                }
            };
            if full {
                return None;
            }
        }
        // The fraction may be of a former, higher rate.
        let fraction = self.fraction.min(speed - 1);
        let work = (bytes as u64).saturating_mul(SECOND).saturating_add(fraction);
        self.busy_until = self.busy_until.saturating_add(work / speed);
        self.fraction = work % speed;
        let mark = rate.mark_after.is_some_and(|after| wait >= nanos(after));
        Some(Departure { at: self.busy_until, mark })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SECOND: u64 = 1_000_000_000;

    fn bytes(bytes_per_second: u64, limit: u64) -> Rate {
        Rate { bytes_per_second, limit: QueueLimit::Bytes(limit), mark_after: None }
    }

    #[test]
    fn rate_of_zero_drops_everything() {
        let mut backlog = Backlog::default();
        for now in [0, 1, SECOND, u64::MAX] {
            assert_eq!(backlog.admit(&bytes(0, u64::MAX), now, 0), None);
        }
    }

    #[test]
    fn rounding_does_not_add_up() {
        // No packet of 1,000 bytes takes a whole number of nanoseconds.
        for speed in [3, 7_000_001, 999_999_937, 123_456_789_011] {
            let rate = bytes(speed, u64::MAX);
            let mut backlog = Backlog::default();
            let mut last = 0;
            for _ in 0..10_000 {
                last = backlog.admit(&rate, 0, 1_000).unwrap().at;
            }
            let exact = 10_000_u128 * 1_000 * u128::from(SECOND) / u128::from(speed);
            assert_eq!(u128::from(last), exact, "{speed} B/s");
        }
    }

    #[test]
    fn idle_transmitter_takes_a_packet_larger_than_its_queue() {
        let rate = bytes(1_000, 10);
        let mut backlog = Backlog::default();
        assert_eq!(backlog.admit(&rate, 5, 1_000).unwrap().at, 5 + SECOND);
        assert_eq!(backlog.admit(&rate, 5, 1), None);
        assert_eq!(backlog.admit(&rate, 4 + SECOND, 20), None);
        assert_eq!(backlog.admit(&rate, 5 + SECOND, 20).unwrap().at, 5 + SECOND + SECOND / 50);
    }

    #[test]
    fn queue_holds_its_bytes_and_frees_them_as_they_leave() {
        let rate = bytes(1_000, 1_000);
        let mut backlog = Backlog::default();
        let admitted = (0..100).filter(|_| backlog.admit(&rate, 0, 100).is_some()).count();
        assert_eq!(admitted, 10);
        assert_eq!(backlog.admit(&rate, SECOND / 10, 101), None);
        assert!(backlog.admit(&rate, SECOND / 10, 100).is_some());
    }

    #[test]
    fn queue_limited_by_time_drops_packets_that_would_wait_longer() {
        let rate = Rate::new(1_000, Duration::from_millis(500));
        let mut backlog = Backlog::default();
        let departures: Vec<_> =
            (0..100).filter_map(|_| backlog.admit(&rate, 0, 100)).map(|d| d.at).collect();
        // The sixth waits for exactly 500 ms.
        assert_eq!(departures.len(), 6);
        assert_eq!(departures[5], 600_000_000);
    }

    #[test]
    fn packets_that_wait_are_marked() {
        let mark_after = Some(Duration::from_millis(200));
        let rate = Rate { mark_after, ..bytes(1_000, u64::MAX) };
        let mut backlog = Backlog::default();
        let marks: Vec<_> = (0..4).map(|_| backlog.admit(&rate, 0, 100).unwrap().mark).collect();
        assert_eq!(marks, [false, false, true, true]);
    }

    #[test]
    fn fraction_of_a_higher_rate_is_not_carried_to_a_lower_one() {
        let mut backlog = Backlog::default();
        let fast = backlog.admit(&bytes(123_456_789_011, u64::MAX), 0, 65_535).unwrap();
        assert!(fast.at > 0 && backlog.fraction > 100_000_000_000);
        let slow = backlog.admit(&bytes(1, u64::MAX), 0, 1).unwrap();
        assert_eq!(slow.at, fast.at + SECOND);
    }

    #[test]
    fn longest_transmission_does_not_overflow() {
        for speed in [1, u64::MAX] {
            let mut backlog = Backlog::default();
            for bytes in [usize::MAX, 0, 1, usize::MAX] {
                assert!(backlog.admit(&Rate::new(speed, Duration::MAX), 7, bytes).is_some());
            }
        }
    }
}
