//! A profile as a caller requests it. The caller can leave a policy to AXON's default or to the endpoints in the
//! graph.

use std::time::Duration;

use super::{Durability, History, Liveliness, Qos, Reliability};

/// One policy of a [`QosRequest`].
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Choice<T> {
    /// The default of AXON: the value in [`Qos::default`].
    #[default]
    SystemDefault,
    /// A level that matches all endpoints of the other side that the graph holds for the topic when the endpoint is
    /// created. A subscription gets the highest one that all publishers offer. A publisher offers the highest one, but
    /// MANUAL_BY_TOPIC only if a subscription requests it. The level is not chosen again later. Clients and servers get
    /// the default.
    BestAvailable,
    /// This value.
    Exactly(T),
}

impl<T> Choice<T> {
    fn resolve(self, default: T, best: impl FnOnce() -> T) -> T {
        match self {
            Self::SystemDefault => default,
            Self::BestAvailable => best(),
            Self::Exactly(value) => value,
        }
    }
}

/// The profile that a caller requests. [`for_publisher`](Self::for_publisher),
/// [`for_subscription`](Self::for_subscription) and [`for_service`](Self::for_service) resolve it to the [`Qos`] of the
/// endpoint.
///
/// ```
/// use axon_shm::qos::{Durability, Qos, QosRequest, Reliability};
///
/// let latched = Qos::default().with_durability(Durability::TransientLocal);
/// let qos = QosRequest::best_available().for_subscription(&[latched]);
/// assert_eq!(qos.durability, Durability::TransientLocal);
/// // One publisher that offers less, and the subscription asks for less, to match both.
/// let qos = QosRequest::best_available().for_subscription(&[latched, Qos::sensor_data()]);
/// assert_eq!(qos.reliability, Reliability::BestEffort);
/// assert_eq!(qos.durability, Durability::Volatile);
/// ```
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[non_exhaustive]
pub struct QosRequest {
    /// The reliability.
    pub reliability: Choice<Reliability>,
    /// The samples that late joiners receive.
    pub durability: Choice<Durability>,
    /// The number of samples to keep; `None` is the default. There is no best choice.
    pub history: Option<History>,
    /// The depth for KEEP_LAST; 0 is the default depth.
    pub depth: u32,
    /// Longest time between two samples; `None` is infinite.
    pub deadline: Choice<Option<Duration>>,
    /// Age at which a sample is no longer delivered.
    pub lifespan: Option<Duration>,
    /// The party that asserts liveliness.
    pub liveliness: Choice<Liveliness>,
    /// Time without an assertion after which a publisher counts as not alive.
    pub lease: Choice<Option<Duration>>,
}

impl From<Qos> for QosRequest {
    fn from(qos: Qos) -> Self {
        Self {
            reliability: Choice::Exactly(qos.reliability),
            durability: Choice::Exactly(qos.durability),
            history: Some(qos.history),
            depth: qos.depth,
            deadline: Choice::Exactly(qos.deadline),
            lifespan: qos.lifespan,
            liveliness: Choice::Exactly(qos.liveliness),
            lease: Choice::Exactly(qos.lease),
        }
    }
}

impl QosRequest {
    /// Returns ROS 2's best-available profile.
    pub fn best_available() -> Self {
        Self {
            reliability: Choice::BestAvailable,
            durability: Choice::BestAvailable,
            deadline: Choice::BestAvailable,
            liveliness: Choice::BestAvailable,
            lease: Choice::BestAvailable,
            ..Self::default()
        }
    }

    /// Resolves the profile for a publisher, whose topic has these subscriptions. The best choices serve every
    /// subscription: RELIABLE and TRANSIENT_LOCAL, the shortest deadline and the shortest lease that any of them
    /// requests, and MANUAL_BY_TOPIC if any of them requests it.
    pub fn for_publisher(&self, subscriptions: &[Qos]) -> Qos {
        let shortest = |of: fn(&Qos) -> Option<Duration>| subscriptions.iter().filter_map(of).min();
        let manual = subscriptions.iter().any(|q| q.liveliness == Liveliness::ManualByTopic);
        self.resolve(Qos {
            reliability: Reliability::Reliable,
            durability: Durability::TransientLocal,
            deadline: shortest(|q| q.deadline),
            liveliness: if manual { Liveliness::ManualByTopic } else { Liveliness::Automatic },
            lease: shortest(|q| q.lease),
            ..Qos::default()
        })
    }

    /// Resolves the profile for a subscription, whose topic has these publishers. The best choice of each policy is the
    /// highest level that all of them offer. Without publishers it is the highest level, but no deadline and no lease.
    pub fn for_subscription(&self, publishers: &[Qos]) -> Qos {
        // A publisher without a deadline does not serve a subscription with one.
        let longest = |of: fn(&Qos) -> Option<Duration>| {
            let all: Option<Vec<Duration>> = publishers.iter().map(of).collect();
            all.and_then(|all| all.into_iter().max())
        };
        let reliable = publishers.iter().all(|q| q.reliability == Reliability::Reliable);
        let latched = publishers.iter().all(|q| q.durability == Durability::TransientLocal);
        let manual = publishers.iter().all(|q| q.liveliness == Liveliness::ManualByTopic);
        self.resolve(Qos {
            reliability: if reliable { Reliability::Reliable } else { Reliability::BestEffort },
            durability: if latched { Durability::TransientLocal } else { Durability::Volatile },
            deadline: longest(|q| q.deadline),
            liveliness: if manual { Liveliness::ManualByTopic } else { Liveliness::Automatic },
            lease: longest(|q| q.lease),
            ..Qos::default()
        })
    }

    /// For a service or a client, which both ends create alike: what is best is the default.
    pub fn for_service(&self) -> Qos {
        self.resolve(Qos::default())
    }

    fn resolve(&self, best: Qos) -> Qos {
        let default = Qos::default();
        Qos {
            reliability: self.reliability.resolve(default.reliability, || best.reliability),
            durability: self.durability.resolve(default.durability, || best.durability),
            history: self.history.unwrap_or(default.history),
            depth: if self.depth == 0 { default.depth } else { self.depth },
            deadline: self.deadline.resolve(default.deadline, || best.deadline),
            lifespan: self.lifespan,
            liveliness: self.liveliness.resolve(default.liveliness, || best.liveliness),
            lease: self.lease.resolve(default.lease, || best.lease),
        }
    }
}
