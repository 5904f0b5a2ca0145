//! Finds stalled routes: routes that the peer asked for and does not read. A flow that waits for the credit
//! of other flows is excused as long as credit comes back. If none comes back, the flows that use credit are
//! judged, KEEP_ALL or not.
//!
//! Time without progress is added up at each check. It stands still while the peer is silent, because the
//! link is then at fault. It continues when any frame of the peer arrives, or once the peer has been silent
//! for so long that it counts as gone. A flow that holds up no publisher starts anew while the peer is
//! silent, so an outage drops none of its samples.
//!
//! A peer that makes some progress now and then is judged by its [pace](Pace), which includes silent time.
//! Both measures pass from one daemon of the peer's host to the next, so a new link or daemon ID does not
//! reset them.

#[cfg(test)]
mod tests;

use std::{collections::HashMap, time::Duration};

use crate::engine::rank::FlowId;

/// Time between two checks.
const CHECK_INTERVAL: Duration = Duration::from_secs(1);
/// The longest time that one check counts: this host may have been suspended.
const LONGEST_LOOK: Duration = Duration::from_secs(2);
/// After this time without a frame of the peer, the link counts as faulty. Time then stands still for the
/// peer's routes.
const SILENT: Duration = Duration::from_secs(6);
/// After this time without a frame, a peer counts as gone, as in the graph. It may then hold up no publisher
/// any more.
const GONE: Duration = Duration::from_secs(20);
/// A peer that holds up a publisher must take a [`SHARE`]th of the waiting samples within this multiple of
/// the limit.
const PERIOD: u32 = 12;
const SHARE: u64 = 64;
/// Divisor of the time in which a flow holds up a publisher while it waits for other flows of the same peer.
/// The peer decides how fast it takes those.
const OTHERS: u32 = 8;

/// Progress of the KEEP_ALL flows with samples that are not acknowledged.
#[derive(Debug)]
pub(super) struct FlowStalls {
    limit: Duration,
    flows: HashMap<FlowId, Progress>,
    /// The number of the peer's frames, and the time of the last change.
    heard: (u64, Duration),
    /// The number of times that the peer returned credit.
    returned: u64,
    /// The time for which flows have waited for credit since the peer last returned some.
    starved: Duration,
    /// When time was last counted.
    looked: Duration,
    next: Duration,
}

/// The progress of a judged flow.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Progress {
    at: (u64, u64),
    /// Time without progress.
    idle: Duration,
    /// Publishes that had found no room when there was last progress.
    refused: u64,
    pace: Pace,
    /// Time in which samples waited without a flow. The next check counts it.
    kept: Duration,
}

/// The pace of a peer while it holds up a publisher: its samples and times. The times add up until the publisher has
/// rested, or the peer has taken its share.
#[derive(Clone, Copy, Debug, Default)]
struct Pace {
    /// The time for which the peer has held up the publisher.
    held: Duration,
    /// The time for which the peer has not held up the publisher.
    free: Duration,
    /// Samples that the peer has acknowledged since the start.
    taken: u64,
    /// Samples that waited at the start.
    waited: u64,
}

/// Counters of the peer's activity.
#[derive(Clone, Copy, Debug)]
pub(super) struct PeerActivity {
    /// Frames that arrived over the link.
    pub(super) heard: u64,
    /// The number of times that the peer returned credit.
    pub(super) returned: u64,
    /// True if a flow waits for credit.
    pub(super) is_awaited: bool,
}

/// A flow with samples that are not acknowledged.
#[derive(Clone, Copy, Debug)]
pub(super) struct BusyFlow {
    pub(super) id: FlowId,
    pub(super) route: u32,
    /// True if the flow's route is known to be stalled.
    pub(super) is_stalled: bool,
    /// The number of acknowledged samples, and of sent parts of samples.
    pub(super) progress: (u64, u64),
    /// Samples that a KEEP_ALL relay makes its publisher keep; `None` if there are none.
    pub(super) keeps: Option<u64>,
    /// The number of publishers that found no room, if this relay may be the reason for the next one.
    pub(super) refused: Option<u64>,
    /// True if the flow belongs to a service: calls may wait for a slow server while there is room for
    /// further calls.
    pub(super) is_service: bool,
    /// True if the flow uses credit that others may have to wait for.
    pub(super) uses_credit: bool,
    /// True if the flow waits for others: none of its samples is in flight.
    pub(super) waits_for_others: bool,
    /// True if a limit of this host holds the flow's samples.
    pub(super) waits_for_limit: bool,
    /// True if the flow has nothing in flight, and this host's KME gives no key for the next sample.
    pub(super) lacks_keys: bool,
    /// True if the flow has no sample that waits or is not acknowledged.
    pub(super) is_quiet: bool,
}

/// Why a route counts as stalled.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum StallCause {
    /// The peer read nothing of the route for the limit.
    NothingRead,
    /// A publisher was held up, and the peer read less than a [`SHARE`]th of its samples in [`PERIOD`] times
    /// the limit.
    TooSlow,
    /// A publisher was held up for as long; at the end this host's KME gave no keys.
    NoKeys,
}

/// The result of a check.
#[derive(Debug, Default, PartialEq, Eq)]
pub(super) struct StallReport {
    /// Routes without progress for the limit, or with too little.
    pub(super) stalled: Vec<(u32, StallCause)>,
    /// Flows that are not busy any more.
    pub(super) quiet: Vec<FlowId>,
}

/// The state of a link, by the arrival of the peer's frames.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum LinkActivity {
    Heard,
    Silent,
    Gone,
}

impl FlowStalls {
    pub(super) fn new(limit: Duration, now: Duration) -> Self {
        Self {
            limit,
            flows: HashMap::new(),
            heard: (0, now),
            returned: 0,
            starved: Duration::ZERO,
            looked: now,
            next: now + CHECK_INTERVAL,
        }
    }

    /// Forgets a flow that is gone. Its number may be used for another flow.
    pub(super) fn forget(&mut self, flow: FlowId) {
        self.flows.remove(&flow);
    }

    /// Removes and returns the progress of a flow that is about to end. Another flow may continue with its
    /// samples.
    pub(super) fn leave(&mut self, flow: &BusyFlow, now: Duration) -> Progress {
        let passed = now.saturating_sub(self.looked).min(LONGEST_LOOK);
        let (hearing, starves) = (self.hearing(now), self.starves());
        match self.flows.remove(&flow.id) {
            Some(progress) => progress.after(passed, flow, hearing, starves, self.limit),
            None => Progress::new(flow),
        }
    }

    /// Returns when time was last counted.
    pub(super) fn looked(&self) -> Duration {
        self.looked
    }

    /// Passes the progress `before` of an ended flow to a flow that continues with its samples; `at` is the
    /// progress that the new flow made. If the time of the ended flow is up, the next check is due at once: a
    /// peer cannot escape it by links that end before the first check.
    pub(super) fn inherit(
        &mut self,
        flow: FlowId,
        at: (u64, u64),
        before: Progress,
        now: Duration,
    ) {
        let own = self.flows.entry(flow).or_insert(before);
        *own = own.and(before, at);
        if own.idle >= self.limit || own.pace.held + own.kept >= self.limit * PERIOD {
            self.next = self.next.min(now);
        }
    }

    /// Starts counting time when the first samples wait: there were no checks before.
    pub(super) fn handle_first(&mut self, now: Duration) {
        self.looked = self.looked.max(now);
        self.next = self.next.max(now + CHECK_INTERVAL);
    }

    /// Returns whether flows have waited for credit for the limit without getting any. Then no waiting flow
    /// is excused any more, and the flows that use credit are judged, too.
    pub(super) fn starves(&self) -> bool {
        self.starved >= self.limit
    }

    /// Returns the time of the next check while flows are busy.
    pub(super) fn poll_timeout(&self) -> Duration {
        self.next
    }

    /// Checks the busy flows if that is due.
    pub(super) fn handle_timeout(
        &mut self,
        now: Duration,
        peer: PeerActivity,
        busy: impl Iterator<Item = BusyFlow>,
    ) -> StallReport {
        let mut found = StallReport::default();
        if now < self.next {
            return found;
        }
        let passed = now.saturating_sub(self.looked).min(LONGEST_LOOK);
        (self.looked, self.next) = (now, now + CHECK_INTERVAL);
        let hearing = self.listen(peer.heard, now);
        if peer.returned != self.returned || !peer.is_awaited {
            (self.returned, self.starved) = (peer.returned, Duration::ZERO);
        } else if hearing == LinkActivity::Heard {
            self.starved += passed;
        }
        let starves = self.starves();
        let before = std::mem::take(&mut self.flows);
        for flow in busy {
            let is_judged = flow.keeps.is_some() || starves && flow.uses_credit;
            if !is_judged {
                found.quiet.extend(flow.is_quiet.then_some(flow.id));
                continue;
            }
            if flow.is_stalled || found.stalled.iter().any(|(route, _)| *route == flow.route) {
                continue;
            }
            let progress = match before.get(&flow.id) {
                Some(progress) => progress.after(passed, &flow, hearing, starves, self.limit),
                None => Progress::new(&flow),
            };
            if progress.idle >= self.limit {
                found.stalled.push((flow.route, StallCause::NothingRead));
            } else if progress.pace.held >= self.limit * PERIOD {
                let why = if flow.lacks_keys { StallCause::NoKeys } else { StallCause::TooSlow };
                found.stalled.push((flow.route, why));
            } else {
                self.flows.insert(flow.id, progress);
            }
        }
        found
    }

    fn listen(&mut self, heard: u64, now: Duration) -> LinkActivity {
        if heard != self.heard.0 {
            self.heard = (heard, now);
        }
        self.hearing(now)
    }

    fn hearing(&self, now: Duration) -> LinkActivity {
        match now.saturating_sub(self.heard.1) {
            short if short < SILENT => LinkActivity::Heard,
            long if long < GONE => LinkActivity::Silent,
            _ => LinkActivity::Gone,
        }
    }
}

impl Progress {
    fn new(flow: &BusyFlow) -> Self {
        let refused = flow.refused.unwrap_or_default();
        Self { at: flow.progress, refused, ..Self::default() }
    }

    /// Updates the progress after the time `passed`.
    fn after(
        mut self,
        passed: Duration,
        flow: &BusyFlow,
        hearing: LinkActivity,
        starves: bool,
        limit: Duration,
    ) -> Self {
        // Sticky until there is progress: not every check comes soon after a publish.
        let is_held = flow.refused.is_some_and(|refused| refused != self.refused);
        let moved = flow.progress != self.at;
        // Other hosts, the peer among them, may use up the keys of the same store: that counts as waiting for
        // others.
        let waits_for_others = (flow.waits_for_others && !starves) || flow.lacks_keys;
        match hearing {
            _ if moved || flow.waits_for_limit => self.idle = Duration::ZERO,
            _ if flow.is_service && !is_held && !starves => self.idle = Duration::ZERO,
            // The peer is not at fault while its flow waits for others. Earlier time stays, because there was
            // no progress since.
            LinkActivity::Heard if waits_for_others => {}
            LinkActivity::Heard => self.idle += passed,
            LinkActivity::Silent | LinkActivity::Gone if !is_held => self.idle = Duration::ZERO,
            LinkActivity::Silent => {}
            LinkActivity::Gone => self.idle += passed,
        }
        let passed = passed + std::mem::take(&mut self.kept);
        self.pace.taken += flow.progress.0.saturating_sub(self.at.0);
        match is_held {
            // While a limit of this host holds the samples, no time counts against the peer.
            true if flow.waits_for_limit => self.pace.pay_back(passed),
            true if waits_for_others => self.pace.hold(passed / OTHERS, flow, limit),
            true => self.pace.hold(passed, flow, limit),
            false => self.pace.rest(passed, limit),
        }
        if moved {
            self.at = flow.progress;
            self.refused = flow.refused.unwrap_or(self.refused);
        }
        self
    }

    /// Adds time in which the samples waited without a flow. `idle` of it counts as time without progress.
    pub(super) fn keep(&mut self, kept: Duration, idle: Duration) {
        self.kept += kept;
        self.idle += idle;
    }

    /// Merges two flows that continue as one, and keeps the worse values. `at` is their common progress.
    pub(super) fn and(self, other: Self, at: (u64, u64)) -> Self {
        let pace = if other.pace.held > self.pace.held { other.pace } else { self.pace };
        Self {
            at,
            idle: self.idle.max(other.idle),
            refused: self.refused.min(other.refused),
            pace,
            kept: self.kept.max(other.kept),
        }
    }
}

impl Pace {
    /// Adds time in which a flow held up its publisher. Starts anew if the peer took its share.
    fn hold(&mut self, passed: Duration, flow: &BusyFlow, limit: Duration) {
        if self.held.is_zero() {
            (self.taken, self.waited) = (0, flow.keeps.unwrap_or_default());
        }
        self.held += passed;
        self.free = Duration::ZERO;
        if self.held >= limit * PERIOD && self.taken >= self.waited.div_ceil(SHARE) {
            *self = Self::default();
        }
    }

    /// Adds time in which a flow did not hold up its publisher. Starts anew after a rest.
    fn rest(&mut self, passed: Duration, limit: Duration) {
        self.free += passed;
        if self.free >= limit {
            *self = Self::default();
        }
    }

    /// Subtracts time in which a limit of this host held up the publisher.
    fn pay_back(&mut self, passed: Duration) {
        self.held = self.held.saturating_sub(passed);
    }
}
