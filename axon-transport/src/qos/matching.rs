//! Which offered and requested profiles go together, as DDS and ROS 2 define it.

use std::fmt;

use super::{Durability, Liveliness, Qos, Reliability};

/// The first policy in which a publisher offers less than a subscription requests.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum Incompatible {
    /// BEST_EFFORT offered, RELIABLE requested.
    Reliability,
    /// VOLATILE offered, TRANSIENT_LOCAL requested.
    Durability,
    /// A longer deadline offered than requested.
    Deadline,
    /// AUTOMATIC offered, MANUAL_BY_TOPIC requested.
    Liveliness,
    /// A longer lease offered than requested.
    LivelinessLease,
}

impl fmt::Display for Incompatible {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Reliability => "RELIABILITY",
            Self::Durability => "DURABILITY",
            Self::Deadline => "DEADLINE",
            Self::Liveliness => "LIVELINESS",
            Self::LivelinessLease => "LIVELINESS_LEASE_DURATION",
        })
    }
}

/// Whether a publisher that offers `offered` serves a subscription that requests `requested`.
///
/// # Errors
/// The first policy that does not go together.
pub fn compatible(offered: &Qos, requested: &Qos) -> Result<(), Incompatible> {
    let longer = |o: Option<u64>, r: Option<u64>| r.is_some_and(|r| o.is_none_or(|o| o > r));
    if offered.reliability == Reliability::BestEffort
        && requested.reliability == Reliability::Reliable
    {
        return Err(Incompatible::Reliability);
    }
    if offered.durability == Durability::Volatile
        && requested.durability == Durability::TransientLocal
    {
        return Err(Incompatible::Durability);
    }
    if longer(offered.deadline, requested.deadline) {
        return Err(Incompatible::Deadline);
    }
    if offered.liveliness == Liveliness::Automatic
        && requested.liveliness == Liveliness::ManualByTopic
    {
        return Err(Incompatible::Liveliness);
    }
    if longer(offered.lease, requested.lease) {
        return Err(Incompatible::LivelinessLease);
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_policy_is_refused_when_less_is_offered_than_requested() {
        let q = Qos::default();
        let cases = [
            (Qos { reliability: Reliability::BestEffort, ..q }, q, Err(Incompatible::Reliability)),
            (q, Qos { durability: Durability::TransientLocal, ..q }, Err(Incompatible::Durability)),
            (q, Qos { deadline: Some(5), ..q }, Err(Incompatible::Deadline)),
            (
                Qos { deadline: Some(6), ..q },
                Qos { deadline: Some(5), ..q },
                Err(Incompatible::Deadline),
            ),
            (Qos { deadline: Some(5), ..q }, Qos { deadline: Some(5), ..q }, Ok(())),
            (q, Qos { liveliness: Liveliness::ManualByTopic, ..q }, Err(Incompatible::Liveliness)),
            (q, Qos { lease: Some(1), ..q }, Err(Incompatible::LivelinessLease)),
            (q, Qos::sensor_data(), Ok(())),
            (Qos::keep_all(), q, Ok(())),
        ];
        for (offered, requested, expected) in cases {
            assert_eq!(compatible(&offered, &requested), expected, "{offered:?} {requested:?}");
        }
    }
}
