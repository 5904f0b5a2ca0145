//! The types that a writer and a reader of a ring exchange with each other and with their owners.

use std::time::SystemTime;

use crate::{
    ids::Gid,
    os::clock::{from_unix_nanos, unix_nanos},
    qos::Qos,
};

/// What a ring is made for.
#[derive(Clone, Copy, Debug)]
pub struct RingOptions {
    /// The publisher.
    pub gid: Gid,
    /// What it offers.
    pub qos: Qos,
    /// Bytes of samples to keep before the oldest go; one sample is always kept.
    pub budget: u64,
    /// The largest sample in bytes.
    pub max_message: u64,
    /// The length in bytes that is expected of samples. Where it is more than 512, readers have
    /// memory of the publisher's own before the first of them comes, in which there are all
    /// samples of more than 4 KiB, and loans of more than 512 bytes.
    pub expected: u64,
}

/// What a reader is given when it attaches.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Grant {
    /// Names this attachment; never 0.
    pub generation: u64,
    /// The first position that the reader takes.
    pub first: u64,
}

/// What goes with a sample.
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
    /// When it was published, in nanoseconds since the Unix epoch.
    pub source_timestamp: i64,
    /// When it was published, in nanoseconds of this host's CLOCK_MONOTONIC: that of a sample from
    /// another host is its arrival less its age. The publisher's lifespan counts from then. 0 is now
    /// for a sample that is published, and stands in one that was taken where the lifespan is infinite.
    pub published: u64,
}

impl Meta {
    /// Of a sample that is published now, with this number and source time.
    pub fn new(sequence: u64, source_time: SystemTime) -> Self {
        Self::at_nanos(sequence, unix_nanos(source_time))
    }

    /// As [`new`](Self::new), with the source time in nanoseconds since the Unix epoch.
    pub fn at_nanos(sequence: u64, source_timestamp: i64) -> Self {
        Self { sequence, source_timestamp, published: 0 }
    }

    /// With the time of publication in nanoseconds of this host's CLOCK_MONOTONIC.
    #[must_use]
    pub fn with_published(self, published: u64) -> Self {
        Self { published, ..self }
    }

    /// The time of publication by the publisher's wall clock.
    pub fn source_time(&self) -> SystemTime {
        from_unix_nanos(self.source_timestamp)
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
    /// Its position in the ring, counted from 0 without gaps. None where nobody reads: then only
    /// its number is used up.
    pub position: Option<u64>,
}

/// A sample that was taken.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Taken {
    /// What goes with it.
    pub meta: Meta,
    /// Its position in the publisher's ring.
    pub position: u64,
}
