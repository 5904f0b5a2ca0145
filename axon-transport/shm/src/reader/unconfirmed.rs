//! Samples that a reader took and that another process or host still has to confirm. Relays use this: the publisher
//! keeps such samples until the relay confirms that they arrived.

use std::collections::VecDeque;

use super::Reader;
use crate::{
    ring::{
        layout,
        protocol::{self, PositionState, RecordRead},
    },
    sync::Ordering,
};

/// Number of samples whose length is read at least, if there are as many; it is always less than twice this number.
const LOOKS: u64 = 1 << 13;

/// Numbers and positions of samples that were taken and are not confirmed, and the number of samples given up so far.
#[derive(Default)]
pub(super) struct UnconfirmedSamples(VecDeque<(u64, u64)>, u64);

impl UnconfirmedSamples {
    pub(super) fn add(&mut self, sequence: u64, position: u64) {
        self.0.push_back((sequence, position));
    }

    /// Returns the position of the oldest one.
    #[inline]
    pub(super) fn first(&self) -> Option<u64> {
        self.0.front().map(|(_, position)| *position)
    }
}

impl Reader {
    /// Requires that samples taken from now on are confirmed by [`finish`](Self::finish): until then, they count as not
    /// taken for their publisher.
    #[inline]
    pub fn finish_later(&mut self) {
        self.under_way.get_or_insert_default();
    }

    /// Returns whether there are samples that were taken and are not confirmed.
    #[inline]
    pub fn is_under_way(&self) -> bool {
        self.under_way.as_ref().is_some_and(|under_way| !under_way.0.is_empty())
    }

    /// Returns the number of unconfirmed samples, including untaken ones.
    #[inline]
    pub fn undone(&self) -> u64 {
        let under_way = self.under_way.as_ref().map_or(0, |under_way| under_way.0.len() as u64);
        under_way.saturating_add(self.unread())
    }

    /// Returns the bytes that the [unconfirmed](Self::undone) samples take, including their descriptors. Of many
    /// samples it reads the length of each nth one, and assumes the others to be like it. Another process wrote the
    /// lengths: any value is possible.
    pub fn undone_bytes(&self) -> u64 {
        let undone = self.undone();
        if undone == 0 || self.attachment.lane.is_forked() {
            return 0;
        }
        let described = undone.saturating_mul(layout::DESCRIPTOR);
        let ring = self.attachment.ring();
        let (Ok(descriptors), Ok((tail, head))) =
            (self.resolve(protocol::array(ring)), protocol::bounds(ring))
        else {
            return described;
        };
        let under_way = self.under_way.as_ref().and_then(|under_way| under_way.first());
        let first = under_way.unwrap_or(self.cursor).max(tail);
        let every = (head.saturating_sub(first) / LOOKS).max(1);
        let view = descriptors.view(&self.attachment);
        let lengths =
            (first..head).step_by(usize::try_from(every).unwrap_or(usize::MAX)).map(|at| {
                match (view.state(at), view.look(at)) {
                    (PositionState::Here, RecordRead::Sample(record)) => u64::from(record.len),
                    _ => 0,
                }
            });
        described.saturating_add(lengths.sum::<u64>().saturating_mul(every))
    }

    /// Returns how many publishes found no space because KEEP_ALL readers had not confirmed the oldest sample. Returns
    /// `None` if this reader has confirmed it. Another process wrote the number, so any value is possible.
    pub fn refused(&self) -> Option<u64> {
        if self.attachment.lane.is_forked() {
            return None;
        }
        let ring = self.attachment.ring();
        let first =
            self.under_way.as_ref().and_then(|under_way| under_way.first()).unwrap_or(self.cursor);
        let (tail, head) = protocol::bounds(ring).ok()?;
        // Relaxed: a number for which nothing else is read.
        let refused = || ring[layout::ring::REFUSED].load(Ordering::Relaxed);
        (first <= tail && first < head).then(refused)
    }

    /// Confirms the samples up to this number.
    #[inline]
    pub fn finish(&mut self, sequence: u64) {
        let Some(under_way) = &mut self.under_way else { return };
        if self.attachment.lane.is_forked() {
            return;
        }
        while under_way.0.front().is_some_and(|(number, _)| *number <= sequence) {
            under_way.0.pop_front();
        }
        self.tell_cursor();
    }

    /// Confirms the message of this number, and all messages taken before it: for a writer whose numbers do not rise.
    pub fn finish_through(&mut self, sequence: u64) {
        let Some(under_way) = &mut self.under_way else { return };
        if self.attachment.lane.is_forked() {
            return;
        }
        if let Some(at) = under_way.0.iter().position(|(number, _)| *number == sequence) {
            under_way.0.drain(..=at);
            self.tell_cursor();
        }
    }

    /// Reports that `samples` samples do not reach their destination. The publisher sees that no later than that they
    /// are [confirmed](Self::finish).
    pub fn give_up(&mut self, samples: u64) {
        let Some(under_way) = &mut self.under_way else { return };
        if !self.attachment.lane.is_forked() {
            under_way.1 = under_way.1.saturating_add(samples);
            self.attachment.lane.give_up(under_way.1);
        }
    }

    /// Makes the samples that were taken and are not confirmed available again.
    pub fn take_back(&mut self) {
        let Some(under_way) = &mut self.under_way else { return };
        if self.attachment.lane.is_forked() {
            return;
        }
        let samples = std::mem::take(&mut under_way.0);
        if let Some((_, position)) = samples.front() {
            self.cursor = *position;
            self.received = self.received.saturating_sub(samples.len() as u64);
            self.awaited.clear();
        }
    }

    /// Like [`take_back`](Self::take_back), for all kept samples of its grant, confirmed or not.
    pub fn rewind(&mut self) {
        self.take_back();
        if self.under_way.is_none() || self.attachment.lane.is_forked() {
            return;
        }
        if let Ok((tail, _)) = protocol::bounds(self.attachment.ring()) {
            let first = tail.max(self.reads.grant.first);
            if first < self.cursor {
                self.cursor = first;
                self.tell_cursor();
            }
        }
    }
}
