//! Reads a QUIC stream in pieces, many of them at a time.

use bytes::Bytes;
use quinn::{RecvStream, VarInt};

/// Pieces that are taken at a time: a packet's payload each, as a rule. What is taken the peer may send
/// anew, so it counts for no window.
const TOGETHER: usize = 64;

/// A stream, and what was taken from it and not used.
pub(super) struct Pieces {
    stream: RecvStream,
    taken: [Bytes; TOGETHER],
    /// Pieces that may be taken.
    together: usize,
    /// Which of `taken` are not used up.
    left: std::ops::Range<usize>,
}

impl Pieces {
    /// Those of a stream whose turn has not come: one is taken at a time.
    pub(super) fn new(stream: RecvStream) -> Self {
        Self { stream, taken: [const { Bytes::new() }; TOGETHER], together: 1, left: 0..0 }
    }

    /// The stream is read to its end from now on.
    pub(super) fn take_many(&mut self) {
        self.together = TOGETHER;
    }

    /// The next bytes, at least one and no more than `most`; `None` at the stream's end, whatever it
    /// was.
    pub(super) async fn next(&mut self, most: usize) -> Option<Bytes> {
        if self.left.is_empty() {
            let taken = self.stream.read_chunks(&mut self.taken[..self.together]).await;
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gateway::played::{Pair, block_on};

    #[test]
    fn a_stream_whose_turn_has_not_come_is_left_where_it_is() {
        const BYTES: usize = 40_000;
        block_on(async {
            let pair = Pair::new().await;
            let mut send = pair.here.open_uni().await.unwrap();
            send.write_all(&[0x5a; BYTES]).await.unwrap();
            send.finish().unwrap();
            // All of it is acknowledged, and so there.
            send.stopped().await.unwrap();
            let mut pieces = Pieces::new(pair.there.accept_uni().await.unwrap());
            assert!(pieces.exact(&mut [0; 24]).await);
            assert!(pieces.left.len() <= 1, "{:?}", pieces.left);
            pieces.take_many();
            let mut rest = BYTES - 24;
            while let Some(piece) = pieces.next(usize::MAX).await {
                rest -= piece.len();
            }
            assert_eq!(rest, 0);
        });
    }
}
