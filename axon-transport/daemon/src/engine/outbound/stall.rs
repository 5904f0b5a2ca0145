//! Finds routes that the peer asked for and does not read. A flow that waits for the credit of others is excused, as long
//! as credit comes back. If none does, those who use it are judged, KEEP_ALL or not.
//!
//! Time without progress is added up look by look. While the peer is silent it stands still: the link is at fault then.
//! It goes on if the peer is heard, whatever of it is heard, or once it is silent for so long that it counts as gone.
//! A flow that holds nobody up begins anew while the peer is silent, so that an outage drops nothing of it.

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

/// KEEP_ALL flows with samples that are not acknowledged.
#[derive(Debug)]
pub(super) struct Stalls {
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

#[derive(Clone, Copy, Debug, Default)]
struct Progress {
    at: (u64, u64),
    /// Time without progress.
    idle: Duration,
    /// Publishes that had found no room when there was progress last.
    refused: u64,
    pace: Pace,
}

/// How much a peer takes that holds a publisher up.
#[derive(Clone, Copy, Debug, Default)]
struct Pace {
    /// For how long it has held the publisher up.
    held: Duration,
    /// For how long it has not.
    free: Duration,
    /// Samples that it had acknowledged at the beginning, and samples that waited then.
    begin: (u64, u64),
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
    /// Whether it uses credit for which others may have to wait.
    pub(super) uses_credit: bool,
    /// Whether it waits for others: none of its samples is in flight.
    pub(super) waits_for_others: bool,
    /// Whether a limit of this host holds its samples.
    pub(super) waits_for_limit: bool,
    /// Whether nothing of it waits, or is not acknowledged.
    pub(super) is_quiet: bool,
}

/// Why a route counts as stalled.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Stall {
    /// Nothing of it was read for the limit.
    NothingRead,
    /// A publisher was held up, and less than a [`SHARE`]th of what it keeps was read in [`PERIOD`] times the limit.
    TooSlow,
}

/// What a look found.
#[derive(Debug, Default, PartialEq, Eq)]
pub(super) struct Found {
    /// Routes that made no progress for the limit, or too little.
    pub(super) stalled: Vec<(u32, Stall)>,
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

impl Stalls {
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

    /// A flow is gone. Its number is another's next. Returns for how long it made no progress.
    pub(super) fn forget(&mut self, flow: FlowId) -> Duration {
        self.flows.remove(&flow).map_or(Duration::ZERO, |progress| progress.idle)
    }

    /// A new flow goes on where another one made no progress for so long.
    pub(super) fn inherit(&mut self, flow: FlowId, idle: Duration) {
        self.flows.entry(flow).or_insert(Progress { idle, ..Progress::default() });
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
    ) -> Found {
        let mut found = Found::default();
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
                found.stalled.push((flow.route, Stall::NothingRead));
            } else if progress.pace.held >= self.limit * PERIOD {
                found.stalled.push((flow.route, Stall::TooSlow));
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
        let is_excused = flow.waits_for_limit || flow.waits_for_others && !starves;
        match hearing {
            _ if moved || flow.waits_for_limit => self.idle = Duration::ZERO,
            Hearing::Heard if is_excused => self.idle = Duration::ZERO,
            Hearing::Heard => self.idle += passed,
            Hearing::Silent | Hearing::Gone if !is_held => self.idle = Duration::ZERO,
            Hearing::Silent => {}
            Hearing::Gone => self.idle += passed,
        }
        if moved {
            self.at = flow.progress;
            self.refused = flow.refused.unwrap_or(self.refused);
        }
        if is_excused {
            self.pace = Pace::default();
        } else if hearing == Hearing::Heard {
            self.pace.add(passed, is_held, flow, limit);
        }
        self
    }
}

impl Pace {
    /// Counts a time in which a flow held its publisher up, or did not. Where it took its share it begins anew.
    fn add(&mut self, passed: Duration, is_held: bool, flow: &BusyFlow, limit: Duration) {
        if is_held {
            if self.held.is_zero() {
                self.begin = (flow.progress.0, flow.keeps.unwrap_or_default());
            }
            self.held += passed;
            self.free = Duration::ZERO;
        } else {
            self.free += passed;
        }
        let taken = flow.progress.0.saturating_sub(self.begin.0);
        let is_over = self.held >= limit * PERIOD;
        if self.free >= limit || is_over && taken >= self.begin.1.div_ceil(SHARE) {
            *self = Self::default();
        }
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
        keeps: Some(1),
        refused: None,
        uses_credit: false,
        waits_for_others: false,
        waits_for_limit: false,
        is_quiet: false,
    };

    /// Looks for ten minutes at flows of a peer that is heard. Returns what was found first, and when.
    fn look(
        is_awaited: bool,
        busy: impl Fn(Duration) -> Vec<BusyFlow>,
        heard: impl Fn(Duration) -> u64,
    ) -> Option<(Duration, Found)> {
        let mut stalls = Stalls::new(LIMIT, Duration::ZERO);
        while stalls.poll_timeout() < Duration::from_secs(600) {
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

    /// A flow whose publisher tries in vain to publish, from the beginning on.
    fn held(now: Duration) -> BusyFlow {
        BusyFlow { refused: Some(10 * now.as_secs()), ..FLOW }
    }

    fn stalled(why: Stall) -> Found {
        Found { stalled: vec![(1, why)], quiet: Vec::new() }
    }

    #[test]
    fn a_peer_that_lets_bytes_pass_and_takes_none_of_few_samples_is_too_slow() {
        let busy = |now: Duration| {
            let parts = now.as_secs() / 9;
            vec![BusyFlow { progress: (0, parts), keeps: Some(30), ..held(now) }]
        };
        let (at, found) = look(false, busy, secs).expect("it is found");
        assert_eq!(found, stalled(Stall::TooSlow));
        assert!(at >= LIMIT * PERIOD, "{at:?}");
    }

    #[test]
    fn a_route_without_progress_is_stalled_after_the_limit_and_told_of_once() {
        let two = [FLOW, BusyFlow { id: 4, ..FLOW }];
        let found = Some((LOOK + LIMIT, stalled(Stall::NothingRead)));
        assert_eq!(look(false, |_| two.into(), secs), found);
        assert_eq!(look(false, |now| vec![held(now)], secs), found);
        assert_eq!(look(false, |_| vec![BusyFlow { is_stalled: true, ..FLOW }], secs), None);
    }

    #[test]
    fn progress_waiting_for_others_and_limits_excuse() {
        let progress = |now: Duration| vec![BusyFlow { progress: (secs(now) / 9, 0), ..held(now) }];
        assert_eq!(look(false, progress, secs), None);
        let waits = |now| vec![BusyFlow { waits_for_others: true, ..held(now) }];
        assert_eq!(look(false, waits, secs), None);
        let waits = |now| vec![BusyFlow { waits_for_limit: true, ..held(now) }];
        assert_eq!(look(false, waits, secs), None);
        assert_eq!(look(false, waits, |_| 0), None, "the peer has all that passed");
    }

    #[test]
    fn an_outage_excuses_a_flow_that_holds_nobody_up() {
        assert_eq!(look(false, |_| vec![FLOW], |_| 0), None);
        // Others hold the publisher up, or it was held up before.
        let before = BusyFlow { refused: Some(7), ..FLOW };
        assert_eq!(look(false, |_| vec![before], |_| 0), None);
    }

    #[test]
    fn a_peer_that_sends_something_now_and_then_holds_no_publisher_up_for_long() {
        for every in [5, 6, 7, 8, 9, 15, 19] {
            let heard = |now: Duration| secs(now) / every;
            let (at, found) = look(false, |now| vec![held(now)], heard).expect("it is found");
            assert_eq!(found, stalled(Stall::NothingRead));
            // It is heard for five seconds at least in each of these times.
            assert!(at <= LOOK + Duration::from_secs(2 * every) + GONE, "{every}: {at:?}");
        }
    }

    #[test]
    fn a_host_that_is_switched_off_holds_a_publisher_up_until_it_is_gone_and_the_limit_is_over() {
        let (at, found) = look(false, |now| vec![held(now)], |_| 0).expect("it is found");
        assert_eq!(found, stalled(Stall::NothingRead));
        assert!(at >= GONE && at <= GONE + LIMIT, "{at:?}");
        // If it holds nobody up before it is gone, the limit begins then.
        let late = |now: Duration| vec![BusyFlow { refused: Some(secs(now).max(60)), ..FLOW }];
        let (at, _) = look(false, late, |_| 0).expect("it is found");
        assert_eq!(at, Duration::from_secs(60) + LIMIT);
    }

    #[test]
    fn waiting_for_others_excuses_nobody_while_the_peer_is_gone() {
        let waits = |now| vec![BusyFlow { waits_for_others: true, ..held(now) }];
        let (at, found) = look(true, waits, |_| 0).expect("it is found");
        assert_eq!(found, stalled(Stall::NothingRead));
        assert!(at <= GONE + LIMIT, "{at:?}");
    }

    #[test]
    fn a_peer_that_holds_a_publisher_up_takes_its_share_or_is_found_too_slow() {
        let period = LIMIT * PERIOD;
        let taking = |every: u64, keeps: u64| {
            move |now: Duration| {
                vec![BusyFlow { progress: (secs(now) / every, 0), keeps: Some(keeps), ..held(now) }]
            }
        };
        // One sample in nine seconds, of 8,192 and of 64.
        let (at, found) = look(false, taking(9, 8192), secs).expect("it is found");
        assert_eq!(found, stalled(Stall::TooSlow));
        assert!(at >= period && at <= period + LIMIT, "{at:?}");
        assert_eq!(look(false, taking(9, 64 * 13), secs), None);
        // Two in a second.
        let twice = |now: Duration| {
            vec![BusyFlow { progress: (2 * secs(now), 0), keeps: Some(8192), ..held(now) }]
        };
        assert_eq!(look(false, twice, secs), None);
        // One that holds nobody up may be as slow as it is.
        let calm = |now: Duration| vec![BusyFlow { refused: Some(7), ..taking(9, 8192)(now)[0] }];
        assert_eq!(look(false, calm, secs), None);
    }

    #[test]
    fn a_moment_in_which_the_publisher_waits_for_nobody_is_no_way_out() {
        let slow = |now: Duration| {
            let refused = (!secs(now).is_multiple_of(9)).then(|| 10 * secs(now));
            vec![BusyFlow { progress: (secs(now) / 9, 0), keeps: Some(8192), refused, ..FLOW }]
        };
        let (_, found) = look(false, slow, secs).expect("it is found");
        assert_eq!(found, stalled(Stall::TooSlow));
        let rest = |now: Duration| {
            let refused = (secs(now) % 60 < 30).then(|| 10 * secs(now));
            vec![BusyFlow { progress: (secs(now) / 9, 0), keeps: Some(8192), refused, ..FLOW }]
        };
        assert_eq!(look(false, rest, secs), None, "the publisher had its limit of rest");
    }

    #[test]
    fn a_flow_that_waits_for_credit_is_judged_once_none_comes_back() {
        let waits = BusyFlow { waits_for_others: true, ..FLOW };
        let (at, found) = look(true, |_| vec![waits], secs).unwrap();
        assert_eq!((at, found), (2 * LIMIT - LOOK, stalled(Stall::NothingRead)), "the last excuse");
        let uses = BusyFlow { keeps: None, uses_credit: true, ..FLOW };
        let (at, found) = look(true, |_| vec![uses], secs).unwrap();
        assert_eq!((at, found), (2 * LIMIT, stalled(Stall::NothingRead)), "from when it is judged");
        assert_eq!(look(false, |_| vec![uses], secs), None);
        // What is heard now and then is no way out of that either.
        let (at, _) = look(
            true,
            |now| vec![BusyFlow { waits_for_others: true, ..held(now) }],
            |now| secs(now) / 7,
        )
        .expect("it is found");
        assert!(at <= 4 * LIMIT, "{at:?}");
    }

    #[test]
    fn a_quiet_flow_is_busy_no_more_unless_it_is_judged() {
        let quiet = BusyFlow { keeps: None, is_quiet: true, ..FLOW };
        let found = Found { stalled: Vec::new(), quiet: vec![3] };
        assert_eq!(look(false, |_| vec![quiet], secs), Some((LOOK, found)));
        let (_, found) = look(false, |_| vec![BusyFlow { is_quiet: true, ..FLOW }], secs).unwrap();
        assert!(found.quiet.is_empty(), "it is judged");
    }

    #[test]
    fn a_number_that_was_forgotten_is_judged_anew() {
        let mut stalls = Stalls::new(LIMIT, Duration::ZERO);
        let peer = |heard| PeerActivity { heard, returned: 0, is_awaited: false };
        for second in 1..=5 {
            stalls.handle_timeout(peer(second), [FLOW].into_iter(), LOOK * second as u32);
        }
        assert_eq!(stalls.forget(FLOW.id), 4 * LOOK);
        assert_eq!(stalls.forget(FLOW.id), Duration::ZERO);
        let found = stalls.handle_timeout(peer(6), [FLOW].into_iter(), LOOK + LIMIT);
        assert_eq!(found, Found::default());
    }

    #[test]
    fn a_flow_goes_on_where_another_one_made_no_progress() {
        let peer = |heard| PeerActivity { heard, returned: 0, is_awaited: false };
        let after = |flow: BusyFlow| {
            let mut stalls = Stalls::new(LIMIT, Duration::ZERO);
            stalls.inherit(FLOW.id, LIMIT - LOOK);
            stalls.handle_timeout(peer(1), [flow].into_iter(), LOOK)
        };
        assert_eq!(after(FLOW), stalled(Stall::NothingRead));
        assert_eq!(after(BusyFlow { progress: (1, 0), ..FLOW }), Found::default());
    }

    #[test]
    fn one_look_counts_for_two_seconds_at_most() {
        let mut stalls = Stalls::new(LIMIT, Duration::ZERO);
        let peer = |heard| PeerActivity { heard, returned: 0, is_awaited: false };
        stalls.handle_timeout(peer(1), [FLOW].into_iter(), LOOK);
        let after = Duration::from_secs(60);
        let found = stalls.handle_timeout(peer(2), [FLOW].into_iter(), after);
        assert_eq!(found, Found::default(), "this host was stopped");
        assert_eq!(stalls.forget(FLOW.id), LONGEST_LOOK);
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
