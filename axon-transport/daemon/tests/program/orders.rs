//! What a program's test tells its processes to do, and what they answer: a line of JSON each.

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

/// All that a graph says of a node or an endpoint.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Described {
    pub(super) kind: Kind,
    /// Or service; empty for a node.
    pub(super) topic: String,
    pub(super) type_name: String,
    pub(super) hash: Vec<u8>,
    pub(super) profile: Profile,
    pub(super) node: String,
    pub(super) namespace: String,
    pub(super) enclave: String,
}

/// What a process is to do. Endpoints go by the numbers that their test gives them.
#[derive(Debug, Serialize, Deserialize)]
pub(super) enum Order {
    /// [`String`]: the GID. `by` is the number of the node that it belongs to.
    Create { id: u64, by: Option<u64>, what: Box<Described> },
    /// [`Published`]: so many samples with source times from `stamp` on, or as many as find room.
    Publish { id: u64, stamp: i64, count: u64, len: u64 },
    /// [`Taken`]: all of so many samples that can be had.
    Take { id: u64, owed: u64 },
    /// [`Losses`], once there are any.
    AwaitLoss { id: u64 },
    /// [`u64`]: the request's number.
    Ask { id: u64, stamp: u64, len: u64 },
    /// The [`Call`]s that were answered: so many, and no more.
    Answer { id: u64, count: u64 },
    /// The [`Call`]s whose answers came: so many, and no more.
    Hear { id: u64, count: u64 },
    /// The numbers of all that a wait finds ready: at once, unless it is to find `some`.
    Wait { some: bool },
    /// `()`.
    End { id: u64 },
    /// [`State`].
    State,
}

/// What became of a publication.
#[derive(Debug, Serialize, Deserialize)]
pub(super) struct Published {
    /// The number of the first sample.
    pub(super) first: Option<u64>,
    pub(super) count: u64,
    /// Whether a reader held the publisher back, after that many.
    pub(super) blocked: bool,
}

/// A sample, as the process that takes it is told of it.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Sample {
    pub(super) publisher: String,
    pub(super) sequence: u64,
    pub(super) stamp: i64,
    pub(super) len: u64,
}

/// A count of losses in all, and since it was looked at before.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Losses {
    pub(super) total: u64,
    pub(super) change: u64,
}

/// What a subscription gave.
#[derive(Debug, Serialize, Deserialize)]
pub(super) struct Taken {
    /// In this order, and the number that each has among all that were taken.
    pub(super) samples: Vec<(Sample, u64)>,
    /// As its event says, and as itself does.
    pub(super) losses: Losses,
    pub(super) lost: u64,
    pub(super) expired: u64,
}

/// Who said what: the number that a request or response begins with.
pub(super) type Call = (String, u64);

/// What a publisher or subscription reports of itself.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Reported {
    /// Matched ever, and now.
    pub(super) ever: u64,
    pub(super) current: u64,
    /// Those that do not go with it by their QoS, and by which policy the last did not.
    pub(super) qos: u64,
    pub(super) policy: Option<String>,
    /// Those that have another type.
    pub(super) types: u64,
    /// A subscription's publishers.
    pub(super) alive: u64,
    pub(super) not_alive: u64,
    /// Deadlines missed, and a publisher's leases that ran out.
    pub(super) late: u64,
    pub(super) lifeless: u64,
}

/// What a process sees of one of its own.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Own {
    pub(super) matched: BTreeSet<String>,
    pub(super) reported: Option<Reported>,
}

/// What a process sees.
#[derive(Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct State {
    /// By GID.
    pub(super) graph: BTreeMap<String, Described>,
    /// By number.
    pub(super) own: BTreeMap<u64, Own>,
}
