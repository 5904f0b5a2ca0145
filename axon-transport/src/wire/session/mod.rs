//! The control messages between sessions and their daemon (`docs/formats.md`, section 8).
//!
//! A packet is a type byte and one CBOR map. Unknown keys are skipped. A packet of unknown type decodes to
//! [`SessionMessage::Unknown`]. Any other invalid packet is an error.

mod codec;
#[cfg(test)]
mod tests;

use axon_shm::internal::Location;
pub use axon_shm::internal::{Segment, SegmentName, SegmentOpened};
pub use codec::CodecError;
use minicbor::{Decode, Encode};
use serde::Serialize;

use crate::{
    graph::{Endpoint, EndpointRange},
    ids::{DaemonId, Gid, SessionId},
    qos::Qos,
};

/// The version of the session protocol that this crate speaks.
pub const PROTOCOL: u32 = 2;
/// The largest packet, in bytes.
pub const MAX_PACKET: usize = 32 * 1024;
/// The most descriptors that one packet carries.
pub const MAX_DESCRIPTORS: usize = 8;

/// What kind of session this is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Encode, Decode, Serialize)]
#[cbor(index_only)]
#[serde(rename_all = "snake_case")]
pub enum SessionRole {
    /// A program with publishers and subscriptions.
    #[n(0)]
    Application,
    /// The daemon's own gateway to other hosts.
    #[n(1)]
    Gateway,
    /// A program that only asks, such as for the status; it may have no endpoints.
    #[n(2)]
    Tool,
}

/// Whether an endpoint stands for itself or for others.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Encode, Decode, Serialize)]
#[cbor(index_only)]
#[serde(rename_all = "snake_case")]
pub enum EndpointRole {
    /// For itself.
    #[n(0)]
    Application,
    /// A local ring that stands in for a publisher on another host.
    #[n(1)]
    StandIn,
    /// A local reader that carries samples to subscriptions on another host.
    #[n(2)]
    Relay,
}

/// The first message of a session.
#[derive(Clone, Debug, PartialEq, Eq, Encode, Decode)]
#[cbor(map)]
pub struct SessionHello {
    /// The protocol that the session speaks.
    #[n(0)]
    pub protocol: u32,
    /// The session.
    #[n(1)]
    pub session: SessionId,
    /// What kind it is.
    #[n(2)]
    pub role: SessionRole,
    /// The process's name, for people.
    #[n(3)]
    pub name: String,
    /// `ROS_DOMAIN_ID`.
    #[n(4)]
    pub domain: u32,
    /// Effective security settings: variable, and value or digest.
    #[n(5)]
    pub settings: Vec<(String, String)>,
    /// Why it shares no memory, if so: then it is relayed, and has no descriptors.
    #[n(6)]
    pub relay: Option<String>,
    /// Discovery range: 0 subnet, 1 localhost, 2 off. Absent where an older library opened it.
    #[n(7)]
    pub range: Option<u8>,
    /// Static peers: addresses or host names; absent is none.
    #[n(8)]
    pub static_peers: Option<Vec<String>>,
}

/// The daemon takes the session.
#[derive(Clone, Debug, PartialEq, Eq, Encode, Decode)]
#[cbor(map)]
pub struct Welcome {
    /// The protocol that the daemon speaks.
    #[n(0)]
    pub protocol: u32,
    /// The daemon.
    #[n(1)]
    pub daemon: DaemonId,
    /// Its process.
    #[n(2)]
    pub pid: u32,
    /// Whether it applies the range and the static peers of each session. An older daemon has one
    /// range for all.
    #[n(3)]
    pub ranges: Option<bool>,
}

/// The daemon does not take the session, or one of its endpoints.
#[derive(Clone, Debug, PartialEq, Eq, Encode, Decode)]
#[cbor(map)]
pub struct SessionRefused {
    /// The variable that differs; empty when none does.
    #[n(0)]
    pub variable: String,
    /// Its value in the session.
    #[n(1)]
    pub ours: String,
    /// Its value in the daemon.
    #[n(2)]
    pub theirs: String,
    /// What is wrong.
    #[n(3)]
    pub text: String,
    /// The endpoint that is refused; `None` when it is not one.
    #[n(4)]
    pub endpoint: Option<Gid>,
}

impl SessionRefused {
    /// For a reason that no variable is to blame for.
    pub fn because(text: String) -> Self {
        let [variable, ours, theirs] = [const { String::new() }; 3];
        Self { variable, ours, theirs, text, endpoint: None }
    }

    /// Of one endpoint.
    pub fn of(endpoint: &Endpoint, why: &str) -> Self {
        let text = format!("endpoint {} of topic {:?}: {why}", endpoint.gid, endpoint.topic);
        Self { endpoint: Some(endpoint.gid), ..Self::because(text) }
    }
}

/// An endpoint exists. Repeating it changes only which endpoints it stands for.
#[derive(Clone, Debug, PartialEq, Eq, Encode, Decode)]
#[cbor(map)]
pub struct Announce {
    /// The endpoint.
    #[n(0)]
    pub endpoint: Endpoint,
    /// Its role.
    #[n(1)]
    pub role: EndpointRole,
    /// The remote subscriptions that a relay stands for.
    #[n(2)]
    pub stands_for: Vec<Gid>,
    /// Where a writer's ring is in its session's memory.
    #[n(3)]
    pub ring: Option<Location>,
    /// The only writer that a relay reads; `None` when it reads all that go with it.
    #[n(4)]
    pub only: Option<Gid>,
}

/// An endpoint is gone.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Encode, Decode)]
#[cbor(map)]
pub struct Gone {
    /// Which.
    #[n(0)]
    pub gid: Gid,
}

/// One endpoint of the graph.
#[derive(Clone, Debug, PartialEq, Eq, Encode, Decode)]
#[cbor(map)]
pub struct GraphItem {
    /// The endpoint.
    #[n(0)]
    pub endpoint: Endpoint,
    /// The daemon it belongs to when that is another host's.
    #[n(1)]
    pub daemon: Option<DaemonId>,
    /// To the gateway, of an endpoint of this host: how far its session is discovered.
    #[n(2)]
    pub reach: Option<EndpointRange>,
}

/// A change of the graph, or a part of the whole of it.
#[derive(Clone, Debug, PartialEq, Eq, Encode, Decode)]
#[cbor(map)]
pub struct SessionGraph {
    /// The version after this change.
    #[n(0)]
    pub version: u64,
    /// Set in the first part of a whole graph: forget what was known.
    #[n(1)]
    pub whole: bool,
    /// Endpoints that are new.
    #[n(2)]
    pub added: Vec<GraphItem>,
    /// Endpoints that are gone.
    #[n(3)]
    pub removed: Vec<Gid>,
    /// Whether another part of the same change follows.
    #[n(4)]
    pub more: bool,
    /// Those of this host's own endpoints that ended. A session that is attached to one lets go of it; an
    /// endpoint of another host is attached to by way of its stand-in, which ends by UNMATCH.
    #[n(5)]
    pub ended: Option<Vec<Gid>>,
}

/// A reader and a writer.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, Encode, Decode)]
#[cbor(map)]
pub struct Pair {
    /// The reader's GID.
    #[n(0)]
    pub reader: Gid,
    /// The writer's GID.
    #[n(1)]
    pub writer: Gid,
}

/// A reader asks a writer to serve it.
#[derive(Clone, Debug, PartialEq, Eq, Encode, Decode)]
#[cbor(map)]
pub struct Attach {
    /// The reader's GID.
    #[n(0)]
    pub reader: Gid,
    /// The writer's GID.
    #[n(1)]
    pub writer: Gid,
    /// The reader's lane in its session's memory.
    #[n(2)]
    pub lane: Location,
    /// What the reader requests.
    #[n(3)]
    pub qos: Qos,
    /// The reader's session.
    #[n(4)]
    pub session: SessionId,
    /// The subscriptions elsewhere that a relay stands for; `None` of a reader that is none.
    #[n(5)]
    pub stands_for: Option<Vec<Gid>>,
    /// The segments of the reader's session that come along.
    #[n(6)]
    pub segments: Vec<Segment>,
    /// The last number that a reader has of the writer that was attached before: it goes on behind it.
    #[n(7)]
    pub after: Option<u64>,
    /// Set where it carries samples to another process: they are taken when that process has them, and
    /// kept for it for a while when the reader's own ends.
    #[n(8)]
    pub carries: Option<bool>,
}

/// The writer serves the reader.
#[derive(Clone, Debug, PartialEq, Eq, Encode, Decode)]
#[cbor(map)]
pub struct Granted {
    /// The reader's GID.
    #[n(0)]
    pub reader: Gid,
    /// The writer's GID.
    #[n(1)]
    pub writer: Gid,
    /// The grant's generation.
    #[n(2)]
    pub generation: u64,
    /// The first position to take.
    #[n(3)]
    pub first: u64,
    /// The writer's session.
    #[n(4)]
    pub session: SessionId,
    /// The writer's ring in its session's memory.
    #[n(5)]
    pub ring: Location,
    /// The segments of the writer's session that come along.
    #[n(6)]
    pub segments: Vec<Segment>,
    /// The number of the writer's last sample in front of the first position.
    #[n(7)]
    pub after: Option<u64>,
    /// Set where its samples come from a process that shares no memory: numbers that are missing were
    /// lost on the way.
    #[n(8)]
    pub relayed: Option<bool>,
}

/// A reader and a writer have nothing to do with each other any more.
#[derive(Clone, Debug, PartialEq, Eq, Encode, Decode)]
#[cbor(map)]
pub struct Unmatch {
    /// The reader's GID.
    #[n(0)]
    pub reader: Gid,
    /// The writer's GID.
    #[n(1)]
    pub writer: Gid,
    /// Why.
    #[n(2)]
    pub reason: String,
}

/// A slice of the status.
#[derive(Clone, Debug, PartialEq, Eq, Encode, Decode)]
#[cbor(map)]
pub struct StatusPart {
    /// Its number, from 0.
    #[n(0)]
    pub part: u32,
    /// How many there are.
    #[n(1)]
    pub parts: u32,
    /// The bytes of the JSON text.
    #[cbor(n(2), with = "minicbor::bytes")]
    pub text: Vec<u8>,
}

/// With whom an endpoint of a relayed session is matched outside of its process; from the session, the
/// clients of a server for which there is what stands for them in its process.
#[derive(Clone, Debug, PartialEq, Eq, Encode, Decode)]
#[cbor(map)]
pub struct RelayMatched {
    /// The endpoint.
    #[n(0)]
    pub gid: Gid,
    /// The others.
    #[n(1)]
    pub others: Vec<Gid>,
}

/// A part of a sample that crosses a relay.
#[derive(Clone, Debug, PartialEq, Eq, Encode, Decode)]
#[cbor(map)]
pub struct SampleFragment {
    /// Its publisher, client or server.
    #[n(0)]
    pub publisher: Gid,
    /// Present in the first fragment alone.
    #[n(1)]
    pub head: Option<SampleHeader>,
    /// The bytes that follow those of the part before.
    #[cbor(n(2), with = "minicbor::bytes")]
    pub bytes: Vec<u8>,
    /// Whose response it is, of a server.
    #[n(3)]
    pub client: Option<Gid>,
}

/// What goes with a sample that crosses a relay.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Encode, Decode)]
pub struct SampleHeader {
    /// Its length in bytes.
    #[n(0)]
    pub length: u32,
    /// The publication's number.
    #[n(1)]
    pub sequence: u64,
    /// When it was published.
    #[n(2)]
    pub source_timestamp: i64,
    /// Samples of its publisher that were lost since the one before.
    #[n(3)]
    pub lost: u64,
    /// When it was published, in nanoseconds of CLOCK_MONOTONIC; 0, or absent, where its publisher's
    /// lifespan is infinite.
    #[n(4)]
    #[cbor(default)]
    pub published: u64,
}

/// The receiver of a channel has room.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Encode, Decode)]
#[cbor(map)]
pub struct Credit {
    /// The channel's publisher, client or server.
    #[n(0)]
    pub publisher: Gid,
    /// For so many bytes more.
    #[n(1)]
    pub bytes: u64,
    /// In the first that it says of this channel: how many MATCHED it has heard by then.
    #[n(2)]
    pub opens: Option<u64>,
    /// Of a server, the client whose responses are the channel.
    #[n(3)]
    pub client: Option<Gid>,
    /// The number of the sample that used the bytes, and is where it is to go.
    #[n(4)]
    pub done: Option<u64>,
}

/// Publishers that were alive since their end of a relay said so last.
#[derive(Clone, Debug, PartialEq, Eq, Encode, Decode)]
#[cbor(map)]
pub struct Asserted {
    /// Which.
    #[n(0)]
    pub publishers: Vec<Gid>,
}

/// Something that writes has ended, or has come back, while what it has written is still on its way to
/// a ring: it is in no graph and nobody counts it, and those who read it get the rest.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Encode, Decode)]
#[cbor(map)]
pub struct WriterLeaving {
    /// What.
    #[n(0)]
    pub gid: Gid,
    /// Whether it has ended.
    #[n(1)]
    pub leaving: bool,
}

/// A relay does not get samples where they are to go: their publisher learns of it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Encode, Decode)]
#[cbor(map)]
pub struct RelayGivenUp {
    /// The relay; the publisher itself where its session is relayed.
    #[n(0)]
    pub reader: Gid,
    /// The publisher.
    #[n(1)]
    pub writer: Gid,
    /// How many.
    #[n(2)]
    pub samples: u64,
}

/// A session asks whether all that it said of one of its publishers was sent to those who read it: the
/// memory in which they find its samples, and what it granted. The daemon answers with the same message
/// once it was.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Encode, Decode)]
#[cbor(map)]
pub struct Fence {
    /// The publisher.
    #[n(0)]
    pub writer: Gid,
    /// A number of the session's own, which tells its questions apart.
    #[n(1)]
    pub number: u64,
}

/// A publisher has ended, and a reader never took up what it was granted: the reader counts the samples as lost. A reader
/// that did take it up counts for itself.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Encode, Decode)]
#[cbor(map)]
pub struct Unmet {
    /// The reader.
    #[n(0)]
    pub reader: Gid,
    /// The publisher.
    #[n(1)]
    pub writer: Gid,
    /// How many there were for the reader, of which it would have taken no more than its depth.
    #[n(2)]
    pub samples: u64,
}

/// Uses that one question about access rules is about, at most.
pub const MOST_CHECKED: usize = 32;

/// A tool asks what access rules of a linked peer let this host do there. Answered as a STATUS_REQUEST is.
#[derive(Clone, Debug, PartialEq, Eq, Encode, Decode)]
#[cbor(map)]
pub struct AccessCheck {
    /// The peer.
    #[n(0)]
    pub daemon: DaemonId,
    /// What this host would do there.
    #[n(1)]
    pub uses: Vec<CheckedUse>,
}

/// One use of a topic or service that access rules are asked about.
#[derive(Clone, Debug, PartialEq, Eq, Encode, Decode)]
#[cbor(array)]
pub struct CheckedUse {
    /// 0 publish, 1 subscribe, 2 serve, 3 call, 4 see.
    #[n(0)]
    pub verb: u8,
    /// Topic, service or node.
    #[n(1)]
    pub name: String,
}

/// A message of the session socket.
#[derive(Clone, Debug, PartialEq, Eq)]
#[allow(missing_docs)]
pub enum SessionMessage {
    Hello(SessionHello),
    Welcome(Welcome),
    Refused(SessionRefused),
    Endpoint(Announce),
    EndpointGone(Gone),
    Graph(SessionGraph),
    Match(Pair),
    Attach(Attach),
    Grant(Granted),
    Detach(Pair),
    Unmatch(Unmatch),
    StatusRequest,
    /// Read the settings that may change while the daemon runs. Answered as a STATUS_REQUEST is.
    Reload,
    AccessCheck(AccessCheck),
    Status(StatusPart),
    Resync,
    Segment(SegmentOpened),
    SegmentGone(SegmentName),
    Need(SegmentName),
    Leaving(WriterLeaving),
    GivenUp(RelayGivenUp),
    Fence(Fence),
    Unmet(Unmet),
    Matched(RelayMatched),
    SampleFragment(SampleFragment),
    Credit(Credit),
    Asserted(Asserted),
    /// A type that this version does not know; to be skipped.
    Unknown(u8),
}
