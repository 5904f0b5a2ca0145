//! The responses that a relayed session's clients have received: the next daemon may send a copy of one.

use std::collections::{BTreeSet, VecDeque};

use axon_shm::Meta;

use super::flow::FlowChannel;

/// Maximum number of remembered responses. A server with more unconfirmed responses at the end of its daemon sends one
/// of them once more.
const MAX_RESPONSES: usize = 4096;

/// The key of a response: its channel, number and time. A server that answers a request twice does so at two times.
type Response = (FlowChannel, u64, i64);

/// The last responses that arrived.
#[derive(Debug, Default)]
pub(crate) struct ResponseLog {
    known: BTreeSet<Response>,
    /// The responses in order of arrival.
    order: VecDeque<Response>,
}

fn response(channel: &FlowChannel, meta: &Meta) -> Response {
    (*channel, meta.sequence, meta.source_nanos)
}

impl ResponseLog {
    /// Returns whether this response arrived before.
    pub(super) fn has(&self, channel: &FlowChannel, meta: &Meta) -> bool {
        channel.client.is_some() && self.known.contains(&response(channel, meta))
    }

    /// Records a response that arrived.
    pub(super) fn add(&mut self, channel: &FlowChannel, meta: &Meta) {
        let response = response(channel, meta);
        if channel.client.is_none() || !self.known.insert(response) {
            return;
        }
        self.order.push_back(response);
        if self.order.len() > MAX_RESPONSES
            && let Some(oldest) = self.order.pop_front()
        {
            self.known.remove(&oldest);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ids::Gid;

    #[test]
    fn response_that_came_is_known_and_another_one_to_the_same_request_is_not() {
        let mut log = ResponseLog::default();
        let [server, client, other] = [1, 2, 3].map(|byte| Gid([byte; 16]));
        let channel = FlowChannel::between(server, client);
        let of = Meta::at_nanos;
        log.add(&channel, &of(7, 100));
        assert!(log.has(&channel, &of(7, 100)));
        assert!(!log.has(&channel, &of(7, 101)) && !log.has(&channel, &of(8, 100)));
        assert!(!log.has(&FlowChannel::between(server, other), &of(7, 100)));
        // The samples of a topic have their own numbers.
        log.add(&FlowChannel::of(server), &of(9, 100));
        assert!(!log.has(&FlowChannel::of(server), &of(9, 100)));
    }

    #[test]
    fn no_more_than_the_last_ones_are_remembered() {
        let mut log = ResponseLog::default();
        let channel = FlowChannel::between(Gid([1; 16]), Gid([2; 16]));
        for number in 0..=MAX_RESPONSES as u64 {
            log.add(&channel, &Meta::at_nanos(number, 5));
            log.add(&channel, &Meta::at_nanos(number, 5));
        }
        assert_eq!((log.known.len(), log.order.len()), (MAX_RESPONSES, MAX_RESPONSES));
        assert!(!log.has(&channel, &Meta::at_nanos(0, 5)));
        assert!(log.has(&channel, &Meta::at_nanos(1, 5)));
    }
}
