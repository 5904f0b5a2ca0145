//! What the conductor and the processes tell each other.

use axon_shm::qos::{Durability, History, Qos, Reliability};
use axon_transport::EndpointSpec;
use serde::{Deserialize, Serialize};

use super::content::SHORTEST;

/// A topic of both hosts: each has a publisher and a subscriber of it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub(crate) enum Topic {
    /// RELIABLE and KEEP_ALL.
    All,
    /// RELIABLE, KEEP_LAST with a depth of 10.
    Last,
    /// BEST_EFFORT with a depth of 5.
    Effort,
    /// RELIABLE, KEEP_ALL and TRANSIENT_LOCAL.
    Map,
}

impl Topic {
    pub(super) const EACH: [Self; 4] = [Self::All, Self::Last, Self::Effort, Self::Map];

    pub(super) fn name(self) -> &'static str {
        match self {
            Self::All => "/all",
            Self::Last => "/last",
            Self::Effort => "/effort",
            Self::Map => "/map",
        }
    }

    /// Whether a subscriber must get each sample.
    pub(super) fn is_keep_all(self) -> bool {
        matches!(self, Self::All | Self::Map)
    }

    /// Whether a subscriber must get the last samples of a publisher that lives.
    pub(super) fn is_reliable(self) -> bool {
        self != Self::Effort
    }

    /// The shortest and the longest sample, in bytes. Maps are short, so that all of them fit into a publisher's history.
    pub(super) fn lengths(self) -> (usize, usize) {
        (SHORTEST, if self == Self::Map { 4_000 } else { 200_000 })
    }

    /// The longest time from sample to sample, in milliseconds.
    pub(super) fn pause_ms(self) -> u64 {
        if self == Self::Map { 500 } else { 200 }
    }

    pub(super) fn publisher(self) -> EndpointSpec {
        EndpointSpec::new(self.name(), "bench/Bytes", self.qos())
    }

    /// Deeper than the publisher: a subscription does not count samples as lost that its own depth passes over.
    pub(super) fn subscription(self) -> EndpointSpec {
        let mut qos = self.qos();
        if !self.is_keep_all() {
            qos.depth = 10_000;
        }
        EndpointSpec::new(self.name(), "bench/Bytes", qos)
    }

    fn qos(self) -> Qos {
        let mut qos = Qos::default();
        match self {
            Self::All => qos.history = History::KeepAll,
            Self::Last => qos.depth = 10,
            Self::Effort => (qos.reliability, qos.depth) = (Reliability::BestEffort, 5),
            Self::Map => {
                (qos.history, qos.durability) = (History::KeepAll, Durability::TransientLocal);
            }
        }
        qos
    }
}

/// What a process does.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub(crate) enum Role {
    Publisher(Topic),
    Subscriber(Topic),
    /// Of the service that the host of this number has.
    Client(usize),
    Server(usize),
}

/// What a process is told.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
pub(super) enum Order {
    /// Publish and call no more.
    Quiet,
    /// Publish ten more samples, once both subscribers are there.
    Finish,
    /// Publish a last sample and end; wait before until all are acknowledged, or not.
    End { wait: bool },
}

/// What a process tells. Endpoints are GIDs in hexadecimal, times nanoseconds of the monotonic clock.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) enum Report {
    /// Its endpoint is there.
    Ready {
        gid: String,
    },
    /// Samples from this one on are for these subscribers.
    Matched {
        from: u64,
        readers: Vec<String>,
    },
    Published {
        number: u64,
        bytes: usize,
        at: u64,
    },
    /// How many samples the publisher has given up.
    GivenUp {
        total: u64,
        at: u64,
    },
    /// The publisher is about to end: the readers of all its samples, and whether all are acknowledged, if that was asked.
    Ended {
        acknowledged: Option<bool>,
        at: u64,
    },
    /// All that `Finish` asked for is published.
    Finished,
    Took {
        publisher: String,
        number: u64,
        sent: u64,
        at: u64,
    },
    /// How many samples the subscription counts as lost.
    Lost {
        total: u64,
    },
    Called {
        number: u64,
        servers: Vec<String>,
        at: u64,
    },
    Answered {
        server: String,
        number: u64,
        at: u64,
    },
    Served {
        client: String,
        number: u64,
        at: u64,
    },
    /// The process saw a broken rule itself.
    Broken {
        what: String,
    },
}
