//! One link: a connection with the state that it has as a link.

pub(super) mod age;
pub(super) mod hand_over;
pub(super) mod take_over;
pub(super) mod view;

use std::{
    rc::Rc,
    sync::Arc,
    time::{Duration, SystemTime},
};

use axon_shm::ids::DaemonId;
use axon_tls::Negotiated;
use axon_transport::status::LinkStatus;
use rustls_pki_types::CertificateDer;

use self::{age::Age, hand_over::DrainingLink, take_over::TakeOver};
use super::identity::PeerIdentity;
use crate::{
    engine::{
        account::{Account, Charge},
        link::opening::{Opening, Sealing},
        links::{admission::HandshakeSlot, silence::LinkSilence},
    },
    keys::Resolver,
    link::{Candidate, Elected, LinkHello, MessageOrder, Side},
};

/// The phase of a link.
pub(super) enum LinkPhase {
    /// The TLS handshake is under way, until this time; on the dialling side, for the dial of this number.
    Handshake(Duration, Option<u64>),
    /// HELLO, and in qkd the proof.
    Opening(Box<Opening>),
    /// It waits for its election, until this time.
    Electing(Duration),
    /// It stands by beside the link in use, over another path, and carries copies alone.
    Standby,
    /// It carries samples.
    Open,
    /// A successor took over: the link delivers its data in flight.
    Leaving(DrainingLink),
}

/// A link.
pub(super) struct Link {
    pub(super) side: Side,
    pub(super) phase: LinkPhase,
    /// The link that it replaces, as its dialler stated.
    pub(super) replaces: Option<[u8; 16]>,
    /// The daemon that was dialled.
    pub(super) expected: Option<DaemonId>,
    /// The link in use beside which it is to stand by, as its dialler stated.
    pub(super) beside: Option<[u8; 16]>,
    /// The reason why it comes in use at this time. It waits because the peer caused too many take-overs.
    pub(super) postponed: Option<(Duration, TakeOver)>,
    /// The peer, once HELLO was checked and its name proven.
    pub(super) peer: Option<LinkPeer>,
    /// The place of its handshake among those under way.
    pub(super) place: Option<HandshakeSlot>,
    /// The look-up of the PSK, which has the reason if it was not found.
    pub(super) resolver: Option<Arc<Resolver>>,
}

/// The data kept from a link's beginning.
#[derive(Clone)]
pub(crate) struct EstablishedPeer {
    /// The peer's HELLO.
    pub(crate) hello: LinkHello,
    /// The parameters negotiated in the handshake.
    pub(crate) negotiated: Negotiated,
    /// The identity that the peer proved.
    pub(crate) who: PeerIdentity,
}

impl EstablishedPeer {
    /// Returns the part of a link's status that its beginning determines.
    pub(super) fn status(&self, since: SystemTime) -> LinkStatus {
        let mut link = LinkStatus::default();
        link.peer = self.hello.daemon.to_string();
        link.host = self.who.host_name(&self.hello.host);
        link.sae = self.hello.sae.clone();
        link.state = "connected".into();
        link.key_exchange = self.negotiated.key_exchange.to_string();
        link.cipher = self.negotiated.cipher.name().into();
        link.authenticated_as = self.who.to_string();
        link.since = Some(since);
        link
    }
}

/// The peer of a link.
pub(super) struct LinkPeer {
    pub(super) summary: EstablishedPeer,
    /// True if it proved that its daemon id is its own.
    pub(super) proven: bool,
    pub(super) order: MessageOrder,
    pub(super) candidate: Candidate,
    /// Key material of the connection, until it is elected.
    pub(super) sealing: Option<Sealing>,
    /// True if messages are sealed one by one.
    pub(super) seals: bool,
    pub(super) elected: Option<Elected>,
    pub(super) age: Age,
    pub(super) since: SystemTime,
    pub(super) account: Rc<Account>,
    /// Unread stream data that the peer may send.
    pub(super) unread: Charge,
    /// The certificates that it showed.
    pub(super) chain: Vec<CertificateDer<'static>>,
    pub(super) silence: LinkSilence,
}

impl Link {
    /// Creates a link that begins with a handshake.
    pub(super) fn new(side: Side, until: Duration, dial: Option<u64>) -> Self {
        Self {
            side,
            phase: LinkPhase::Handshake(until, dial),
            replaces: None,
            expected: None,
            beside: None,
            postponed: None,
            peer: None,
            place: None,
            resolver: None,
        }
    }

    /// Returns when an action is due.
    pub(super) fn poll_timeout(&self) -> Option<Duration> {
        let phase = match &self.phase {
            LinkPhase::Handshake(until, dial) => dial.is_none().then_some(*until),
            LinkPhase::Opening(opening) => opening.poll_timeout(),
            LinkPhase::Electing(until) => Some(*until),
            LinkPhase::Standby | LinkPhase::Open => None,
            LinkPhase::Leaving(leaving) => leaving.poll_timeout(),
        };
        let peer = self.peer.as_ref();
        let ages = matches!(self.phase, LinkPhase::Standby | LinkPhase::Open);
        let age = peer.filter(|_| ages).and_then(|peer| peer.age.poll_timeout());
        let probe = peer.and_then(|peer| peer.silence.poll_timeout());
        let postponed = self.postponed.as_ref().map(|(due, _)| *due);
        [phase, age, probe, postponed].into_iter().flatten().min()
    }

    /// Returns whether data may come over it: it is, or was, elected.
    pub(super) fn carries(&self) -> bool {
        matches!(self.phase, LinkPhase::Open | LinkPhase::Leaving(_))
    }

    /// Returns whether it stands by, and carries copies of samples alone.
    pub(super) fn carries_copies(&self) -> bool {
        matches!(self.phase, LinkPhase::Standby)
    }

    /// Returns whether it carries samples.
    pub(super) fn is_open(&self) -> bool {
        matches!(self.phase, LinkPhase::Open)
    }
}
