//! Measures how far QUIC took the samples of a flow, over all links that carried them.

/// The newest number of which QUIC took any byte, and the bytes taken of that sample. Bytes that QUIC takes again over
/// another link are no progress, whether the same flow sends them or its successor.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct SentProgress {
    sequence: u64,
    bytes: u64,
}

impl SentProgress {
    /// Records that QUIC has `bytes` bytes of a sample. Returns how many of them it took for the first time.
    pub(super) fn advance(&mut self, sequence: u64, bytes: u64) -> u64 {
        let known = if sequence == self.sequence { self.bytes } else { 0 };
        let to = Self { sequence, bytes };
        if to <= *self {
            return 0;
        }
        *self = to;
        bytes - known
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bytes_that_were_taken_before_do_not_count_again() {
        let mut sent_progress = SentProgress::default();
        let taken = [(1, 10), (1, 30), (2, 5), (1, 40), (2, 5), (2, 3), (2, 7), (9, 0), (9, 1)];
        let new = taken.map(|(sequence, bytes)| sent_progress.advance(sequence, bytes));
        assert_eq!(new, [10, 20, 5, 0, 0, 0, 2, 0, 1]);
        // A successor continues from there.
        let mut next = SentProgress::default().max(sent_progress);
        assert_eq!([(1, 50), (9, 4)].map(|(s, b)| next.advance(s, b)), [0, 3]);
    }
}
