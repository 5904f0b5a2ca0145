//! Scripts of timed faults.
//!
//! A script is generated from a seed ([`Script::generate`]), or parsed from the text that it prints as, so
//! that a failing one can be kept as a test. [`Script::shrink`] reduces it first.
//!
//! A fault carries its own duration. So each one can be deleted without a change to the meaning of another:
//! no partition stays because its end was deleted. [`Script::steps`] lists beginnings and ends in order.

mod generate;
mod shrink;
mod text;

#[cfg(test)]
mod tests;

use std::time::Duration;

pub(crate) use generate::{Recipe, Weights};
pub(crate) use shrink::Shrunk;

/// Faults for a number of hosts, and the seed of the run.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Script {
    /// Seed of everything else in the run: network, hosts, workload.
    pub(crate) seed: u64,
    /// Hosts have the indexes below it.
    pub(crate) hosts: usize,
    pub(crate) faults: Vec<Fault>,
}

/// One fault of a host or of the network, or one act of an application.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Fault {
    pub(crate) at: Duration,
    /// Time from beginning to end; `None`: it has no end, or none is needed.
    pub(crate) lasts: Option<Duration>,
    pub(crate) kind: Kind,
}

/// The kind of a fault. The run ignores a fault that does not apply, for example a burst of samples without a
/// publisher.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Kind {
    /// No packet passes between the hosts and all others.
    Partition { hosts: Vec<usize> },
    /// No packet passes from `from` to `to`.
    Cut { from: usize, to: usize },
    /// The daemon ends: at once, or `orderly` as after SIGTERM. At the fault's end it starts again.
    Kill { host: usize, orderly: bool },
    /// The daemon gets no time (SIGSTOP).
    Pause { host: usize },
    /// The path between two hosts, in both directions, is another one.
    Path { from: usize, to: usize, change: PathChange },
    /// The NAT in front of the host forgets its mappings.
    Rebind { host: usize },
    /// An interface of the host gets another address.
    Move { host: usize, interface: usize },
    /// An interface of the host is down.
    InterfaceDown { host: usize, interface: usize },
    /// The host's KME fails.
    Kme { host: usize, failure: KmeFailure },
    /// A publisher exists.
    Publisher { host: usize, topic: usize, qos: Qos },
    /// A subscription exists.
    Subscription { host: usize, topic: usize, qos: Qos },
    /// The host's publishers of a topic publish `count` samples of `size` bytes, one each `every`.
    Publish { host: usize, topic: usize, count: u32, size: u32, every: Duration },
}

/// A path with impairments. Probabilities are in thousandths.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct PathChange {
    pub(crate) delay: Duration,
    pub(crate) jitter: Duration,
    pub(crate) loss: u16,
    pub(crate) duplicate: u16,
    pub(crate) reorder: u16,
    /// IP bytes per second.
    pub(crate) rate: Option<u64>,
}

/// The kind of a KME's failure.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum KmeFailure {
    /// Connections to it are refused.
    Unreachable,
    /// It answers nothing.
    Silent,
    /// It answers each request after a long time.
    Slow,
    /// It answers with an error status.
    Error,
    /// It has no keys left.
    Exhausted,
    /// It answers with a key of another peer.
    WrongKey,
}

/// QoS of a publisher or a subscription.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Qos {
    BestEffort,
    ReliableKeepLast,
    ReliableKeepAll,
    TransientLocal,
}

/// The beginning or the end of a fault.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Step {
    pub(crate) at: Duration,
    /// The fault's index in the script.
    pub(crate) fault: usize,
    pub(crate) edge: Edge,
}

/// See [`Step`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Edge {
    Begin,
    End,
}

impl Script {
    /// Returns all beginnings and ends by time. At one time, ends come before beginnings, and then the order is
    /// that of the script; a fault that lasts no time begins before it ends.
    pub(crate) fn steps(&self) -> Vec<Step> {
        let mut steps = Vec::new();
        for (fault, Fault { at, lasts, .. }) in self.faults.iter().enumerate() {
            steps.push((1, Step { at: *at, fault, edge: Edge::Begin }));
            if let Some(lasts) = lasts {
                let rank = if lasts.is_zero() { 2 } else { 0 };
                steps.push((rank, Step { at: at.saturating_add(*lasts), fault, edge: Edge::End }));
            }
        }
        steps.sort_by_key(|(rank, step)| (step.at, *rank, step.fault));
        steps.into_iter().map(|(_, step)| step).collect()
    }

    /// Returns when the last fault has ended or, if it has no end, begun.
    pub(crate) fn end(&self) -> Duration {
        let ends = self.faults.iter().map(|f| f.at.saturating_add(f.lasts.unwrap_or_default()));
        ends.max().unwrap_or_default()
    }
}

impl Kind {
    /// Returns each host that the fault names.
    fn hosts_mut(&mut self) -> Vec<&mut usize> {
        match self {
            Self::Partition { hosts } => hosts.iter_mut().collect(),
            Self::Cut { from, to } | Self::Path { from, to, .. } => vec![from, to],
            Self::Kill { host, .. }
            | Self::Pause { host }
            | Self::Rebind { host }
            | Self::Move { host, .. }
            | Self::InterfaceDown { host, .. }
            | Self::Kme { host, .. }
            | Self::Publisher { host, .. }
            | Self::Subscription { host, .. }
            | Self::Publish { host, .. } => vec![host],
        }
    }
}
