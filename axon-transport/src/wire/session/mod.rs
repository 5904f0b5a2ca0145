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

/// The kind of a session.
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
    /// A program that only sends queries, for example for the status. It may have no endpoints.
    #[n(2)]
    Tool,
}

/// Tells whether an endpoint stands for itself or for others.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Encode, Decode, Serialize)]
#[cbor(index_only)]
#[serde(rename_all = "snake_case")]
pub enum EndpointRole {
    /// An endpoint of an application, which stands for itself.
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
    /// The session's id.
    #[n(1)]
    pub session: SessionId,
    /// The kind of the session.
    #[n(2)]
    pub role: SessionRole,
    /// The process's name, for people.
    #[n(3)]
    pub name: String,
    /// `ROS_DOMAIN_ID`.
    #[n(4)]
    pub domain: u32,
    /// The effective security settings: each variable with its value or a digest.
    #[n(5)]
    pub settings: Vec<(String, String)>,
    /// The reason why the session shares no memory. If set, the session is relayed and sends no descriptors.
    #[n(6)]
    pub relay: Option<String>,
    /// The discovery range: 0 subnet, 1 localhost, 2 off. Absent if an older library opened the session.
    #[n(7)]
    pub range: Option<u8>,
    /// The static peers: addresses or host names. Absent for none.
    #[n(8)]
    pub static_peers: Option<Vec<String>>,
}

/// The daemon accepts the session.
#[derive(Clone, Debug, PartialEq, Eq, Encode, Decode)]
#[cbor(map)]
pub struct Welcome {
    /// The protocol that the daemon speaks.
    #[n(0)]
    pub protocol: u32,
    /// The daemon's id.
    #[n(1)]
    pub daemon: DaemonId,
    /// The id of the daemon's process.
    #[n(2)]
    pub pid: u32,
    /// True if the daemon applies the range and the static peers of each session. An older daemon has one range for all
    /// sessions.
    #[n(3)]
    pub ranges: Option<bool>,
}

/// The daemon refuses the session, or one of its endpoints.
#[derive(Clone, Debug, PartialEq, Eq, Encode, Decode)]
#[cbor(map)]
pub struct SessionRefused {
    /// The variable that differs; empty if none does.
    #[n(0)]
    pub variable: String,
    /// The value in the session.
    #[n(1)]
    pub ours: String,
    /// The value in the daemon.
    #[n(2)]
    pub theirs: String,
    /// The reason.
    #[n(3)]
    pub text: String,
    /// The endpoint that is refused; `None` if the refusal is not about one.
    #[n(4)]
    pub endpoint: Option<Gid>,
}

impl SessionRefused {
    /// Creates a refusal that no variable causes.
    pub fn because(text: String) -> Self {
        let [variable, ours, theirs] = [const { String::new() }; 3];
        Self { variable, ours, theirs, text, endpoint: None }
    }

    /// Creates a refusal of an endpoint.
    pub fn of(endpoint: &Endpoint, why: &str) -> Self {
        let text = format!("endpoint {} of topic {:?}: {why}", endpoint.gid, endpoint.topic);
        Self { endpoint: Some(endpoint.gid), ..Self::because(text) }
    }
}

/// An endpoint exists. A repetition changes only the endpoints that it stands for.
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
    /// The location of a writer's ring in its session's memory.
    #[n(3)]
    pub ring: Option<Location>,
    /// The only writer that a relay reads; `None` if it reads all that match.
    #[n(4)]
    pub only: Option<Gid>,
}

/// An endpoint is gone.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Encode, Decode)]
#[cbor(map)]
pub struct Gone {
    /// The endpoint's GID.
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
    /// The daemon to which it belongs, if it is on another host.
    #[n(1)]
    pub daemon: Option<DaemonId>,
    /// Only to the gateway, for an endpoint of this host: the discovery range of its session.
    #[n(2)]
    pub reach: Option<EndpointRange>,
}

/// A change of the graph, or a part of the whole graph.
#[derive(Clone, Debug, PartialEq, Eq, Encode, Decode)]
#[cbor(map)]
pub struct SessionGraph {
    /// The version after this change.
    #[n(0)]
    pub version: u64,
    /// Set in the first part of a whole graph: the receiver forgets what it knew.
    #[n(1)]
    pub whole: bool,
    /// The new endpoints.
    #[n(2)]
    pub added: Vec<GraphItem>,
    /// The endpoints that are gone.
    #[n(3)]
    pub removed: Vec<Gid>,
    /// True if another part of the same change follows.
    #[n(4)]
    pub more: bool,
    /// The endpoints of this host that ended. A session that is attached to one detaches from it. An endpoint of
    /// another host is attached through its stand-in, which ends by UNMATCH.
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
    /// The QoS that the reader requests.
    #[n(3)]
    pub qos: Qos,
    /// The reader's session.
    #[n(4)]
    pub session: SessionId,
    /// The remote subscriptions that a relay stands for; `None` for a reader that is no relay.
    #[n(5)]
    pub stands_for: Option<Vec<Gid>>,
    /// The segments of the reader's session that come with the message.
    #[n(6)]
    pub segments: Vec<Segment>,
    /// The last number that the reader has from the writer, if it was attached before. It continues after that.
    #[n(7)]
    pub after: Option<u64>,
    /// Set if the reader carries samples to another process. They count as taken when that process has them, and are
    /// kept for it for a while if the reader's own process ends.
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
    /// The segments of the writer's session that come with the message.
    #[n(6)]
    pub segments: Vec<Segment>,
    /// The number of the writer's last sample before the first position.
    #[n(7)]
    pub after: Option<u64>,
    /// Set if the samples come from a process that shares no memory. Then missing numbers were lost on the way.
    #[n(8)]
    pub relayed: Option<bool>,
}

/// A reader and a writer are no longer matched.
#[derive(Clone, Debug, PartialEq, Eq, Encode, Decode)]
#[cbor(map)]
pub struct Unmatch {
    /// The reader's GID.
    #[n(0)]
    pub reader: Gid,
    /// The writer's GID.
    #[n(1)]
    pub writer: Gid,
    /// The reason.
    #[n(2)]
    pub reason: String,
}

/// A part of the status.
#[derive(Clone, Debug, PartialEq, Eq, Encode, Decode)]
#[cbor(map)]
pub struct StatusPart {
    /// The number of the part, from 0.
    #[n(0)]
    pub part: u32,
    /// The number of parts.
    #[n(1)]
    pub parts: u32,
    /// The bytes of the JSON text.
    #[cbor(n(2), with = "minicbor::bytes")]
    pub text: Vec<u8>,
}

/// The endpoints outside the process of a relayed session with which one of its endpoints is matched. From the session:
/// the clients of a server for which its process has stand-ins.
#[derive(Clone, Debug, PartialEq, Eq, Encode, Decode)]
#[cbor(map)]
pub struct RelayMatched {
    /// The endpoint.
    #[n(0)]
    pub gid: Gid,
    /// The matched endpoints.
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
    /// Set only in the first fragment.
    #[n(1)]
    pub head: Option<SampleHeader>,
    /// The bytes, which follow those of the previous fragment.
    #[cbor(n(2), with = "minicbor::bytes")]
    pub bytes: Vec<u8>,
    /// For a server: the client whose response it is.
    #[n(3)]
    pub client: Option<Gid>,
}

/// The metadata of a sample that crosses a relay.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Encode, Decode)]
pub struct SampleHeader {
    /// Its length in bytes.
    #[n(0)]
    pub length: u32,
    /// The sequence number of the publication.
    #[n(1)]
    pub sequence: u64,
    /// The source timestamp.
    #[n(2)]
    pub source_timestamp: i64,
    /// Number of samples of the publisher that were lost since the previous one.
    #[n(3)]
    pub lost: u64,
    /// The time of publication in nanoseconds of CLOCK_MONOTONIC; 0 or absent if the publisher's lifespan is infinite.
    #[n(4)]
    #[cbor(default)]
    pub published: u64,
}

/// The receiver of a channel grants credit.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Encode, Decode)]
#[cbor(map)]
pub struct Credit {
    /// The channel's publisher, client or server.
    #[n(0)]
    pub publisher: Gid,
    /// The additional bytes that the sender may send.
    #[n(1)]
    pub bytes: u64,
    /// Set in the first credit of a channel: the number of MATCHED messages that the receiver has received by then.
    #[n(2)]
    pub opens: Option<u64>,
    /// For a server: the client whose responses are the channel.
    #[n(3)]
    pub client: Option<Gid>,
    /// The number of the sample that used the bytes and has reached its destination.
    #[n(4)]
    pub done: Option<u64>,
}

/// Publishers that asserted their liveliness since the previous message.
#[derive(Clone, Debug, PartialEq, Eq, Encode, Decode)]
#[cbor(map)]
pub struct Asserted {
    /// The publishers.
    #[n(0)]
    pub publishers: Vec<Gid>,
}

/// A writer has ended, or has come back, while its samples are still on their way to a ring. A writer that leaves is in
/// no graph and not counted, but its readers get the rest.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Encode, Decode)]
#[cbor(map)]
pub struct WriterLeaving {
    /// The writer's GID.
    #[n(0)]
    pub gid: Gid,
    /// True if it has ended.
    #[n(1)]
    pub leaving: bool,
}

/// A relay could not deliver samples. Their publisher is told.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Encode, Decode)]
#[cbor(map)]
pub struct RelayGivenUp {
    /// The relay; for a relayed session, the publisher itself.
    #[n(0)]
    pub reader: Gid,
    /// The publisher.
    #[n(1)]
    pub writer: Gid,
    /// The number of samples.
    #[n(2)]
    pub samples: u64,
}

/// A session asks whether everything that it sent about one of its publishers has been sent to the publisher's readers:
/// the memory with its samples, and its grants. The daemon answers with the same message once it has.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Encode, Decode)]
#[cbor(map)]
pub struct Fence {
    /// The publisher.
    #[n(0)]
    pub writer: Gid,
    /// The session's number for this question.
    #[n(1)]
    pub number: u64,
}

/// A publisher has ended, and a reader never took up its grant. The reader counts the samples as lost. A reader that
/// did take up its grant counts its losses itself.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Encode, Decode)]
#[cbor(map)]
pub struct Unmet {
    /// The reader.
    #[n(0)]
    pub reader: Gid,
    /// The publisher.
    #[n(1)]
    pub writer: Gid,
    /// The number of samples for the reader; the reader would have taken at most its depth of them.
    #[n(2)]
    pub samples: u64,
}

/// Most uses in one question about access rules.
pub const MOST_CHECKED: usize = 32;

/// A tool asks what the access rules of a linked peer let this host do there. Answered like a STATUS_REQUEST.
#[derive(Clone, Debug, PartialEq, Eq, Encode, Decode)]
#[cbor(map)]
pub struct AccessCheck {
    /// The peer.
    #[n(0)]
    pub daemon: DaemonId,
    /// The uses that this host would make there.
    #[n(1)]
    pub uses: Vec<CheckedUse>,
}

/// A use of a topic or service that access rules are asked about.
#[derive(Clone, Debug, PartialEq, Eq, Encode, Decode)]
#[cbor(array)]
pub struct CheckedUse {
    /// 0 publish, 1 subscribe, 2 serve, 3 call, 4 see.
    #[n(0)]
    pub verb: u8,
    /// The topic, service or node.
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
    /// Re-reads the settings that may change while the daemon runs. Answered like a STATUS_REQUEST.
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
    /// A message type that this version does not know; it is skipped.
    Unknown(u8),
}
