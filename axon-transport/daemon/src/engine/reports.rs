//! Reports of the links' status and losses for the control plane, once a second and when a link changed.

use std::time::Duration;

use super::{effects::Effects, links::Links, peers::LinkedPeers};
use crate::bridge::ToControl;

/// Between two reports.
const REPORT_INTERVAL: Duration = Duration::from_secs(1);

/// When the next report is due.
#[derive(Debug)]
pub(super) struct Reports {
    next: Duration,
}

impl Reports {
    /// Creates the schedule: the first report is due a second after the engine's start.
    pub(super) fn new() -> Self {
        Self { next: REPORT_INTERVAL }
    }

    /// Makes the next report due now, because a link changed.
    pub(super) fn hurry(&mut self, now: Duration) {
        self.next = now;
    }

    /// Returns when the next report is due, while there are peers.
    pub(super) fn poll_timeout(&self) -> Duration {
        self.next
    }

    /// Returns whether a report is due. If so, the next one is due a second later.
    pub(super) fn take_due(&mut self, now: Duration) -> bool {
        let is_due = now >= self.next;
        if is_due {
            self.next = now + REPORT_INTERVAL;
        }
        is_due
    }
}

/// Reports losses and the status of each link.
pub(super) fn report(peers: &mut LinkedPeers, links: &Links, effects: &mut Effects, now: Duration) {
    report_excess(peers, links, effects);
    for (_, peer) in peers.iter() {
        effects.tell_lost(&links.peer_text(peer.link), peer.counters.take_lost());
        if !peer.silent
            && let Some(mut status) = links.view(peer.link).and_then(|link| link.status())
        {
            peer.fill(&mut status, now);
            status.standby = links.standby_status(peer.daemon, now);
            effects.tell(ToControl::Link(Box::new(status), peer.refused_routes()));
        }
    }
}

/// Reports the peers that have more long messages in flight than they may: their links may stand still.
fn report_excess(peers: &mut LinkedPeers, links: &Links, effects: &mut Effects) {
    for peer in peers.values_mut() {
        let Some(most) = links.window_credit(peer.link) else { continue };
        let Some(bytes) = peer.inbound.find_excess(peer.link, most) else { continue };
        let text = links.peer_text(peer.link);
        let reason = format!(
            "it has {bytes} bytes of long messages in flight that wait for memory, {most} are allowed: its link may \
             stand still until it gives them up"
        );
        tracing::warn!(peer = text, reason, "a peer sends too many long messages at a time");
        let (kind, what) = (links.kind(peer.link), "long messages".to_owned());
        effects.tell(ToControl::Refusal { kind, peer: text, what, reason });
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reports_are_a_second_apart_unless_a_link_changes() {
        let (mut reports, half) = (Reports::new(), REPORT_INTERVAL / 2);
        assert!(!reports.take_due(half));
        assert!(reports.take_due(REPORT_INTERVAL + half), "late is not never");
        assert_eq!(reports.poll_timeout(), 2 * REPORT_INTERVAL + half);
        assert!(!reports.take_due(2 * REPORT_INTERVAL));
        reports.hurry(2 * REPORT_INTERVAL);
        assert_eq!(reports.poll_timeout(), 2 * REPORT_INTERVAL);
        assert!(reports.take_due(2 * REPORT_INTERVAL) && !reports.take_due(2 * REPORT_INTERVAL));
        assert_eq!(reports.poll_timeout(), 3 * REPORT_INTERVAL);
    }
}
