//! Determines which part of an MCAP log a checksum covers.
//!
//! MCAP has a checksum for each chunk, and one at the end for the whole data section. Zero means that there is no
//! checksum.

use mcap::{MAGIC, records::op};

/// The length of a record's operation code and length field.
const HEAD: usize = 9;
/// The offset of the checksum in the body of a chunk, after two times and the uncompressed length.
const CHUNK_CHECKSUM: usize = 24;
const CHECKSUM: usize = 4;

/// Follows the records of a log as a reader reads them.
///
/// The reader requests no byte beyond the current record. The record that began last is therefore the record of the
/// message that the reader returns.
#[derive(Debug, Default)]
pub(super) struct Coverage {
    /// The number of bytes of the magic number read so far.
    magic: usize,
    no_log: bool,
    head: Vec<u8>,
    /// The first bytes of the body. They include the checksum of a chunk or of the data section.
    body: Vec<u8>,
    /// The number of bytes of the record that are still to come.
    left: u64,
    /// A schema or a channel was outside chunks, and topics of messages depend on it.
    names_outside: bool,
    /// Messages that no chunk's checksum covers.
    unchecked: u64,
    end: Option<u32>,
}

impl Coverage {
    /// Processes the next bytes of the log.
    pub(super) fn read(&mut self, mut bytes: &[u8]) {
        while let [first, rest @ ..] = bytes {
            if self.magic < MAGIC.len() {
                self.no_log |= *first != MAGIC[self.magic];
                self.magic += 1;
                bytes = rest;
            } else if self.head.len() < HEAD || self.left == 0 {
                if self.head.len() == HEAD {
                    self.head.clear();
                    self.body.clear();
                }
                self.head.push(*first);
                bytes = rest;
                if let Some((_, length)) = self.whole_head() {
                    self.left = length;
                    self.begun();
                }
            } else {
                let taken = usize::try_from(self.left).unwrap_or(usize::MAX).min(bytes.len());
                let kept = (CHUNK_CHECKSUM + CHECKSUM).saturating_sub(self.body.len()).min(taken);
                self.body.extend_from_slice(&bytes[..kept]);
                self.left -= taken as u64;
                bytes = &bytes[taken..];
                self.ended();
            }
        }
    }

    /// Returns whether the log begins with the magic number of MCAP.
    pub(super) fn is_log(&self) -> bool {
        self.magic == MAGIC.len() && !self.no_log
    }

    /// Counts a message that the reader returns.
    pub(super) fn message(&mut self) {
        let at = CHUNK_CHECKSUM..CHUNK_CHECKSUM + CHECKSUM;
        let chunk = matches!(self.whole_head(), Some((op::CHUNK, _)));
        let checksum = self.body.get(at).is_some_and(|checksum| checksum != [0; CHECKSUM]);
        self.unchecked += u64::from(self.names_outside || !(chunk && checksum));
    }

    /// Returns how many of the returned messages no checksum covers, if the reader ended with `error`.
    pub(super) fn unverified(&self, error: &mcap::McapError) -> u64 {
        let mismatch = matches!(error, mcap::McapError::BadDataCrc { .. });
        // The reader compares the checksum of the data section before it continues.
        let section = self.end.is_some_and(|checksum| checksum != 0) && !mismatch;
        if section { 0 } else { self.unchecked }
    }

    fn whole_head(&self) -> Option<(u8, u64)> {
        let [op, length @ ..] = self.head.as_slice() else { return None };
        Some((*op, u64::from_le_bytes(length.try_into().ok()?)))
    }

    fn begun(&mut self) {
        if self.end.is_none() {
            self.names_outside |= matches!(self.head[0], op::SCHEMA | op::CHANNEL);
        }
    }

    fn ended(&mut self) {
        if self.left == 0 && self.head[0] == op::DATA_END && self.end.is_none() {
            let checksum = self.body.get(..CHECKSUM).and_then(|bytes| bytes.try_into().ok());
            self.end = Some(checksum.map_or(0, u32::from_le_bytes));
        }
    }
}
