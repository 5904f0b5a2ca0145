//! The information that an application receives with a sample.

use std::time::{Duration, SystemTime};

use axon_shm::Meta;

use crate::{ids::Gid, session::clock};

/// The information about a sample besides its bytes.
///
/// ```
/// # use std::time::Duration;
/// # use axon_transport::{
/// #     EndpointSpec, Session, SessionOptions,
/// #     config::{Config, DaemonPolicy},
/// #     qos::Qos,
/// # };
/// # let config = Config::builder().daemon(DaemonPolicy::Off).build()?;
/// # let session = Session::open(&config, SessionOptions::new("robot"))?;
/// # let spec = || EndpointSpec::new("/speed", "example/Speed", Qos::default());
/// let publisher = session.create_publisher(spec())?;
/// let subscription = session.create_subscription(spec())?;
/// assert!(publisher.wait_matched(1, Duration::from_secs(10)));
/// publisher.publish(b"1.5 m/s")?;
///
/// let info = subscription.recv(&mut Vec::new(), Some(Duration::from_secs(10)))?;
/// assert_eq!((info.publisher, info.sequence, info.reception), (publisher.gid(), 1, 1));
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct MessageInfo {
    /// The publisher of the sample.
    pub publisher: Gid,
    /// The number of the publication, from 1.
    pub sequence: u64,
    /// The time of the publication, by the publisher's clock.
    pub source_timestamp: SystemTime,
    /// The time at which the sample was taken, by this host's clock.
    pub received_timestamp: SystemTime,
    /// The number of the sample among the samples that the endpoint has taken, from 1.
    pub reception: u64,
    /// The age and lifespan of the sample, if the lifespan is finite.
    pub lifetime: Option<Lifetime>,
}

/// The age of a sample when it was taken, and its publisher's lifespan. Both are measured by the monotonic clock, so a
/// step of this or another host's wall clock does not matter.
///
/// ```
/// # use std::time::Duration;
/// # use axon_transport::{
/// #     EndpointSpec, Session, SessionOptions,
/// #     config::{Config, DaemonPolicy},
/// #     qos::Qos,
/// # };
/// # let config = Config::builder().daemon(DaemonPolicy::Off).build()?;
/// # let session = Session::open(&config, SessionOptions::new("robot"))?;
/// let lifespan = Duration::from_secs(60);
/// let spec = || EndpointSpec::new("/speed", "example/Speed", Qos::default().with_lifespan(lifespan));
/// let publisher = session.create_publisher(spec())?;
/// let subscription = session.create_subscription(spec())?;
/// assert!(publisher.wait_matched(1, Duration::from_secs(10)));
/// publisher.publish(b"1.5 m/s")?;
///
/// let info = subscription.recv(&mut Vec::new(), Some(Duration::from_secs(10)))?;
/// let lifetime = info.lifetime.expect("the lifespan is finite");
/// assert_eq!(lifetime.lifespan, lifespan);
/// assert!(lifetime.age < lifespan);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct Lifetime {
    /// The time from the publication until the sample was taken.
    pub age: Duration,
    /// The maximum age at which the sample is delivered.
    pub lifespan: Duration,
}

impl Lifetime {
    pub(super) fn of(meta: &Meta, lifespan: Duration) -> Self {
        let age = clock::monotonic().saturating_sub(meta.published_nanos);
        Self { age: Duration::from_nanos(age), lifespan }
    }

    /// Returns whether the sample is too old to be delivered.
    pub(super) fn is_over(self) -> bool {
        self.age > self.lifespan
    }
}
