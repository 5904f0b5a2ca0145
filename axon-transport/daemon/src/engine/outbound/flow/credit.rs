//! The credit for long samples towards one peer: the amount that may be in flight at a time.
//!
//! A receiver stops reading a long message while it has no memory for it. The bytes that wait there use up QUIC's
//! connection window. If they use up all of it, the rest of messages that do have memory cannot arrive, and the link
//! makes no progress. So the samples in flight never use up the window, even if the receiver reads none of them, and
//! the receiver has memory for all of them.

use std::{
    cell::Cell,
    collections::{HashMap, VecDeque},
    rc::Rc,
};

use crate::{
    engine::{
        quic::transport::{LINK_WINDOW, STREAM_WINDOW, window_credit},
        rank::{FlowId, RANKS},
    },
    link::ReceiveLimits,
};

/// What a peer has that does not say it: as much as the second link of an identity has, and all memory for messages.
const UNSAID: ReceiveLimits =
    ReceiveLimits { unread: (LINK_WINDOW as u64) + (16 << 20), messages: 64 << 20 };
/// The part of the credit that counts as little: a quarter.
const LITTLE: u64 = 4;
/// No peer has less: with nothing, a sample of one publisher would keep out those of all others.
const MIN_CREDIT: u64 = 1 << 20;
/// A sample longer than this needs memory for messages. The receiver counts from 32 KiB on, header and seal included.
const LONG_SAMPLE_BYTES: usize = 31 << 10;
/// Memory that the receiver counts for header and seal.
const OVERHEAD: u64 = 1 << 10;
/// Bytes of small samples of one flow that may be in flight, whatever the credit.
pub(in crate::engine::outbound) const ALWAYS: u64 = 256 << 10;

/// The part of the credit that samples in flight use.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(in crate::engine::outbound) struct UsedCredit {
    /// Bytes of the connection window.
    pub(in crate::engine::outbound) window: u64,
    /// Bytes of memory for messages.
    memory: u64,
}

impl UsedCredit {
    /// Returns the credit that the samples of one stream use: `bytes` in all, the longest of `longest` bytes.
    pub(in crate::engine::outbound) fn of(bytes: usize, longest: usize) -> Self {
        let memory = if longest > LONG_SAMPLE_BYTES { longest as u64 + OVERHEAD } else { 0 };
        Self { window: (bytes as u64).min(STREAM_WINDOW.1), memory }
    }
}

/// The credit of one peer.
#[derive(Debug)]
pub(in crate::engine::outbound) struct PeerCredit {
    most: Cell<UsedCredit>,
    used: Cell<UsedCredit>,
    /// Counts the changes after which a flow that had too little may have enough.
    grown: Cell<u64>,
    /// Counts how often credit came back.
    returned: Cell<u64>,
}

/// The credit that one flow, or one best-effort sample, uses. Dropping it gives the credit back.
#[derive(Debug)]
pub(in crate::engine::outbound) struct CreditShare {
    of: Rc<PeerCredit>,
    used: UsedCredit,
}

impl PeerCredit {
    /// Creates the credit at a peer that has not reported its memory.
    pub(in crate::engine::outbound) fn new() -> Rc<Self> {
        Rc::new(Self {
            most: Cell::new(limit(&UNSAID)),
            used: Cell::default(),
            grown: Cell::new(0),
            returned: Cell::new(0),
        })
    }

    /// Sets the memory that the peer reported; `None` if it has not reported it over this link.
    pub(in crate::engine::outbound) fn set(&self, intake: Option<&ReceiveLimits>) {
        let most = limit(intake.unwrap_or(&UNSAID));
        let before = self.most.replace(most);
        if most.window > before.window || most.memory > before.memory {
            self.grown.set(self.grown.get() + 1);
        }
    }

    /// Returns how often credit came back. While it does not change, the peer takes nothing in.
    pub(in crate::engine::outbound) fn returned(&self) -> u64 {
        self.returned.get()
    }

    /// Creates an unused share.
    pub(in crate::engine::outbound) fn share(self: &Rc<Self>) -> CreditShare {
        CreditShare { of: Rc::clone(self), used: UsedCredit::default() }
    }

    fn change(&self, before: UsedCredit, after: UsedCredit) {
        let used = self.used.get();
        self.used.set(UsedCredit {
            window: used.window - before.window + after.window,
            memory: used.memory - before.memory + after.memory,
        });
        if after.window < before.window || after.memory < before.memory {
            self.grown.set(self.grown.get() + 1);
            self.returned.set(self.returned.get() + 1);
        }
    }
}

impl CreditShare {
    /// Returns whether it uses any credit.
    pub(in crate::engine::outbound) fn is_used(&self) -> bool {
        self.used != UsedCredit::default()
    }

    /// Creates another unused share of the same peer.
    pub(in crate::engine::outbound) fn sibling(&self) -> Self {
        self.of.share()
    }

    /// Returns whether it may use this much. It may use any amount while the other shares use little: one sample may
    /// always be in flight, however long it is.
    pub(in crate::engine::outbound) fn may_use(&self, after: UsedCredit) -> bool {
        let (most, all) = (self.of.most.get(), self.of.used.get());
        let others = UsedCredit {
            window: all.window - self.used.window,
            memory: all.memory - self.used.memory,
        };
        let fits = |others: u64, after: u64, most: u64| {
            others <= most / LITTLE || others.saturating_add(after) <= most
        };
        fits(others.window, after.window, most.window)
            && (after.memory == 0 || fits(others.memory, after.memory, most.memory))
    }

    /// Sets the credit that it uses from now on.
    pub(in crate::engine::outbound) fn set(&mut self, used: UsedCredit) {
        self.of.change(self.used, used);
        self.used = used;
    }
}

impl Drop for CreditShare {
    fn drop(&mut self) {
        self.set(UsedCredit::default());
    }
}

/// Returns the credit that samples in flight may use at a peer with this memory. A peer that reports nearly nothing
/// counts as having [`LEAST`].
fn limit(intake: &ReceiveLimits) -> UsedCredit {
    let (unread, memory) = (intake.unread.max(MIN_CREDIT), intake.messages.max(MIN_CREDIT));
    UsedCredit { window: window_credit(unread), memory }
}

/// Flows that wait for credit, in order. A later flow does not overtake a flow of its own or a higher rank, so shorter
/// samples do not keep out a long one.
#[derive(Debug, Default)]
pub(in crate::engine::outbound) struct CreditQueue {
    order: VecDeque<FlowId>,
    /// The place of each flow's rank.
    places: HashMap<FlowId, usize>,
    /// Number of flows that wait at each place.
    at_place: [usize; RANKS],
    /// The value of `grown` when the flows were last taken out.
    seen: u64,
    /// True if a flow left the queue: the flows behind it may have enough.
    left: bool,
}

impl CreditQueue {
    /// Adds a flow that waits, of the rank at this place.
    pub(in crate::engine::outbound) fn add(&mut self, flow: FlowId, place: usize) {
        if self.places.insert(flow, place).map(|before| self.at_place[before] -= 1).is_none() {
            self.order.push_back(flow);
        }
        self.at_place[place] += 1;
    }

    /// Forgets a flow that is gone.
    pub(in crate::engine::outbound) fn forget(&mut self, flow: FlowId) {
        if let Some(place) = self.places.remove(&flow) {
            self.at_place[place] -= 1;
            self.order.retain(|other| *other != flow);
            self.left = true;
        }
    }

    /// Returns whether flows that wait may have enough now.
    pub(in crate::engine::outbound) fn is_due(&self, credit: &PeerCredit) -> bool {
        !self.order.is_empty() && (self.left || self.seen != credit.grown.get())
    }

    /// Takes out all flows, in order.
    pub(in crate::engine::outbound) fn take(&mut self, credit: &PeerCredit) -> VecDeque<FlowId> {
        (self.seen, self.left) = (credit.grown.get(), false);
        self.places.clear();
        self.at_place = [0; RANKS];
        std::mem::take(&mut self.order)
    }

    /// Returns the place of the highest rank that waits. Flows of this rank and of lower ones wait, too.
    pub(in crate::engine::outbound) fn closed_from(&self) -> Option<usize> {
        self.at_place.iter().position(|flows| *flows > 0)
    }

    /// Returns whether no flow waits.
    pub(in crate::engine::outbound) fn is_empty(&self) -> bool {
        self.order.is_empty()
    }

    /// Returns the number of waiting flows.
    #[cfg(test)]
    pub(in crate::engine::outbound) fn len(&self) -> usize {
        self.order.len()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn credit(unread: u64, messages: u64) -> Rc<PeerCredit> {
        let credit = PeerCredit::new();
        credit.set(Some(&ReceiveLimits { unread, messages }));
        credit
    }

    #[test]
    fn samples_in_flight_use_at_most_three_quarters_of_the_window() {
        let credit = credit(32 << 20, u64::MAX);
        let mut shares: Vec<_> = (0..7).map(|_| credit.share()).collect();
        let sample = UsedCredit::of(16 << 20, 16 << 20);
        assert_eq!(sample.window, 4 << 20, "as much as the window of a stream");
        for share in &mut shares[..6] {
            assert!(share.may_use(sample));
            share.set(sample);
        }
        assert!(!shares[6].may_use(sample));
        assert!(shares[6].may_use(UsedCredit::default()));
        assert!(shares[5].may_use(UsedCredit::of(20 << 20, 16 << 20)), "its stream has no more");
        shares.remove(0);
        assert!(shares[5].may_use(sample));
    }

    #[test]
    fn samples_in_flight_use_no_more_memory_than_there_is() {
        let credit = credit(u64::from(u32::MAX), 64 << 20);
        let [mut one, mut two] = [credit.share(), credit.share()];
        one.set(UsedCredit::of(60 << 20, 60 << 20));
        assert!(!two.may_use(UsedCredit::of(8 << 20, 8 << 20)));
        assert!(two.may_use(UsedCredit::of(8 << 20, 16 << 10)), "short ones need none");
        drop(one);
        let longest = UsedCredit::of(256 << 20, 256 << 20);
        assert!(two.may_use(longest), "one is always in flight");
        two.set(longest);
        assert!(two.may_use(longest));
        assert!(!credit.share().may_use(UsedCredit::of(40 << 10, 40 << 10)));
    }

    #[test]
    fn a_peer_that_says_little_is_sent_one_sample_at_a_time() {
        for intake in [
            ReceiveLimits { unread: 0, messages: 0 },
            ReceiveLimits { unread: 1, messages: u64::MAX },
        ] {
            let credit = PeerCredit::new();
            credit.set(Some(&intake));
            let (mut one, two) = (credit.share(), credit.share());
            let sample = UsedCredit::of(1 << 21, 1 << 21);
            assert!(one.may_use(sample));
            one.set(sample);
            assert!(!two.may_use(sample));
        }
    }

    #[test]
    fn flows_that_wait_keep_their_order_and_are_due_when_credit_comes_back() {
        let credit = credit(32 << 20, 64 << 20);
        let mut queue = CreditQueue::default();
        let mut share = credit.share();
        share.set(UsedCredit::of(1 << 20, 1 << 20));
        queue.take(&credit);
        [(3, 7), (1, 5), (2, 7), (3, 7)].iter().for_each(|(flow, place)| queue.add(*flow, *place));
        assert_eq!((queue.len(), queue.closed_from()), (3, Some(5)));
        assert!(!queue.is_due(&credit));
        share.set(UsedCredit::default());
        assert!(queue.is_due(&credit));
        assert_eq!(queue.take(&credit), [3, 1, 2]);
        assert!(!queue.is_due(&credit) && queue.closed_from().is_none());
        queue.add(1, 5);
        queue.add(2, 7);
        assert!(!queue.is_due(&credit));
        queue.forget(1);
        assert!(queue.is_due(&credit), "the next one is first now");
    }
}
