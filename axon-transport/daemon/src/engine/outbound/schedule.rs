//! Decides which flow sends next. Plain data: it knows flows by number, and no QUIC types.
//!
//! A higher rank goes first: the priority of the topic, and within a priority the class. Within a rank flows take
//! turns. [`starvation`](super::flow_scheduler) keeps a rank from starving.

use std::collections::VecDeque;

use crate::engine::rank::{FlowId, RANKS, Rank};

/// The flows that have samples to send. Each is in the queue of the rank under which it was added.
#[derive(Debug, Default)]
pub(super) struct Schedule {
    ranks: [VecDeque<FlowId>; RANKS],
    /// The rank of each flow, by its number.
    rank_of: Vec<Option<Rank>>,
}

impl Schedule {
    /// Returns whether it contains a flow.
    pub(super) fn contains(&self, flow: FlowId) -> bool {
        self.rank_of.get(flow).is_some_and(Option::is_some)
    }

    /// Adds a flow behind the others of its rank. A flow that is in a queue keeps its place.
    pub(super) fn push(&mut self, flow: FlowId, rank: Rank) {
        if self.note(flow, rank) {
            self.ranks[rank.place()].push_back(flow);
        }
    }

    /// Adds a flow before the others of its rank. A flow that is in a queue keeps its place.
    pub(super) fn push_first(&mut self, flow: FlowId, rank: Rank) {
        if self.note(flow, rank) {
            self.ranks[rank.place()].push_front(flow);
        }
    }

    fn note(&mut self, flow: FlowId, rank: Rank) -> bool {
        if flow >= self.rank_of.len() {
            self.rank_of.resize(flow + 1, None);
        }
        let is_new = self.rank_of[flow].is_none();
        if is_new {
            self.rank_of[flow] = Some(rank);
        }
        is_new
    }

    /// Takes the next flow, with the rank under which it was added. Ranks for whose place `borrows` returns true go
    /// before all others.
    pub(super) fn pop(&mut self, borrows: impl Fn(usize) -> bool) -> Option<(FlowId, Rank)> {
        let borrowers = self.ranks.iter_mut().enumerate().filter(|(at, _)| borrows(*at));
        let borrower = borrowers.map(|(_, rank)| rank).find_map(VecDeque::pop_front);
        let flow = borrower.or_else(|| self.ranks.iter_mut().find_map(VecDeque::pop_front))?;
        Some((flow, self.rank_of[flow].take()?))
    }

    /// Removes a flow that is gone.
    pub(super) fn remove(&mut self, flow: FlowId) {
        if let Some(rank) = self.rank_of.get_mut(flow).and_then(Option::take) {
            self.ranks[rank.place()].retain(|other| *other != flow);
        }
    }

    /// Returns whether no flow has samples to send.
    pub(super) fn is_empty(&self) -> bool {
        self.ranks.iter().all(VecDeque::is_empty)
    }
}

#[cfg(test)]
mod tests {
    use axon_transport::config::TopicPriority;

    use super::*;
    use crate::engine::rank::Class;

    fn normal(class: Class) -> Rank {
        Rank { priority: TopicPriority::Normal, class }
    }

    fn next(schedule: &mut Schedule) -> Option<FlowId> {
        schedule.pop(|_| false).map(|(flow, _)| flow)
    }

    #[test]
    fn a_higher_rank_goes_first_and_flows_of_a_rank_take_turns() {
        let mut schedule = Schedule::default();
        let of = |priority, class| Rank { priority, class };
        schedule.push(1, normal(Class::Bulk));
        schedule.push(2, normal(Class::SmallBestEffort));
        schedule.push(3, normal(Class::SmallReliable));
        schedule.push(4, normal(Class::SmallReliable));
        schedule.push(5, normal(Class::Service));
        schedule.push(6, of(TopicPriority::Low, Class::Service));
        schedule.push(7, of(TopicPriority::High, Class::Bulk));
        let order: Vec<_> = std::iter::from_fn(|| next(&mut schedule)).collect();
        assert_eq!(order, [7, 5, 3, 4, 2, 1, 6]);
        assert!(schedule.is_empty());
    }

    #[test]
    fn a_rank_that_borrows_goes_first() {
        let mut schedule = Schedule::default();
        schedule.push(1, normal(Class::SmallReliable));
        schedule.push(2, normal(Class::Bulk));
        let bulk = normal(Class::Bulk).place();
        assert_eq!(schedule.pop(|at| at == bulk), Some((2, normal(Class::Bulk))));
        assert_eq!(schedule.pop(|at| at == bulk), Some((1, normal(Class::SmallReliable))));
    }

    #[test]
    fn a_flow_that_was_removed_has_no_turn() {
        let mut schedule = Schedule::default();
        schedule.push(1, normal(Class::Bulk));
        schedule.push(2, normal(Class::Bulk));
        schedule.remove(1);
        schedule.remove(3);
        assert_eq!((next(&mut schedule), next(&mut schedule)), (Some(2), None));
    }

    #[test]
    fn a_flow_has_one_place_until_its_turn() {
        let mut schedule = Schedule::default();
        schedule.push(1, normal(Class::Bulk));
        schedule.push(2, normal(Class::Bulk));
        schedule.push(2, normal(Class::Service));
        schedule.push_first(2, normal(Class::Service));
        assert!(schedule.contains(2) && !schedule.contains(3));
        assert_eq!((next(&mut schedule), next(&mut schedule)), (Some(1), Some(2)));
        assert!(!schedule.contains(2) && schedule.is_empty());
        schedule.push(1, normal(Class::Bulk));
        schedule.push_first(2, normal(Class::Bulk));
        assert_eq!(next(&mut schedule), Some(2), "its turn is over");
    }

    #[test]
    fn service_messages_have_their_own_class_at_any_length() {
        assert_eq!(Class::of(true, true, 1 << 20), Class::Service);
        assert_eq!(Class::of(false, true, 4096), Class::SmallReliable);
        assert_eq!(Class::of(false, false, 4097), Class::Bulk);
    }

    #[test]
    fn streams_have_the_order_of_the_ranks() {
        let classes = [Class::Service, Class::SmallReliable, Class::SmallBestEffort, Class::Bulk];
        let priorities = [TopicPriority::High, TopicPriority::Normal, TopicPriority::Low];
        let ranks = priorities.iter().flat_map(|priority| classes.map(|class| (*priority, class)));
        let ranks: Vec<_> = ranks.map(|(priority, class)| Rank { priority, class }).collect();
        assert!(ranks.is_sorted_by(|one, next| one.place() + 1 == next.place()));
        // A second BEST_EFFORT sample in flight is one below its class.
        assert!(ranks.is_sorted_by(|one, next| one.of_stream() > next.of_stream()));
        assert!(ranks[3].of_stream() - 1 > ranks[4].of_stream());
    }
}
