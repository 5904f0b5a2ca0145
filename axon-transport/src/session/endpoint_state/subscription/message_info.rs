//! What an application is told of a sample besides its bytes.

use std::time::{Duration, SystemTime};

use axon_shm::Meta;

use crate::{ids::Gid, session::clock};

/// What is known of a sample besides its bytes.
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
    /// Who published it.
    pub publisher: Gid,
    /// The publication's number, from 1.
    pub sequence: u64,
    /// When it was published, by the publisher's clock.
    pub source_timestamp: SystemTime,
    /// When it was taken, by this host's clock.
    pub received_timestamp: SystemTime,
    /// Its number among those that the endpoint has taken, from 1.
    pub reception: u64,
    /// Its age and lifespan, where the lifespan is finite.
    pub lifetime: Option<Lifetime>,
}

/// The age of a sample when it was taken, and its publisher's lifespan. The monotonic clock tells both,
/// so that neither a step of the wall clock nor that of another host counts.
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
    /// How long ago it was published when it was taken.
    pub age: Duration,
    /// How old it may be to be delivered.
    pub lifespan: Duration,
}

impl Lifetime {
    pub(super) fn of(meta: &Meta, lifespan: Duration) -> Self {
        let age = clock::monotonic().saturating_sub(meta.published_nanos);
        Self { age: Duration::from_nanos(age), lifespan }
    }

    /// Whether the sample is not to be delivered any more.
    pub(super) fn is_over(self) -> bool {
        self.age > self.lifespan
    }
}
