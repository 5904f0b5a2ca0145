//! The control messages between sessions and their daemon (`docs/formats.md`, section 8).
//!
//! A packet is a type byte and one CBOR map. Unknown keys are skipped; a packet of unknown type
//! decodes to [`Message::Unknown`]; everything else that does not fit is an error.

use minicbor::{Decode, Encode};
use serde::Serialize;

use crate::{
    graph::{Endpoint, EndpointKind},
    ids::{DaemonId, Gid, SessionId},
    qos::Qos,
    shm::{Location, SegmentInfo, SegmentKind},
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

/// For whom an endpoint stands.
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
pub struct Hello {
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
}

/// The daemon does not take the session, or one of its endpoints.
#[derive(Clone, Debug, PartialEq, Eq, Encode, Decode)]
#[cbor(map)]
pub struct Refused {
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
}

/// An endpoint exists. Repeating it changes only for whom it stands.
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
}

/// A change of the graph, or a part of the whole of it.
#[derive(Clone, Debug, PartialEq, Eq, Encode, Decode)]
#[cbor(map)]
pub struct Graph {
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
    /// Those of this host's own endpoints that ended. Whoever is attached to one lets go of it; an
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
    /// The remote subscriptions that the reader stands for.
    #[n(5)]
    pub stands_for: Vec<Gid>,
    /// The segments of the reader's session that come along.
    #[n(6)]
    pub segments: Vec<Segment>,
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
}

/// A segment of a session's memory, besides the first.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Encode, Decode)]
pub struct Segment {
    /// Its number.
    #[n(0)]
    pub number: u32,
    /// The publisher whose samples are in it, where it is only one's.
    #[n(1)]
    pub publisher: Option<Gid>,
}

impl From<SegmentInfo> for Segment {
    fn from(info: SegmentInfo) -> Self {
        let publisher = match info.kind {
            SegmentKind::Samples(gid) => Some(gid),
            SegmentKind::Session | SegmentKind::Heap => None,
        };
        Self { number: info.number, publisher }
    }
}

impl From<Segment> for SegmentInfo {
    fn from(segment: Segment) -> Self {
        let kind = segment.publisher.map_or(SegmentKind::Heap, SegmentKind::Samples);
        Self { number: segment.number, kind }
    }
}

/// A session has one segment more.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Encode, Decode)]
#[cbor(map)]
pub struct SegmentOpened {
    /// The session.
    #[n(0)]
    pub session: SessionId,
    /// The segment.
    #[n(1)]
    pub segment: Segment,
}

/// One segment of a session: that is gone, or that another one needs.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Encode, Decode)]
#[cbor(map)]
pub struct SegmentName {
    /// The session.
    #[n(0)]
    pub session: SessionId,
    /// The segment's number.
    #[n(1)]
    pub number: u32,
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

#[derive(Clone, Copy, Debug, Encode, Decode)]
#[cbor(map)]
struct Empty {}

/// A message of the session socket.
#[derive(Clone, Debug, PartialEq, Eq)]
#[allow(missing_docs)]
pub enum Message {
    Hello(Hello),
    Welcome(Welcome),
    Refused(Refused),
    Endpoint(Announce),
    EndpointGone(Gone),
    Graph(Graph),
    Match(Pair),
    Attach(Attach),
    Grant(Granted),
    Detach(Pair),
    Unmatch(Unmatch),
    StatusRequest,
    Status(StatusPart),
    Resync,
    Segment(SegmentOpened),
    SegmentGone(SegmentName),
    Need(SegmentName),
    /// A type that this version does not know; to be skipped.
    Unknown(u8),
}

/// Why bytes are not a message, or a message has no bytes.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum CodecError {
    /// Nothing at all.
    #[error("an empty packet")]
    Empty,
    /// More than a packet holds.
    #[error("a message of {0} bytes; a packet holds {MAX_PACKET}")]
    TooLarge(usize),
    /// Not the map that the type calls for.
    #[error("message type {kind}: {source}")]
    Malformed {
        /// The message's type byte.
        kind: u8,
        /// What the decoder found.
        source: minicbor::decode::Error,
    },
    /// Bytes after the map.
    #[error("message type {0}: bytes after the map")]
    Trailing(u8),
}

impl Message {
    /// The packet's bytes.
    ///
    /// # Errors
    /// [`CodecError::TooLarge`] when they do not fit into one packet.
    pub fn encode(&self) -> Result<Vec<u8>, CodecError> {
        let (kind, body) = match self {
            Self::Hello(m) => (1, minicbor::to_vec(m)),
            Self::Welcome(m) => (2, minicbor::to_vec(m)),
            Self::Refused(m) => (3, minicbor::to_vec(m)),
            Self::Endpoint(m) => (4, minicbor::to_vec(m)),
            Self::EndpointGone(m) => (5, minicbor::to_vec(m)),
            Self::Graph(m) => (6, minicbor::to_vec(m)),
            Self::Match(m) => (7, minicbor::to_vec(m)),
            Self::Attach(m) => (8, minicbor::to_vec(m)),
            Self::Grant(m) => (9, minicbor::to_vec(m)),
            Self::Detach(m) => (10, minicbor::to_vec(m)),
            Self::Unmatch(m) => (11, minicbor::to_vec(m)),
            Self::StatusRequest => (12, minicbor::to_vec(Empty {})),
            Self::Status(m) => (13, minicbor::to_vec(m)),
            Self::Resync => (14, minicbor::to_vec(Empty {})),
            Self::Segment(m) => (15, minicbor::to_vec(m)),
            Self::SegmentGone(m) => (16, minicbor::to_vec(m)),
            Self::Need(m) => (17, minicbor::to_vec(m)),
            Self::Unknown(kind) => (*kind, minicbor::to_vec(Empty {})),
        };
        // Encoding into a Vec has no way to fail.
        let body = body.unwrap_or_default();
        if body.len() + 1 > MAX_PACKET {
            return Err(CodecError::TooLarge(body.len() + 1));
        }
        let mut packet = Vec::with_capacity(body.len() + 1);
        packet.push(kind);
        packet.extend_from_slice(&body);
        Ok(packet)
    }

    /// Whether a packet is part of a status.
    pub(crate) fn is_status(packet: &[u8]) -> bool {
        packet.first() == Some(&13)
    }

    /// The message of one packet.
    ///
    /// # Errors
    /// When it is empty, too large, or not the map its type calls for.
    pub fn decode(packet: &[u8]) -> Result<Self, CodecError> {
        if packet.len() > MAX_PACKET {
            return Err(CodecError::TooLarge(packet.len()));
        }
        let (&kind, body) = packet.split_first().ok_or(CodecError::Empty)?;
        Ok(match kind {
            1 => Self::Hello(map(kind, body)?),
            2 => Self::Welcome(map(kind, body)?),
            3 => Self::Refused(map(kind, body)?),
            4 => Self::Endpoint(map(kind, body)?),
            5 => Self::EndpointGone(map(kind, body)?),
            6 => Self::Graph(map(kind, body)?),
            7 => Self::Match(map(kind, body)?),
            8 => Self::Attach(map(kind, body)?),
            9 => Self::Grant(map(kind, body)?),
            10 => Self::Detach(map(kind, body)?),
            11 => Self::Unmatch(map(kind, body)?),
            12 => map::<Empty>(kind, body).map(|_| Self::StatusRequest)?,
            13 => Self::Status(map(kind, body)?),
            14 => map::<Empty>(kind, body).map(|_| Self::Resync)?,
            15 => Self::Segment(map(kind, body)?),
            16 => Self::SegmentGone(map(kind, body)?),
            17 => Self::Need(map(kind, body)?),
            _ => Self::Unknown(kind),
        })
    }
}

fn map<'b, T: Decode<'b, ()>>(kind: u8, body: &'b [u8]) -> Result<T, CodecError> {
    let mut decoder = minicbor::Decoder::new(body);
    let value = decoder.decode().map_err(|source| CodecError::Malformed { kind, source })?;
    if decoder.position() == body.len() { Ok(value) } else { Err(CodecError::Trailing(kind)) }
}

/// Whether an endpoint of this kind owns a ring that readers map.
pub(crate) fn writes(kind: EndpointKind) -> bool {
    matches!(kind, EndpointKind::Publisher)
}

/// Whether an endpoint of this kind attaches to rings.
pub(crate) fn reads(kind: EndpointKind) -> bool {
    matches!(kind, EndpointKind::Subscription)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn endpoint() -> Endpoint {
        Endpoint {
            gid: Gid([7; 16]),
            kind: EndpointKind::Publisher,
            topic: "/scan".into(),
            type_name: "sensor_msgs/msg/LaserScan".into(),
            type_hash: vec![1, 2, 3],
            qos: Qos::keep_all(),
            node: "lidar".into(),
            namespace: "/".into(),
            enclave: String::new(),
        }
    }

    fn messages() -> Vec<Message> {
        let (reader, writer) = (Gid([1; 16]), Gid([2; 16]));
        let session = SessionId([3; 16]);
        vec![
            Message::Hello(Hello {
                protocol: PROTOCOL,
                session,
                role: SessionRole::Application,
                name: "talker".into(),
                domain: 7,
                settings: vec![("AXON_SECURITY_MODE".into(), "classic".into())],
            }),
            Message::Welcome(Welcome { protocol: 1, daemon: DaemonId([4; 16]), pid: 12 }),
            Message::Refused(Refused {
                variable: "AXON_QUIC_CIPHER".into(),
                ours: "a".into(),
                theirs: "b".into(),
                text: String::new(),
            }),
            Message::Endpoint(Announce {
                endpoint: endpoint(),
                role: EndpointRole::Relay,
                stands_for: vec![reader, writer],
                ring: Some(Location { segment: 0, offset: 4096 }),
            }),
            Message::EndpointGone(Gone { gid: reader }),
            Message::Graph(Graph {
                version: 3,
                whole: true,
                added: vec![GraphItem { endpoint: endpoint(), daemon: Some(DaemonId([9; 16])) }],
                removed: vec![writer],
                more: false,
                ended: Some(vec![Gid([8; 16])]),
            }),
            Message::Match(Pair { reader, writer }),
            Message::Attach(Attach {
                reader,
                writer,
                lane: Location { segment: 3, offset: 1 << 33 },
                qos: Qos::default(),
                session,
                stands_for: vec![],
                segments: vec![Segment { number: 3, publisher: None }],
            }),
            Message::Grant(Granted {
                reader,
                writer,
                generation: 5,
                first: 6,
                session,
                ring: Location { segment: 0, offset: 4096 },
                segments: vec![Segment { number: 7, publisher: Some(writer) }],
            }),
            Message::Detach(Pair { reader, writer }),
            Message::Unmatch(Unmatch { reader, writer, reason: "gone".into() }),
            Message::StatusRequest,
            Message::Status(StatusPart { part: 0, parts: 1, text: b"{}".to_vec() }),
            Message::Resync,
            Message::Segment(SegmentOpened {
                session,
                segment: Segment { number: 9, publisher: Some(writer) },
            }),
            Message::SegmentGone(SegmentName { session, number: 9 }),
            Message::Need(SegmentName { session, number: 9 }),
        ]
    }

    #[test]
    fn hostile_packets_are_errors() {
        assert!(matches!(Message::decode(&[]), Err(CodecError::Empty)));
        assert!(matches!(
            Message::decode(&vec![0; MAX_PACKET + 1]),
            Err(CodecError::TooLarge(n)) if n == MAX_PACKET + 1
        ));
        assert!(matches!(Message::decode(&[7]), Err(CodecError::Malformed { kind: 7, .. })));
        // A map without a needed key.
        assert!(matches!(Message::decode(&[5, 0xa0]), Err(CodecError::Malformed { .. })));
        // An array that claims 2^32 elements allocates nothing.
        assert!(Message::decode(&[6, 0xa1, 3, 0x9a, 0xff, 0xff, 0xff, 0xff]).is_err());
        for message in messages() {
            let mut packet = message.encode().unwrap();
            packet.push(0);
            assert!(Message::decode(&packet).is_err(), "{message:?} with a byte after it");
            for cut in 1..packet.len() - 1 {
                assert!(Message::decode(&packet[..cut]).is_err(), "{message:?} cut at {cut}");
            }
        }
    }

    #[test]
    fn unknown_types_and_keys_are_skipped() {
        assert_eq!(Message::decode(&[200, 1, 2, 3]).unwrap(), Message::Unknown(200));
        // { 0: pid, 1: .., 99: [1, {2: 3}] } for WELCOME with one key more.
        let mut packet = vec![2];
        let mut e = minicbor::Encoder::new(&mut packet);
        e.map(4).unwrap();
        e.u8(0).unwrap().u8(1).unwrap();
        e.u8(99).unwrap().array(2).unwrap().u8(1).unwrap();
        e.map(1).unwrap().u8(2).unwrap().u8(3).unwrap();
        e.u8(1).unwrap().bytes(&[4; 16]).unwrap();
        e.u8(2).unwrap().u8(12).unwrap();
        let welcome = Welcome { protocol: 1, daemon: DaemonId([4; 16]), pid: 12 };
        assert_eq!(Message::decode(&packet).unwrap(), Message::Welcome(welcome));
    }

    #[test]
    fn messages_survive_the_wire() {
        for message in messages() {
            let packet = message.encode().unwrap();
            assert_eq!(Message::decode(&packet).unwrap(), message);
        }
    }

    #[test]
    fn a_message_larger_than_a_packet_is_refused_by_its_sender() {
        let removed = vec![Gid([1; 16]); 3000];
        let graph =
            Graph { version: 1, whole: false, added: vec![], removed, more: false, ended: None };
        assert!(matches!(Message::Graph(graph).encode(), Err(CodecError::TooLarge(_))));
    }

    proptest! {
        #[test]
        fn no_packet_panics(packet in proptest::collection::vec(any::<u8>(), 0..512)) {
            let _ = Message::decode(&packet);
        }

        #[test]
        fn no_mutated_packet_panics(
            which in 0usize..17, at in any::<prop::sample::Index>(), byte: u8,
        ) {
            let mut packet = messages()[which].encode().unwrap();
            let at = at.index(packet.len());
            packet[at] = byte;
            let _ = Message::decode(&packet);
        }
    }
}
