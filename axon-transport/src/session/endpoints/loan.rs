//! Samples that are written in place.

use std::{
    fmt, io,
    ops::{Deref, DerefMut},
    sync::Arc,
};

use axon_shm::PublishError;

use crate::session::{clock, endpoint_state::PublisherInner};

/// A sample that the application writes in place, from the front or as a slice. Dropping the loan without
/// calling [`publish`](Self::publish) discards the sample.
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
/// let mut loan = publisher.loan(100_000)?;
/// loan.fill(7);
/// loan.publish()?;
///
/// let (_info, sample) = subscription.take_sample().expect("it is there");
/// assert_eq!(sample.len(), 100_000);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub struct Loan<'a> {
    pub(super) loan: axon_shm::Loan<'a>,
    pub(super) publisher: &'a PublisherInner,
}

impl Loan<'_> {
    /// Publishes it, stamped with the current time, and returns its sequence number.
    ///
    /// # Errors
    /// When fewer bytes were written than the loan has, and as for [`Publisher::publish`](super::Publisher::publish).
    pub fn publish(self) -> Result<u64, PublishError> {
        self.publisher.published(self.loan.publish_next(clock::wall()))
    }
}

impl Deref for Loan<'_> {
    type Target = [u8];

    fn deref(&self) -> &[u8] {
        &self.loan
    }
}

impl DerefMut for Loan<'_> {
    fn deref_mut(&mut self) -> &mut [u8] {
        &mut self.loan
    }
}

impl fmt::Debug for Loan<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("Loan").field(&self.publisher.endpoint.topic).finish()
    }
}

impl io::Write for Loan<'_> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.loan.write(bytes)
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// A sample that is being written, of which a part from the front may be published.
pub(crate) struct OwnedLoan {
    pub(super) loan: axon_shm::Loan<'static>,
    pub(super) publisher: Arc<PublisherInner>,
}

impl OwnedLoan {
    /// Returns the address of the sample, which does not move.
    pub(crate) fn as_mut_ptr(&mut self) -> *mut u8 {
        self.loan.as_mut_ptr()
    }

    /// Publishes the first `len` bytes, with the caller's source timestamp in nanoseconds or the current time, and
    /// returns the sequence number.
    pub(crate) fn publish(
        self,
        len: usize,
        source_timestamp: Option<i64>,
    ) -> Result<u64, PublishError> {
        let time = source_timestamp.unwrap_or_else(clock::wall);
        self.publisher.published(self.loan.publish_front(len, time))
    }
}
