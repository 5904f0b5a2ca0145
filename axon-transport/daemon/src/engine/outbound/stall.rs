//! Finds routes that the peer asked for and does not read. A flow that waits for the credit of others is excused, as long
//! as credit comes back. If none does, those who use it are judged, KEEP_ALL or not.

use std::{collections::HashMap, time::Duration};

use super::schedule::FlowId;

/// Between two looks.
const LOOK: Duration = Duration::from_secs(1);
/// After so long without anything of the peer the link is at fault: the link's own limits apply, and the time of
/// the routes begins again.
const SILENT: Duration = Duration::from_secs(6);

/// KEEP_ALL flows with samples that are not acknowledged.
#[derive(Debug)]
pub(super) struct Stalls {
    limit: Duration,
    flows: HashMap<FlowId, Progress>,
    /// Frames of the peer, and when there was a new one.
    heard: (u64, Duration),
    /// How often credit came back, and when it did last or nobody waited for any.
    returned: (u64, Duration),
    next: Duration,
}

#[derive(Clone, Copy, Debug)]
struct Progress {
    at: (u64, u64),
    since: Duration,
}

/// What the peer did so far.
#[derive(Clone, Copy, Debug)]
pub(super) struct PeerActivity {
    /// Frames that came over the link.
    pub(super) heard: u64,
    /// How often credit came back.
    pub(super) returned: u64,
    /// Whether a flow waits for credit.
    pub(super) is_awaited: bool,
}

/// A flow with samples that are not acknowledged.
#[derive(Clone, Copy, Debug)]
pub(super) struct BusyFlow {
    pub(super) id: FlowId,
    pub(super) route: u32,
    /// Whether its route is known to be stalled.
    pub(super) is_stalled: bool,
    pub(super) progress: (u64, u64),
    /// Whether a KEEP_ALL relay holds its publisher back.
    pub(super) is_held_back: bool,
    /// Whether it uses credit for which others may have to wait.
    pub(super) uses_credit: bool,
    /// Whether it waits for others: none of its samples is in flight.
    pub(super) waits_for_others: bool,
    /// Whether a limit of this host holds its samples.
    pub(super) waits_for_limit: bool,
    /// Whether nothing of it waits, or is not acknowledged.
    pub(super) is_quiet: bool,
}

/// What a look found.
#[derive(Debug, Default, PartialEq, Eq)]
pub(super) struct Found {
    /// Routes that made no progress for the limit.
    pub(super) stalled: Vec<u32>,
    /// Flows that are busy no more.
    pub(super) quiet: Vec<FlowId>,
}

impl Stalls {
    pub(super) fn new(limit: Duration, now: Duration) -> Self {
        Self { limit, flows: HashMap::new(), heard: (0, now), returned: (0, now), next: now + LOOK }
    }

    /// A flow is gone. Its number is another's next.
    pub(super) fn forget(&mut self, flow: FlowId) {
        self.flows.remove(&flow);
    }

    /// Samples wait, and none did before: nobody looked while there was nothing.
    pub(super) fn handle_first(&mut self, now: Duration) {
        self.next = self.next.max(now + LOOK);
    }

    /// Whether flows have waited for credit for the limit, and none came back. Then no flow that waits is excused any
    /// more, and those that use credit are judged, too.
    pub(super) fn starves(&self, now: Duration) -> bool {
        now.saturating_sub(self.returned.1) >= self.limit
    }

    /// When to look again, while flows are busy.
    pub(super) fn poll_timeout(&self) -> Duration {
        self.next
    }

    /// Looks at the busy flows, if that is due.
    pub(super) fn handle_timeout(
        &mut self,
        peer: PeerActivity,
        busy: impl Iterator<Item = BusyFlow>,
        now: Duration,
    ) -> Found {
        let mut found = Found::default();
        if now < self.next {
            return found;
        }
        self.next = now + LOOK;
        if peer.heard != self.heard.0 {
            self.heard = (peer.heard, now);
        }
        let silent = now.saturating_sub(self.heard.1) >= SILENT;
        if silent || peer.returned != self.returned.0 || !peer.is_awaited {
            self.returned = (peer.returned, now);
        }
        let starves = self.starves(now);
        let before = std::mem::take(&mut self.flows);
        for flow in busy {
            let is_judged = flow.is_held_back || starves && flow.uses_credit;
            if !is_judged {
                found.quiet.extend(flow.is_quiet.then_some(flow.id));
                continue;
            }
            if flow.is_stalled || found.stalled.contains(&flow.route) {
                continue;
            }
            let progress = match before.get(&flow.id) {
                Some(progress)
                    if progress.at == flow.progress
                        && !silent
                        && !flow.waits_for_limit
                        && (starves || !flow.waits_for_others) =>
                {
                    *progress
                }
                _ => Progress { at: flow.progress, since: now },
            };
            if now.saturating_sub(progress.since) >= self.limit {
                found.stalled.push(flow.route);
                continue;
            }
            self.flows.insert(flow.id, progress);
        }
        found
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const LIMIT: Duration = Duration::from_secs(10);
    const FLOW: BusyFlow = BusyFlow {
        id: 3,
        route: 1,
        is_stalled: false,
        progress: (0, 0),
        is_held_back: true,
        uses_credit: false,
        waits_for_others: false,
        waits_for_limit: false,
        is_quiet: false,
    };

    /// Looks for a minute at flows of a peer that is heard. Returns what was found first, and when.
    fn look(
        is_awaited: bool,
        busy: impl Fn(Duration) -> Vec<BusyFlow>,
        heard: impl Fn(Duration) -> u64,
    ) -> Option<(Duration, Found)> {
        let mut stalls = Stalls::new(LIMIT, Duration::ZERO);
        while stalls.poll_timeout() < Duration::from_secs(60) {
            let now = stalls.poll_timeout();
            let peer = PeerActivity { heard: heard(now), returned: 0, is_awaited };
            let found = stalls.handle_timeout(peer, busy(now).into_iter(), now);
            if found != Found::default() {
                return Some((now, found));
            }
        }
        None
    }

    fn secs(now: Duration) -> u64 {
        now.as_secs()
    }

    #[test]
    fn a_route_without_progress_is_stalled_after_the_limit_and_told_of_once() {
        let found = Found { stalled: vec![1], quiet: Vec::new() };
        let two = [FLOW, BusyFlow { id: 4, ..FLOW }];
        assert_eq!(look(false, |_| two.into(), secs), Some((LOOK + LIMIT, found)));
        assert_eq!(look(false, |_| vec![BusyFlow { is_stalled: true, ..FLOW }], secs), None);
    }

    #[test]
    fn progress_a_silent_peer_and_waiting_for_others_excuse() {
        let progress = |now: Duration| vec![BusyFlow { progress: (now.as_secs() / 9, 0), ..FLOW }];
        assert_eq!(look(false, progress, secs), None);
        assert_eq!(look(false, |_| vec![FLOW], |_| 0), None, "the link is at fault");
        let waits = BusyFlow { waits_for_others: true, ..FLOW };
        assert_eq!(look(false, |_| vec![waits], secs), None);
    }

    #[test]
    fn a_flow_that_waits_for_credit_is_judged_once_none_comes_back() {
        let waits = BusyFlow { waits_for_others: true, ..FLOW };
        let (at, found) = look(true, |_| vec![waits], secs).unwrap();
        assert_eq!((at, found.stalled), (2 * LIMIT - LOOK, vec![1]), "from its last excuse on");
        let uses = BusyFlow { is_held_back: false, uses_credit: true, ..FLOW };
        let (at, found) = look(true, |_| vec![uses], secs).unwrap();
        assert_eq!((at, found.stalled), (2 * LIMIT, vec![1]), "from when it is judged on");
        assert_eq!(look(false, |_| vec![uses], secs), None);
    }

    #[test]
    fn a_quiet_flow_is_busy_no_more_unless_it_is_judged() {
        let quiet = BusyFlow { is_held_back: false, is_quiet: true, ..FLOW };
        let found = Found { stalled: Vec::new(), quiet: vec![3] };
        assert_eq!(look(false, |_| vec![quiet], secs), Some((LOOK, found)));
        let (_, found) = look(false, |_| vec![BusyFlow { is_quiet: true, ..FLOW }], secs).unwrap();
        assert!(found.quiet.is_empty(), "it is judged");
    }

    #[test]
    fn a_number_that_was_forgotten_is_judged_anew() {
        let mut stalls = Stalls::new(LIMIT, Duration::ZERO);
        let peer = |heard| PeerActivity { heard, returned: 0, is_awaited: false };
        stalls.handle_timeout(peer(1), [FLOW].into_iter(), LOOK);
        stalls.forget(FLOW.id);
        let found = stalls.handle_timeout(peer(2), [FLOW].into_iter(), LOOK + LIMIT);
        assert_eq!(found, Found::default());
    }

    #[test]
    fn nobody_looks_for_a_second_after_the_first_sample() {
        let mut stalls = Stalls::new(LIMIT, Duration::ZERO);
        let now = Duration::from_secs(100);
        stalls.handle_first(now);
        assert_eq!(stalls.poll_timeout(), now + LOOK);
        stalls.handle_first(Duration::ZERO);
        assert_eq!(stalls.poll_timeout(), now + LOOK);
    }
}
