//! The control plane's state: sessions, endpoints, matched pairs, and the queued messages of each session.
//!
//! A state machine (`docs/architecture.md`) without time: messages of sessions go in, packets and descriptors come
//! out. `F` stands for a descriptor. Matching is a function of the endpoints alone. If a session cannot receive its
//! messages in time, the registry sends it the complete state anew ([`Registry::poll_output`]).

#[cfg(test)]
mod bounds;
mod fence;
mod graph;
mod input;
mod left;
mod matching;
mod output;
mod range;
mod relayed;
mod segments;
#[cfg(test)]
mod tests;

use std::{
    collections::{BTreeMap, BTreeSet, HashMap, HashSet, VecDeque},
    sync::{Arc, Weak},
};

use axon_shm::internal::Location;
pub use graph::parts;
pub use output::Output;
pub use range::OutOfRangePair;
pub use relayed::RelayCounters;

use crate::{
    graph::{Endpoint, RemoteEndpoint, Scope},
    ids::{DaemonId, Gid, SessionId},
    wire::session::{Attach, EndpointRole, Granted, Pair, Segment, SessionRole},
};

/// Packets that may wait for one session before it is told everything anew instead.
pub const MAX_QUEUE: usize = if cfg!(test) { 24 } else { 4096 };
/// Their bytes, likewise.
pub const MAX_QUEUE_BYTES: usize = if cfg!(test) { 64 << 10 } else { 4 << 20 };
/// Segments of one session's memory: as many descriptors of the daemon's.
pub const MAX_SEGMENTS: usize = if cfg!(test) { 256 } else { 1024 };
/// Pairs that the endpoints of one session may make when they are announced: what a thousand
/// publishers and as many subscriptions make. The gateway's stand-ins are bounded by its links.
pub const MAX_PAIRS: usize = if cfg!(test) { 1 << 10 } else { 1 << 20 };
/// Pairs of all sessions.
pub const MAX_ALL_PAIRS: usize = if cfg!(test) { 1 << 18 } else { 1 << 22 };
/// Bytes of the status in one packet.
const STATUS_SLICE: usize = 24 * 1024;
/// Sessions of one daemon.
pub const MAX_SESSIONS: usize = 4096;
/// Those of one process.
pub const MAX_OF_PROCESS: usize = 256;
/// Remembered GIDs of endpoints that ended while there was no daemon to tell.
const MAX_TOMBSTONES: usize = 4096;

/// Packets that live as long as a session has yet to be sent them.
type SharedPackets = Vec<Weak<[u8]>>;

/// The state of the control plane.
#[derive(Debug)]
pub struct Registry<F> {
    sessions: BTreeMap<SessionId, SessionEntry<F>>,
    endpoints: HashMap<Gid, LocalEndpoint>,
    topics: HashMap<Topic, Members>,
    pairs: BTreeMap<Pair, PairProgress>,
    remote: BTreeMap<DaemonId, BTreeMap<Gid, RemoteEndpoint>>,
    tombstones: VecDeque<Gid>,
    version: u64,
    added: BTreeMap<Gid, Item>,
    /// Whether each was this host's own.
    removed: BTreeMap<Gid, bool>,
    /// Those of them that were this host's own.
    ended: BTreeSet<Gid>,
    /// Endpoints of this host whose session lists other peers than the gateway was told.
    regraded: BTreeSet<Gid>,
    /// Applications' sessions came or went.
    rescoped: bool,
    /// The packets of the whole graph as each view was told it last, and the version of it.
    whole: (u64, BTreeMap<range::GraphFilter, SharedPackets>),
    ready: BTreeSet<SessionId>,
    /// The first endpoint of each session that was refused, and why.
    refused: Vec<(SessionId, String)>,
    /// FENCEs that are not answered yet.
    fences: Vec<fence::FenceRequest>,
    /// Memory of sessions that ended.
    left: left::LeftMemory<F>,
}

/// A session as the registry knows it.
#[derive(Debug)]
pub struct SessionEntry<F> {
    /// What kind it is.
    pub role: SessionRole,
    /// Its process's name.
    pub name: String,
    /// Its process.
    pub pid: u32,
    /// How far it is discovered; `None` of the gateway, and of all in a registry within a process.
    pub scope: Option<Scope>,
    /// Daemons of the linked peers that it lists.
    pub lists: BTreeSet<DaemonId>,
    /// Its endpoints.
    pub endpoints: BTreeSet<Gid>,
    /// Segment, doorbell and pidfd; a tool has none, nor has a session that nobody can meet.
    pub descriptors: Option<[F; 3]>,
    /// The segments of its memory besides the first, by number.
    pub segments: BTreeMap<u32, SessionSegment<F>>,
    /// Other sessions whose descriptors it holds.
    known: HashMap<SessionId, SentSegments>,
    queue: VecDeque<Output<F>>,
    /// The number of the last packet that was queued.
    last_queued: u64,
    queue_limit: usize,
    queued_bytes: usize,
    bytes_limit: usize,
    behind: bool,
    /// It asked to be told everything anew, and is once it has taken what waits for it.
    resync: bool,
    /// Its endpoints whose pairs it is still to be told of, while it is told everything.
    telling: Option<Vec<Gid>>,
    /// The pairs that its announcements made.
    pairs: usize,
    /// What it asked about, and the next part of it.
    status: Option<(Arc<[u8]>, u32)>,
    /// An endpoint of its was refused.
    refused: bool,
    /// It was told that no more segments of its memory are taken.
    short: bool,
    /// What is shown of its relay, where it is relayed. Pairs within it are its own process's.
    pub relay: Option<Arc<RelayCounters>>,
}

/// A segment of a session's memory.
#[derive(Clone, Debug)]
pub struct SessionSegment<F> {
    /// What it is.
    pub segment: Segment,
    /// Its descriptor.
    pub descriptor: F,
}

/// What a session holds of another.
#[derive(Debug, Default)]
struct SentSegments {
    /// The pairs for which it does.
    pairs: HashSet<Pair>,
    /// The numbers of the segments that it was handed.
    segments: BTreeSet<u32>,
    /// Those of them for which it asked: it may have had them before.
    asked: BTreeSet<u32>,
}

/// An endpoint of a session here.
#[derive(Debug)]
pub struct LocalEndpoint {
    /// Whose it is.
    pub session: SessionId,
    /// The endpoint.
    pub endpoint: Endpoint,
    /// Whether it stands for itself or for others.
    pub role: EndpointRole,
    /// A relay's remote subscriptions.
    pub stands_for: Vec<Gid>,
    /// The only writer that a relay reads, where it is not all.
    pub only: Option<Gid>,
    /// Where a writer's ring is.
    pub ring: Option<Location>,
    /// It has ended, but what it has written is not all in its ring yet.
    pub leaving: bool,
}

/// How far a pair has come.
#[derive(Debug)]
struct PairProgress {
    /// The session that announced the second of the two.
    by: SessionId,
    /// What its reader asked.
    attach: Option<Attach>,
    /// The subscriptions that the reader stands for, as last sent to the writer.
    stands_for: Option<Vec<Gid>>,
    /// What its writer answered.
    grant: Option<Granted>,
}

/// An endpoint that is new in the graph, and its daemon where that is another host's.
type Item = (Arc<Endpoint>, Option<DaemonId>);

/// A topic's or service's name and type.
#[derive(Clone, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
struct Topic(String, String);

#[derive(Debug, Default)]
struct Members {
    writers: BTreeSet<Gid>,
    readers: BTreeSet<Gid>,
}

/// What a session did that no session does. It is disconnected.
#[derive(Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum Violation {
    /// A message that only a daemon sends, or a second HELLO.
    #[error("an unexpected message")]
    Unexpected,
    /// Descriptors where none belong, or not those that do.
    #[error("a message with {0} descriptors")]
    Descriptors(usize),
    /// An endpoint of another session, or a role that is not the session's.
    #[error("endpoint {0} is not its own")]
    NotItsOwn(Gid),
    /// A segment of memory that it announced before, or with its introduction.
    #[error("segment {0} of its memory")]
    Segments(u32),
    /// Too many sessions.
    #[error("more than {MAX_SESSIONS} sessions")]
    Sessions,
}

impl<F> Default for Registry<F> {
    fn default() -> Self {
        Self {
            sessions: BTreeMap::new(),
            endpoints: HashMap::new(),
            topics: HashMap::new(),
            pairs: BTreeMap::new(),
            remote: BTreeMap::new(),
            tombstones: VecDeque::new(),
            version: 0,
            added: BTreeMap::new(),
            removed: BTreeMap::new(),
            ended: BTreeSet::new(),
            regraded: BTreeSet::new(),
            rescoped: false,
            whole: (0, BTreeMap::new()),
            ready: BTreeSet::new(),
            refused: Vec::new(),
            fences: Vec::new(),
            left: left::LeftMemory::default(),
        }
    }
}

impl<F: Clone> Registry<F> {
    /// The sessions.
    pub fn sessions(&self) -> impl Iterator<Item = (&SessionId, &SessionEntry<F>)> {
        self.sessions.iter()
    }

    /// One session.
    pub fn session(&self, id: &SessionId) -> Option<&SessionEntry<F>> {
        self.sessions.get(id)
    }

    /// A session is relayed.
    pub fn set_relayed(&mut self, id: &SessionId, relay: Arc<RelayCounters>) {
        if let Some(entry) = self.sessions.get_mut(id) {
            entry.relay = Some(relay);
        }
    }

    /// How many are.
    pub fn relayed(&self) -> usize {
        self.sessions.values().filter(|s| s.relay.is_some()).count()
    }

    /// Whether there is an application's session.
    pub fn is_needed(&self) -> bool {
        self.sessions.values().any(|s| s.role == SessionRole::Application)
    }

    /// The endpoints of sessions here.
    pub fn endpoints(&self) -> impl Iterator<Item = &LocalEndpoint> {
        self.endpoints.values()
    }

    /// The endpoints on other hosts.
    pub fn remote_endpoints(&self) -> impl Iterator<Item = (&DaemonId, &Endpoint)> {
        self.remote
            .iter()
            .flat_map(|(daemon, all)| all.values().map(move |e| (daemon, &*e.endpoint)))
    }

    /// The pairs whose reader has asked its writer.
    pub fn attached(&self) -> impl Iterator<Item = &Attach> {
        self.pairs.values().filter_map(|asked| asked.attach.as_ref())
    }

    /// The version that the next [`flush`](Self::flush) will exceed.
    pub fn version(&self) -> u64 {
        self.version
    }
}
