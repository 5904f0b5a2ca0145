//! The protocol between a thread that is about to sleep and the processes that may have to wake it.
//!
//! The sleeper stores its ticket, fences, and checks once more for news. The waker makes its news visible, fences,
//! and checks for a ticket. At least one of the two sees the other's store. Neither fence can be weaker, because
//! each side stores one word and loads another.

use crate::sync::{Ordering, Site, Word, fence_at};

/// Sleeper: arms `word` with `ticket`, which is larger than any before. The sleeper checks for news after this.
pub(crate) fn arm<W: Word>(word: &W, ticket: u64) {
    word.store(ticket, Ordering::Relaxed);
    // Pairs with the fence of `settle`.
    fence_at::<W>(Site::ArmFence);
}

/// Sleeper: disarms the word, because no thread sleeps any more.
pub(crate) fn disarm<W: Word>(word: &W) {
    word.store(0, Ordering::Relaxed);
}

/// Waker: orders all earlier stores before the following loads of tickets.
#[inline]
pub(crate) fn settle<W: Word>() {
    // Pairs with the fence of `arm`.
    fence_at::<W>(Site::SettleFence);
}

/// Waker, after [`settle`]: returns whether a sleeper has to be woken for the news. `rung` is the last ticket that this
/// process rang for; other processes do not use it.
#[inline]
pub(crate) fn waits<W: Word>(word: &W, rung: &W) -> bool {
    unrung(word, rung).is_some()
}

/// Waker, after [`settle`]: returns whether the caller has to ring the doorbell. Only one thread gets true for a
/// ticket.
#[inline]
pub(crate) fn due<W: Word>(word: &W, rung: &W) -> bool {
    unrung(word, rung).is_some_and(|ticket| rung.fetch_max(ticket, Ordering::Relaxed) < ticket)
}

#[inline]
fn unrung<W: Word>(word: &W, rung: &W) -> Option<u64> {
    let ticket = word.load(Ordering::Relaxed);
    (ticket != 0 && rung.load(Ordering::Relaxed) < ticket).then_some(ticket)
}
