//! One link: a connection with the state that it has as a link.

use std::{rc::Rc, sync::Arc, time::Duration};

use axon_tls::Negotiated;
use rustls_pki_types::CertificateDer;

use crate::{
    engine::{
        account::{Account, Charge},
        link::opening::{Opening, Sealing},
        links::{
            admission::Place,
            silence::{Prober, Traffic},
            who::Who,
        },
    },
    keys::Resolver,
    link::{Candidate, Elected, Hello, Order, Side},
};

/// How far a link has come.
pub(super) enum Phase {
    /// The TLS handshake is under way, until this time; this side's by a dial of this number.
    Handshake(Duration, Option<u64>),
    /// HELLO, and in qkd the proof.
    Opening(Box<Opening>),
    /// It waits for its election, until this time.
    Electing(Duration),
    /// It carries samples.
    Open,
    /// A successor took over: it delivers what is under way.
    Leaving(Leaving),
}

/// A link that a successor took over from.
#[derive(Clone, Copy, Debug)]
pub(super) struct Leaving {
    /// When it ends at the latest, in qkd.
    pub(super) until: Option<Duration>,
    /// The peer sends over the successor.
    pub(super) succeeded: bool,
    /// The peer's control stream ended.
    pub(super) ended: bool,
    /// The peer said that it closed the link.
    pub(super) closed: bool,
    /// When the peer's patience with this side's streams is looked at again.
    pub(super) wait: Option<Duration>,
}

/// A link.
pub(super) struct Link {
    pub(super) side: Side,
    pub(super) phase: Phase,
    /// The link that it replaces, as its dialler said.
    pub(super) replaces: Option<[u8; 16]>,
    /// The peer, once HELLO was checked and its name proven.
    pub(super) peer: Option<LinkPeer>,
    /// The place of its handshake among those under way.
    pub(super) place: Option<Place>,
    /// Tells why a PSK was not found.
    pub(super) resolver: Option<Arc<Resolver>>,
}

/// What is kept of a link's beginning.
#[derive(Clone)]
pub(crate) struct Summary {
    /// The peer's HELLO.
    pub(crate) hello: Hello,
    /// What the handshake agreed on.
    pub(crate) negotiated: Negotiated,
    /// As whom the peer proved itself.
    pub(crate) who: Who,
}

/// The peer of a link.
pub(super) struct LinkPeer {
    pub(super) summary: Summary,
    pub(super) order: Order,
    pub(super) candidate: Candidate,
    /// Key material of the connection, until it is elected.
    pub(super) sealing: Option<Sealing>,
    /// Whether messages are sealed one by one.
    pub(super) seals: bool,
    pub(super) elected: Option<Elected>,
    /// In qkd: when a successor is dialled, and when the link ends.
    pub(super) renew_at: Option<Duration>,
    pub(super) until: Option<Duration>,
    pub(super) since_unix_ms: u64,
    pub(super) account: Rc<Account>,
    /// Unread stream data that the peer may send.
    pub(super) unread: Charge,
    /// The certificates that it showed.
    pub(super) chain: Vec<CertificateDer<'static>>,
    pub(super) silence: Silence,
}

/// Whether the peer answers.
pub(super) struct Silence {
    /// What came and went at the last look.
    pub(super) traffic: Traffic,
    /// What had gone when the last datagram came.
    pub(super) heard: Traffic,
    /// Probes of the path, while the link is silent.
    pub(super) probing: Option<Probing>,
    /// A successor was dialled since it is silent, and nothing was acknowledged since.
    pub(super) silent: bool,
    /// When the last datagram came.
    pub(super) heard_at: Duration,
    /// What had come and gone when the peer was taken for gone, while it is.
    pub(super) gone: Option<Traffic>,
}

/// Probes of the path of a silent link.
pub(super) struct Probing {
    pub(super) prober: Prober,
    pub(super) nonce: [u8; 8],
    /// When the probing began.
    pub(super) begun: Duration,
    /// The traffic before.
    pub(super) traffic: Traffic,
}

impl Silence {
    pub(super) fn new(now: Duration) -> Self {
        let (traffic, heard) = (Traffic::default(), Traffic::default());
        Self { traffic, heard, probing: None, silent: false, heard_at: now, gone: None }
    }
}

impl Link {
    /// A link that begins with a handshake.
    pub(super) fn new(side: Side, until: Duration, dial: Option<u64>) -> Self {
        Self {
            side,
            phase: Phase::Handshake(until, dial),
            replaces: None,
            peer: None,
            place: None,
            resolver: None,
        }
    }

    /// When something is due.
    pub(super) fn poll_timeout(&self) -> Option<Duration> {
        let phase = match &self.phase {
            Phase::Handshake(until, dial) => dial.is_none().then_some(*until),
            Phase::Opening(opening) => opening.poll_timeout(),
            Phase::Electing(until) => Some(*until),
            Phase::Open => None,
            Phase::Leaving(leaving) => [leaving.until, leaving.wait].into_iter().flatten().min(),
        };
        let peer = self.peer.as_ref();
        let ends = peer.into_iter().filter(|_| matches!(self.phase, Phase::Open));
        let ends = ends.flat_map(|peer| [peer.renew_at, peer.until]).flatten().min();
        let probing = peer.and_then(|peer| peer.silence.probing.as_ref());
        let probe = probing.and_then(|p| Some(p.begun + p.prober.poll_timeout()?));
        [phase, ends, probe].into_iter().flatten().min()
    }

    /// Whether data may come over it: it is, or was, elected.
    pub(super) fn carries(&self) -> bool {
        matches!(self.phase, Phase::Open | Phase::Leaving(_))
    }

    /// Whether it carries samples.
    pub(super) fn is_open(&self) -> bool {
        matches!(self.phase, Phase::Open)
    }
}
