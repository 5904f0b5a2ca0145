//! The connections that a pass did not finish: control streams with more to read, and lost connections whose links end
//! once everything that arrived over them is read.

use std::collections::VecDeque;

use quinn_proto::ConnectionError;

/// Connections, by the numbers of their links.
#[derive(Default)]
pub(super) struct UnfinishedConnections {
    /// Connections whose control streams have more to read, once the events so far are handled.
    unread: Vec<u64>,
    /// Connections whose control streams have more to read, and for whose next message there was no memory: they go
    /// first.
    blocked: Vec<u64>,
    /// Connections that are lost and whose links still exist.
    lost: VecDeque<(u64, ConnectionError)>,
}

impl UnfinishedConnections {
    /// Adds a connection whose control stream has more to read.
    pub(super) fn add_unread(&mut self, number: u64) {
        self.unread.push(number);
    }

    /// Adds a connection whose control stream has more to read, and for whose next message there was no memory.
    pub(super) fn add_blocked(&mut self, number: u64) {
        self.blocked.push(number);
    }

    /// Returns whether there are control streams with more to read.
    pub(super) fn has_unread(&self) -> bool {
        !self.unread.is_empty() || !self.blocked.is_empty()
    }

    /// Takes the connections whose control streams have more to read.
    pub(super) fn take_unread(&mut self) -> Vec<u64> {
        let mut next = std::mem::take(&mut self.blocked);
        next.append(&mut self.unread);
        next
    }

    /// Adds a connection that was lost.
    pub(super) fn add_lost(&mut self, number: u64, reason: ConnectionError) {
        self.lost.push_back((number, reason));
    }

    /// Returns whether a connection is lost and its link still exists.
    pub(super) fn is_lost(&self, number: u64) -> bool {
        self.lost.iter().any(|(lost, _)| *lost == number)
    }

    /// Takes the next lost connection, with the reason.
    pub(super) fn poll_lost(&mut self) -> Option<(u64, ConnectionError)> {
        self.lost.pop_front()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lost_connections_end_in_order_and_stand_until_then() {
        let mut unfinished = UnfinishedConnections::default();
        unfinished.add_lost(3, ConnectionError::TimedOut);
        unfinished.add_lost(1, ConnectionError::Reset);
        assert!(unfinished.is_lost(3) && unfinished.is_lost(1) && !unfinished.is_lost(2));
        assert_eq!(unfinished.poll_lost(), Some((3, ConnectionError::TimedOut)));
        assert!(!unfinished.is_lost(3) && unfinished.is_lost(1));
        assert_eq!(unfinished.poll_lost(), Some((1, ConnectionError::Reset)));
        assert_eq!(unfinished.poll_lost(), None);
    }

    #[test]
    fn streams_whose_message_found_no_room_go_first() {
        let mut unfinished = UnfinishedConnections::default();
        unfinished.add_unread(1);
        [3, 2].into_iter().for_each(|number| unfinished.add_blocked(number));
        assert!(unfinished.has_unread());
        assert_eq!(unfinished.take_unread(), [3, 2, 1]);
        assert!(!unfinished.has_unread());
    }

    #[test]
    fn unread_streams_are_taken_once() {
        let mut unfinished = UnfinishedConnections::default();
        unfinished.add_lost(7, ConnectionError::Reset);
        assert!(!unfinished.has_unread(), "a lost connection is another matter");
        [5, 2].into_iter().for_each(|number| unfinished.add_unread(number));
        assert!(unfinished.has_unread());
        assert_eq!(unfinished.take_unread(), [5, 2]);
        assert!(!unfinished.has_unread() && unfinished.take_unread().is_empty());
    }
}
