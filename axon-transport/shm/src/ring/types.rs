//! The types that a writer and a reader of a ring exchange with each other and with their owners.

use std::time::{Duration, SystemTime};

use crate::{
    ids::Gid,
    os::clock::{from_unix_nanos, unix_nanos},
    qos::Qos,
};

/// The options of a ring.
#[derive(Clone, Copy, Debug)]
pub struct RingOptions {
    /// The publisher's GID.
    pub gid: Gid,
    /// The offered QoS.
    pub qos: Qos,
    /// Bytes of samples to keep before the oldest are dropped. One sample is always kept.
    pub budget: u64,
    /// The largest sample in bytes.
    pub max_message: u64,
    /// The expected length of samples in bytes. If it is more than 512, readers get the publisher's own memory before
    /// the first sample. All samples of more than 4 KiB, and loans of more than 512 bytes, are there.
    pub expected: u64,
}

/// The terms of a reader's attachment.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Grant {
    /// The number of this attachment; never 0.
    pub generation: u64,
    /// The first position that the reader takes.
    pub first: u64,
}

/// The metadata of a sample.
///
/// ```
/// use std::time::SystemTime;
/// use axon_shm::{Context, Meta, Publisher, PublisherOptions, qos::Qos};
///
/// let publisher = Publisher::new(&Context::new()?, PublisherOptions::new(Qos::default()))?;
/// let meta = Meta::new(7, SystemTime::UNIX_EPOCH);
/// publisher.publish_with(meta, b"hello")?;
/// assert_eq!(meta.source_time(), SystemTime::UNIX_EPOCH);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct Meta {
    /// The publisher's sequence number.
    pub sequence: u64,
    /// [`source_time`](Self::source_time) in nanoseconds since the Unix epoch, as the ring stores it. For this
    /// project's crates.
    #[doc(hidden)]
    pub source_nanos: i64,
    /// [`published`](Self::published) in nanoseconds, as the ring stores it; 0 is `None`. For this project's crates.
    #[doc(hidden)]
    pub published_nanos: u64,
}

impl Meta {
    /// Returns the data of a sample that is published now, with this number and source time.
    pub fn new(sequence: u64, source_time: SystemTime) -> Self {
        Self::at_nanos(sequence, unix_nanos(source_time))
    }

    /// Like [`new`](Self::new), with the source time in nanoseconds since the Unix epoch. For this project's crates.
    #[doc(hidden)]
    pub fn at_nanos(sequence: u64, source_nanos: i64) -> Self {
        Self { sequence, source_nanos, published_nanos: 0 }
    }

    /// Sets the time of publication, by this host's CLOCK_MONOTONIC; the default is the time of the call that
    /// publishes. The publisher's lifespan counts from there.
    #[must_use]
    pub fn with_published(self, published: Duration) -> Self {
        self.with_published_nanos(u64::try_from(published.as_nanos()).unwrap_or(u64::MAX))
    }

    /// Like [`with_published`](Self::with_published), in nanoseconds. For this project's crates.
    #[doc(hidden)]
    #[must_use]
    pub fn with_published_nanos(self, published_nanos: u64) -> Self {
        Self { published_nanos, ..self }
    }

    /// Returns the time of publication by the publisher's wall clock.
    pub fn source_time(&self) -> SystemTime {
        from_unix_nanos(self.source_nanos)
    }

    /// Returns the time of publication by this host's CLOCK_MONOTONIC. For a sample from another host it is the arrival
    /// less the sample's age. Returns `None` for a taken sample if the publisher's lifespan is infinite.
    pub fn published(&self) -> Option<Duration> {
        (self.published_nanos > 0).then(|| Duration::from_nanos(self.published_nanos))
    }
}

/// A sample that was published.
///
/// ```
/// use std::time::SystemTime;
/// use axon_shm::{Context, Meta, Publisher, PublisherOptions, qos::Qos};
///
/// let publisher = Publisher::new(&Context::new()?, PublisherOptions::new(Qos::default()))?;
/// let mut loan = publisher.loan(5)?;
/// loan.copy_from_slice(b"hello");
/// let published = loan.publish(Meta::new(1, SystemTime::now()))?;
/// assert_eq!(published.position, None, "nobody reads");
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct Published {
    /// The sample's position in the ring, counted from 0 without gaps. `None` if nobody reads: then the publish only
    /// uses up its number.
    pub position: Option<u64>,
}

/// A sample that was taken.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Taken {
    /// The sample's metadata.
    pub meta: Meta,
    /// The sample's position in the publisher's ring.
    pub position: u64,
}
