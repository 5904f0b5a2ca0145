//! A sample that is written in place.

use std::io;

use super::{Meta, PublishError, Published, Writer, layout::INLINE, ring};
use std::sync::atomic::AtomicU64;

/// Memory of a ring to be filled, from the front, and published. Dropping it gives it back.
///
/// Written through [`io::Write`], not as a slice: a reader that was overtaken may still look at
/// the same memory, which must therefore be written by atomic words.
pub struct Loan<'a> {
    writer: &'a Writer,
    len: usize,
    written: usize,
    place: Place,
}

enum Place {
    Inline([u8; INLINE]),
    /// The offset in the payload area, and the bytes written since the last whole word.
    Area {
        at: u64,
        partial: [u8; 8],
    },
    Published,
}

impl<'a> Loan<'a> {
    pub(super) fn inline(writer: &'a Writer, len: usize) -> Self {
        Self { writer, len, written: 0, place: Place::Inline([0; INLINE]) }
    }

    pub(super) fn placed(writer: &'a Writer, len: usize, at: u64) -> Self {
        Self { writer, len, written: 0, place: Place::Area { at, partial: [0; 8] } }
    }

    /// Publishes it, waiting for a slot as [`Writer::publish`] does.
    ///
    /// # Errors
    /// Not all of it was written, or as [`Writer::publish`]. The loan is given back.
    pub fn publish(mut self, meta: Meta) -> Result<Published, PublishError> {
        let (len, written) = (self.len as u64, self.written as u64);
        if written < len {
            return Err(PublishError::Incomplete { len, written });
        }
        let published = match &self.place {
            Place::Inline(bytes) => {
                self.writer.publish_loan(meta, self.len, None, &bytes[..self.len])
            }
            Place::Area { at, .. } => self.writer.publish_loan(meta, self.len, Some(*at), &[]),
            Place::Published => unreachable!("publishing takes the loan"),
        }?;
        self.place = Place::Published;
        Ok(published)
    }
}

impl io::Write for Loan<'_> {
    /// Appends; writes nothing once the loan is full.
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let mut bytes = &bytes[..bytes.len().min(self.len - self.written)];
        let count = bytes.len();
        match &mut self.place {
            Place::Inline(all) => all[self.written..][..count].copy_from_slice(bytes),
            Place::Area { at, partial } => {
                let words = self.writer.payload(*at, self.len as u64);
                let mut next = self.written / 8;
                let filled = self.written % 8;
                ring::about_to_write::<AtomicU64>();
                if filled > 0 {
                    let head = bytes.len().min(8 - filled);
                    partial[filled..filled + head].copy_from_slice(&bytes[..head]);
                    ring::copy_in(&words[next..], &partial[..filled + head]);
                    next += usize::from(filled + head == 8);
                    bytes = &bytes[head..];
                }
                if !bytes.is_empty() {
                    ring::copy_in(&words[next..], bytes);
                    let rest = bytes.len() % 8;
                    partial[..rest].copy_from_slice(&bytes[bytes.len() - rest..]);
                }
            }
            Place::Published => unreachable!("publishing takes the loan"),
        }
        self.written += count;
        Ok(count)
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

impl Drop for Loan<'_> {
    fn drop(&mut self) {
        if let Place::Area { at, .. } = self.place {
            self.writer.unreserve(at, self.len);
        }
    }
}
