//! Probes links that are silent although their path works again.
//!
//! QUIC doubles its pause after each unacknowledged packet: after an outage of eight seconds a link may stay silent for
//! eight more. A link over which something was sent and nothing arrives is therefore probed beside QUIC, four times a
//! second. When a probe is answered and the peer still acknowledges nothing, a successor is dialled
//! (`docs/architecture.md`, links).
//!
//! Only acknowledgements count. A packet that the peer sends by itself does not end the pause of this side's QUIC: data
//! that waits here would still wait for it.

use std::time::Duration;

use crate::{engine::quic::answers::Exchange, link::Side};

/// Time between two probes.
const PROBE_EVERY: Duration = Duration::from_millis(250);

/// Time that QUIC has after an answer: a packet of its own may be in flight.
const GRACE: Duration = Duration::from_millis(300);

/// Length of a long silence, after which QUIC's next packet is as far away as the silence was long.
const LONG_SILENCE: Duration = Duration::from_secs(1);

const GRACE_AFTER_LONG: Duration = Duration::from_millis(50);

/// Additional wait of the side that was dialled: two successors would be one too many.
const DIALLED: Duration = Duration::from_millis(100);

/// Time after which the next successor is dialled if one did not come about; it doubles each time, because a dial may
/// cost a key.
const FIRST_REDIAL_PAUSE: Duration = Duration::from_secs(1);

const AGAIN_AT_MOST: Duration = Duration::from_secs(8);

/// Number of unanswered probes in a row that show that the path was cut after the dial, which may be why no successor
/// came about. A lossy path loses one or two.
const CUT: u32 = 3;

/// Number of further probes after which that is reported again: a report to discovery may get lost.
const CUT_AGAIN: u32 = 16;

/// The traffic of a connection, as far as it matters for silence.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(in crate::engine::links) struct Traffic {
    /// Number of received frames. A count of datagrams would include those that any host sends; a packet that is not
    /// authentic, or comes twice, has no frame.
    came: u64,
    exchange: Exchange,
}

impl Traffic {
    /// Reads the counters from a connection's statistics.
    pub(crate) fn from(stats: &quinn_proto::ConnectionStats) -> Self {
        Self { came: frames_came(stats), exchange: Exchange::from(stats) }
    }

    #[cfg(test)]
    pub(super) fn of(came: u64, acknowledged: u64, asked: u64) -> Self {
        Self { came, exchange: Exchange { acknowledged, asked, pings: 0 } }
    }

    /// Returns the frames that asked for an answer, and the answers.
    pub(crate) fn exchange(self) -> Exchange {
        self.exchange
    }

    /// Returns whether the peer acknowledged something since `before`: QUIC then retransmits missing data at once.
    pub(crate) fn answered_since(self, before: Self) -> bool {
        self.exchange.is_answered_since(before.exchange)
    }

    /// Returns whether nothing arrived since `before`, and something that asks for an answer was sent since the last
    /// datagram came, when the traffic was `heard`.
    pub(crate) fn is_silent(self, before: Self, heard: Self) -> bool {
        self.came == before.came && self.exchange.asked > heard.exchange.asked
    }

    /// Returns whether a datagram came since `before`.
    pub(crate) fn has_come_since(self, before: Self) -> bool {
        self.came != before.came
    }
}

/// Returns the number of the peer's frames that show that it lives: each of its packets has one of them.
pub(in crate::engine::links) fn frames_came(stats: &quinn_proto::ConnectionStats) -> u64 {
    let came = stats.frame_rx;
    let data = came.stream + came.datagram + came.crypto + came.reset_stream + came.stop_sending;
    let limits =
        came.max_data + came.max_stream_data + came.max_streams_uni + came.max_streams_bidi;
    let blocked = came.data_blocked + came.stream_data_blocked + came.streams_blocked_uni;
    let paths = came.path_challenge + came.path_response + came.new_connection_id;
    came.acks
        + came.ping
        + came.immediate_ack
        + came.ack_frequency
        + data
        + limits
        + blocked
        + paths
}

/// The action for a silent link.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in crate::engine::links) enum Step {
    /// Send a probe.
    Probe,
    /// Dial a successor: the path works.
    Replace,
}

/// Decides when a silent link is probed and when it is replaced. A state machine as `docs/architecture.md`
/// describes them; `now` is the time since the link was found silent.
#[derive(Debug)]
pub(in crate::engine::links) struct Prober {
    side: Side,
    next: Step,
    due: Duration,
    /// Number of probes sent in a row and not answered.
    asked: u32,
    /// The time at which the first of them was sent.
    unanswered_since: Duration,
    /// The number of unanswered probes when the path was last found cut.
    said_cut: Option<u32>,
    /// The last dial, and the pause after it.
    dialled: Option<(Duration, Duration)>,
}

impl Prober {
    /// Creates the prober of a link that was found silent: a probe is due.
    pub(crate) fn new(side: Side) -> Self {
        let due = Duration::ZERO;
        let next = Step::Probe;
        Self { side, next, due, asked: 0, unanswered_since: due, said_cut: None, dialled: None }
    }

    /// Returns whether an answer to a probe counts.
    pub(crate) fn awaits_echo(&self) -> bool {
        self.asked > 0
    }

    /// Handles the answer to a probe: QUIC has some time more, and a successor that was dialled has its pause.
    pub(crate) fn handle_echo(&mut self, now: Duration) {
        self.asked = 0;
        if self.dialled.is_some_and(|(at, pause)| now < at + pause) {
            return;
        }
        let grace = if now < LONG_SILENCE { GRACE } else { GRACE_AFTER_LONG };
        let more = if self.side == Side::Client { Duration::ZERO } else { DIALLED };
        (self.next, self.due) = (Step::Replace, now + grace + more);
    }

    /// Returns whether the path counts as cut at the latest probe: the previous ones were not answered, the first of
    /// them for two round trips. Returns true again from time to time, as long as that lasts.
    pub(crate) fn find_cut(&mut self, now: Duration, round_trip: Duration) -> bool {
        let unanswered = self.asked.saturating_sub(1);
        let cut = unanswered >= CUT
            && now.saturating_sub(self.unanswered_since) >= 2 * round_trip
            && self.said_cut.is_none_or(|said| unanswered >= said + CUT_AGAIN);
        if cut {
            self.said_cut = Some(unanswered);
        }
        cut
    }

    /// Returns when to call [`handle_timeout`](Self::handle_timeout).
    pub(crate) fn poll_timeout(&self) -> Option<Duration> {
        Some(self.due)
    }

    /// Returns the action that is due at `now`.
    pub(crate) fn handle_timeout(&mut self, now: Duration) -> Option<Step> {
        if now < self.due {
            return None;
        }
        let step = self.next;
        match step {
            Step::Probe => {
                if self.asked >= CUT {
                    self.dialled = None;
                }
                if self.asked == 0 {
                    (self.unanswered_since, self.said_cut) = (now, None);
                }
                self.asked += 1;
            }
            Step::Replace => {
                let pause = self.dialled.map_or(FIRST_REDIAL_PAUSE, |(_, pause)| 2 * pause);
                self.dialled = Some((now, pause.min(AGAIN_AT_MOST)));
            }
        }
        (self.next, self.due) = (Step::Probe, now + PROBE_EVERY);
        Some(step)
    }
}

#[cfg(test)]
mod tests {
    use std::cell::Cell;

    use super::*;

    const ROUND_TRIP: Duration = Duration::from_millis(30);
    /// Time from a dial to the first message over the successor, if no key has to be fetched.
    const HANDSHAKE: Duration = Duration::from_millis(60);

    /// Walks the prober until it dials a successor. A probe is answered if it leaves when `path_works`. Returns the
    /// number of probes, and when the successor is dialled.
    fn walk(prober: &mut Prober, path_works: impl Fn(Duration) -> bool) -> (u32, Duration) {
        let mut probes = 0;
        let mut echo = None;
        loop {
            let due = prober.poll_timeout().expect("something is always due");
            if let Some(at) = echo.filter(|at| *at < due) {
                echo = None;
                prober.handle_echo(at);
                continue;
            }
            match prober.handle_timeout(due) {
                Some(Step::Probe) => {
                    probes += 1;
                    if path_works(due) {
                        echo = echo.or(Some(due + ROUND_TRIP));
                    }
                }
                Some(Step::Replace) => return (probes, due),
                None => unreachable!("it is due"),
            }
        }
    }

    /// Cuts the path for `cut` after the link was found silent. Returns the number of probes, and how long after the
    /// path's return the successor carries messages.
    fn replaced_after(cut: Duration, side: Side) -> (u32, Duration) {
        let (probes, dialled) = walk(&mut Prober::new(side), |now| now >= cut);
        (probes, dialled + HANDSHAKE - cut)
    }

    #[test]
    fn successor_carries_messages_within_500_ms_after_the_path_returns() {
        for millis in 1_000..12_000 {
            let cut = Duration::from_millis(millis);
            for side in [Side::Client, Side::Server] {
                let (probes, after) = replaced_after(cut, side);
                assert!(after <= Duration::from_millis(500), "{cut:?}, {side:?}: {after:?}");
                // Four a second, and no more.
                assert!(u64::from(probes) <= millis / 250 + 2, "{cut:?}: {probes}");
            }
        }
    }

    #[test]
    fn a_short_silence_gives_quic_time_to_end_it_itself() {
        let (_, after) = replaced_after(Duration::ZERO, Side::Client);
        assert_eq!(after, ROUND_TRIP + GRACE + HANDSHAKE);
        let (_, after) = replaced_after(Duration::ZERO, Side::Server);
        assert_eq!(after, ROUND_TRIP + GRACE + DIALLED + HANDSHAKE);
    }

    #[test]
    fn second_cut_after_the_dial_ends_within_500_ms_of_its_return() {
        for millis in 1_000..6_000 {
            let mut prober = Prober::new(Side::Client);
            let (_, dialled) = walk(&mut prober, |_| true);
            let back = dialled + Duration::from_millis(millis);
            let (_, again) = walk(&mut prober, |now| now >= back);
            let after = again + HANDSHAKE - back;
            assert!(after <= Duration::from_millis(500), "{millis} ms: {after:?}");
        }
    }

    #[test]
    fn several_short_returns_end_within_500_ms_of_the_last_one() {
        // Tries several numbers of returns of the path, and times for which it works and does not.
        for returns in 1..6 {
            for (works, cut) in [(50, 1_000), (100, 1_800), (300, 2_500), (700, 5_000)] {
                let [works, cut] = [works, cut].map(Duration::from_millis);
                let mut prober = Prober::new(Side::Client);
                let mut back = cut;
                for _ in 0..returns {
                    let (_, dialled) = walk(&mut prober, |now| now >= back);
                    // The handshake does not come through: the path is cut a moment after the dial.
                    back = dialled + works + cut;
                }
                let (_, dialled) = walk(&mut prober, |now| now >= back);
                let after = dialled + HANDSHAKE - back;
                let most = Duration::from_millis(500);
                assert!(after <= most, "{returns} returns, cut for {cut:?}: {after:?}");
            }
        }
    }

    #[test]
    fn a_lost_probe_is_no_cut() {
        let mut prober = Prober::new(Side::Client);
        let mut dials = Vec::new();
        for _ in 0..6 {
            // One of three probes is answered.
            let number = Cell::new(0);
            let answered = |_| {
                number.set(number.get() + 1);
                number.get() % 3 == 1
            };
            dials.push(walk(&mut prober, answered).1);
        }
        let pauses: Vec<_> = dials.windows(2).map(|d| (d[1] - d[0]).as_secs()).collect();
        assert_eq!(pauses, [1, 2, 4, 8, 8]);
    }

    #[test]
    fn dials_of_a_peer_that_refuses_successors_become_rarer() {
        let mut prober = Prober::new(Side::Client);
        assert!(!prober.awaits_echo(), "nothing was asked");
        let mut dials = Vec::new();
        for _ in 0..8 {
            dials.push(walk(&mut prober, |_| true).1);
            assert!(!prober.awaits_echo(), "an answer that comes twice dials no other one");
        }
        let pauses: Vec<_> = dials.windows(2).map(|d| (d[1] - d[0]).as_secs()).collect();
        assert_eq!(pauses, [1, 2, 4, 8, 8, 8, 8]);
    }
}
