//! ROS 2's rules for the compatibility of a publisher and a subscription, written a second time for the models of
//! tests. They use no code under test: they are the table of ROS 2's documentation ("About Quality of Service
//! settings"), one line per policy.

use std::{collections::BTreeSet, time::Duration};

use axon_transport::qos::{Durability, History, Liveliness, Qos, Reliability};
use serde::{Deserialize, Serialize};

/// A quality of service. Times are in seconds; `None` is infinite.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Profile {
    pub(crate) reliable: bool,
    pub(crate) transient_local: bool,
    /// The depth of KEEP_LAST; `None` is KEEP_ALL.
    pub(crate) depth: Option<u32>,
    pub(crate) deadline: Option<u64>,
    pub(crate) manual: bool,
    pub(crate) lease: Option<u64>,
    pub(crate) lifespan: Option<u64>,
}

impl Default for Profile {
    /// Returns ROS 2's default: RELIABLE, VOLATILE, KEEP_LAST(10).
    fn default() -> Self {
        let (deadline, lease, lifespan) = (None, None, None);
        let (reliable, transient_local, depth, manual) = (true, false, Some(10), false);
        Self { reliable, transient_local, depth, deadline, manual, lease, lifespan }
    }
}

/// The policies that can make two endpoints incompatible, as ROS 2 spells them.
pub(crate) const POLICIES: [&str; 5] =
    ["RELIABILITY", "DURABILITY", "DEADLINE", "LIVELINESS", "LIVELINESS_LEASE_DURATION"];

impl Profile {
    /// Returns the policies because of which a publisher of this profile does not serve a subscription that requests
    /// `wanted`.
    pub(crate) fn falls_short_of(&self, wanted: &Self) -> BTreeSet<String> {
        // An offered period must not be longer than the requested one.
        let longer = |offered: Option<u64>, wanted: Option<u64>| match (offered, wanted) {
            (_, None) => false,
            (None, Some(_)) => true,
            (Some(offered), Some(wanted)) => offered > wanted,
        };
        let short = [
            !self.reliable && wanted.reliable,
            !self.transient_local && wanted.transient_local,
            longer(self.deadline, wanted.deadline),
            !self.manual && wanted.manual,
            longer(self.lease, wanted.lease),
        ];
        let policies = POLICIES.iter().zip(short).filter(|(_, short)| *short);
        policies.map(|(policy, _)| (*policy).to_owned()).collect()
    }

    /// Converts the profile to the QoS of an endpoint.
    pub(crate) fn qos(&self) -> Qos {
        let period = |seconds: Option<u64>| seconds.map(Duration::from_secs);
        let liveliness =
            if self.manual { Liveliness::ManualByTopic } else { Liveliness::Automatic };
        let qos = match self.depth {
            Some(depth) => Qos::default().with_depth(depth),
            None => Qos::keep_all().with_depth(1),
        };
        qos.with_reliability(if self.reliable {
            Reliability::Reliable
        } else {
            Reliability::BestEffort
        })
        .with_durability(if self.transient_local {
            Durability::TransientLocal
        } else {
            Durability::Volatile
        })
        .with_deadline(period(self.deadline))
        .with_lifespan(period(self.lifespan))
        .with_liveliness(liveliness, period(self.lease))
    }

    /// Converts the QoS of an endpoint to a profile. Returns `None` if [`qos`](Self::qos) makes no such QoS.
    #[allow(dead_code, reason = "not every test looks at others' profiles")]
    pub(crate) fn of(qos: &Qos) -> Option<Self> {
        let seconds = |period: Option<Duration>| period.map(|period| period.as_secs());
        let profile = Self {
            reliable: qos.reliability == Reliability::Reliable,
            transient_local: qos.durability == Durability::TransientLocal,
            depth: (qos.history == History::KeepLast).then_some(qos.depth),
            deadline: seconds(qos.deadline),
            manual: qos.liveliness == Liveliness::ManualByTopic,
            lease: seconds(qos.lease),
            lifespan: seconds(qos.lifespan),
        };
        (profile.qos() == *qos).then_some(profile)
    }
}

/// Returns whether two endpoints of a topic have the same type: the same name, and the same hash if both know it.
pub(crate) fn same_type(one: (&str, &[u8]), other: (&str, &[u8])) -> bool {
    one.0 == other.0 && (one.1 == other.1 || one.1.is_empty() || other.1.is_empty())
}
