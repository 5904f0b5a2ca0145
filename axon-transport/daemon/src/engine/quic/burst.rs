//! The number of datagrams that leave together.
//!
//! The kernel hands a batch to the peer as one message, so the peer decrypts the first datagram once the last one is
//! encrypted. A sample of 64 KiB in one batch is encrypted and decrypted one after the other; in pieces, both sides
//! work at the same time. Each piece costs a system call on either side, which a stream does not need: its peer has
//! datagrams to decrypt all the time.

use std::time::Duration;

/// Datagrams in each of the first pieces of a burst. With half as many, the system calls cost as much as the peer gains.
const PIECE: usize = 16;
/// Time without more than an acknowledgement after which a burst is over although samples wait: the peer does not read
/// their streams.
const PAUSE: Duration = Duration::from_millis(5);
/// A later piece holds at most this part of the datagrams before it in the burst: a quarter.
const PART: usize = 4;

/// The datagrams that one connection sent since its last pause.
#[derive(Debug, Default)]
pub(in crate::engine) struct DatagramBurst {
    sent: usize,
    /// Datagrams of the current pass.
    of_pass: usize,
    /// The time of the last pass that sent more than an acknowledgement.
    sent_at: Duration,
    /// True if samples wait for QUIC to take more.
    is_full: bool,
}

impl DatagramBurst {
    /// Returns the number of datagrams that may leave together.
    pub(in crate::engine) fn most(&self) -> usize {
        PIECE.max(self.sent / PART)
    }

    /// Handles datagrams that leave together.
    pub(in crate::engine) fn handle_sent(&mut self, datagrams: usize) {
        self.sent = self.sent.saturating_add(datagrams);
        self.of_pass = self.of_pass.saturating_add(datagrams);
    }

    /// Sets whether samples wait for QUIC to take more.
    pub(in crate::engine) fn set_full(&mut self, is_full: bool) {
        self.is_full = is_full;
    }

    /// Handles the end of a pass: QUIC sends nothing more now. The burst is over if the pass sent no more than an
    /// acknowledgement, and no sample waits or the last such pass is some time ago.
    pub(in crate::engine) fn handle_pass(&mut self, now: Duration) {
        if std::mem::take(&mut self.of_pass) > 1 {
            self.sent_at = now;
        } else if !self.is_full || now >= self.sent_at + PAUSE {
            self.sent = 0;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Most datagrams of a batch of the reactor.
    const BATCH: usize = 44;

    /// Sends so many datagrams in one pass. Returns the pieces.
    fn pass(burst: &mut DatagramBurst, datagrams: usize) -> Vec<usize> {
        pass_at(burst, datagrams, Duration::ZERO)
    }

    fn pass_at(burst: &mut DatagramBurst, mut datagrams: usize, now: Duration) -> Vec<usize> {
        let mut pieces = Vec::new();
        while datagrams > 0 {
            let piece = datagrams.min(burst.most()).min(BATCH);
            burst.handle_sent(piece);
            pieces.push(piece);
            datagrams -= piece;
        }
        burst.handle_pass(now);
        pieces
    }

    #[test]
    fn a_sample_of_64_kib_leaves_in_three_pieces_each_time() {
        let mut burst = DatagramBurst::default();
        for _ in 0..3 {
            assert_eq!(pass(&mut burst, 47), [16, 16, 15]);
            assert_eq!(pass(&mut burst, 1), [1], "an acknowledgement");
        }
    }

    #[test]
    fn pieces_of_a_longer_burst_grow() {
        let mut burst = DatagramBurst::default();
        let pieces = pass(&mut burst, 400);
        assert_eq!(pieces[..8], [16, 16, 16, 16, 16, 20, 25, 31]);
        assert_eq!(pieces[8..13], [39, 44, 44, 44, 44]);
        // A stream goes on in the next pass.
        assert_eq!(pass(&mut burst, 100), [44, 44, 12]);
    }

    #[test]
    fn a_burst_lasts_while_samples_wait_for_quic() {
        let mut burst = DatagramBurst::default();
        pass(&mut burst, 400);
        burst.set_full(true);
        for _ in 0..3 {
            pass(&mut burst, 0);
        }
        assert_eq!(pass(&mut burst, 50), [44, 6]);
        burst.set_full(false);
        pass(&mut burst, 0);
        assert_eq!(pass(&mut burst, 50), [16, 16, 16, 2]);
    }

    #[test]
    fn lone_samples_leave_in_pieces_beside_a_stream_that_the_peer_does_not_read() {
        let mut burst = DatagramBurst::default();
        burst.set_full(true);
        for number in 0..20 {
            let now = Duration::from_millis(10 * number);
            assert_eq!(pass_at(&mut burst, 47, now), [16, 16, 15]);
            pass_at(&mut burst, 1, now + Duration::from_millis(1));
            pass_at(&mut burst, 0, now + PAUSE);
        }
    }
}
