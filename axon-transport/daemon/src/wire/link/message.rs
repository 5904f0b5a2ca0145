//! The messages of the control stream.

use axon_shm::{
    ids::{DaemonId, Gid},
    qos::Qos,
};
use axon_transport::{
    graph::Endpoint,
    internal::{
        graph::LIMITS,
        wire::session::{CheckedUse, MOST_CHECKED},
    },
};
use minicbor::{Decode, Encode};

use super::frame::{FrameError, from_map, to_map};
use crate::{daemon_key::DaemonProof, owner::Proof, wire::keys::KeyMessage};

/// Who a daemon is and how it is set up: the first message in each direction.
#[derive(Clone, Debug, PartialEq, Eq, Encode, Decode)]
#[cbor(map)]
pub struct LinkHello {
    /// Lowest protocol version spoken.
    #[n(0)]
    pub protocol_min: u8,
    /// Highest protocol version spoken.
    #[n(1)]
    pub protocol_max: u8,
    /// ROS domain.
    #[n(2)]
    pub domain: u32,
    /// The sender.
    #[n(3)]
    pub daemon: DaemonId,
    /// Security mode: 0 classic, 1 qkd.
    #[n(4)]
    pub mode: u8,
    /// Key mode: 0 none, 1 session, 2 messages10.
    #[n(5)]
    pub key_mode: u8,
    /// Key exchange: 0 X25519MLKEM768, 1 psk_ke, 2 psk_dhe_ke.
    #[n(6)]
    pub kex: u8,
    /// Cipher: 0 chacha20-poly1305, 1 aes-256-gcm.
    #[n(7)]
    pub cipher: u8,
    /// SAE ID, in qkd.
    #[n(8)]
    pub sae: Option<String>,
    /// The host's name, for people.
    #[n(9)]
    pub host: String,
    /// Classic authentication: 0 none, 1 pinned, 2 ca; absent in qkd.
    #[n(12)]
    pub auth: Option<u8>,
    /// The link that this connection succeeds.
    #[cbor(n(15), with = "minicbor::bytes")]
    pub replaces: Option<[u8; 16]>,
    /// The daemon that the dialler means to reach.
    #[n(16)]
    pub expects: Option<DaemonId>,
    /// Whether the sender lists the receiver as a static peer.
    #[n(17)]
    pub static_peer: bool,
    /// Routes that the sender serves a peer at most. Absent: 1,024.
    #[n(18)]
    pub routes: Option<u32>,
    /// Proves the sender's id for this connection. Versions before say none.
    #[n(19)]
    pub proof: Option<DaemonProof>,
}

/// The connection that the lower daemon id keeps.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Encode, Decode)]
#[cbor(map)]
pub struct Elected {
    /// Names the link, for a successor's HELLO.
    #[cbor(n(0), with = "minicbor::bytes")]
    pub link: [u8; 16],
    /// Larger than that of any link elected before it: on two connections, what was said first may be
    /// read last.
    #[n(1)]
    pub election: u64,
}

/// The sender has closed a superseded link that was silent, and sends nothing over it any more.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Encode, Decode)]
#[cbor(map)]
pub struct LinkClosed {
    /// Its name in ELECTED.
    #[cbor(n(0), with = "minicbor::bytes")]
    pub link: [u8; 16],
}

/// What changed in the sender's graph.
#[derive(Clone, Debug, Default, PartialEq, Eq, Encode, Decode)]
#[cbor(map)]
pub struct GraphUpdate {
    /// Version after this message.
    #[n(0)]
    pub version: u64,
    /// Version that it builds on; 0 for a whole graph.
    #[n(1)]
    pub before: u64,
    /// Endpoints that came or changed.
    #[n(2)]
    pub added: Vec<Endpoint>,
    /// Endpoints that went.
    #[n(3)]
    pub removed: Vec<Gid>,
    /// Whether the next GRAPH goes on with it: a whole graph counts once all of it is there.
    #[n(4)]
    pub more: bool,
    /// Those of `added` whose session's range is LOCALHOST; the others' is SUBNET.
    #[n(5)]
    pub localhost: Option<Vec<Gid>>,
    /// Those of `added` whose session lists the receiver's host as a static peer.
    #[n(6)]
    pub listing: Option<Vec<Gid>>,
    /// Those of `added` that the receiver may see and not use: access rules of the sender deny it the other end.
    #[n(7)]
    pub denied: Option<Vec<Gid>>,
}

/// The receiver of GRAPH missed a version and asks for the whole.
#[derive(Clone, Debug, PartialEq, Eq, Encode, Decode)]
#[cbor(map)]
pub struct GraphResync {
    /// The version it holds.
    #[n(0)]
    pub version: u64,
}

/// One subscription on the asking side of a route.
#[derive(Clone, Debug, PartialEq, Eq, Encode, Decode)]
#[cbor(map)]
pub struct RouteSubscriber {
    /// Its GID.
    #[n(0)]
    pub gid: Gid,
    /// What it requests.
    #[n(1)]
    pub qos: Qos,
}

/// The newest sample of a publisher that the asking side has.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Encode, Decode)]
#[cbor(array)]
pub struct LastSeen {
    /// The publisher.
    #[n(0)]
    pub publisher: Gid,
    /// Its sequence number.
    #[n(1)]
    pub sequence: u64,
}

/// Asks for a topic's samples; again with the same route to change its subscriptions.
#[derive(Clone, Debug, PartialEq, Eq, Encode, Decode)]
#[cbor(map)]
pub struct Subscribe {
    /// The asking side's number for the route.
    #[n(0)]
    pub route: u32,
    /// Topic name.
    #[n(1)]
    pub topic: String,
    /// Type name.
    #[n(2)]
    pub type_name: String,
    /// 0 topic, 1 request, 2 response.
    #[n(3)]
    pub kind: u8,
    /// The subscriptions that the route serves.
    #[n(4)]
    pub subscribers: Vec<RouteSubscriber>,
    /// Where to resume.
    #[n(5)]
    pub last: Vec<LastSeen>,
    /// Whether the asking side acknowledges with RECEIVED what it gets.
    #[n(6)]
    pub acknowledges: Option<bool>,
    /// Whether the asking side reads short headers.
    #[n(7)]
    pub short_headers: Option<bool>,
}

impl Subscribe {
    /// Bytes that count for it where memory is bounded.
    pub fn bytes(&self) -> usize {
        let Self { topic, type_name, subscribers, last, .. } = self;
        topic.len() + type_name.len() + size_of_val(&**subscribers) + size_of_val(&**last)
    }
}

/// Ends a route.
#[derive(Clone, Debug, PartialEq, Eq, Encode, Decode)]
#[cbor(map)]
pub struct Unsubscribe {
    /// The route.
    #[n(0)]
    pub route: u32,
}

/// The publishers that now feed a route.
#[derive(Clone, Debug, PartialEq, Eq, Encode, Decode)]
#[cbor(map)]
pub struct RouteReady {
    /// The route.
    #[n(0)]
    pub route: u32,
    /// Their GIDs.
    #[n(1)]
    pub publishers: Vec<Gid>,
}

/// Publishers of the sender's host that were alive since it was said last, whether or not they
/// published: of those that have a lease and feed a route.
#[derive(Clone, Debug, PartialEq, Eq, Encode, Decode)]
#[cbor(map)]
pub struct LivelinessAsserted {
    /// Their GIDs.
    #[n(0)]
    pub publishers: Vec<Gid>,
}

/// How far the samples of publishers came: a message of one.
#[derive(Clone, Debug, Default, PartialEq, Eq, Encode, Decode)]
#[cbor(map)]
pub struct ReceivedUpTo {
    /// One element a publisher and route.
    #[n(0)]
    pub flows: Vec<ReceivedOf>,
}

/// How far the reliable samples of one publisher came over one route.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Encode, Decode)]
#[cbor(array)]
pub struct ReceivedOf {
    /// The receiver's number for the route.
    #[n(0)]
    pub route: u32,
    /// The publisher.
    #[n(1)]
    pub publisher: Gid,
    /// Samples up to this number are in the ring from which subscriptions take.
    #[n(2)]
    pub sequence: u64,
    /// But for so many, since it was said last, that the receiver had to drop.
    #[n(3)]
    pub dropped: u64,
}

/// A route is not served, though it was asked for.
#[derive(Clone, Debug, PartialEq, Eq, Encode, Decode)]
#[cbor(map)]
pub struct RouteRefused {
    /// The asking side's number for the route.
    #[n(0)]
    pub route: u32,
    /// Why, for people.
    #[n(1)]
    pub reason: String,
    /// Seconds after which the route may be asked for again; absent: as long as nothing changes there
    /// is no use.
    #[n(2)]
    pub retry_s: Option<u32>,
}

/// The sender does not ask for a route that both graphs call for, or for some of its publishers.
#[derive(Clone, Debug, PartialEq, Eq, Encode, Decode)]
#[cbor(map)]
pub struct RouteUnasked {
    /// Topic name.
    #[n(0)]
    pub topic: String,
    /// Type name.
    #[n(1)]
    pub type_name: String,
    /// 0 topic, 1 request, 2 response.
    #[n(2)]
    pub kind: u8,
    /// Why, for people; absent: it asks for all after all, or has no use for it.
    #[n(3)]
    pub reason: Option<String>,
}

/// What the sender of this message takes in over this link at a time.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Encode, Decode)]
#[cbor(map)]
pub struct ReceiveLimits {
    /// Bytes that it has not read: the connection's window.
    #[n(0)]
    pub unread: u64,
    /// Bytes of messages longer than 32 KiB that have not come whole or wait for a reader.
    #[n(1)]
    pub messages: u64,
}

/// What the receiver may not do at the sender's host, of what the sender knows from the receiver's graph.
#[derive(Clone, Debug, Default, PartialEq, Eq, Encode, Decode)]
#[cbor(map)]
pub struct DeniedUses {
    /// What is denied now.
    #[n(0)]
    pub denied: Vec<DeniedUse>,
    /// What was denied and is not any more, or is of no endpoint of the receiver any more. The reasons are empty.
    #[n(1)]
    pub lifted: Vec<DeniedUse>,
}

/// One use of a topic or service that an access rule denies.
#[derive(Clone, Debug, PartialEq, Eq, Encode, Decode)]
#[cbor(array)]
pub struct DeniedUse {
    /// 0 publish, 1 subscribe, 2 serve, 3 call.
    #[n(0)]
    pub verb: u8,
    /// Topic or service.
    #[n(1)]
    pub name: String,
    /// Which rule decides, for people.
    #[n(2)]
    pub reason: String,
}

/// Uses in one message, at most.
pub const MAX_DENIED: usize = 512;

/// The sender asks what access rules at the receiver's host let it do there.
#[derive(Clone, Debug, Default, PartialEq, Eq, Encode, Decode)]
#[cbor(map)]
pub struct LinkAccessCheck {
    /// The sender's number for the question.
    #[n(0)]
    pub number: u64,
    /// What it would do.
    #[n(1)]
    pub uses: Vec<CheckedUse>,
}

/// Answers a [`LinkAccessCheck`].
#[derive(Clone, Debug, Default, PartialEq, Eq, Encode, Decode)]
#[cbor(map)]
pub struct AccessDecisions {
    /// The number of the question.
    #[n(0)]
    pub number: u64,
    /// One for each use, in the order of the question.
    #[n(1)]
    pub decisions: Vec<UseDecision>,
}

/// What access rules say of one use.
#[derive(Clone, Debug, PartialEq, Eq, Encode, Decode)]
#[cbor(array)]
pub struct UseDecision {
    /// Whether they allow it.
    #[n(0)]
    pub allowed: bool,
    /// Which rule decides, for people.
    #[n(1)]
    pub reason: String,
}

/// That sessions are the sender's. Said before GRAPH, once on each connection.
#[derive(Clone, Debug, PartialEq, Eq, Encode, Decode)]
#[cbor(map)]
pub struct Owners {
    /// One for each session.
    #[n(0)]
    pub proofs: Vec<Proof>,
}

/// Proofs in one message.
pub const MAX_PROOFS: usize = 128;

/// KEEPALIVE carries nothing.
#[derive(Clone, Debug, PartialEq, Eq, Encode, Decode)]
#[cbor(map)]
struct NoContent {}

const MAX_HOST: usize = 255;
const MAX_SAE: usize = 63;
const MAX_REASON: usize = 1024;

/// A control message.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum LinkMessage {
    /// Who I am.
    Hello(LinkHello),
    /// This connection stays.
    Elected(Elected),
    /// Graph changes.
    Graph(GraphUpdate),
    /// Send the whole graph.
    GraphResync(GraphResync),
    /// Send a topic.
    Subscribe(Subscribe),
    /// Stop sending it.
    Unsubscribe(Unsubscribe),
    /// The topic's publishers are attached.
    RouteReady(RouteReady),
    /// Still here.
    Keepalive,
    /// These publishers, too.
    Asserted(LivelinessAsserted),
    /// So far samples came.
    Received(ReceivedUpTo),
    /// This route is not served.
    RouteRefused(RouteRefused),
    /// This route is not asked for.
    RouteUnasked(RouteUnasked),
    /// These sessions are mine.
    Owners(Owners),
    /// A silent link that this one succeeds is closed.
    LinkClosed(LinkClosed),
    /// How much the sender takes in at a time.
    ReceiveLimits(ReceiveLimits),
    /// Uses that the sender's access rules deny to the receiver.
    Denied(DeniedUses),
    /// Asks whether the receiver's access rules allow uses.
    AccessCheck(LinkAccessCheck),
    /// Answers ACCESS_CHECK.
    AccessDecisions(AccessDecisions),
    /// About keys.
    Keys(KeyMessage),
}

impl LinkMessage {
    /// Type byte and CBOR map.
    pub(super) fn encode(&self) -> (u8, Vec<u8>) {
        match self {
            Self::Hello(m) => (1, to_map(m)),
            Self::Elected(m) => (2, to_map(m)),
            Self::Graph(m) => (3, to_map(m)),
            Self::GraphResync(m) => (4, to_map(m)),
            Self::Subscribe(m) => (5, to_map(m)),
            Self::Unsubscribe(m) => (6, to_map(m)),
            Self::RouteReady(m) => (7, to_map(m)),
            Self::Keepalive => (8, to_map(&NoContent {})),
            Self::Asserted(m) => (9, to_map(m)),
            Self::Received(m) => (10, to_map(m)),
            Self::RouteRefused(m) => (11, to_map(m)),
            Self::Owners(m) => (12, to_map(m)),
            Self::LinkClosed(m) => (13, to_map(m)),
            Self::RouteUnasked(m) => (14, to_map(m)),
            Self::ReceiveLimits(m) => (15, to_map(m)),
            Self::Denied(m) => (20, to_map(m)),
            Self::AccessCheck(m) => (21, to_map(m)),
            Self::AccessDecisions(m) => (22, to_map(m)),
            Self::Keys(m) => {
                let mut map = Vec::new();
                m.encode(&mut map);
                (m.frame_type(), map)
            }
        }
    }

    /// Whether [`decode`](Self::decode) knows this type.
    pub(super) fn is_known(kind: u8) -> bool {
        matches!(kind, 1..=22)
    }

    /// The message of type `kind`, `None` for an unknown type.
    pub(super) fn decode(kind: u8, map: &[u8]) -> Result<Option<Self>, FrameError> {
        let message = match kind {
            1 => Self::Hello(from_map(kind, map)?),
            2 => Self::Elected(from_map(kind, map)?),
            3 => Self::Graph(from_map(kind, map)?),
            4 => Self::GraphResync(from_map(kind, map)?),
            5 => Self::Subscribe(from_map(kind, map)?),
            6 => Self::Unsubscribe(from_map(kind, map)?),
            7 => Self::RouteReady(from_map(kind, map)?),
            8 => from_map::<NoContent>(kind, map).map(|_| Self::Keepalive)?,
            9 => Self::Asserted(from_map(kind, map)?),
            10 => Self::Received(from_map(kind, map)?),
            11 => Self::RouteRefused(from_map(kind, map)?),
            12 => Self::Owners(from_map(kind, map)?),
            13 => Self::LinkClosed(from_map(kind, map)?),
            14 => Self::RouteUnasked(from_map(kind, map)?),
            15 => Self::ReceiveLimits(from_map(kind, map)?),
            16..=19 => Self::Keys(
                KeyMessage::decode(kind, map)
                    .map_err(|e| FrameError::Malformed { kind, reason: e.to_string() })?,
            ),
            20 => Self::Denied(from_map(kind, map)?),
            21 => Self::AccessCheck(from_map(kind, map)?),
            22 => Self::AccessDecisions(from_map(kind, map)?),
            _ => return Ok(None),
        };
        match message.bounds() {
            Ok(()) => Ok(Some(message)),
            Err(reason) => Err(FrameError::Malformed { kind, reason: reason.into() }),
        }
    }

    /// What the CBOR types alone do not bound.
    fn bounds(&self) -> Result<(), &'static str> {
        let ok = |condition: bool, reason| if condition { Ok(()) } else { Err(reason) };
        match self {
            Self::Hello(m) => ok(
                m.host.len() <= MAX_HOST && m.sae.as_ref().is_none_or(|s| s.len() <= MAX_SAE),
                "a name is too long",
            ),
            Self::Graph(m) => ok(
                m.added.len() <= LIMITS.endpoints
                    && m.removed.len() <= LIMITS.endpoints
                    && [&m.localhost, &m.listing, &m.denied]
                        .iter()
                        .all(|gids| gids.as_ref().is_none_or(|gids| gids.len() <= m.added.len()))
                    && m.added.iter().all(Endpoint::is_sane),
                "an endpoint is out of bounds",
            ),
            Self::Asserted(LivelinessAsserted { publishers })
            | Self::RouteReady(RouteReady { publishers, .. }) => {
                ok(publishers.len() <= LIMITS.endpoints, "more publishers than there can be")
            }
            Self::Received(m) => {
                ok(m.flows.len() <= LIMITS.endpoints, "more publishers than there can be")
            }
            Self::RouteRefused(m) => ok(m.reason.len() <= MAX_REASON, "a reason is too long"),
            Self::RouteUnasked(m) => ok(
                m.topic.len() <= LIMITS.name
                    && m.type_name.len() <= LIMITS.name
                    && m.kind <= 2
                    && m.reason.as_ref().is_none_or(|reason| reason.len() <= MAX_REASON),
                "a route is out of bounds",
            ),
            Self::Denied(DeniedUses { denied, lifted }) => ok(
                denied.len() <= MAX_DENIED
                    && lifted.len() <= MAX_DENIED
                    && denied.iter().chain(lifted).all(|denied| {
                        denied.verb <= 3
                            && denied.name.len() <= LIMITS.name
                            && denied.reason.len() <= MAX_REASON
                    }),
                "a denied use is out of bounds",
            ),
            Self::AccessCheck(m) => ok(
                m.uses.len() <= MOST_CHECKED
                    && m.uses.iter().all(|used| used.verb <= 4 && used.name.len() <= LIMITS.name),
                "a use that is asked about is out of bounds",
            ),
            Self::AccessDecisions(m) => ok(
                m.decisions.len() <= MOST_CHECKED
                    && m.decisions.iter().all(|decision| decision.reason.len() <= MAX_REASON),
                "a decision is out of bounds",
            ),
            Self::Owners(m) => ok(m.proofs.len() <= MAX_PROOFS, "too many proofs"),
            Self::Subscribe(m) => ok(
                m.topic.len() <= LIMITS.name
                    && m.type_name.len() <= LIMITS.name
                    && m.kind <= 2
                    && m.subscribers.len() <= LIMITS.endpoints
                    && m.last.len() <= LIMITS.endpoints
                    && m.subscribers.iter().all(|s| s.qos.depth >= 1),
                "a route is out of bounds",
            ),
            Self::Elected(_)
            | Self::GraphResync(_)
            | Self::Unsubscribe(_)
            | Self::Keepalive
            | Self::ReceiveLimits(_)
            | Self::LinkClosed(_) => Ok(()),
            // Their decoder bounds them.
            Self::Keys(_) => Ok(()),
        }
    }
}
