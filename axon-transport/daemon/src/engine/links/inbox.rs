//! Discovery datagrams on their way to the control plane.
//!
//! Any host can send them. The first ones are passed on at once. Those of a flood are held for some milliseconds and
//! passed on together, so that they cost the control plane one turn, not one each.

use std::{net::SocketAddr, time::Duration};

use crate::discovery::Datagrams;

/// Number of datagrams that are passed on at once; `A_SECOND` more may be in each second.
const DATAGRAM_BURST: f64 = 32.0;
const A_SECOND: f64 = 16.0;
/// Maximum time that other datagrams are held.
const MAX_DATAGRAM_HOLD: Duration = Duration::from_millis(40);
/// Maximum number of held datagrams. The last quarter is for the addresses of listed peers and of links.
const MAX_HELD_DATAGRAMS: usize = 512;

/// The held datagrams.
#[derive(Debug)]
pub(super) struct DiscoveryInbox {
    held: Datagrams,
    due: Option<Duration>,
    /// Number of datagrams that may be passed on at once; `filled` is the time at which it was computed.
    tokens: f64,
    filled: Duration,
}

impl DiscoveryInbox {
    /// Creates an empty inbox.
    pub(super) fn new() -> Self {
        Self {
            held: Datagrams::default(),
            due: None,
            tokens: DATAGRAM_BURST,
            filled: Duration::ZERO,
        }
    }

    /// Adds a datagram. `known` returns whether it came from the address of a listed peer or of a link.
    pub(super) fn add(
        &mut self,
        from: SocketAddr,
        bytes: &[u8],
        known: impl FnOnce() -> bool,
        now: Duration,
    ) {
        let held = self.held.len();
        if held >= MAX_HELD_DATAGRAMS || (held >= MAX_HELD_DATAGRAMS / 4 * 3 && !known()) {
            return;
        }
        self.held.push(from, bytes);
        let passed = now.saturating_sub(self.filled).as_secs_f64();
        (self.tokens, self.filled) = ((self.tokens + passed * A_SECOND).min(DATAGRAM_BURST), now);
        let due = if self.tokens >= 1.0 {
            self.tokens -= 1.0;
            now
        } else {
            now + MAX_DATAGRAM_HOLD
        };
        self.due = Some(self.due.map_or(due, |other| other.min(due)));
    }

    /// Returns whether datagrams are held.
    pub(super) fn is_holding(&self) -> bool {
        !self.held.is_empty()
    }

    /// Returns when [`take`](Self::take) returns datagrams.
    pub(super) fn poll_timeout(&self) -> Option<Duration> {
        self.due
    }

    /// Takes the datagrams, once they are due.
    pub(super) fn take(&mut self, now: Duration) -> Option<Datagrams> {
        self.due.take_if(|due| *due <= now)?;
        Some(std::mem::take(&mut self.held))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn from(last: u8) -> SocketAddr {
        ([10, 0, 0, last], 61_300).into()
    }

    fn at(millis: u64) -> Duration {
        Duration::from_millis(millis)
    }

    #[test]
    fn first_datagrams_go_on_at_once_and_a_flood_goes_on_together() {
        let mut inbox = DiscoveryInbox::new();
        for _ in 0..32 {
            inbox.add(from(1), &[7], || false, at(0));
            assert_eq!(inbox.take(at(0)).map(|taken| taken.len()), Some(1));
        }
        for millis in 0..40 {
            inbox.add(from(2), &[8, 9], || false, at(millis));
            assert!(inbox.take(at(millis)).is_none() && inbox.is_holding(), "{millis}");
        }
        assert_eq!(inbox.poll_timeout(), Some(at(40)));
        let taken = inbox.take(at(40)).unwrap();
        assert!(taken.iter().eq(std::iter::repeat_n((from(2), &[8, 9][..]), 40)));
        assert!(!inbox.is_holding() && inbox.poll_timeout().is_none());
    }

    #[test]
    fn a_datagram_after_a_pause_goes_on_at_once_with_those_that_are_held() {
        let mut inbox = DiscoveryInbox::new();
        (0..33).for_each(|_| inbox.add(from(1), &[7], || false, at(0)));
        inbox.take(at(0));
        inbox.add(from(1), &[7], || false, at(1));
        inbox.add(from(1), &[8], || false, at(200));
        assert_eq!(inbox.take(at(200)).map(|taken| taken.len()), Some(2));
    }

    #[test]
    fn the_inbox_is_bounded_and_keeps_room_for_known_addresses() {
        let mut inbox = DiscoveryInbox::new();
        (0..10_000).for_each(|_| inbox.add(from(1), &[7; 512], || false, at(0)));
        inbox.add(from(2), &[8], || true, at(0));
        (0..10_000).for_each(|_| inbox.add(from(3), &[9; 512], || true, at(0)));
        let taken = inbox.take(at(0)).unwrap();
        assert_eq!(taken.len(), MAX_HELD_DATAGRAMS);
        assert_eq!(taken.iter().nth(MAX_HELD_DATAGRAMS / 4 * 3), Some((from(2), &[8][..])));
    }
}
