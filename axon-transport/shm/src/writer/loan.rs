//! A sample that the application writes in place before it publishes it.

#![allow(unsafe_code)]

use std::{
    io,
    ops::{Deref, DerefMut},
    ptr::NonNull,
    slice,
    sync::Arc,
    time::SystemTime,
};

use crate::{
    alloc::segments::OwnSegment,
    error::PublishError,
    os::clock::{unix_nanos, wall},
    ring::{
        layout::{ALIGNED, Location},
        types::{Meta, Published},
    },
    writer::{
        KEEP_ALL_PUBLISH_TIMEOUT, Numbering, PublishDeadline, RingPayload, WakeTiming, Writer,
    },
};

/// Memory to be filled and published: shared memory if such a sample is read in place. Dropping the loan gives the
/// memory back.
///
/// It is written from the front through [`io::Write`], or anywhere as the slice that it dereferences to; the slice
/// holds zeros or bytes of earlier samples at first. In a forked child it must not be used: dereferencing it panics,
/// and using a slice that was borrowed before ends the child.
///
/// It borrows its publisher, and publishing consumes it:
///
/// ```compile_fail,E0505
/// # use axon_shm::{PublishError, Publisher};
/// fn too_late(publisher: Publisher) -> Result<(), PublishError> {
///     let loan = publisher.loan(10_000)?;
///     drop(publisher);
///     loan.publish_now().map(drop)
/// }
/// ```
///
/// ```compile_fail,E0382
/// # use axon_shm::{PublishError, Publisher};
/// fn written_while_it_is_read(publisher: &Publisher) -> Result<(), PublishError> {
///     let mut loan = publisher.loan(10_000)?;
///     loan.fill(1);
///     loan.publish_now()?;
///     loan.fill(2);
///     Ok(())
/// }
/// ```
pub struct Loan<'a> {
    writer: Lender<'a>,
    /// Bytes in front of the first lent byte.
    lead: usize,
    len: usize,
    written: usize,
    memory: LoanMemory,
}

/// The writer whose memory is lent.
pub(crate) enum Lender<'a> {
    Borrowed(&'a Writer),
    Shared(Arc<Writer>),
}

impl Deref for Lender<'_> {
    type Target = Writer;

    #[inline]
    fn deref(&self) -> &Writer {
        match self {
            Self::Borrowed(writer) => writer,
            Self::Shared(writer) => writer,
        }
    }
}

enum LoanMemory {
    /// Private memory, in words that are aligned to 16.
    Own(Vec<u128>),
    Shared(LoanLocation),
    Published,
}

/// Shared memory that is lent.
pub(crate) struct LoanLocation {
    pub(crate) segment: Arc<OwnSegment>,
    /// Offset in the segment, in bytes.
    pub(crate) at: u64,
}

impl LoanLocation {
    fn location(&self) -> Location {
        Location { segment: self.segment.number(), offset: self.at }
    }
}

impl<'a> Loan<'a> {
    pub(crate) fn copied(writer: Lender<'a>, lead: usize, len: usize) -> Self {
        let words = vec![0; (lead + len).div_ceil(ALIGNED)];
        Self { writer, lead, len, written: 0, memory: LoanMemory::Own(words) }
    }

    /// Creates a loan of `len` bytes behind the first `lead` bytes of `place`; all of them have been lent.
    pub(crate) fn placed(writer: Lender<'a>, lead: usize, len: usize, place: LoanLocation) -> Self {
        Self { writer, lead, len, written: 0, memory: LoanMemory::Shared(place) }
    }

    /// Publishes the loan, waiting for a slot as [`Writer::publish`] does.
    ///
    /// # Errors
    /// The loan was neither written to the end nor borrowed as a slice; or as for [`Writer::publish`]. The loan is
    /// given back.
    #[inline]
    pub fn publish(self, meta: Meta) -> Result<Published, PublishError> {
        self.publish_as(Numbering::Given(meta)).map(|(_, published)| published)
    }

    /// Like [`publish`](Self::publish), with this source time. Returns the sample's sequence number, the one after the
    /// publisher's last.
    ///
    /// # Errors
    /// As for [`publish`](Self::publish).
    #[inline]
    pub fn publish_at(self, source_time: SystemTime) -> Result<u64, PublishError> {
        self.publish_next(unix_nanos(source_time))
    }

    /// Like [`publish_at`](Self::publish_at), with a source time in nanoseconds since the Unix epoch. For this
    /// project's crates.
    #[doc(hidden)]
    #[inline]
    pub fn publish_next(self, source_timestamp: i64) -> Result<u64, PublishError> {
        self.publish_as(Numbering::Next(source_timestamp)).map(|(sequence, _)| sequence)
    }

    /// Like [`publish_at`](Self::publish_at), with the current time.
    ///
    /// # Errors
    /// As for [`publish`](Self::publish).
    #[inline]
    pub fn publish_now(self) -> Result<u64, PublishError> {
        self.publish_next(wall())
    }

    /// Like [`publish_next`](Self::publish_next), for its first `len` bytes. For this project's crates.
    #[doc(hidden)]
    #[inline]
    pub fn publish_front(self, len: usize, source_timestamp: i64) -> Result<u64, PublishError> {
        let (most, written) = (self.len as u64, self.written as u64);
        if self.written < len {
            return Err(PublishError::Incomplete { len: most, written });
        }
        let numbering = Numbering::Next(source_timestamp);
        self.commit(len, numbering, PublishDeadline::new(KEEP_ALL_PUBLISH_TIMEOUT))
            .map(|(sequence, _)| sequence)
    }

    #[inline]
    fn publish_as(self, numbering: Numbering) -> Result<(u64, Published), PublishError> {
        let len = self.len;
        if self.written < len {
            let (len, written) = (len as u64, self.written as u64);
            return Err(PublishError::Incomplete { len, written });
        }
        self.commit(len, numbering, PublishDeadline::new(KEEP_ALL_PUBLISH_TIMEOUT))
    }

    pub(crate) fn commit(
        mut self,
        len: usize,
        numbering: Numbering,
        deadline: PublishDeadline,
    ) -> Result<(u64, Published), PublishError> {
        if self.writer.is_forked() {
            return Err(PublishError::Forked);
        }
        let payload = match &self.memory {
            LoanMemory::Shared(place) if len as u64 > self.writer.longest_copied() => {
                let (lead, lent) = (self.lead, self.lead + self.len);
                RingPayload::Written { at: place.location(), lead, len, lent }
            }
            // A sample that is short after all is copied from the loan.
            LoanMemory::Own(_) | LoanMemory::Shared(_) => RingPayload::Bytes(&self[..len]),
            LoanMemory::Published => unreachable!("publishing takes the loan"),
        };
        let taken = matches!(payload, RingPayload::Written { .. });
        let (sequence, published) =
            self.writer.commit(numbering, payload, deadline, WakeTiming::Now)?;
        // What nobody reads has not become a sample, and its memory is given back.
        if taken && published.position.is_some() {
            self.memory = LoanMemory::Published;
        }
        Ok((sequence, published))
    }

    /// Returns the address of the lent memory.
    #[inline]
    fn lent(&self, place: &LoanLocation) -> NonNull<u8> {
        assert!(!self.writer.is_forked(), "a loan of shared memory, used after fork");
        place.segment.memory.address(place.at + self.lead as u64, self.len)
    }
}

impl Deref for Loan<'_> {
    type Target = [u8];

    #[inline]
    fn deref(&self) -> &[u8] {
        match &self.memory {
            LoanMemory::Own(words) => &bytes_of(words)[self.lead..][..self.len],
            // SAFETY: `len` bytes of the segment's map, which lives as long as the loan. They are
            // memory from the system or bytes of earlier samples, so initialized. They are lent to
            // this loan alone, and no reader reads them before they are published, which takes the
            // loan: nothing writes to them while it is borrowed. The words of the whole map that
            // exist beside are atomic and not touched here.
            LoanMemory::Shared(place) => unsafe {
                slice::from_raw_parts(self.lent(place).as_ptr(), self.len)
            },
            LoanMemory::Published => &[],
        }
    }
}

impl DerefMut for Loan<'_> {
    /// A caller that borrows the bytes counts as writing all of them.
    #[inline]
    fn deref_mut(&mut self) -> &mut [u8] {
        self.written = self.len;
        if let LoanMemory::Shared(place) = &self.memory {
            let start = self.lent(place).as_ptr();
            // SAFETY: as in `deref`, and borrowed mutably like the loan itself. Other processes
            // have the memory mapped; they cannot write to it, and those that keep to the protocol
            // do not read it.
            return unsafe { slice::from_raw_parts_mut(start, self.len) };
        }
        match &mut self.memory {
            LoanMemory::Own(words) => &mut bytes_of_mut(words)[self.lead..][..self.len],
            LoanMemory::Shared(_) | LoanMemory::Published => &mut [],
        }
    }
}

impl io::Write for Loan<'_> {
    /// Appends; writes nothing once the loan is full.
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        if self.writer.is_forked() {
            return Err(io::Error::other(PublishError::Forked));
        }
        let from = self.written;
        let count = bytes.len().min(self.len - from);
        self[from..from + count].copy_from_slice(&bytes[..count]);
        self.written = from + count;
        Ok(count)
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

impl Drop for Loan<'_> {
    fn drop(&mut self) {
        // The history of a forked child is an unused copy, and its lock may be held.
        if let LoanMemory::Shared(place) = &self.memory
            && !self.writer.is_forked()
        {
            self.writer.give_back(place.location(), self.lead + self.len);
        }
    }
}

fn bytes_of(words: &[u128]) -> &[u8] {
    // SAFETY: the same memory, borrowed as long; any byte of a word is a byte.
    unsafe { slice::from_raw_parts(words.as_ptr().cast(), size_of_val(words)) }
}

fn bytes_of_mut(words: &mut [u128]) -> &mut [u8] {
    // SAFETY: the same memory, borrowed as long and mutably; any bytes are a word.
    unsafe { slice::from_raw_parts_mut(words.as_mut_ptr().cast(), size_of_val(words)) }
}
