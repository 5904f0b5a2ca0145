//! The progress of a link whose successor took over.

use std::time::Duration;

/// Time of one wait for the peer.
const HAND_OVER: Duration = Duration::from_secs(5);

/// The progress of a link whose successor took over.
///
/// It closes once everything has arrived in both directions: this side's streams are sent, and the peer, which sends
/// over the successor, has ended its control stream or has waited for this side for long enough. If the link is silent,
/// or the peer closed it, nothing more arrives.
#[derive(Clone, Copy, Debug)]
pub(in crate::engine::links) struct DrainingLink {
    /// The latest time at which it ends, in qkd.
    until: Option<Duration>,
    /// True if the peer sends over the successor.
    succeeded: bool,
    /// True if the peer's control stream ended.
    ended: bool,
    /// True if the peer reported that it closed the link.
    closed: bool,
    /// The time at which the wait for this side's streams is checked again.
    wait: Option<Duration>,
}

/// The traffic of a superseded link.
#[derive(Clone, Copy, Debug)]
pub(in crate::engine::links) struct HandOverProgress {
    /// True if the peer does not answer over it.
    pub(in crate::engine::links) silent: bool,
    /// True if all of this side's streams but the control stream are sent.
    pub(in crate::engine::links) sent: bool,
    /// Number of the peer's streams that are being read.
    pub(in crate::engine::links) reading: usize,
}

/// The next step for a superseded link.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in crate::engine::links) enum HandOverStep {
    Wait,
    /// End this side's control stream.
    Finish,
    /// Close the link: everything has arrived.
    Close,
}

impl DrainingLink {
    /// Creates the state when a successor took over. The link's keys may be used `until` a time.
    pub(in crate::engine::links) fn new(
        until: Option<Duration>,
        succeeded: bool,
        now: Duration,
    ) -> Self {
        let until = until.map(|until| until.max(now + HAND_OVER));
        Self { until, succeeded, ended: false, closed: false, wait: None }
    }

    pub(in crate::engine::links) fn poll_timeout(&self) -> Option<Duration> {
        [self.until, self.wait].into_iter().flatten().min()
    }

    pub(in crate::engine::links) fn is_over(&self, now: Duration) -> bool {
        self.until.is_some_and(|until| until <= now)
    }

    /// Records that the peer sends over the successor.
    pub(in crate::engine::links) fn handle_succeeded(&mut self) {
        self.succeeded = true;
    }

    /// Records the peer's message that it closed the link, whose packets do not arrive.
    pub(in crate::engine::links) fn handle_closed(&mut self) {
        self.closed = true;
    }

    /// Records that the peer's control stream ended.
    pub(in crate::engine::links) fn handle_ended(&mut self) {
        self.ended = true;
    }

    pub(in crate::engine::links) fn handle_progress(
        &mut self,
        now: Duration,
        under_way: HandOverProgress,
    ) -> HandOverStep {
        let HandOverProgress { silent, sent, reading } = under_way;
        if self.closed || (silent && self.succeeded) {
            return HandOverStep::Close;
        }
        if silent || !self.succeeded || !(sent || self.wait.is_some()) {
            return HandOverStep::Wait;
        }
        let wait = *self.wait.get_or_insert(now + HAND_OVER);
        if reading == 0 && (self.ended || now >= wait) {
            return HandOverStep::Close;
        }
        if now >= wait {
            self.wait = Some(now + HAND_OVER);
        }
        HandOverStep::Finish
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const NOW: Duration = Duration::from_secs(1000);
    const BUSY: HandOverProgress = HandOverProgress { silent: false, sent: false, reading: 1 };
    const SENT: HandOverProgress = HandOverProgress { sent: true, ..BUSY };
    const READ: HandOverProgress = HandOverProgress { reading: 0, ..SENT };
    const SILENT: HandOverProgress = HandOverProgress { silent: true, ..BUSY };

    #[test]
    fn it_closes_when_both_sides_have_sent_and_read_everything() {
        let mut leaving = DrainingLink::new(None, false, NOW);
        assert_eq!(
            leaving.handle_progress(NOW, READ),
            HandOverStep::Wait,
            "the peer sends over it still"
        );
        leaving.handle_succeeded();
        assert_eq!(leaving.handle_progress(NOW, BUSY), HandOverStep::Wait);
        assert_eq!(leaving.handle_progress(NOW, SENT), HandOverStep::Finish);
        assert_eq!(
            leaving.handle_progress(NOW, READ),
            HandOverStep::Finish,
            "the peer's streams go on"
        );
        leaving.handle_ended();
        assert_eq!(leaving.handle_progress(NOW, SENT), HandOverStep::Finish);
        assert_eq!(leaving.handle_progress(NOW, READ), HandOverStep::Close);
    }

    #[test]
    fn hand_over_waits_a_bounded_time_for_the_end_of_the_control_stream() {
        let mut leaving = DrainingLink::new(None, true, NOW);
        assert_eq!(leaving.handle_progress(NOW, SENT), HandOverStep::Finish);
        assert_eq!(leaving.poll_timeout(), Some(NOW + HAND_OVER));
        // A stream is being read when the time is over: the link waits as long again.
        let later = NOW + HAND_OVER;
        assert_eq!(leaving.handle_progress(later, SENT), HandOverStep::Finish);
        assert_eq!(leaving.poll_timeout(), Some(later + HAND_OVER));
        assert_eq!(leaving.handle_progress(later, READ), HandOverStep::Finish);
        assert_eq!(leaving.handle_progress(later + HAND_OVER, READ), HandOverStep::Close);
    }

    #[test]
    fn a_silent_link_closes_once_the_peer_sends_over_the_successor() {
        let mut leaving = DrainingLink::new(None, false, NOW);
        assert_eq!(leaving.handle_progress(NOW, SILENT), HandOverStep::Wait);
        leaving.handle_succeeded();
        assert_eq!(leaving.handle_progress(NOW, SILENT), HandOverStep::Close);
        let mut closed = DrainingLink::new(None, false, NOW);
        closed.handle_closed();
        assert_eq!(closed.handle_progress(NOW, BUSY), HandOverStep::Close, "the peer said so");
    }

    #[test]
    fn a_link_whose_keys_age_has_time_for_a_hand_over_and_no_more() {
        let late = DrainingLink::new(Some(NOW), true, NOW);
        assert!(!late.is_over(NOW) && late.is_over(NOW + HAND_OVER));
        let until = NOW + 2 * HAND_OVER;
        let early = DrainingLink::new(Some(until), true, NOW);
        assert_eq!(early.poll_timeout(), Some(until));
        assert!(!DrainingLink::new(None, true, NOW).is_over(Duration::MAX));
    }
}
