//! The order in which samples are sent: first by the priority of the topic, then by class.

use axon_transport::config::TopicPriority;

/// The number of a flow towards one peer.
pub(crate) type FlowId = usize;

/// Maximum length of a small sample in bytes.
pub(in crate::engine) const SMALL: usize = 4096;
/// Number of classes; `RANKS` is the number of ranks.
const CLASSES: usize = 4;
pub(in crate::engine) const RANKS: usize = 3 * CLASSES;
/// Distance of two topic priorities in the priorities of QUIC's streams. It leaves space below each class.
const PRIORITY: i32 = 8;

/// The class of a flow's next sample. Control messages go before all classes: QUIC sends their stream first.
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
    /// Returns the class of a flow that sends a sample of this length.
    pub(in crate::engine) fn of(service: bool, reliable: bool, length: usize) -> Self {
        match (service, reliable) {
            (true, _) => Self::Service,
            _ if length > SMALL => Self::Bulk,
            (_, true) => Self::SmallReliable,
            (_, false) => Self::SmallBestEffort,
        }
    }
}

/// The rank of a sample, which decides the order of sending.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Rank {
    /// The priority of the topic.
    pub(crate) priority: TopicPriority,
    /// The class of the sample.
    pub(crate) class: Class,
}

impl Rank {
    /// Returns the priority of its QUIC streams. QUIC shares the link evenly among streams of the same priority.
    pub(in crate::engine) fn of_stream(self) -> i32 {
        let class = match self.class {
            Class::Service => 3,
            Class::SmallReliable => 2,
            Class::SmallBestEffort => 1,
            Class::Bulk => 0,
        };
        self.priority as i32 * PRIORITY + class
    }

    /// Returns its place among all ranks; the first to send is at 0.
    pub(in crate::engine) fn place(self) -> usize {
        (TopicPriority::High as usize - self.priority as usize) * CLASSES + self.class as usize
    }
}

/// The priorities of the routes of a link.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Priorities([usize; 3]);

impl Priorities {
    /// Counts a route of this priority.
    pub(in crate::engine) fn add(&mut self, priority: TopicPriority) {
        self.0[priority as usize] += 1;
    }

    /// Removes a route of this priority from the count.
    pub(in crate::engine) fn remove(&mut self, priority: TopicPriority) {
        self.0[priority as usize] -= 1;
    }

    /// Returns the number of priorities below this one that have routes.
    pub(crate) fn below(&self, priority: TopicPriority) -> u64 {
        self.0[..priority as usize].iter().filter(|routes| **routes > 0).count() as u64
    }
}
