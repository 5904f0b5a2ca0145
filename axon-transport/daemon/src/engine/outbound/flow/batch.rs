//! A batch of messages that a flow sealed together, until QUIC has taken it.

use std::collections::VecDeque;

use bytes::Bytes;

/// A sealed message that is not entirely with QUIC.
#[derive(Debug)]
pub(super) struct Sealed {
    pub(super) sequence: u64,
    /// Bytes of the serialized message.
    pub(super) length: usize,
    /// The end of its frame, in bytes of the batch.
    pub(super) end: u64,
}

/// A batch of sealed messages.
#[derive(Debug, Default)]
pub(super) struct Batch {
    /// The part that QUIC has not taken.
    chunks: VecDeque<Bytes>,
    sealed: VecDeque<Sealed>,
    /// The start of the first sealed message's frame, in bytes of the batch.
    begin: u64,
    /// Bytes that QUIC has taken.
    taken: u64,
}

impl Batch {
    /// Returns whether QUIC has all of it.
    pub(super) fn is_empty(&self) -> bool {
        self.chunks.is_empty()
    }

    /// Returns the number of bytes that QUIC has not taken.
    pub(super) fn left(&self) -> usize {
        self.chunks.iter().map(Bytes::len).sum()
    }

    /// Clears the batch for the next one.
    pub(super) fn clear(&mut self) {
        self.chunks.clear();
        self.sealed.clear();
        (self.begin, self.taken) = (0, 0);
    }

    /// Adds a message to the batch.
    pub(super) fn add(&mut self, sealed: Sealed) {
        self.sealed.push_back(sealed);
    }

    /// Adds the bytes of all its messages.
    pub(super) fn set_chunks(&mut self, chunks: impl IntoIterator<Item = Bytes>) {
        self.chunks.extend(chunks);
    }

    /// Puts bytes in front of its first message, of which QUIC has taken nothing.
    pub(super) fn put_before(&mut self, bytes: &[u8]) {
        self.chunks.push_front(Bytes::copy_from_slice(bytes));
        self.sealed.iter_mut().for_each(|sealed| sealed.end += bytes.len() as u64);
    }

    /// What QUIC has not taken, for it to take from.
    pub(super) fn chunks(&mut self) -> &mut [Bytes] {
        self.chunks.make_contiguous()
    }

    /// QUIC took so many of the chunks wholly.
    pub(super) fn drop_chunks(&mut self, chunks: usize) {
        self.chunks.drain(..chunks);
    }

    /// QUIC took so many bytes. `each` is told of the messages that it has a part of, or the rest now: how many bytes
    /// of the frame it has, and whether that is all.
    pub(super) fn handle_taken(&mut self, bytes: u64, mut each: impl FnMut(&Sealed, u64, bool)) {
        self.taken += bytes;
        while let Some(sealed) = self.sealed.front() {
            let is_whole = sealed.end <= self.taken;
            if self.begin < self.taken {
                each(sealed, self.taken.min(sealed.end) - self.begin, is_whole);
            }
            if !is_whole {
                break;
            }
            self.begin = sealed.end;
            self.sealed.pop_front();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_message_is_sent_once_its_last_byte_is_taken() {
        let mut batch = Batch::default();
        batch.add(Sealed { sequence: 1, length: 5, end: 10 });
        batch.add(Sealed { sequence: 2, length: 5, end: 20 });
        batch.set_chunks([Bytes::from_static(&[0; 20])]);
        batch.put_before(&[0; 4]);
        assert_eq!(batch.left(), 24);
        let mut sent = |bytes| {
            let mut sent = Vec::new();
            batch.handle_taken(bytes, |sealed, bytes, is_whole| {
                sent.push((sealed.sequence, bytes, is_whole));
            });
            sent
        };
        assert_eq!(sent(13), [(1, 13, false)], "the header counts");
        assert_eq!(sent(1), [(1, 14, true)]);
        assert_eq!(sent(2), [(2, 2, false)]);
        assert_eq!(sent(8), [(2, 10, true)]);
    }
}
