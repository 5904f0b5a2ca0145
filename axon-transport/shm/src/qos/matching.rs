//! Compatibility of offered and requested profiles, as DDS and ROS 2 define it.

use std::{fmt, time::Duration};

use super::{Choice, Durability, Liveliness, Qos, QosRequest, Reliability};

/// A policy in which a publisher offers less than a subscription requests.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
#[non_exhaustive]
pub enum Incompatible {
    /// The publisher offers BEST_EFFORT, the subscription requests RELIABLE.
    Reliability,
    /// The publisher offers VOLATILE, the subscription requests TRANSIENT_LOCAL.
    Durability,
    /// The offered deadline is longer than the requested one.
    Deadline,
    /// The publisher offers AUTOMATIC, the subscription requests MANUAL_BY_TOPIC.
    Liveliness,
    /// The offered lease is longer than the requested one.
    LivelinessLease,
}

impl Incompatible {
    /// Every policy that can make two endpoints incompatible, in the order in which they are
    /// checked.
    pub const ALL: [Self; 5] = [
        Self::Reliability,
        Self::Durability,
        Self::Deadline,
        Self::Liveliness,
        Self::LivelinessLease,
    ];

    /// Describes the offered and the requested value, for people.
    pub fn reason(self) -> &'static str {
        match self {
            Self::Reliability => "the publisher is BEST_EFFORT, the subscription wants RELIABLE",
            Self::Durability => "the publisher is VOLATILE, the subscription wants TRANSIENT_LOCAL",
            Self::Deadline => {
                "the publisher's deadline is longer than the one the subscription wants"
            }
            Self::Liveliness => {
                "the publisher's liveliness is AUTOMATIC, the subscription wants MANUAL_BY_TOPIC"
            }
            Self::LivelinessLease => {
                "the publisher's liveliness lease is longer than the one the subscription wants"
            }
        }
    }
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

/// Checks whether a publisher that offers `offered` serves a subscription that requests
/// `requested`.
///
/// # Errors
/// The first incompatible policy.
pub fn compatible(offered: &Qos, requested: &Qos) -> Result<(), Incompatible> {
    incompatibilities(offered, requested).next().map_or(Ok(()), Err)
}

/// Returns every policy for which `offered` is less than `requested`.
pub fn incompatibilities(offered: &Qos, requested: &Qos) -> impl Iterator<Item = Incompatible> {
    let (offered, requested) = (*offered, *requested);
    Incompatible::ALL.into_iter().filter(move |policy| match policy {
        Incompatible::Reliability => {
            offered.reliability == Reliability::BestEffort
                && requested.reliability == Reliability::Reliable
        }
        Incompatible::Durability => {
            offered.durability == Durability::Volatile
                && requested.durability == Durability::TransientLocal
        }
        Incompatible::Deadline => longer(offered.deadline, requested.deadline),
        Incompatible::Liveliness => {
            offered.liveliness == Liveliness::Automatic
                && requested.liveliness == Liveliness::ManualByTopic
        }
        Incompatible::LivelinessLease => longer(offered.lease, requested.lease),
    })
}

/// The compatibility of two profiles whose open policies have not been resolved.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Compatibility {
    /// They are compatible, whatever the open policies become.
    Compatible,
    /// It depends on open policies; these may be incompatible.
    Unknown(Vec<Incompatible>),
    /// They are incompatible in these policies, whatever the open policies become.
    Incompatible(Vec<Incompatible>),
}

/// Checks whether two profiles are compatible. Each may leave policies open.
pub fn check(offered: &QosRequest, requested: &QosRequest) -> Compatibility {
    let policies = |worst: bool| -> Vec<Incompatible> {
        // The best case is the highest offer and the lowest request; the worst case is the lowest
        // offer and the highest request.
        let offer = pick(offered, !worst);
        let request = pick(requested, worst);
        incompatibilities(&offer, &request).collect()
    };
    let certain = policies(false);
    if !certain.is_empty() {
        return Compatibility::Incompatible(certain);
    }
    let possible = policies(true);
    if possible.is_empty() { Compatibility::Compatible } else { Compatibility::Unknown(possible) }
}

/// Returns the highest or the lowest profile that a request can resolve to.
fn pick(request: &QosRequest, highest: bool) -> Qos {
    fn choose<T>(choice: Choice<T>, open: T) -> T {
        if let Choice::Exactly(value) = choice { value } else { open }
    }
    let (reliability, durability, liveliness, time) = if highest {
        let manual = Liveliness::ManualByTopic;
        (Reliability::Reliable, Durability::TransientLocal, manual, Some(Duration::ZERO))
    } else {
        (Reliability::BestEffort, Durability::Volatile, Liveliness::Automatic, None)
    };
    Qos {
        reliability: choose(request.reliability, reliability),
        durability: choose(request.durability, durability),
        deadline: choose(request.deadline, time),
        liveliness: choose(request.liveliness, liveliness),
        lease: choose(request.lease, time),
        ..Qos::default()
    }
}

/// Returns whether the offered period is longer than the requested one; `None` is infinite.
fn longer(offered: Option<Duration>, requested: Option<Duration>) -> bool {
    requested.is_some_and(|r| offered.is_none_or(|o| o > r))
}
