//! Keeps ranks from starving. QUIC sends the streams of a higher priority first, so a topic that fills the link by
//! itself would starve all ranks below it. For each eight bytes that a rank sends, each rank that waits below it may
//! send one as if it had the same rank.

use crate::engine::rank::{RANKS, Rank};

/// Number of bytes of a higher rank for which a waiting rank is lent one byte.
const SHARE: i64 = 8;
/// Minimum number of bytes that are lent; `MOST` is the maximum that a rank saves.
const QUANTUM: i64 = 64 << 10;
const MAX_CREDIT: i64 = 4 * QUANTUM;

/// The bytes that are lent to ranks.
#[derive(Debug, Default)]
pub(super) struct StarvationCredit {
    /// The bytes that are lent to each rank; `None` if the rank does not wait.
    saved: [Option<i64>; RANKS],
    /// The rank that sent last in its own right.
    lender: Option<Rank>,
}

impl StarvationCredit {
    /// Records that a flow of this rank waits for QUIC.
    pub(super) fn handle_blocked(&mut self, rank: Rank) {
        self.saved[rank.place()].get_or_insert(0);
    }

    /// Records that a flow of this rank sent `bytes` bytes in its own right.
    pub(super) fn handle_sent(&mut self, rank: Rank, bytes: u64) {
        let at = rank.place();
        self.saved[at] = None;
        self.lender = Some(rank);
        let share = i64::try_from(bytes).unwrap_or(i64::MAX) / SHARE;
        for saved in self.saved[at + 1..].iter_mut().flatten() {
            *saved = (*saved + share).min(MAX_CREDIT);
        }
    }

    /// Returns whether the rank at this place may send as another one now.
    pub(super) fn borrows(&self, at: usize) -> bool {
        self.lender.is_some_and(|lender| lender.place() < at)
            && self.saved[at].is_some_and(|saved| saved >= QUANTUM)
    }

    /// Returns the rank as which a flow of this rank may send now.
    pub(super) fn borrow(&self, rank: Rank) -> Option<Rank> {
        self.lender.filter(|_| self.borrows(rank.place()))
    }

    /// Records that a flow of this rank sent `bytes` bytes as another rank.
    pub(super) fn handle_borrowed(&mut self, rank: Rank, bytes: u64) {
        if let Some(saved) = &mut self.saved[rank.place()] {
            *saved -= i64::try_from(bytes).unwrap_or(i64::MAX);
        }
    }
}

#[cfg(test)]
mod tests {
    use axon_transport::config::TopicPriority;

    use super::*;
    use crate::engine::rank::Class;

    const HIGH: Rank = Rank { priority: TopicPriority::High, class: Class::Bulk };
    const SMALL: Rank = Rank { priority: TopicPriority::Normal, class: Class::SmallReliable };
    const BULK: Rank = Rank { priority: TopicPriority::Normal, class: Class::Bulk };

    #[test]
    fn a_starved_rank_gets_an_eighth_of_the_higher_ranks_output() {
        let mut lending = StarvationCredit::default();
        [SMALL, BULK].iter().for_each(|rank| lending.handle_blocked(*rank));
        let mut sent = [0; 2];
        for _ in 0..1000 {
            lending.handle_sent(HIGH, 16 << 10);
            for (rank, sent) in [SMALL, BULK].iter().zip(&mut sent) {
                if lending.borrow(*rank) == Some(HIGH) {
                    lending.handle_borrowed(*rank, 64 << 10);
                    *sent += 64 << 10;
                }
            }
        }
        let share = 1000 * (16 << 10) / 8;
        assert!(sent.iter().all(|sent| (share - QUANTUM..=share).contains(sent)), "{sent:?}");
    }

    #[test]
    fn a_rank_that_sends_in_its_own_right_is_lent_nothing() {
        let mut lending = StarvationCredit::default();
        lending.handle_blocked(BULK);
        for _ in 0..1000 {
            lending.handle_sent(SMALL, 100);
            lending.handle_sent(BULK, 64 << 10);
            lending.handle_blocked(BULK);
            assert_eq!(lending.borrow(BULK), None);
        }
    }

    #[test]
    fn a_higher_rank_borrows_nothing_of_a_lower_one() {
        let mut lending = StarvationCredit::default();
        lending.handle_blocked(HIGH);
        (0..100).for_each(|_| lending.handle_sent(BULK, 1 << 20));
        assert_eq!(lending.borrow(HIGH), None);
    }

    #[test]
    fn the_starvation_credit_is_bounded() {
        let mut lending = StarvationCredit::default();
        lending.handle_blocked(BULK);
        lending.handle_sent(SMALL, 1 << 30);
        lending.handle_borrowed(BULK, MAX_CREDIT as u64 - 1);
        assert_eq!(lending.borrow(BULK), None);
    }
}
