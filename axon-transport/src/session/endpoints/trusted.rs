//! A subscription whose samples are slices.

use std::{ops::Deref, time::Duration};

use axon_shm::{SampleSlice, TrustPublishers};

use super::subscription::Subscription;
use crate::session::{endpoint_state::MessageInfo, error::RecvError};

/// A [`Subscription`] whose publishers are trusted, so that samples are read in place as `&[u8]`.
///
/// ```
/// use std::time::Duration;
///
/// use axon_transport::{
///     EndpointSpec, Session, SessionOptions,
///     config::{Config, DaemonPolicy},
///     qos::Qos,
///     shm::TrustPublishers,
/// };
///
/// let config = Config::builder().daemon(DaemonPolicy::Off).build()?;
/// let session = Session::open(&config, SessionOptions::new("viewer"))?;
/// let spec = || EndpointSpec::new("/camera", "example/Image", Qos::default());
/// // SAFETY: only this process publishes, and it forks no child.
/// let trust = unsafe { TrustPublishers::new() };
/// let subscription = session.create_subscription(spec())?.trusting(trust);
/// let publisher = session.create_publisher(spec())?;
/// assert!(subscription.wait_matched(1, Duration::from_secs(10)));
///
/// publisher.publish(&[7; 100_000])?;
/// let (_info, image) = subscription.recv_slice(None)?;
/// assert_eq!(image[99_999], 7);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Debug)]
pub struct TrustedSubscription {
    subscription: Subscription,
    trust: TrustPublishers,
}

impl Subscription {
    /// Takes samples as slices from now on. [`TrustPublishers::new`] lists the conditions for the publishers: for each
    /// that the subscription matches, and for the daemon if publishers are on other hosts. Copies, which
    /// [`take`](Self::take) and [`recv`](Self::recv) make, have no conditions.
    #[must_use]
    pub fn trusting(self, trust: TrustPublishers) -> TrustedSubscription {
        TrustedSubscription { subscription: self, trust }
    }
}

impl TrustedSubscription {
    /// Like [`Subscription::take_sample`], as a slice.
    pub fn take_slice(&self) -> Option<(MessageInfo, SampleSlice)> {
        let (info, sample) = self.subscription.take_sample()?;
        Some((info, sample.into_slice(self.trust)))
    }

    /// Like [`take_slice`](Self::take_slice), after waiting for at most `timeout`, or without limit if it is `None`.
    ///
    /// # Errors
    /// [`RecvError::TimedOut`], and [`RecvError::Forked`] in a forked child.
    pub fn recv_slice(
        &self,
        timeout: Option<Duration>,
    ) -> Result<(MessageInfo, SampleSlice), RecvError> {
        let Subscription { inner, session } = &self.subscription;
        inner.recv(session.core(), timeout, || self.take_slice())
    }

    /// Like [`recv_slice`](Self::recv_slice), without limit, for a task of any runtime.
    ///
    /// # Errors
    /// As for [`Subscription::recv_async`].
    pub async fn recv_slice_async(&self) -> Result<(MessageInfo, SampleSlice), RecvError> {
        let (info, sample) = self.subscription.recv_sample_async().await?;
        Ok((info, sample.into_slice(self.trust)))
    }

    /// Returns the subscription, which does not trust its publishers.
    pub fn into_inner(self) -> Subscription {
        self.subscription
    }
}

impl Deref for TrustedSubscription {
    type Target = Subscription;

    fn deref(&self) -> &Subscription {
        &self.subscription
    }
}
