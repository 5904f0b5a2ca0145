//! Writes the publisher's times into the ring's header.

use super::Writer;
use crate::{
    ring::{
        layout::ring,
        times::{Times, read},
    },
    sync::{Ordering, Word},
};

impl Writer {
    /// Says that a sample was published at `now`.
    #[inline]
    pub fn note_sample(&self, now: u64) {
        self.note(ring::SAMPLED, now);
    }

    /// Says that the publisher is alive.
    #[inline]
    pub fn assert(&self, now: u64) {
        self.note(ring::ASSERTED, now);
    }

    /// What its readers see.
    pub fn times(&self) -> Times {
        if self.is_forked() { Times::default() } else { read(self.ring.words()) }
    }

    #[inline]
    fn note(&self, word: usize, now: u64) {
        if !self.is_forked() {
            Word::store(&self.ring.words()[word], now, Ordering::Relaxed);
        }
    }
}
