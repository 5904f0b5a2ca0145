//! Limits the connections that have not sent HELLO yet. If there are too many, the daemon closes one connection of
//! the process with the most of them.

use std::{
    cell::RefCell,
    collections::{BTreeMap, HashMap},
    rc::Rc,
};

use tokio::sync::Notify;

/// Maximum number of connections without a HELLO at a time.
pub(super) const MAX_PENDING_CONNECTIONS: usize = 256;
/// The maximum if the daemon's descriptors are short.
pub(super) const MOST_WHERE_SHORT: usize = 8;

/// The connections without HELLO of all processes. If there are too many, the process with the most of them loses the
/// connection that has been silent longest: other processes do not delay a process that sends HELLO as it connects.
#[derive(Clone, Debug, Default)]
pub(super) struct PendingConnections(Rc<RefCell<SilentConnection>>);

#[derive(Debug, Default)]
struct SilentConnection {
    next: u64,
    /// The connections in order of arrival: the process of each, and the signal that another connection takes its
    /// place.
    connections: BTreeMap<u64, (u32, Rc<Notify>)>,
}

/// A connection that has not sent HELLO, until it is dropped.
#[derive(Debug)]
pub(super) struct PendingConnection {
    strangers: PendingConnections,
    number: u64,
    replaced: Rc<Notify>,
}

impl PendingConnections {
    /// Adds a connection of process `pid`. If there are more than `most`, one of them has to go.
    pub(super) fn add(&self, pid: u32, most: usize) -> PendingConnection {
        let mut waiting = self.0.borrow_mut();
        let (number, replaced) = (waiting.next, Rc::new(Notify::new()));
        waiting.next += 1;
        waiting.connections.insert(number, (pid, Rc::clone(&replaced)));
        if waiting.connections.len() > most
            && let Some((_, victim)) =
                waiting.victim().and_then(|number| waiting.connections.remove(&number))
        {
            victim.notify_one();
        }
        drop(waiting);
        PendingConnection { strangers: self.clone(), number, replaced }
    }
}

impl SilentConnection {
    fn victim(&self) -> Option<u64> {
        let mut of: HashMap<u32, usize> = HashMap::new();
        for (pid, _) in self.connections.values() {
            *of.entry(*pid).or_default() += 1;
        }
        let most = of.values().max()?;
        self.connections.iter().find(|(_, (pid, _))| of[pid] == *most).map(|(number, _)| *number)
    }
}

impl PendingConnection {
    /// Waits until another connection takes its place.
    pub(super) async fn replaced(&self) {
        self.replaced.notified().await;
    }
}

impl Drop for PendingConnection {
    fn drop(&mut self) {
        self.strangers.0.borrow_mut().connections.remove(&self.number);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_oldest_of_the_process_with_the_most_connections_makes_room() {
        let strangers = PendingConnections::default();
        let there = |stranger: &PendingConnection| {
            strangers.0.borrow().connections.contains_key(&stranger.number)
        };
        let honest = strangers.add(7, MAX_PENDING_CONNECTIONS);
        let crowd: Vec<_> = (0..3 * MAX_PENDING_CONNECTIONS)
            .map(|_| strangers.add(9, MAX_PENDING_CONNECTIONS))
            .collect();
        let late = strangers.add(8, MAX_PENDING_CONNECTIONS);
        assert!(there(&honest) && there(&late));
        assert_eq!(
            crowd.iter().filter(|stranger| there(stranger)).count(),
            MAX_PENDING_CONNECTIONS - 2
        );
        assert!(!there(&crowd[0]) && there(crowd.last().unwrap()), "the oldest go");
        drop((honest, late, crowd));
        assert!(strangers.0.borrow().connections.is_empty());
    }

    #[test]
    fn of_many_processes_with_one_each_the_oldest_makes_room() {
        let strangers = PendingConnections::default();
        let crowd: Vec<_> = (0..2 * MAX_PENDING_CONNECTIONS)
            .map(|pid| strangers.add(pid as u32, MAX_PENDING_CONNECTIONS))
            .collect();
        let there: Vec<_> = strangers.0.borrow().connections.keys().copied().collect();
        assert_eq!(
            there,
            (MAX_PENDING_CONNECTIONS as u64..2 * MAX_PENDING_CONNECTIONS as u64)
                .collect::<Vec<_>>()
        );
        drop(crowd);
    }
}
