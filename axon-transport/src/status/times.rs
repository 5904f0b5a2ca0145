//! The form of times in the JSON of a status: whole numbers of a unit. Each module is for `#[serde(with = "…")]`.

use std::time::{Duration, SystemTime};

use serde::{Deserialize, Deserializer, Serialize, Serializer};

/// A number that holds as much of a time as it can.
fn saturated(time: u128) -> u64 {
    u64::try_from(time).unwrap_or(u64::MAX)
}

/// Milliseconds since the Unix epoch. Times before it are 0.
pub(super) fn unix_ms(time: SystemTime) -> u64 {
    time.duration_since(SystemTime::UNIX_EPOCH).map_or(0, |since| saturated(since.as_millis()))
}

fn from_unix_ms(millis: u64) -> SystemTime {
    let time = SystemTime::UNIX_EPOCH.checked_add(Duration::from_millis(millis));
    time.unwrap_or(SystemTime::UNIX_EPOCH)
}

macro_rules! unit {
    ($name:ident, $text:literal, $to:expr, $from:expr) => {
        #[doc = $text]
        pub(super) mod $name {
            use super::*;

            pub(crate) fn serialize<S: Serializer>(
                time: &Duration,
                to: S,
            ) -> Result<S::Ok, S::Error> {
                $to(*time).serialize(to)
            }

            pub(crate) fn deserialize<'de, D: Deserializer<'de>>(
                from: D,
            ) -> Result<Duration, D::Error> {
                u64::deserialize(from).map($from)
            }
        }
    };
}

unit!(seconds, "A duration in seconds.", |time: Duration| time.as_secs(), Duration::from_secs);
unit!(
    millis,
    "A duration in milliseconds.",
    |time: Duration| saturated(time.as_millis()),
    Duration::from_millis
);
unit!(
    micros,
    "A duration in microseconds.",
    |time: Duration| saturated(time.as_micros()),
    Duration::from_micros
);

/// A duration in milliseconds, or null.
pub(super) mod optional_millis {
    use super::*;

    pub(crate) fn serialize<S: Serializer>(
        time: &Option<Duration>,
        to: S,
    ) -> Result<S::Ok, S::Error> {
        time.map(|time| saturated(time.as_millis())).serialize(to)
    }

    pub(crate) fn deserialize<'de, D: Deserializer<'de>>(
        from: D,
    ) -> Result<Option<Duration>, D::Error> {
        Ok(Option::<u64>::deserialize(from)?.map(Duration::from_millis))
    }
}

/// Milliseconds since the Unix epoch.
pub(super) mod unix_millis {
    use super::*;

    pub(crate) fn serialize<S: Serializer>(time: &SystemTime, to: S) -> Result<S::Ok, S::Error> {
        unix_ms(*time).serialize(to)
    }

    pub(crate) fn deserialize<'de, D: Deserializer<'de>>(from: D) -> Result<SystemTime, D::Error> {
        u64::deserialize(from).map(from_unix_ms)
    }
}

/// Milliseconds since the Unix epoch, or 0.
pub(super) mod optional_unix_millis {
    use super::*;

    pub(crate) fn serialize<S: Serializer>(
        time: &Option<SystemTime>,
        to: S,
    ) -> Result<S::Ok, S::Error> {
        time.map_or(0, unix_ms).serialize(to)
    }

    pub(crate) fn deserialize<'de, D: Deserializer<'de>>(
        from: D,
    ) -> Result<Option<SystemTime>, D::Error> {
        let millis = u64::deserialize(from)?;
        Ok((millis > 0).then(|| from_unix_ms(millis)))
    }
}
