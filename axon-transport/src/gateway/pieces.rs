//! What has come of a stream, piece by piece: many pieces are taken from the connection at a time.

use bytes::Bytes;
use quinn::{RecvStream, VarInt};

/// Pieces that are taken at a time: a packet's payload each, as a rule.
const TOGETHER: usize = 64;

/// A stream, and what was taken from it and not used.
pub(super) struct Pieces {
    stream: RecvStream,
    taken: [Bytes; TOGETHER],
    /// Which of `taken` are not used up.
    left: std::ops::Range<usize>,
}

impl Pieces {
    pub(super) fn new(stream: RecvStream) -> Self {
        Self { stream, taken: [const { Bytes::new() }; TOGETHER], left: 0..0 }
    }

    /// The next bytes, at least one and no more than `most`; `None` at the stream's end, whatever it
    /// was.
    pub(super) async fn next(&mut self, most: usize) -> Option<Bytes> {
        if self.left.is_empty() {
            let taken = self.stream.read_chunks(&mut self.taken).await;
            self.left = 0..taken.ok()??;
        }
        let piece = &mut self.taken[self.left.start];
        if piece.len() > most {
            return Some(piece.split_to(most));
        }
        self.left.start += 1;
        Some(std::mem::take(piece))
    }

    /// Fills `into`; whether the stream was long enough.
    pub(super) async fn exact(&mut self, mut into: &mut [u8]) -> bool {
        while !into.is_empty() {
            let Some(piece) = self.next(into.len()).await else { return false };
            let (filled, rest) = into.split_at_mut(piece.len());
            filled.copy_from_slice(&piece);
            into = rest;
        }
        true
    }

    /// Tells the peer that no more is wanted.
    pub(super) fn stop(&mut self, code: VarInt) {
        // Only one that was stopped or has ended cannot be.
        let _ = self.stream.stop(code);
    }
}
