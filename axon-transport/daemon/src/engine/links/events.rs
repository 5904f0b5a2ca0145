//! What comes of the links: events for the owner of the peers, reports for the control plane.

use std::{collections::VecDeque, net::SocketAddr};

use axon_shm::ids::DaemonId;
use quinn_proto::StreamEvent;

use crate::{
    bridge::RefusalKind,
    discovery::{AddressConfidence, Datagrams},
    engine::{account::Charge, refusal::Refusal},
    link::{LinkClosed, LinkMessage},
};

/// What came of the links, for the owner of the peers.
#[derive(Debug)]
pub(in crate::engine) enum LinkEvent {
    /// A link of this peer is elected. It takes over from another one, if that is named.
    Up {
        number: u64,
        daemon: DaemonId,
        old: Option<u64>,
        /// To be said over the new link.
        closed: Option<LinkClosed>,
    },
    /// A message on the link in use, with what it weighs on the peer's account until it is handled.
    Message(u64, DaemonId, LinkMessage, Option<Charge>),
    /// An event of a data stream of any link of this peer.
    Stream(u64, DaemonId, StreamEvent),
    /// The keys of this link changed.
    Keys(DaemonId),
    /// The peer has been silent for so long that it is taken for gone. Its link stands.
    Silent(DaemonId),
    /// A peer that was silent is back, over the same link.
    Back(DaemonId),
    /// A superseded link of this peer is given up, whose packets do not arrive. To be said over the link in use.
    Closed(DaemonId, LinkClosed),
    /// A link that was not in use is over: nothing more of its streams can be read.
    Gone(u64, DaemonId),
    /// The last link of a peer is over.
    Down {
        number: u64,
        daemon: DaemonId,
        peer: String,
        reason: String,
        /// Another daemon of its host takes its place.
        restarted: bool,
    },
}

/// What the links say to the control plane.
#[derive(Debug)]
pub(in crate::engine) enum LinkReport {
    /// A link, or an attempt at one, was refused.
    Refused(RefusalKind, String, Refusal),
    /// A dial failed.
    DialFailed { daemon: DaemonId, standing: AddressConfidence },
    /// A link of this daemon is up at this address. Whether the daemon proved its id.
    Up { daemon: DaemonId, address: SocketAddr, proven: bool },
    /// Whether the path of this daemon's link carries anything: probes of it were not answered, or it answers again.
    Path { daemon: DaemonId, works: bool },
    /// Datagrams of discovery.
    Datagrams(Datagrams),
}

/// Events and reports that were not taken yet, in order.
#[derive(Default)]
pub(super) struct LinkOutbox {
    events: VecDeque<LinkEvent>,
    reports: VecDeque<LinkReport>,
}

impl LinkOutbox {
    /// Adds an event.
    pub(super) fn event(&mut self, event: LinkEvent) {
        self.events.push_back(event);
    }

    /// Adds a report.
    pub(super) fn report(&mut self, report: LinkReport) {
        self.reports.push_back(report);
    }

    /// How many events wait.
    #[cfg(test)]
    pub(super) fn waiting(&self) -> usize {
        self.events.len()
    }

    /// Whether events wait.
    pub(super) fn has_events(&self) -> bool {
        !self.events.is_empty()
    }

    /// The next event.
    pub(super) fn poll_event(&mut self) -> Option<LinkEvent> {
        self.events.pop_front()
    }

    /// The next report.
    pub(super) fn poll_report(&mut self) -> Option<LinkReport> {
        self.reports.pop_front()
    }
}
