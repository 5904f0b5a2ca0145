//! The clocks that all processes of a host share.

use std::time::{Duration, SystemTime};

use rustix::time::{ClockId, clock_gettime};

/// Returns the nanoseconds of the monotonic clock, which is the same in all processes of a host.
#[inline]
pub fn monotonic() -> u64 {
    let now = clock_gettime(ClockId::Monotonic);
    now.tv_sec as u64 * 1_000_000_000 + now.tv_nsec as u64
}

/// Returns the wall clock's nanoseconds since the Unix epoch.
#[inline]
pub fn wall() -> i64 {
    let now = clock_gettime(ClockId::Realtime);
    now.tv_sec.saturating_mul(1_000_000_000).saturating_add(now.tv_nsec).max(0)
}

/// Converts nanoseconds since the Unix epoch, the form in rings and messages, to a time.
pub fn from_unix_nanos(nanoseconds: i64) -> SystemTime {
    let distance = Duration::from_nanos(nanoseconds.unsigned_abs());
    if nanoseconds < 0 {
        SystemTime::UNIX_EPOCH - distance
    } else {
        SystemTime::UNIX_EPOCH + distance
    }
}

/// Converts a time to nanoseconds since the Unix epoch. A time before 1677 or after 2262 becomes the nearest value.
pub fn unix_nanos(time: SystemTime) -> i64 {
    match time.duration_since(SystemTime::UNIX_EPOCH) {
        Ok(after) => i64::try_from(after.as_nanos()).unwrap_or(i64::MAX),
        Err(before) => {
            let before = i128::try_from(before.duration().as_nanos()).unwrap_or(i128::MAX);
            i64::try_from(-before).unwrap_or(i64::MIN)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nanoseconds_survive_a_round_trip() {
        for nanoseconds in [i64::MIN, -1_000_000_001, -1, 0, 1, 1_700_000_000_123_456_789, i64::MAX]
        {
            assert_eq!(unix_nanos(from_unix_nanos(nanoseconds)), nanoseconds);
        }
        let hour = Duration::from_secs(3600);
        assert_eq!(unix_nanos(from_unix_nanos(i64::MAX) + hour), i64::MAX);
        assert_eq!(unix_nanos(from_unix_nanos(i64::MIN) - hour), i64::MIN);
    }
}
