//! Finds routes that the peer asked for and does not read. A flow that waits for the credit of others is excused, as long
//! as credit comes back. If none does, those who use it are judged, KEEP_ALL or not.
//!
//! Time without progress is added up look by look. While the peer is silent it stands still: the link is at fault then.
//! It goes on if the peer is heard, whatever of it is heard, or once it is silent for so long that it counts as gone.
//! A flow that holds nobody up begins anew while the peer is silent, so that an outage drops nothing of it.
//!
//! A peer that makes some progress now and then is judged by its [pace](Pace), which counts silence too. The next daemon
//! of the peer's host goes on with both where the last one ended, so a new link or daemon id is no way around them.

#[cfg(test)]
mod tests;

use std::{collections::HashMap, time::Duration};

use super::schedule::FlowId;

/// Between two looks.
const LOOK: Duration = Duration::from_secs(1);
/// The longest time that one look counts: this host may have been stopped.
const LONGEST_LOOK: Duration = Duration::from_secs(2);
/// After so long without anything of the peer the link is at fault, and time stands still for its routes.
const SILENT: Duration = Duration::from_secs(6);
/// After so long a peer is gone, as the graph has it. From then on it may hold nobody up any more.
const GONE: Duration = Duration::from_secs(20);
/// A peer that holds a publisher up takes a [`SHARE`]th of what waits for it in so many times the limit.
const PERIOD: u32 = 12;
const SHARE: u64 = 64;
/// One in so many seconds counts in which a flow that holds a publisher up waits for others of its peer. The peer decides
/// how soon it takes in those.
const OTHERS: u32 = 8;

/// KEEP_ALL flows with samples that are not acknowledged.
#[derive(Debug)]
pub(super) struct FlowStalls {
    limit: Duration,
    flows: HashMap<FlowId, Progress>,
    /// Frames of the peer, and when there was a new one.
    heard: (u64, Duration),
    /// How often credit came back.
    returned: u64,
    /// For how long flows have waited for credit since some came back.
    starved: Duration,
    /// When time was counted last.
    looked: Duration,
    next: Duration,
}

/// What is known of a flow that is judged.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Progress {
    at: (u64, u64),
    /// Time without progress.
    idle: Duration,
    /// Publishes that had found no room when there was progress last.
    refused: u64,
    pace: Pace,
    /// Time in which there was no flow, and samples waited: the next look counts it.
    kept: Duration,
}

/// How much a peer takes that holds a publisher up. All the time counts until the publisher has rested, or the peer has
/// taken its share.
#[derive(Clone, Copy, Debug, Default)]
struct Pace {
    /// For how long it has held the publisher up.
    held: Duration,
    /// For how long it has not.
    free: Duration,
    /// Samples that it has acknowledged since the beginning.
    taken: u64,
    /// Samples that waited at the beginning.
    waited: u64,
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
    /// Samples that are acknowledged, and parts of them that are sent.
    pub(super) progress: (u64, u64),
    /// Samples that a KEEP_ALL relay has its publisher keep, if there are any.
    pub(super) keeps: Option<u64>,
    /// How many publishes found no room, if that relay is why the next one may not.
    pub(super) refused: Option<u64>,
    /// Whether it is of a service: calls may wait for a slow server as long as there is room for the next ones.
    pub(super) is_service: bool,
    /// Whether it uses credit for which others may have to wait.
    pub(super) uses_credit: bool,
    /// Whether it waits for others: none of its samples is in flight.
    pub(super) waits_for_others: bool,
    /// Whether a limit of this host holds its samples.
    pub(super) waits_for_limit: bool,
    /// Whether nothing of it is in flight, and this host's KME gives no keys for the next sample.
    pub(super) lacks_keys: bool,
    /// Whether nothing of it waits, or is not acknowledged.
    pub(super) is_quiet: bool,
}

/// Why a route counts as stalled.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum StallCause {
    /// Nothing of it was read for the limit.
    NothingRead,
    /// A publisher was held up, and less than a [`SHARE`]th of what it keeps was read in [`PERIOD`] times the limit.
    TooSlow,
    /// A publisher was held up for as long, last since this host's KME gave no keys.
    NoKeys,
}

/// What a look found.
#[derive(Debug, Default, PartialEq, Eq)]
pub(super) struct StallReport {
    /// Routes that made no progress for the limit, or too little.
    pub(super) stalled: Vec<(u32, StallCause)>,
    /// Flows that are busy no more.
    pub(super) quiet: Vec<FlowId>,
}

/// Whether a peer is heard.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Hearing {
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
            next: now + LOOK,
        }
    }

    /// A flow is gone. Its number is another's next.
    pub(super) fn forget(&mut self, flow: FlowId) {
        self.flows.remove(&flow);
    }

    /// A flow is about to end, and another one may go on with its samples. Returns what is known of it.
    pub(super) fn leave(&mut self, flow: &BusyFlow, now: Duration) -> Progress {
        let passed = now.saturating_sub(self.looked).min(LONGEST_LOOK);
        let (hearing, starves) = (self.hearing(now), self.starves());
        match self.flows.remove(&flow.id) {
            Some(progress) => progress.after(passed, flow, hearing, starves, self.limit),
            None => Progress::new(flow),
        }
    }

    /// When time was counted last.
    pub(super) fn looked(&self) -> Duration {
        self.looked
    }

    /// A flow that made this progress goes on with the samples of one that ended, and with what is known of that. If its
    /// time is over it is looked at at once: no link needs to be long enough for a look.
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

    /// Samples wait, and none did before: nobody looked while there was nothing.
    pub(super) fn handle_first(&mut self, now: Duration) {
        self.looked = self.looked.max(now);
        self.next = self.next.max(now + LOOK);
    }

    /// Whether flows have waited for credit for the limit, and none came back. Then no flow that waits is excused any
    /// more, and those that use credit are judged, too.
    pub(super) fn starves(&self) -> bool {
        self.starved >= self.limit
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
    ) -> StallReport {
        let mut found = StallReport::default();
        if now < self.next {
            return found;
        }
        let passed = now.saturating_sub(self.looked).min(LONGEST_LOOK);
        (self.looked, self.next) = (now, now + LOOK);
        let hearing = self.listen(peer.heard, now);
        if peer.returned != self.returned || !peer.is_awaited {
            (self.returned, self.starved) = (peer.returned, Duration::ZERO);
        } else if hearing == Hearing::Heard {
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

    fn listen(&mut self, heard: u64, now: Duration) -> Hearing {
        if heard != self.heard.0 {
            self.heard = (heard, now);
        }
        self.hearing(now)
    }

    fn hearing(&self, now: Duration) -> Hearing {
        match now.saturating_sub(self.heard.1) {
            short if short < SILENT => Hearing::Heard,
            long if long < GONE => Hearing::Silent,
            _ => Hearing::Gone,
        }
    }
}

impl Progress {
    fn new(flow: &BusyFlow) -> Self {
        let refused = flow.refused.unwrap_or_default();
        Self { at: flow.progress, refused, ..Self::default() }
    }

    /// The flow is looked at again after a time.
    fn after(
        mut self,
        passed: Duration,
        flow: &BusyFlow,
        hearing: Hearing,
        starves: bool,
        limit: Duration,
    ) -> Self {
        // Sticky until there is progress: not every look is soon after a publish.
        let is_held = flow.refused.is_some_and(|refused| refused != self.refused);
        let moved = flow.progress != self.at;
        // Another one may draw from the same store of keys, the peer among them: this counts as waiting for others.
        let waits_for_others = (flow.waits_for_others && !starves) || flow.lacks_keys;
        match hearing {
            _ if moved || flow.waits_for_limit => self.idle = Duration::ZERO,
            _ if flow.is_service && !is_held && !starves => self.idle = Duration::ZERO,
            // What others have it wait for is no fault of it. What went before stays: there was no progress since.
            Hearing::Heard if waits_for_others => {}
            Hearing::Heard => self.idle += passed,
            Hearing::Silent | Hearing::Gone if !is_held => self.idle = Duration::ZERO,
            Hearing::Silent => {}
            Hearing::Gone => self.idle += passed,
        }
        let passed = passed + std::mem::take(&mut self.kept);
        self.pace.taken += flow.progress.0.saturating_sub(self.at.0);
        match is_held {
            // The peer has all that passed.
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

    /// The samples waited for so long, and no flow sent them. `idle` of it counts as time without progress.
    pub(super) fn keep(&mut self, kept: Duration, idle: Duration) {
        self.kept += kept;
        self.idle += idle;
    }

    /// The worse of two flows that go on as one, which made this progress.
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
    /// Counts a time in which a flow held its publisher up. Where it took its share it begins anew.
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

    /// Counts a time in which a flow did not hold its publisher up. After a rest it begins anew.
    fn rest(&mut self, passed: Duration, limit: Duration) {
        self.free += passed;
        if self.free >= limit {
            *self = Self::default();
        }
    }

    /// Takes off a time in which a limit of this host held the publisher up.
    fn pay_back(&mut self, passed: Duration) {
        self.held = self.held.saturating_sub(passed);
    }
}
