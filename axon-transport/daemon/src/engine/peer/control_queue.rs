//! The control messages that wait to be sent to one peer.

use std::collections::VecDeque;

use crate::link::{LinkClosed, LinkMessage};

/// Maximum number of closed links that are reported to the peer again: as many as may wait for their end.
const SAID_CLOSED: usize = 8;

/// Control messages for one peer, in order.
#[derive(Default)]
pub(super) struct ControlQueue {
    messages: VecDeque<LinkMessage>,
    /// The latest links that were closed while their packets did not arrive.
    closed: Vec<LinkClosed>,
}

impl ControlQueue {
    /// Adds a message.
    pub(super) fn say(&mut self, message: LinkMessage) {
        self.messages.push_back(message);
    }

    /// Returns the next message.
    pub(super) fn poll(&mut self) -> Option<LinkMessage> {
        self.messages.pop_front()
    }

    /// Discards unsent messages, because another link takes over.
    pub(super) fn succeed(&mut self) {
        self.messages.clear();
    }

    /// Queues [`LinkClosed`] for a link whose packets may not arrive, and repeats it for earlier links: the link that
    /// takes over may have come before their messages left. `None` only repeats.
    pub(super) fn say_closed(&mut self, closed: Option<LinkClosed>) {
        self.closed.extend(closed);
        let before = self.closed.len().saturating_sub(SAID_CLOSED);
        self.closed.drain(..before);
        self.messages.extend(self.closed.iter().copied().map(LinkMessage::LinkClosed));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn closed(number: u8) -> LinkClosed {
        LinkClosed { link: [number; 16] }
    }

    /// Returns the links that are reported as closed.
    fn said(queue: &mut ControlQueue) -> Vec<LinkClosed> {
        let messages = std::iter::from_fn(|| queue.poll()).map(|message| match message {
            LinkMessage::LinkClosed(closed) => closed,
            other => panic!("{other:?}"),
        });
        messages.collect()
    }

    #[test]
    fn closed_links_are_said_again_over_each_link_that_takes_over() {
        let mut queue = ControlQueue::default();
        queue.say_closed(Some(closed(1)));
        queue.say_closed(None);
        assert_eq!(said(&mut queue), [closed(1), closed(1)]);
        // The message about the second link is lost with the link over which it was to be sent.
        queue.say_closed(Some(closed(2)));
        queue.succeed();
        queue.say_closed(Some(closed(3)));
        assert_eq!(said(&mut queue), [1, 2, 3].map(closed));
    }

    #[test]
    fn the_latest_closed_links_alone_are_remembered() {
        let mut queue = ControlQueue::default();
        (0..20).for_each(|number| queue.say_closed(Some(closed(number))));
        queue.succeed();
        queue.say_closed(None);
        assert_eq!(said(&mut queue), [12, 13, 14, 15, 16, 17, 18, 19].map(closed));
    }
}
