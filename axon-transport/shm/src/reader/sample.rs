//! A sample that a reader took without copying it.

#![allow(unsafe_code)]

use std::{
    collections::TryReserveError,
    fmt,
    io::{self, Read, Seek, SeekFrom},
    mem::MaybeUninit,
    ops::Range,
    slice,
    sync::{Arc, atomic::AtomicU64},
};

use crate::{
    memory::{copy, segment::Map},
    ring::types::{Meta, Taken},
    session::attachment::Pin,
};

/// A sample, in the publisher's memory if it is long enough for that, or else in a copy.
///
/// It stays as it was published for as long as this value lives, even after the subscription, the publisher and its
/// process have ended. Only then may the publisher reuse the memory; it never waits for that. A subscription can have
/// five such samples of one publisher; a sixth is copied, and so is one that is longer than its share of the memory
/// that the publisher can spare. Any thread may read and drop it.
///
/// A publisher in another process that does not keep to the protocol can still change the bytes. They are therefore
/// read as values ([`read_at`](Self::read_at), [`copy_to`](Self::copy_to), [`reader`](Self::reader)), and as a slice
/// only if the caller [vouches for the publisher](Self::into_slice).
///
/// Reading in place borrows the sample:
///
/// ```compile_fail,E0505
/// # use axon_shm::{Subscriber, TakeError};
/// fn first(subscriber: &mut Subscriber) -> Result<(), TakeError> {
///     if let Some(sample) = subscriber.take()? {
///         let reader = sample.reader();
///         drop(sample); // The publisher may write here from now on.
///         std::io::copy(&mut { reader }, &mut std::io::sink()).unwrap();
///     }
///     Ok(())
/// }
/// ```
///
/// A forked child has no access to it: it reads nothing there.
pub struct Sample {
    taken: Taken,
    len: usize,
    data: SampleBytes,
}

enum SampleBytes {
    Copied(Vec<u8>),
    Pinned { there: MappedRange, pin: Pin },
}

/// Bytes of a map: the bytes of `words`, without the first `skip` bytes.
pub(crate) struct MappedRange {
    pub(crate) map: Arc<Map>,
    pub(crate) words: Range<usize>,
    pub(crate) skip: usize,
}

impl MappedRange {
    #[inline]
    pub(crate) fn words(&self) -> &[AtomicU64] {
        &self.map.words()[self.words.clone()]
    }
}

impl Sample {
    /// Creates a sample with its own bytes.
    pub(crate) fn copied(taken: Taken, bytes: Vec<u8>) -> Self {
        Self { taken, len: bytes.len(), data: SampleBytes::Copied(bytes) }
    }

    /// Creates a sample of `len` bytes at `there`, inside its words, which `pin` pins.
    pub(crate) fn pinned(taken: Taken, len: usize, there: MappedRange, pin: Pin) -> Self {
        debug_assert!(there.skip + len <= there.words().len() * 8);
        Self { taken, len, data: SampleBytes::Pinned { there, pin } }
    }

    /// Returns its metadata.
    #[inline]
    pub fn meta(&self) -> Meta {
        self.taken.meta
    }

    /// Returns its position in the publisher's ring.
    #[inline]
    pub fn position(&self) -> u64 {
        self.taken.position
    }

    /// Returns its length in bytes.
    #[inline]
    pub fn len(&self) -> usize {
        self.len
    }

    /// Returns whether it has no bytes.
    #[inline]
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// Returns whether it is in the publisher's memory.
    #[inline]
    pub fn is_borrowed(&self) -> bool {
        matches!(self.data, SampleBytes::Pinned { .. })
    }

    /// Returns whether this is a forked child, which has no access to it.
    #[inline]
    pub(super) fn is_forked(&self) -> bool {
        matches!(&self.data, SampleBytes::Pinned { pin, .. } if pin.attachment().lane.is_forked())
    }

    /// Copies bytes from `at` on to the front of `out`, as many as there are and fit, and returns their number.
    #[inline]
    pub fn read_at(&self, at: usize, out: &mut [u8]) -> usize {
        let count = out.len().min(self.len.saturating_sub(at));
        if count == 0 {
            return 0;
        }
        let out = &mut out[..count];
        match &self.data {
            SampleBytes::Copied(bytes) => out.copy_from_slice(&bytes[at.min(self.len)..][..count]),
            SampleBytes::Pinned { pin, .. } if pin.attachment().lane.is_forked() => return 0,
            SampleBytes::Pinned { there, .. } => copy::read_at(there.words(), there.skip + at, out),
        }
        count
    }

    /// Fills `out` with its first bytes. Returns false, with nothing written, in a forked child. For this project's
    /// crates.
    ///
    /// # Panics
    /// `out` is longer than the sample.
    #[doc(hidden)]
    #[inline]
    pub fn write_to(&self, out: &mut [MaybeUninit<u8>]) -> bool {
        assert!(out.len() <= self.len);
        match &self.data {
            SampleBytes::Copied(bytes) => {
                for (to, byte) in out.iter_mut().zip(bytes) {
                    to.write(*byte);
                }
            }
            SampleBytes::Pinned { pin, .. } if pin.attachment().lane.is_forked() => return false,
            SampleBytes::Pinned { there, .. } => copy::copy(there.words(), there.skip, out),
        }
        true
    }

    /// Replaces the content of `out` by the sample's bytes; in a forked child, by none.
    ///
    /// # Errors
    /// There is no memory for the bytes.
    pub fn copy_to(&self, out: &mut Vec<u8>) -> Result<(), TryReserveError> {
        match &self.data {
            SampleBytes::Copied(bytes) => {
                out.clear();
                out.try_reserve(bytes.len())?;
                out.extend_from_slice(bytes);
                Ok(())
            }
            SampleBytes::Pinned { pin, .. } if pin.attachment().lane.is_forked() => {
                out.clear();
                Ok(())
            }
            SampleBytes::Pinned { there, .. } => {
                copy::copy_out(there.words(), there.skip, self.len, out)
            }
        }
    }

    /// Returns a reader of the sample from the front, for instance to deserialize it.
    pub fn reader(&self) -> SampleReader<'_> {
        SampleReader { sample: self, at: 0 }
    }

    /// Returns the address of its bytes. If it [is borrowed](Self::is_borrowed), they are aligned to 16, or the bytes
    /// behind the header of its publisher's [loan](crate::Publisher::loan_behind) are.
    ///
    /// They are readable for as long as the sample lives. A publisher that does not keep to the
    /// protocol may change them at any time, so an access must be atomic or volatile.
    #[inline]
    pub fn as_ptr(&self) -> *const u8 {
        match &self.data {
            SampleBytes::Copied(bytes) => bytes.as_ptr(),
            SampleBytes::Pinned { there, .. } => {
                there.words().as_ptr().cast::<u8>().wrapping_add(there.skip)
            }
        }
    }

    /// Returns its bytes in place.
    /// Returns its bytes in place.
    ///
    /// # Safety
    /// If it [is borrowed](Self::is_borrowed), the caller must trust the publisher's process not to write to a pinned
    /// sample; this crate never does. And the slice must not be used in a child that was forked while the sample lived.
    pub unsafe fn as_slice(&self) -> &[u8] {
        // SAFETY: the `len` bytes from there on are initialized and readable as long as `self` lives. They belong to
        // the vector, or to the map, which holds as many after the skipped bytes (`pinned`). Nobody writes to them
        // meanwhile: the vector is not shared, and for the map the caller promises it.
        unsafe { slice::from_raw_parts(self.as_ptr(), self.len) }
    }
}

impl fmt::Debug for Sample {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Sample")
            .field("meta", &self.meta())
            .field("len", &self.len)
            .field("borrowed", &self.is_borrowed())
            .finish_non_exhaustive()
    }
}

/// Reads a [`Sample`] from the front.
///
/// ```
/// # use std::{os::unix::net::UnixDatagram, thread, time::Duration};
/// # use axon_shm::{Context, Publisher, PublisherOptions, Subscriber, SubscriberOptions, qos::Qos};
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
/// let mut text = String::new();
/// std::io::Read::read_to_string(&mut sample.reader(), &mut text)?;
/// assert_eq!(text, "hello");
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Debug)]
pub struct SampleReader<'a> {
    sample: &'a Sample,
    at: u64,
}

impl Read for SampleReader<'_> {
    fn read(&mut self, out: &mut [u8]) -> io::Result<usize> {
        let count = usize::try_from(self.at).map_or(0, |at| self.sample.read_at(at, out));
        self.at += count as u64;
        Ok(count)
    }
}

impl Seek for SampleReader<'_> {
    fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
        let (from, by) = match to {
            SeekFrom::Start(at) => (at, 0),
            SeekFrom::Current(by) => (self.at, by),
            SeekFrom::End(by) => (self.sample.len as u64, by),
        };
        let outside = || io::Error::new(io::ErrorKind::InvalidInput, "before a sample's start");
        self.at = from.checked_add_signed(by).ok_or_else(outside)?;
        Ok(self.at)
    }
}
