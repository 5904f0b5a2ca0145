//! The two clocks: wall-clock time for timestamps, monotonic time for timeouts.

use std::time::{Duration, SystemTime};

pub(super) use axon_shm::internal::{monotonic, wall};

/// The time that rings and wires have as nanoseconds since the Unix epoch.
pub fn from_unix_nanos(nanoseconds: i64) -> SystemTime {
    let distance = Duration::from_nanos(nanoseconds.unsigned_abs());
    if nanoseconds < 0 {
        SystemTime::UNIX_EPOCH - distance
    } else {
        SystemTime::UNIX_EPOCH + distance
    }
}

/// Nanoseconds since the Unix epoch, as rings and wires have them: the nearest that they can say of a time
/// before 1677 or after 2262.
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
    fn nanoseconds_are_the_same_after_a_way_there_and_back() {
        for nanoseconds in [i64::MIN, -1_000_000_001, -1, 0, 1, 1_700_000_000_123_456_789, i64::MAX]
        {
            assert_eq!(unix_nanos(from_unix_nanos(nanoseconds)), nanoseconds);
        }
        let hour = Duration::from_secs(3600);
        assert_eq!(unix_nanos(from_unix_nanos(i64::MAX) + hour), i64::MAX);
        assert_eq!(unix_nanos(from_unix_nanos(i64::MIN) - hour), i64::MIN);
    }
}
