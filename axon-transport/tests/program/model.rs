//! What endpoints are by the rules of ROS 2, and what processes must see of them.

use std::collections::{BTreeMap, BTreeSet};

use axon_transport::qos::{Durability, History, Qos, Reliability};

/// A profile by its number: reliability, durability, and how much is kept.
pub(super) fn profile(number: u64) -> Qos {
    let depths = [1, 3, 10, 40];
    let depth = depths.get(usize::try_from(number / 4).unwrap()).copied();
    Qos {
        reliability: [Reliability::Reliable, Reliability::BestEffort][(number % 2) as usize],
        durability: [Durability::Volatile, Durability::TransientLocal][(number / 2 % 2) as usize],
        history: if depth.is_some() { History::KeepLast } else { History::KeepAll },
        depth: depth.unwrap_or(10),
        ..Qos::default()
    }
}

pub(super) const PROFILES: u64 = 20;

pub(super) fn joined(set: &BTreeSet<String>) -> String {
    set.iter().cloned().collect::<Vec<_>>().join(",")
}

/// What a process sees.
#[derive(Debug, Default, PartialEq)]
pub(super) struct State {
    pub(super) graph: BTreeSet<String>,
    /// By the numbers of its endpoints.
    pub(super) matched: BTreeMap<u64, BTreeSet<String>>,
}

impl std::fmt::Display for State {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}", joined(&self.graph))?;
        self.matched.iter().try_for_each(|(id, gids)| write!(f, ";{id}={}", joined(gids)))
    }
}

#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Kind {
    Publisher,
    Subscription,
    Server,
    Client,
}

impl Kind {
    pub(super) fn name(self) -> &'static str {
        match self {
            Self::Publisher => "publisher",
            Self::Subscription => "subscription",
            Self::Server => "server",
            Self::Client => "client",
        }
    }
}

/// An endpoint as the model has it.
pub(super) struct Modelled {
    pub(super) gid: String,
    pub(super) process: usize,
    pub(super) kind: Kind,
    /// Or service.
    pub(super) topic: u64,
    pub(super) hash: u64,
    pub(super) qos: Qos,
    /// A publisher's samples, oldest first; what a subscription has to take, by the source's time.
    pub(super) samples: BTreeMap<u64, u64>,
    /// The requests that a server has to answer, and the responses that a client has to take, with
    /// the other end of each.
    pub(super) calls: BTreeSet<(String, u64)>,
}

impl Modelled {
    /// ROS 2's rule, as its documentation has it.
    pub(super) fn goes_with(&self, other: &Self) -> bool {
        let (offers, requests) = match (self.kind, other.kind) {
            (Kind::Publisher, Kind::Subscription) => (self, other),
            (Kind::Subscription, Kind::Publisher) => (other, self),
            (Kind::Server, Kind::Client) | (Kind::Client, Kind::Server) => {
                return self.topic == other.topic;
            }
            _ => return false,
        };
        let reliable = offers.qos.reliability == Reliability::Reliable
            || requests.qos.reliability == Reliability::BestEffort;
        let durable = offers.qos.durability == Durability::TransientLocal
            || requests.qos.durability == Durability::Volatile;
        (self.topic, self.hash) == (other.topic, other.hash) && reliable && durable
    }

    /// Whether a wait finds it ready.
    pub(super) fn is_ready(&self) -> bool {
        match self.kind {
            Kind::Publisher => false,
            Kind::Subscription => !self.samples.is_empty(),
            Kind::Server | Kind::Client => !self.calls.is_empty(),
        }
    }

    pub(super) fn depth(&self) -> usize {
        match self.qos.history {
            History::KeepLast => self.qos.depth as usize,
            History::KeepAll => usize::MAX,
        }
    }

    /// Of the requests of a client, or the responses of a server, it keeps the newest.
    pub(super) fn keep_call(&mut self, other: &str, stamp: u64) {
        let of_other = (other.to_owned(), 0)..=(other.to_owned(), u64::MAX);
        self.calls.insert((other.to_owned(), stamp));
        while self.calls.range(of_other.clone()).count() > self.depth() {
            let oldest = self.calls.range(of_other.clone()).next().cloned();
            oldest.map(|oldest| self.calls.remove(&oldest));
        }
    }

    pub(super) fn keep(&mut self, stamp: u64, len: u64) {
        self.samples.insert(stamp, len);
        while self.samples.len() > self.depth() {
            self.samples.pop_first();
        }
    }
}
