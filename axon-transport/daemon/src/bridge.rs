//! The messages between the control plane and the gateway.
//!
//! They run on threads and runtimes of their own and share nothing but these two bounded channels,
//! one session socket, and the table of the sessions' keys. Neither waits for the other: the control
//! plane drops an order that does not fit, and a gateway that fails is started again.

use std::{
    collections::BTreeSet,
    net::{IpAddr, SocketAddr},
    os::fd::OwnedFd,
    sync::Arc,
};

use axon_shm::ids::{DaemonId, Gid};
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

/// What either channel holds.
pub const CHANNEL: usize = 1024;

/// Stands in the status for topics whose losses are not kept apart: too many, or too long a name.
pub(crate) const OTHER_TOPICS: &str = "(other topics)";

/// What a gateway is started with.
#[derive(Debug)]
pub struct GatewayParts {
    /// The daemon's settings.
    pub config: Arc<Config>,
    /// The daemon.
    pub daemon: DaemonId,
    /// The key of which its id is made.
    pub daemon_key: Option<Arc<DaemonKey>>,
    /// The keys of the sessions, with which the gateway proves to peers that they are this daemon's.
    pub keys: Arc<SessionKeys>,
    /// One end of a socket pair, for [`Session::over`](axon_transport::Session::over).
    pub socket: OwnedFd,
    /// To the control plane.
    pub control: mpsc::Sender<ToControl>,
    /// From the control plane.
    pub orders: mpsc::Receiver<ToGateway>,
}

/// A route that does not cross, though endpoints of this host and the peer's match.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RefusedRoute {
    /// Its topic or service.
    pub topic: String,
    /// Its type; `None`: any.
    pub type_name: Option<String>,
    /// The endpoints of this host that wait for it.
    pub waits: EndpointKind,
    /// Who refuses it, and why.
    pub reason: String,
}

/// What is known of somebody who is refused. Each kind has a rate limit of its own in the log, and a share of the
/// refusals that status shows, so that a flood of one kind hides no other.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RefusalKind {
    /// A beacon says so, and anybody can send one.
    Beacon,
    /// It has not proved who it is, or was dialled at an address that discovery found.
    Unproven,
    /// It is at the address of a static peer.
    Listed,
    /// It proved who it is.
    Peer,
    /// It is a session, or an endpoint, of this host.
    Local,
}

/// The settings on what crosses between hosts that may change while the gateway runs.
#[derive(Clone, Debug)]
#[non_exhaustive]
pub struct TrafficRules {
    /// The access rules.
    pub access: AccessRules,
    /// `[[topic]]` of the file.
    pub topics: Vec<TopicRule>,
}

impl TrafficRules {
    /// Those of a configuration.
    pub fn of(config: &Config) -> Self {
        Self { access: config.access.clone(), topics: config.topics.clone() }
    }
}

/// From the gateway to the control plane.
#[derive(Debug)]
pub enum ToControl {
    /// The gateway stands; its QUIC socket has this port. Sent once, before anything else.
    Started {
        /// The UDP port.
        port: u16,
    },
    /// A peer's endpoints changed.
    RemoteGraph {
        /// The peer.
        daemon: DaemonId,
        /// Forget what it had.
        reset: bool,
        /// Endpoints that are new.
        added: Vec<RemoteEndpoint>,
        /// Endpoints that are gone.
        removed: Vec<Gid>,
    },
    /// A dial, ours or the peer's, became a link.
    LinkUp {
        /// The peer.
        daemon: DaemonId,
        /// Where it is.
        address: SocketAddr,
        /// Whether it proved that the id is its own.
        proven: bool,
    },
    /// How a link does, and routes that do not cross it: at its start and from time to time. Replaces what was known of
    /// the peer.
    Link(Box<LinkStatus>, Vec<RefusedRoute>),
    /// Whether the path of a link carries anything. While it does not, the peer is looked for at its other addresses. A
    /// successor's path works until this says otherwise.
    Path {
        /// The peer.
        daemon: DaemonId,
        /// Whether it does.
        works: bool,
    },
    /// A peer has been silent for so long that its endpoints are forgotten. Its link stands:
    /// [`RemoteGraph`](Self::RemoteGraph) brings them back, or the link goes down.
    Silent {
        /// The peer.
        daemon: DaemonId,
    },
    /// A link is over. The peer's endpoints are forgotten.
    LinkDown {
        /// The peer.
        daemon: DaemonId,
        /// Why.
        reason: String,
    },
    /// A dial that was ordered came to nothing. Why is said by [`ToControl::Refusal`].
    DialFailed {
        /// The peer.
        daemon: DaemonId,
        /// Why it may be there, as the order said it.
        standing: AddressConfidence,
    },
    /// Discovery datagrams that arrived at the QUIC port.
    Datagrams(Datagrams),
    /// Somebody was refused, by this host or by the other.
    Refusal {
        /// What is known of the other.
        kind: RefusalKind,
        /// The other: a daemon id, SAE ID or address.
        peer: String,
        /// What was refused, such as `handshake` or the variable that differs.
        what: String,
        /// Why.
        reason: String,
    },
    /// Samples of a topic did not get to another host.
    Lost {
        /// The topic.
        topic: String,
        /// Why, as the status names it.
        cause: &'static str,
        /// How many.
        samples: u64,
    },
    /// Whether samples of publishers that ended are on their way to other hosts: the daemon does not
    /// end meanwhile.
    Draining(bool),
    /// The rules of the order with this number count: no pair is there that they deny.
    Rules(u64),
    /// A peer answered a question about its access rules.
    Decisions {
        /// The number of the question.
        number: u64,
        /// The peer's decisions. `None`: it is not linked.
        decisions: Option<Vec<PeerDecision>>,
    },
    /// What is to be shown of the key supply.
    Keys(serde_json::Value),
    /// What waited when the daemon was told to end has arrived, or does not get on: it may end.
    Finished,
}

/// From the control plane to the gateway.
#[derive(Debug)]
pub enum ToGateway {
    /// Connect to a peer. Answered by [`ToControl::LinkUp`] or [`ToControl::DialFailed`].
    Dial {
        /// The daemon expected there.
        daemon: DaemonId,
        /// Its SAE ID, in qkd.
        sae: Option<String>,
        /// Where it may be, best first.
        addresses: Vec<SocketAddr>,
        /// Whether this host lists it as a static peer.
        listed: bool,
        /// Why it may be there; the answer says it again.
        standing: AddressConfidence,
    },
    /// Send a discovery datagram from the QUIC port.
    SendDatagram {
        /// To whom.
        to: SocketAddr,
        /// What.
        bytes: Vec<u8>,
    },
    /// These rules count from now on. Answered by [`ToControl::Rules`] with this number.
    Rules(TrafficRules, u64),
    /// Ask a peer what its access rules let this host do. Answered by [`ToControl::Decisions`] once the peer answered.
    CheckAccess {
        /// The peer.
        daemon: DaemonId,
        /// A number for the question, used once.
        number: u64,
        /// What this host would do.
        uses: Vec<CheckedUse>,
    },
    /// These addresses are those of listed peers from now on.
    Listed(BTreeSet<IpAddr>),
    /// Say when what waits to be sent has arrived: the daemon is to end.
    Finish,
    /// Say goodbye to every peer and return.
    Shutdown,
}
