//! Which flow sends next. Plain data: it knows flows by number, and no QUIC types.
//!
//! A higher class goes first. Within a class flows take turns. Bulk is not starved: it has every eighth turn while it
//! waits.

use std::collections::VecDeque;

/// The number of a flow towards one peer.
pub(crate) type FlowId = usize;

/// A sample of at most so many bytes is small.
const SMALL: usize = 4096;
/// Turns of higher classes after which bulk has one.
const TURNS: u32 = 7;

/// What a flow sends next. Control messages go before all classes: QUIC itself sends their stream first.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Class {
    /// Requests and responses of services and actions.
    Service,
    /// A RELIABLE sample of at most 4 KiB.
    SmallReliable,
    /// A BEST_EFFORT sample of at most 4 KiB.
    SmallBestEffort,
    /// All longer samples.
    Bulk,
}

impl Class {
    /// The class of a flow that sends a sample of this length.
    pub(super) fn of(service: bool, reliable: bool, length: usize) -> Self {
        match (service, reliable) {
            (true, _) => Self::Service,
            _ if length > SMALL => Self::Bulk,
            (_, true) => Self::SmallReliable,
            (_, false) => Self::SmallBestEffort,
        }
    }

    /// The priority of its QUIC streams. QUIC shares the link evenly among streams of the same priority.
    pub(super) fn priority(self) -> i32 {
        match self {
            Self::Service => 3,
            Self::SmallReliable => 2,
            Self::SmallBestEffort => 1,
            Self::Bulk => 0,
        }
    }
}

/// The flows that have something to send.
#[derive(Debug, Default)]
pub(super) struct Schedule {
    classes: [VecDeque<FlowId>; 4],
    turns: u32,
}

impl Schedule {
    /// Adds a flow behind the others of its class. The caller adds no flow twice.
    pub(super) fn push(&mut self, flow: FlowId, class: Class) {
        self.classes[class as usize].push_back(flow);
    }

    /// The next flow, and its class when it was added.
    pub(super) fn pop(&mut self) -> Option<(FlowId, Class)> {
        const ORDER: [Class; 4] =
            [Class::Service, Class::SmallReliable, Class::SmallBestEffort, Class::Bulk];
        if self.turns >= TURNS {
            self.turns = 0;
            if let Some(flow) = self.classes[Class::Bulk as usize].pop_front() {
                return Some((flow, Class::Bulk));
            }
        }
        for class in ORDER {
            if let Some(flow) = self.classes[class as usize].pop_front() {
                let bulk_waits = !self.classes[Class::Bulk as usize].is_empty();
                self.turns = if class != Class::Bulk && bulk_waits { self.turns + 1 } else { 0 };
                return Some((flow, class));
            }
        }
        None
    }

    /// Removes a flow that is gone.
    pub(super) fn remove(&mut self, flow: FlowId) {
        self.classes.iter_mut().for_each(|class| class.retain(|other| *other != flow));
    }

    /// Whether no flow has anything to send.
    pub(super) fn is_empty(&self) -> bool {
        self.classes.iter().all(VecDeque::is_empty)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_higher_class_goes_first_and_flows_of_a_class_take_turns() {
        let mut schedule = Schedule::default();
        schedule.push(1, Class::Bulk);
        schedule.push(2, Class::SmallBestEffort);
        schedule.push(3, Class::SmallReliable);
        schedule.push(4, Class::SmallReliable);
        schedule.push(5, Class::Service);
        let order: Vec<_> = std::iter::from_fn(|| schedule.pop()).map(|(flow, _)| flow).collect();
        assert_eq!(order, [5, 3, 4, 2, 1]);
        assert!(schedule.is_empty());
    }

    #[test]
    fn bulk_has_every_eighth_turn_of_a_link_that_small_samples_fill() {
        let mut schedule = Schedule::default();
        schedule.push(1, Class::Bulk);
        schedule.push(2, Class::SmallReliable);
        let mut bulk = 0;
        for _ in 0..80 {
            let (flow, class) = schedule.pop().unwrap();
            bulk += u32::from(class == Class::Bulk);
            schedule.push(flow, class);
        }
        assert_eq!(bulk, 10);
    }

    #[test]
    fn a_flow_that_was_removed_has_no_turn() {
        let mut schedule = Schedule::default();
        schedule.push(1, Class::Bulk);
        schedule.push(2, Class::Bulk);
        schedule.remove(1);
        assert_eq!(schedule.pop(), Some((2, Class::Bulk)));
        assert_eq!(schedule.pop(), None);
    }

    #[test]
    fn services_are_a_class_of_their_own_whatever_their_length() {
        assert_eq!(Class::of(true, true, 1 << 20), Class::Service);
        assert_eq!(Class::of(false, true, 4096), Class::SmallReliable);
        assert_eq!(Class::of(false, false, 4097), Class::Bulk);
        assert!(Class::Service.priority() > Class::Bulk.priority());
    }
}
