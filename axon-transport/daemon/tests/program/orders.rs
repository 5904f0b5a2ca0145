//! The orders of a program's test to its processes, and their answers: one line of JSON each.

use std::collections::{BTreeMap, BTreeSet};

use serde::{Deserialize, Serialize};

use super::rules::Profile;

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) enum Kind {
    Node,
    Publisher,
    Subscription,
    Server,
    Client,
}

/// All properties of a node or an endpoint that a graph contains.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Described {
    pub(super) kind: Kind,
    /// The topic or service; empty for a node.
    pub(super) topic: String,
    pub(super) type_name: String,
    pub(super) hash: Vec<u8>,
    pub(super) profile: Profile,
    pub(super) node: String,
    pub(super) namespace: String,
    pub(super) enclave: String,
}

/// An order to a process. Endpoints are identified by the numbers that the test assigns.
#[derive(Debug, Serialize, Deserialize)]
pub(super) enum Order {
    /// Creates an endpoint or node. Answer: [`String`], the GID. `by` is the number of the node
    /// that it belongs to.
    Create { id: u64, by: Option<u64>, what: Box<Described> },
    /// Publishes `count` samples with source times from `stamp` on, or as many as fit. Answer:
    /// [`Published`].
    Publish { id: u64, stamp: i64, count: u64, len: u64 },
    /// Takes all of `owed` samples that can be had. Answer: [`Taken`].
    Take { id: u64, owed: u64 },
    /// Waits for losses. Answer: [`Losses`].
    AwaitLoss { id: u64 },
    /// Sends a request. Answer: [`u64`], the request's number.
    Ask { id: u64, stamp: u64, len: u64 },
    /// Answers `count` requests, and checks that there are no more. Answer: the [`Call`]s.
    Answer { id: u64, count: u64 },
    /// Takes `count` responses, and checks that there are no more. Answer: the [`Call`]s.
    Hear { id: u64, count: u64 },
    /// Queries everything that a wait finds ready, at once, or, with `some`, once anything is.
    /// Answer: the numbers.
    Wait { some: bool },
    /// Drops an endpoint or node. Answer: `()`.
    End { id: u64 },
    /// Queries the state. Answer: [`State`].
    State,
}

/// The result of publishing.
#[derive(Debug, Serialize, Deserialize)]
pub(super) struct Published {
    /// The number of the first sample.
    pub(super) first: Option<u64>,
    pub(super) count: u64,
    /// True if a reader held the publisher back after `count` samples.
    pub(super) blocked: bool,
}

/// A sample, with the metadata that the taking process gets.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Sample {
    pub(super) publisher: String,
    pub(super) sequence: u64,
    pub(super) stamp: i64,
    pub(super) len: u64,
}

/// A count of losses: the total, and the change since the last query.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Losses {
    pub(super) total: u64,
    pub(super) change: u64,
}

/// The samples that a subscription took.
#[derive(Debug, Serialize, Deserialize)]
pub(super) struct Taken {
    /// The samples in order, each with its number among all that were taken.
    pub(super) samples: Vec<(Sample, u64)>,
    /// The losses by the event, and by the subscription itself.
    pub(super) losses: Losses,
    pub(super) lost: u64,
    pub(super) expired: u64,
}

/// The sender of a request or response, and the number at its beginning.
pub(super) type Call = (String, u64);

/// The statuses of a publisher or subscription.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Reported {
    /// Number of matches so far, and now.
    pub(super) ever: u64,
    pub(super) current: u64,
    /// Number of endpoints with an incompatible QoS, and the policy of the last one.
    pub(super) qos: u64,
    pub(super) policy: Option<String>,
    /// Number of endpoints with another type.
    pub(super) types: u64,
    /// For a subscription: its publishers that are alive, and those that are not.
    pub(super) alive: u64,
    pub(super) not_alive: u64,
    /// Number of missed deadlines, and of a publisher's expired leases.
    pub(super) late: u64,
    pub(super) lifeless: u64,
}

/// A process's view of one of its endpoints.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Own {
    pub(super) matched: BTreeSet<String>,
    pub(super) reported: Option<Reported>,
}

/// A process's view of everything.
#[derive(Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct State {
    /// By GID.
    pub(super) graph: BTreeMap<String, Described>,
    /// By number.
    pub(super) own: BTreeMap<u64, Own>,
}
