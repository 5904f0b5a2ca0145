//! The messages between the control plane and the gateway.
//!
//! They run on threads and runtimes of their own. They share only these two bounded channels, one session socket, and
//! the table of the sessions' keys. Neither waits for the other: the control plane drops an order that does not fit,
//! and a failed gateway is started again.

use std::{
    collections::BTreeSet,
    net::{IpAddr, SocketAddr},
    os::fd::OwnedFd,
    sync::Arc,
};

use axon_shm::{
    ids::{DaemonId, Gid},
    internal::KnownPeers,
};
use axon_transport::{
    access::AccessRules,
    config::{Config, TopicRule},
    graph::EndpointKind,
    internal::{graph::RemoteEndpoint, wire::session::CheckedUse},
    status::{LinkStatus, PeerDecision},
};
use tokio::sync::mpsc;

use crate::{
    daemon_key::DaemonKey,
    discovery::{AddressConfidence, Datagrams},
    owner::SessionKeys,
};

/// Capacity of each channel, in messages.
pub const CHANNEL: usize = 1024;

/// Name in the status for topics whose losses are not counted separately, because they are too many or the name is too
/// long.
pub(crate) const OTHER_TOPICS: &str = "(other topics)";

/// The parts of a new gateway.
#[derive(Debug)]
pub struct GatewayParts {
    /// The daemon's settings.
    pub config: Arc<Config>,
    /// The daemon.
    pub daemon: DaemonId,
    /// The key from which the daemon's id is derived; `None` if the system could not make one, so the id is random.
    pub daemon_key: Option<Arc<DaemonKey>>,
    /// The keys of the sessions. With them the gateway proves to peers that the sessions belong to this daemon.
    pub keys: Arc<SessionKeys>,
    /// The descriptors of the sessions that the control plane holds.
    pub known_peers: Arc<KnownPeers>,
    /// The gateway's end of a socket pair, for [`Session::over`](axon_transport::Session::over).
    pub socket: OwnedFd,
    /// Sender to the control plane.
    pub control: mpsc::Sender<ToControl>,
    /// Receiver of the control plane's orders.
    pub orders: mpsc::Receiver<ToGateway>,
}

/// A route that either side refuses, wholly or in part, although endpoints of this host and of the peer match.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RefusedRoute {
    /// The topic or service.
    pub topic: String,
    /// The type; `None` for any type.
    pub type_name: Option<String>,
    /// The kind of this host's endpoints that wait for the route.
    pub waits: EndpointKind,
    /// The host that refuses the route, and the reason.
    pub reason: String,
}

/// The kind of a refused party: a peer, or a session or endpoint of this host. Each kind has its own rate limit in the
/// log and its own share of the refusals in the status, so a flood of one kind hides no other.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RefusalKind {
    /// Known from a beacon alone; any host can send a beacon.
    Beacon,
    /// A peer that did not prove its identity, or was dialled at an address that discovery found.
    Unproven,
    /// A peer at the address of a static peer.
    Listed,
    /// A peer that proved its identity.
    Peer,
    /// A session or an endpoint of this host.
    Local,
}

/// The settings for traffic between hosts that may change while the gateway runs.
#[derive(Clone, Debug)]
#[non_exhaustive]
pub struct TrafficRules {
    /// The access rules.
    pub access: AccessRules,
    /// The `[[topic]]` entries of the file.
    pub topics: Vec<TopicRule>,
}

impl TrafficRules {
    /// Returns the rules of a configuration.
    pub fn of(config: &Config) -> Self {
        Self { access: config.access.clone(), topics: config.topics.clone() }
    }
}

/// A message from the gateway to the control plane.
#[derive(Debug)]
pub enum ToControl {
    /// The gateway runs, and its QUIC socket has this port. Sent once, before any other message.
    Started {
        /// The UDP port.
        port: u16,
    },
    /// A peer's endpoints changed.
    RemoteGraph {
        /// The peer.
        daemon: DaemonId,
        /// True if the peer's earlier endpoints are to be forgotten.
        reset: bool,
        /// New endpoints.
        added: Vec<RemoteEndpoint>,
        /// Removed endpoints.
        removed: Vec<Gid>,
    },
    /// A dial by this host or by the peer became a link.
    LinkUp {
        /// The peer.
        daemon: DaemonId,
        /// The peer's address.
        address: SocketAddr,
        /// True if it proved that the id is its own.
        proven: bool,
    },
    /// The status of a link, and the routes that do not cross it. Sent at its start and from time to time. It replaces
    /// the earlier status of the peer.
    Link(Box<LinkStatus>, Vec<RefusedRoute>),
    /// A report about the path of a link. While it carries no packets, discovery looks for the peer at its other
    /// addresses. A successor's path counts as working until this message reports a failure.
    Path {
        /// The peer.
        daemon: DaemonId,
        /// True if the path carries packets.
        works: bool,
    },
    /// A peer has been silent for so long that its endpoints are forgotten. Its link stays up: either
    /// [`RemoteGraph`](Self::RemoteGraph) restores the endpoints, or the link goes down.
    Silent {
        /// The peer.
        daemon: DaemonId,
    },
    /// A link ended. The peer's endpoints are forgotten.
    LinkDown {
        /// The peer.
        daemon: DaemonId,
        /// The reason.
        reason: String,
    },
    /// An ordered dial failed. [`ToControl::Refusal`] states the reason.
    DialFailed {
        /// The peer.
        daemon: DaemonId,
        /// The confidence in the address, as the order stated it.
        standing: AddressConfidence,
        /// The address at which an authenticated peer answered that it is another daemon, or that it ends.
        absent_at: Option<SocketAddr>,
    },
    /// Discovery datagrams that arrived at the QUIC port.
    Datagrams(Datagrams),
    /// A peer or an endpoint was refused, by this host or by the other.
    Refusal {
        /// The kind of the refused party.
        kind: RefusalKind,
        /// The refused party: a daemon id, SAE ID or address.
        peer: String,
        /// The refused step or setting, such as `handshake` or the variable that differs.
        what: String,
        /// The reason.
        reason: String,
    },
    /// Samples of a topic did not reach another host.
    Lost {
        /// The topic.
        topic: String,
        /// The cause, as the status names it.
        cause: &'static str,
        /// The number of samples.
        samples: u64,
    },
    /// True while samples of ended publishers are on their way to other hosts. The daemon does not end meanwhile.
    Draining(bool),
    /// The gateway applied the rules of the order with this number: no pair that they deny remains.
    Rules(u64),
    /// A peer answered a question about its access rules.
    Decisions {
        /// The number of the question.
        number: u64,
        /// The peer's decisions; `None` if the peer is not linked.
        decisions: Option<Vec<PeerDecision>>,
    },
    /// The key supply's part of the status.
    Keys(serde_json::Value),
    /// After the order to end, the remaining samples arrived or make no progress: the daemon may end.
    Finished,
}

/// An order from the control plane to the gateway.
#[derive(Debug)]
pub enum ToGateway {
    /// Connect to a peer. Answered by [`ToControl::LinkUp`] or [`ToControl::DialFailed`].
    Dial {
        /// The daemon expected there.
        daemon: DaemonId,
        /// The daemon's SAE ID, in qkd.
        sae: Option<String>,
        /// Addresses where the peer may be, best first.
        addresses: Vec<SocketAddr>,
        /// True if this host lists it as a static peer.
        listed: bool,
        /// The confidence in the addresses; the answer repeats it.
        standing: AddressConfidence,
    },
    /// Sets the addresses at which discovery knows a linked peer, best first: the candidates for a second path. Any
    /// host can send the beacons that they are from.
    Addresses {
        /// The peer.
        daemon: DaemonId,
        /// At most eight addresses.
        addresses: Vec<SocketAddr>,
    },
    /// Send a discovery datagram from the QUIC port.
    SendDatagram {
        /// The receiver's address.
        to: SocketAddr,
        /// The datagram.
        bytes: Vec<u8>,
    },
    /// Applies these rules from now on. Answered by [`ToControl::Rules`] with this number.
    Rules(TrafficRules, u64),
    /// Ask a peer which uses its access rules permit to this host. Answered by [`ToControl::Decisions`] once the peer
    /// answered.
    CheckAccess {
        /// The peer.
        daemon: DaemonId,
        /// The number of the question, used once.
        number: u64,
        /// The uses that this host would make.
        uses: Vec<CheckedUse>,
    },
    /// Sets the addresses of listed peers.
    Listed(BTreeSet<IpAddr>),
    /// Report when the waiting samples have arrived: the daemon is to end.
    Finish,
    /// Say goodbye to every peer, then return.
    Shutdown,
}
