//! The policies of one endpoint.

use std::time::Duration;

use minicbor::{Decode, Encode};
use serde::Serialize;

/// The reliability: must every sample arrive?
#[derive(Clone, Copy, Debug, PartialEq, Eq, Encode, Decode, Serialize)]
#[cbor(index_only)]
#[serde(rename_all = "snake_case")]
pub enum Reliability {
    /// Samples may be lost.
    #[n(0)]
    BestEffort,
    /// Samples arrive, within the bounds of the history.
    #[n(1)]
    Reliable,
}

/// The samples that a late-joining subscription receives.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Encode, Decode, Serialize)]
#[cbor(index_only)]
#[serde(rename_all = "snake_case")]
pub enum Durability {
    /// Only samples published from then on.
    #[n(0)]
    Volatile,
    /// The publisher's history, then new samples.
    #[n(1)]
    TransientLocal,
}

/// The number of samples to keep.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Encode, Decode, Serialize)]
#[cbor(index_only)]
#[serde(rename_all = "snake_case")]
pub enum History {
    /// The newest `depth` samples.
    #[n(0)]
    KeepLast,
    /// All samples, up to the memory budget; then the publisher waits.
    #[n(1)]
    KeepAll,
}

/// The party that asserts a publisher's liveliness.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Encode, Decode, Serialize)]
#[cbor(index_only)]
#[serde(rename_all = "snake_case")]
pub enum Liveliness {
    /// The publisher's session.
    #[n(0)]
    Automatic,
    /// The publisher itself, when it publishes or asserts.
    #[n(1)]
    ManualByTopic,
}

/// The quality of service that an endpoint offers or requests.
///
/// ```
/// use axon_shm::qos::{Durability, Qos};
///
/// let map = Qos::default().with_depth(1).with_durability(Durability::TransientLocal);
/// assert_eq!((map.depth, map.durability), (1, Durability::TransientLocal));
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq, Encode, Decode, Serialize)]
#[cbor(map)]
#[non_exhaustive]
pub struct Qos {
    /// The reliability.
    #[n(0)]
    pub reliability: Reliability,
    /// The samples that late joiners receive.
    #[n(1)]
    pub durability: Durability,
    /// The number of samples to keep.
    #[n(2)]
    pub history: History,
    /// The number of samples kept by [`History::KeepLast`]; at least 1.
    #[n(3)]
    pub depth: u32,
    /// Longest time between two samples.
    #[cbor(n(4), with = "super::nanoseconds", has_nil)]
    #[serde(serialize_with = "super::nanoseconds::serialize")]
    pub deadline: Option<Duration>,
    /// Age at which a sample is no longer delivered.
    #[cbor(n(5), with = "super::nanoseconds", has_nil)]
    #[serde(serialize_with = "super::nanoseconds::serialize")]
    pub lifespan: Option<Duration>,
    /// The party that asserts liveliness.
    #[n(6)]
    pub liveliness: Liveliness,
    /// Time without an assertion after which a publisher counts as not alive.
    #[cbor(n(7), with = "super::nanoseconds", has_nil)]
    #[serde(serialize_with = "super::nanoseconds::serialize")]
    pub lease: Option<Duration>,
}

impl Default for Qos {
    /// Returns ROS 2's default profile: RELIABLE, VOLATILE, KEEP_LAST(10).
    fn default() -> Self {
        Self {
            reliability: Reliability::Reliable,
            durability: Durability::Volatile,
            history: History::KeepLast,
            depth: 10,
            deadline: None,
            lifespan: None,
            liveliness: Liveliness::Automatic,
            lease: None,
        }
    }
}

impl Qos {
    /// Returns a RELIABLE, KEEP_ALL profile: no sample is dropped, and a publisher waits for its
    /// slowest such reader.
    pub fn keep_all() -> Self {
        Self { history: History::KeepAll, ..Self::default() }
    }

    /// Returns ROS 2's sensor data profile: BEST_EFFORT, KEEP_LAST(5).
    pub fn sensor_data() -> Self {
        Self { reliability: Reliability::BestEffort, depth: 5, ..Self::default() }
    }

    /// Sets the reliability.
    #[must_use]
    pub fn with_reliability(self, reliability: Reliability) -> Self {
        Self { reliability, ..self }
    }

    /// Sets the durability.
    #[must_use]
    pub fn with_durability(self, durability: Durability) -> Self {
        Self { durability, ..self }
    }

    /// Sets the history.
    #[must_use]
    pub fn with_history(self, history: History) -> Self {
        Self { history, ..self }
    }

    /// Sets the depth, for [`History::KeepLast`].
    #[must_use]
    pub fn with_depth(self, depth: u32) -> Self {
        Self { depth, ..self }
    }

    /// Sets the deadline; `None` is infinite.
    #[must_use]
    pub fn with_deadline(self, deadline: impl Into<Option<Duration>>) -> Self {
        Self { deadline: deadline.into(), ..self }
    }

    /// Sets the lifespan; `None` is infinite.
    #[must_use]
    pub fn with_lifespan(self, lifespan: impl Into<Option<Duration>>) -> Self {
        Self { lifespan: lifespan.into(), ..self }
    }

    /// Sets the liveliness and the lease; `None` is an infinite lease.
    #[must_use]
    pub fn with_liveliness(
        self,
        liveliness: Liveliness,
        lease: impl Into<Option<Duration>>,
    ) -> Self {
        Self { liveliness, lease: lease.into(), ..self }
    }

    /// Sets the lease; `None` is infinite.
    #[must_use]
    pub fn with_lease(self, lease: impl Into<Option<Duration>>) -> Self {
        Self { lease: lease.into(), ..self }
    }
}
