//! Since when the peer of a connection has not answered.

use std::time::Duration;

use quinn_proto::ConnectionStats;

/// Frames that a connection sent and that ask for an acknowledgement, and the acknowledgements that came.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(in crate::engine) struct Exchange {
    /// Number of acknowledgements.
    pub(in crate::engine) acknowledged: u64,
    /// Number of sent frames with data or limits. Frames that QUIC sends by itself to keep the connection, or to find out
    /// how long a packet may be, do not count.
    pub(in crate::engine) asked: u64,
    /// Number of PING frames. QUIC sends them to keep the connection, with a probe of a longer packet, and when
    /// acknowledgements are missing.
    pub(in crate::engine) pings: u64,
}

impl Exchange {
    /// Reads the counters from a connection's statistics.
    pub(in crate::engine) fn from(stats: &ConnectionStats) -> Self {
        let sent = stats.frame_tx;
        let limits = sent.max_data + sent.max_stream_data;
        let asked = sent.stream + sent.datagram + sent.reset_stream + sent.stop_sending + limits;
        Self { acknowledged: stats.frame_rx.acks, asked, pings: sent.ping }
    }

    /// Returns whether the peer acknowledged something since `before`.
    pub(in crate::engine) fn is_answered_since(self, before: Self) -> bool {
        self.acknowledged != before.acknowledged
    }

    /// Returns whether an answer is missing since `before`. A single PING may be a packet that is too long for the path;
    /// QUIC repeats none of these.
    pub(in crate::engine) fn asks_since(self, before: Self) -> bool {
        self.asked > before.asked || self.pings > before.pings + 1
    }
}

/// The time at which the first packet left that asks for an answer, since the peer's latest one.
#[derive(Clone, Copy, Debug, Default)]
pub(in crate::engine) struct AnswerWatch {
    /// Number of acknowledgements when the latest one came.
    acknowledged: u64,
    /// Frames that asked for an answer when the latest one came.
    sent: u64,
    since: Option<Duration>,
}

impl AnswerWatch {
    /// Begins anew: the peer answered.
    pub(in crate::engine) fn restart(&mut self, exchange: Exchange) {
        let Exchange { acknowledged, asked, pings } = exchange;
        *self = Self { acknowledged, sent: asked + pings, since: None };
    }

    /// Begins anew if the peer answered since. Returns whether it did.
    pub(in crate::engine) fn handle_exchange(&mut self, exchange: Exchange) -> bool {
        let is_answer = exchange.acknowledged != self.acknowledged;
        if is_answer {
            self.restart(exchange);
        }
        is_answer
    }

    /// Records that a packet left.
    pub(in crate::engine) fn handle_sent(
        &mut self,
        exchange: impl FnOnce() -> Exchange,
        now: Duration,
    ) {
        if self.since.is_none() {
            let exchange = exchange();
            self.since = (exchange.asked + exchange.pings > self.sent).then_some(now);
        }
    }

    /// Returns since when the peer has not answered.
    pub(in crate::engine) fn since(&self) -> Option<Duration> {
        self.since
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const NOW: Duration = Duration::from_secs(5);

    fn exchange(acknowledged: u64, asked: u64, pings: u64) -> Exchange {
        Exchange { acknowledged, asked, pings }
    }

    #[test]
    fn acknowledgements_alone_await_no_answer() {
        let mut watch = AnswerWatch::default();
        watch.restart(exchange(3, 4, 1));
        watch.handle_sent(|| exchange(3, 4, 1), NOW);
        assert_eq!(watch.since(), None);
        watch.handle_sent(|| exchange(3, 5, 1), NOW * 2);
        watch.handle_sent(|| exchange(3, 9, 1), NOW * 3);
        assert_eq!(watch.since(), Some(NOW * 2), "the first one");
        assert!(!watch.handle_exchange(exchange(3, 9, 1)));
        assert_eq!(watch.since(), Some(NOW * 2), "nothing was acknowledged");
        assert!(watch.handle_exchange(exchange(4, 9, 1)));
        assert_eq!(watch.since(), None);
    }

    #[test]
    fn single_ping_does_not_show_that_an_answer_is_missing() {
        let before = exchange(3, 4, 1);
        assert!(!exchange(3, 4, 1).asks_since(before));
        assert!(!exchange(3, 4, 2).asks_since(before), "a long packet may be lost");
        assert!(exchange(3, 4, 3).asks_since(before));
        assert!(exchange(3, 5, 1).asks_since(before));
    }
}
