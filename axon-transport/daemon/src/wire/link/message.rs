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

/// The identity and the settings of a daemon: the first message in each direction.
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
    /// True if the sender lists the receiver as a static peer.
    #[n(17)]
    pub static_peer: bool,
    /// Most routes that the sender serves a peer; absent: 1,024.
    #[n(18)]
    pub routes: Option<u32>,
    /// The proof of the sender's id for this connection. Earlier versions send none.
    #[n(19)]
    pub proof: Option<DaemonProof>,
    /// Maximum number of links with one peer at a time that the sender supports; absent: 1.
    #[n(20)]
    pub paths: Option<u8>,
    /// The link in use beside which this connection stands by, over another path.
    #[cbor(n(21), with = "minicbor::bytes")]
    pub beside: Option<[u8; 16]>,
}

/// The connection that the daemon with the lower id keeps.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Encode, Decode)]
#[cbor(map)]
pub struct Elected {
    /// The name of the link, for a successor's HELLO.
    #[cbor(n(0), with = "minicbor::bytes")]
    pub link: [u8; 16],
    /// Larger than that of any link elected before it: of messages on two connections, the first that was sent may be
    /// read last.
    #[n(1)]
    pub election: u64,
    /// True if the connection stands by: the link in use stays in use. A second ELECTED on the connection, without this
    /// key, puts it in use.
    #[n(2)]
    pub standby: Option<bool>,
}

/// The sender has closed a superseded link that was silent, and sends nothing over it any more.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Encode, Decode)]
#[cbor(map)]
pub struct LinkClosed {
    /// The name of the link in ELECTED.
    #[cbor(n(0), with = "minicbor::bytes")]
    pub link: [u8; 16],
}

/// The changes of the sender's graph.
#[derive(Clone, Debug, Default, PartialEq, Eq, Encode, Decode)]
#[cbor(map)]
pub struct GraphUpdate {
    /// Version after this message.
    #[n(0)]
    pub version: u64,
    /// Version that it builds on; 0 for a whole graph.
    #[n(1)]
    pub before: u64,
    /// New or changed endpoints.
    #[n(2)]
    pub added: Vec<Endpoint>,
    /// Removed endpoints.
    #[n(3)]
    pub removed: Vec<Gid>,
    /// True if the next GRAPH continues this one: a whole graph counts once all of it has arrived.
    #[n(4)]
    pub more: bool,
    /// Endpoints of `added` whose session's range is LOCALHOST; the range of the others is SUBNET.
    #[n(5)]
    pub localhost: Option<Vec<Gid>>,
    /// Endpoints of `added` whose session lists the receiver's host as a static peer.
    #[n(6)]
    pub listing: Option<Vec<Gid>>,
    /// Endpoints of `added` that the receiver may see and not use: access rules of the sender deny it the other end.
    #[n(7)]
    pub denied: Option<Vec<Gid>>,
}

/// A request for the whole graph by a receiver of GRAPH that missed a version.
#[derive(Clone, Debug, PartialEq, Eq, Encode, Decode)]
#[cbor(map)]
pub struct GraphResync {
    /// The version that the receiver holds.
    #[n(0)]
    pub version: u64,
}

/// One subscription on the asking side of a route.
#[derive(Clone, Debug, PartialEq, Eq, Encode, Decode)]
#[cbor(map)]
pub struct RouteSubscriber {
    /// The subscription's GID.
    #[n(0)]
    pub gid: Gid,
    /// The requested QoS.
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
    /// The sample's sequence number.
    #[n(1)]
    pub sequence: u64,
}

/// A request for a topic's samples. The asking side repeats it with the same route to change its subscriptions.
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
    /// The samples after which the route resumes.
    #[n(5)]
    pub last: Vec<LastSeen>,
    /// True if the asking side acknowledges received samples with RECEIVED.
    #[n(6)]
    pub acknowledges: Option<bool>,
    /// True if the asking side reads short headers.
    #[n(7)]
    pub short_headers: Option<bool>,
}

impl Subscribe {
    /// Returns the bytes that it counts towards memory limits.
    pub fn bytes(&self) -> usize {
        let Self { topic, type_name, subscribers, last, .. } = self;
        topic.len() + type_name.len() + size_of_val(&**subscribers) + size_of_val(&**last)
    }
}

/// A request to end a route.
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
    /// The publishers' GIDs.
    #[n(1)]
    pub publishers: Vec<Gid>,
}

/// Publishers of the sender's host that were alive since the last such message, whether or not they published. Only
/// publishers that have a lease and feed a route are listed.
#[derive(Clone, Debug, PartialEq, Eq, Encode, Decode)]
#[cbor(map)]
pub struct LivelinessAsserted {
    /// The publishers' GIDs.
    #[n(0)]
    pub publishers: Vec<Gid>,
}

/// The progress of publishers' samples, as the receiver reports it.
#[derive(Clone, Debug, Default, PartialEq, Eq, Encode, Decode)]
#[cbor(map)]
pub struct ReceivedUpTo {
    /// One element per publisher and route.
    #[n(0)]
    pub flows: Vec<ReceivedOf>,
}

/// The progress of one publisher's reliable samples over one route.
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
    /// The number of samples among them that the receiver had to drop since its last report.
    #[n(3)]
    pub dropped: u64,
}

/// A route that is not served, although it was requested.
#[derive(Clone, Debug, PartialEq, Eq, Encode, Decode)]
#[cbor(map)]
pub struct RouteRefused {
    /// The asking side's number for the route.
    #[n(0)]
    pub route: u32,
    /// The reason, for people.
    #[n(1)]
    pub reason: String,
    /// Seconds after which the route may be requested again; absent: a request is useless until something changes.
    #[n(2)]
    pub retry_s: Option<u32>,
}

/// A route that both graphs require and that the sender does not ask for, or not for all of its publishers.
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
    /// The reason, for people; absent: the sender asks for all of the route after all, or has no use for it.
    #[n(3)]
    pub reason: Option<String>,
}

/// The limits of the bytes that the sender of this message accepts over this link at a time.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Encode, Decode)]
#[cbor(map)]
pub struct ReceiveLimits {
    /// Bytes that it has not read: the connection's window.
    #[n(0)]
    pub unread: u64,
    /// Bytes of messages longer than 32 KiB that are incomplete or wait for a reader.
    #[n(1)]
    pub messages: u64,
}

/// Uses that the sender's host denies the receiver, as far as the sender knows them from the receiver's graph.
#[derive(Clone, Debug, Default, PartialEq, Eq, Encode, Decode)]
#[cbor(map)]
pub struct DeniedUses {
    /// Uses that are denied now.
    #[n(0)]
    pub denied: Vec<DeniedUse>,
    /// Uses that are no longer denied, or that no endpoint of the receiver makes any more. The reasons are empty.
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
    /// The rule that decides, for people.
    #[n(2)]
    pub reason: String,
}

/// Most uses in one message.
pub const MAX_DENIED: usize = 512;

/// A question about the uses that access rules at the receiver's host permit to the sender.
#[derive(Clone, Debug, Default, PartialEq, Eq, Encode, Decode)]
#[cbor(map)]
pub struct LinkAccessCheck {
    /// The sender's number for the question.
    #[n(0)]
    pub number: u64,
    /// The uses in question.
    #[n(1)]
    pub uses: Vec<CheckedUse>,
}

/// The answer to a [`LinkAccessCheck`].
#[derive(Clone, Debug, Default, PartialEq, Eq, Encode, Decode)]
#[cbor(map)]
pub struct AccessDecisions {
    /// The number of the question.
    #[n(0)]
    pub number: u64,
    /// One decision for each use, in the order of the question.
    #[n(1)]
    pub decisions: Vec<UseDecision>,
}

/// The decision of access rules about one use.
#[derive(Clone, Debug, PartialEq, Eq, Encode, Decode)]
#[cbor(array)]
pub struct UseDecision {
    /// True if the rules allow the use.
    #[n(0)]
    pub allowed: bool,
    /// The rule that decides, for people.
    #[n(1)]
    pub reason: String,
}

/// Proofs that sessions belong to the sender. Sent before GRAPH, once on each connection.
#[derive(Clone, Debug, PartialEq, Eq, Encode, Decode)]
#[cbor(map)]
pub struct Owners {
    /// One proof for each session.
    #[n(0)]
    pub proofs: Vec<Proof>,
}

/// Most proofs in one message.
pub const MAX_PROOFS: usize = 128;

/// The empty content of KEEPALIVE.
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
    /// The identity and the settings of the sender.
    Hello(LinkHello),
    /// The election of this connection.
    Elected(Elected),
    /// Graph changes.
    Graph(GraphUpdate),
    /// A request for the whole graph.
    GraphResync(GraphResync),
    /// A request for a topic.
    Subscribe(Subscribe),
    /// A request to end a route.
    Unsubscribe(Unsubscribe),
    /// The publishers of a route that are attached.
    RouteReady(RouteReady),
    /// A sign of life.
    Keepalive,
    /// Publishers that were alive.
    Asserted(LivelinessAsserted),
    /// The progress of received samples.
    Received(ReceivedUpTo),
    /// A route that is not served.
    RouteRefused(RouteRefused),
    /// A route that the sender does not ask for.
    RouteUnasked(RouteUnasked),
    /// Proofs that sessions belong to the sender.
    Owners(Owners),
    /// The end of a silent link that this link succeeds.
    LinkClosed(LinkClosed),
    /// The limits of the bytes that the sender accepts at a time.
    ReceiveLimits(ReceiveLimits),
    /// Uses that the sender's access rules deny to the receiver.
    Denied(DeniedUses),
    /// A question whether the receiver's access rules allow uses.
    AccessCheck(LinkAccessCheck),
    /// The answer to ACCESS_CHECK.
    AccessDecisions(AccessDecisions),
    /// A request to put the link that stands by in use: the link in use does not answer the sender.
    SwitchOver,
    /// A message about keys.
    Keys(KeyMessage),
}

impl LinkMessage {
    /// Returns the type byte and the CBOR map.
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
            Self::SwitchOver => (23, to_map(&NoContent {})),
            Self::Keys(m) => {
                let mut map = Vec::new();
                m.encode(&mut map);
                (m.frame_type(), map)
            }
        }
    }

    /// Returns whether [`decode`](Self::decode) knows this type.
    pub(super) fn is_known(kind: u8) -> bool {
        matches!(kind, 1..=23)
    }

    /// Decodes the message of type `kind`; returns `None` for an unknown type.
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
            23 => from_map::<NoContent>(kind, map).map(|_| Self::SwitchOver)?,
            _ => return Ok(None),
        };
        match message.bounds() {
            Ok(()) => Ok(Some(message)),
            Err(reason) => Err(FrameError::Malformed { kind, reason: reason.into() }),
        }
    }

    /// Checks the limits that the CBOR types alone do not set.
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
            | Self::SwitchOver
            | Self::LinkClosed(_) => Ok(()),
            // The decoder of key messages checks their limits.
            Self::Keys(_) => Ok(()),
        }
    }
}
