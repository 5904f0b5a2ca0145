//! The memory of this host that connections and links take, for the simulator.

use crate::engine::links::Links;

/// The numbers and bytes that are held.
#[derive(Clone, Copy, Debug)]
pub(in crate::engine) struct HeldByLinks {
    /// Connections, including those that are closed and not yet drained.
    pub(in crate::engine) connections: usize,
    /// Links whose peer is known.
    pub(in crate::engine) links: usize,
    /// Links that stand by.
    pub(in crate::engine) standby: usize,
    /// Connections that are being opened.
    pub(in crate::engine) opening: usize,
    pub(in crate::engine) dials: usize,
    /// Events that have not been handled.
    pub(in crate::engine) events: usize,
    /// The longest queue of control messages of one connection in bytes; `unhandled` is the maximum of received and
    /// unhandled ones.
    pub(in crate::engine) unsent: usize,
    pub(in crate::engine) unhandled: usize,
}

impl Links {
    pub(in crate::engine) fn held(&self) -> HeldByLinks {
        let all = self.table.iter().count();
        let links = self.table.iter().filter(|(_, link)| link.peer.is_some()).count();
        let numbers = self.connections.numbers();
        let connections = numbers.iter().filter_map(|number| self.connections.get(*number));
        let (unsent, unhandled) = connections
            .map(|connection| connection.control.held())
            .fold((0, 0), |most, held| (held.0.max(most.0), held.1.max(most.1)));
        HeldByLinks {
            connections: numbers.len(),
            links,
            standby: self.table.standby_count(),
            opening: all - links,
            dials: self.dials.len(),
            events: self.outbox.waiting(),
            unsent,
            unhandled,
        }
    }
}
