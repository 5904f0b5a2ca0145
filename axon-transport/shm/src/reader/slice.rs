//! A sample as a slice, for a caller that trusts its publishers.

#![allow(unsafe_code)]

use std::{fmt, ops::Deref};

use super::sample::Sample;
use crate::ring::types::Meta;

/// The caller's promise that publishers do not write to a sample that is being read. It is given once, and turns
/// samples into [slices](Sample::into_slice) without further `unsafe`.
///
/// ```
/// use axon_shm::TrustPublishers;
///
/// // SAFETY: only our own programs publish to what this one reads, over this crate, and this one forks no child.
/// let trust = unsafe { TrustPublishers::new() };
/// # let _ = trust;
/// ```
#[derive(Clone, Copy, Debug)]
pub struct TrustPublishers(());

impl TrustPublishers {
    /// Trusts the publishers of all samples that are turned into slices by this value or a copy of it.
    ///
    /// # Safety
    /// While such a slice is in use, nobody may write to its bytes. Another process has their memory mapped for
    /// writing, like the bytes of a memory-mapped file. A reader is not told of a write. A write to bytes behind a
    /// `&[u8]` is undefined behaviour: properties that were checked may not hold any more. Therefore:
    ///
    /// - The process of each publisher must keep to the protocol. Any version of this crate does, even if its process
    ///   is killed: it does not write to a pinned sample. A process that was taken over by an attacker, or that
    ///   overwrites memory by mistake, may not. If samples come through an AXON daemon, the daemon is one of the
    ///   publishers.
    /// - No `&[u8]` that was borrowed from such a slice before a fork may be used in the child, where the memory is not
    ///   mapped. A slice that is borrowed in the child is empty.
    ///
    /// The memory cannot be truncated, unlike a file's: it is sealed, so that reading it raises no signal.
    #[must_use]
    pub const unsafe fn new() -> Self {
        Self(())
    }
}

/// The bytes of a [`Sample`] in place: a `&[u8]` wherever one is asked for.
///
/// Like its [`Sample`], it keeps the sample from being overwritten. In a forked child it is empty.
///
/// ```
/// # use std::{os::unix::net::UnixDatagram, thread, time::Duration};
/// # use axon_shm::{Context, Publisher, PublisherOptions, Subscriber, SubscriberOptions, TrustPublishers, qos::Qos};
/// # let context = Context::new()?;
/// # let publisher = Publisher::new(&context, PublisherOptions::new(Qos::default()))?;
/// # let (ours, theirs) = UnixDatagram::pair()?;
/// # let options = SubscriberOptions::new(Qos::default());
/// # let ten = Some(Duration::from_secs(10));
/// # let mut subscriber = thread::scope(|scope| {
/// #     let subscriber = scope.spawn(|| Subscriber::connect(&context, &theirs, options, ten));
/// #     publisher.serve(&ours, ten).map(|_| ())?;
/// #     subscriber.join().unwrap()
/// # })?;
/// publisher.publish(b"hello")?;
/// let sample = subscriber.recv(ten)?.expect("a sample");
/// // SAFETY: only this process publishes, and it forks no child.
/// let slice = sample.into_slice(unsafe { TrustPublishers::new() });
/// assert_eq!(&slice[..], b"hello");
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub struct SampleSlice {
    sample: Sample,
}

impl Sample {
    /// Returns its bytes in place, for a caller that trusts its publisher. Nothing is copied.
    #[must_use]
    pub fn into_slice(self, _trust: TrustPublishers) -> SampleSlice {
        SampleSlice { sample: self }
    }
}

impl SampleSlice {
    /// Returns the sample's metadata.
    pub fn meta(&self) -> Meta {
        self.sample.meta()
    }

    /// Returns the sample, to be read as values.
    pub fn sample(&self) -> &Sample {
        &self.sample
    }

    /// Returns the sample.
    pub fn into_sample(self) -> Sample {
        self.sample
    }
}

impl Deref for SampleSlice {
    type Target = [u8];

    #[inline]
    fn deref(&self) -> &[u8] {
        if self.sample.is_forked() {
            return &[];
        }
        // SAFETY: only `into_slice` makes a value of this type, and it takes a `TrustPublishers`. The maker of that
        // promised that nobody writes to the sample, and that bytes borrowed here are not used in a child that is
        // forked later. This process is no such child.
        unsafe { self.sample.as_slice() }
    }
}

impl AsRef<[u8]> for SampleSlice {
    fn as_ref(&self) -> &[u8] {
        self
    }
}

impl fmt::Debug for SampleSlice {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("SampleSlice").field(&self.sample).finish()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ring::types::Taken;

    #[test]
    fn a_copied_sample_is_a_slice_of_its_own_bytes() {
        let taken =
            Taken { meta: Meta { sequence: 1, source_nanos: 2, published_nanos: 3 }, position: 0 };
        // SAFETY: the sample has its bytes to itself.
        let trust = unsafe { TrustPublishers::new() };
        for bytes in [&b""[..], b"x", b"several"] {
            let slice = Sample::copied(taken, bytes.to_vec()).into_slice(trust);
            assert_eq!((&slice[..], slice.meta()), (bytes, taken.meta));
            assert_eq!(slice.as_ref().as_ptr(), slice.sample().as_ptr());
            assert_eq!(slice.into_sample().len(), bytes.len());
        }
    }
}
