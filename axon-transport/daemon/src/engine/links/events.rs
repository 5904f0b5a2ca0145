//! The output of the links: events for the owner of the peers, reports for the control plane.

use std::{collections::VecDeque, net::SocketAddr};

use axon_shm::ids::DaemonId;
use quinn_proto::StreamEvent;

use crate::{
    bridge::RefusalKind,
    discovery::{AddressConfidence, Datagrams},
    engine::{account::Charge, refusal::Refusal},
    link::{LinkClosed, LinkMessage},
};

/// An event of the links for the owner of the peers.
#[derive(Debug)]
pub(in crate::engine) enum LinkEvent {
    /// A link of this peer is elected. It takes over from the `old` link, if there is one.
    Up {
        number: u64,
        daemon: DaemonId,
        old: Option<u64>,
        /// The message to send over the new link.
        closed: Option<LinkClosed>,
    },
    /// A message on the link in use, and its charge on the peer's account until it is handled.
    Message(u64, DaemonId, Box<LinkMessage>, Option<Charge>),
    /// An event of a data stream of any link of this peer.
    Stream(u64, DaemonId, StreamEvent),
    /// The keys of this link changed.
    Keys(DaemonId),
    /// The peer has been silent for so long that it counts as gone. Its link stays.
    Silent(DaemonId),
    /// A peer that was silent is back, over the same link.
    Back(DaemonId),
    /// A superseded link of this peer is given up, because its packets do not arrive. The message is to be sent over
    /// the link in use.
    Closed(DaemonId, LinkClosed),
    /// A link that was not in use is over: its streams cannot be read any more.
    Gone(u64, DaemonId),
    /// The last link of a peer is over.
    Down {
        number: u64,
        daemon: DaemonId,
        peer: String,
        reason: String,
        /// True if another daemon of its host takes its place.
        restarted: bool,
    },
}

/// A report of the links to the control plane.
#[derive(Debug)]
pub(in crate::engine) enum LinkReport {
    /// A link, or an attempt at one, was refused.
    Refused(RefusalKind, String, Refusal),
    /// A dial failed. If an authenticated peer answered that it is another daemon, `absent_at` is its address.
    DialFailed { daemon: DaemonId, standing: AddressConfidence, absent_at: Option<SocketAddr> },
    /// A link of this daemon is up at this address. `proven` is true if the daemon proved its id.
    Up { daemon: DaemonId, address: SocketAddr, proven: bool },
    /// The path of this daemon's link fails, because probes of it were not answered, or works again.
    Path { daemon: DaemonId, works: bool },
    /// Datagrams of discovery.
    Datagrams(Datagrams),
}

/// Events and reports that have not been taken, in order.
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

    /// Returns the number of waiting events.
    #[cfg(test)]
    pub(super) fn waiting(&self) -> usize {
        self.events.len()
    }

    /// Returns whether events wait.
    pub(super) fn has_events(&self) -> bool {
        !self.events.is_empty()
    }

    /// Returns the next event.
    pub(super) fn poll_event(&mut self) -> Option<LinkEvent> {
        self.events.pop_front()
    }

    /// Returns the next report.
    pub(super) fn poll_report(&mut self) -> Option<LinkReport> {
        self.reports.pop_front()
    }
}
