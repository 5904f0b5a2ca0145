use super::*;

const LIMIT: Duration = Duration::from_secs(10);
const FLOW: BusyFlow = BusyFlow {
    id: 3,
    route: 1,
    is_stalled: false,
    progress: (0, 0),
    keeps: Some(1),
    refused: None,
    is_service: false,
    uses_credit: false,
    waits_for_others: false,
    waits_for_limit: false,
    lacks_keys: false,
    is_quiet: false,
};

/// Checks the flows of a peer whose frames arrive, for twenty minutes. Returns the first result and its time.
fn look(
    is_awaited: bool,
    busy: impl Fn(Duration) -> Vec<BusyFlow>,
    heard: impl Fn(Duration) -> u64,
) -> Option<(Duration, StallReport)> {
    let mut stalls = FlowStalls::new(LIMIT, Duration::ZERO);
    while stalls.poll_timeout() < Duration::from_secs(1200) {
        let now = stalls.poll_timeout();
        let peer = PeerActivity { heard: heard(now), returned: 0, is_awaited };
        let found = stalls.handle_timeout(now, peer, busy(now).into_iter());
        if found != StallReport::default() {
            return Some((now, found));
        }
    }
    None
}

fn secs(now: Duration) -> u64 {
    now.as_secs()
}

/// Returns a flow whose publisher cannot publish from the start.
fn held(now: Duration) -> BusyFlow {
    BusyFlow { refused: Some(10 * now.as_secs()), ..FLOW }
}

fn stalled(why: StallCause) -> StallReport {
    StallReport { stalled: vec![(1, why)], quiet: Vec::new() }
}

#[test]
fn peer_that_acknowledges_bytes_but_no_sample_is_stalled() {
    let busy = |now: Duration| {
        let parts = now.as_secs() / 9;
        vec![BusyFlow { progress: (0, parts), keeps: Some(30), ..held(now) }]
    };
    let (at, found) = look(false, busy, secs).expect("it is found");
    assert_eq!(found, stalled(StallCause::TooSlow));
    assert!(at >= LIMIT * PERIOD, "{at:?}");
}

#[test]
fn a_route_without_progress_is_stalled_after_the_limit_and_told_of_once() {
    let two = [FLOW, BusyFlow { id: 4, ..FLOW }];
    let found = Some((CHECK_INTERVAL + LIMIT, stalled(StallCause::NothingRead)));
    assert_eq!(look(false, |_| two.into(), secs), found);
    assert_eq!(look(false, |now| vec![held(now)], secs), found);
    assert_eq!(look(false, |_| vec![BusyFlow { is_stalled: true, ..FLOW }], secs), None);
}

#[test]
fn progress_waiting_for_others_and_limits_excuse() {
    let progress = |now: Duration| vec![BusyFlow { progress: (secs(now) / 9, 0), ..held(now) }];
    assert_eq!(look(false, progress, secs), None);
    let waits = |now: Duration| {
        vec![BusyFlow { waits_for_others: true, progress: (secs(now) / 90, 0), ..held(now) }]
    };
    assert_eq!(look(false, waits, secs), None);
    let waits = |now| vec![BusyFlow { waits_for_limit: true, ..held(now) }];
    assert_eq!(look(false, waits, secs), None);
    assert_eq!(look(false, waits, |_| 0), None, "the peer has all that passed");
}

/// A peer whose KME draws from the same store can make this host's KME run out of keys.
#[test]
fn a_kme_without_keys_excuses_for_longer_than_the_limit_and_not_for_good() {
    let lacks = |now| vec![BusyFlow { lacks_keys: true, ..held(now) }];
    let (at, found) = look(false, lacks, secs).expect("it is found");
    assert_eq!(found, stalled(StallCause::NoKeys));
    assert!(at >= LIMIT * PERIOD * OTHERS && at <= LIMIT * PERIOD * OTHERS + LIMIT, "{at:?}");
    // A flow that holds up no publisher is not judged.
    assert_eq!(look(false, |_| vec![BusyFlow { lacks_keys: true, ..FLOW }], secs), None);
    // An outage that ends does not count for more than its share either.
    let comes = |now: Duration| {
        let lacks_keys = !secs(now).is_multiple_of(100);
        vec![BusyFlow { lacks_keys, progress: (secs(now) / 100, 0), ..held(now) }]
    };
    assert_eq!(look(false, comes, secs), None);
}

#[test]
fn an_outage_excuses_a_flow_that_blocks_no_publisher() {
    assert_eq!(look(false, |_| vec![FLOW], |_| 0), None);
    // Other flows hold up the publisher, or it was held up before.
    let before = BusyFlow { refused: Some(7), ..FLOW };
    assert_eq!(look(false, |_| vec![before], |_| 0), None);
}

#[test]
fn a_peer_that_sends_something_now_and_then_holds_no_publisher_up_for_long() {
    for every in [5, 6, 7, 8, 9, 15, 19] {
        let heard = |now: Duration| secs(now) / every;
        let (at, found) = look(false, |now| vec![held(now)], heard).expect("it is found");
        assert_eq!(found, stalled(StallCause::NothingRead));
        // Frames arrive for at least five seconds in each of these periods.
        assert!(at <= CHECK_INTERVAL + Duration::from_secs(2 * every) + GONE, "{every}: {at:?}");
    }
}

#[test]
fn switched_off_host_holds_up_a_publisher_for_the_stall_limit() {
    let (at, found) = look(false, |now| vec![held(now)], |_| 0).expect("it is found");
    assert_eq!(found, stalled(StallCause::NothingRead));
    assert!(at >= GONE && at <= GONE + LIMIT, "{at:?}");
    // If the peer holds up no publisher before it is gone, the limit starts then.
    let late = |now: Duration| vec![BusyFlow { refused: Some(secs(now).max(60)), ..FLOW }];
    let (at, _) = look(false, late, |_| 0).expect("it is found");
    assert_eq!(at, Duration::from_secs(60) + LIMIT);
}

#[test]
fn waiting_for_other_flows_excuses_no_flow_while_the_peer_is_gone() {
    let waits = |now| vec![BusyFlow { waits_for_others: true, ..held(now) }];
    let (at, found) = look(true, waits, |_| 0).expect("it is found");
    assert_eq!(found, stalled(StallCause::NothingRead));
    assert!(at <= GONE + LIMIT, "{at:?}");
}

#[test]
fn peer_that_holds_up_a_publisher_takes_its_share_or_counts_as_stalled() {
    let period = LIMIT * PERIOD;
    let taking = |every: u64, keeps: u64| {
        move |now: Duration| {
            vec![BusyFlow { progress: (secs(now) / every, 0), keeps: Some(keeps), ..held(now) }]
        }
    };
    // One sample in nine seconds, of 8,192 and of 64.
    let (at, found) = look(false, taking(9, 8192), secs).expect("it is found");
    assert_eq!(found, stalled(StallCause::TooSlow));
    assert!(at >= period && at <= period + LIMIT, "{at:?}");
    assert_eq!(look(false, taking(9, 64 * 13), secs), None);
    // Two samples in a second.
    let twice = |now: Duration| {
        vec![BusyFlow { progress: (2 * secs(now), 0), keeps: Some(8192), ..held(now) }]
    };
    assert_eq!(look(false, twice, secs), None);
    // A flow that holds up no publisher may be arbitrarily slow.
    let calm = |now: Duration| vec![BusyFlow { refused: Some(7), ..taking(9, 8192)(now)[0] }];
    assert_eq!(look(false, calm, secs), None);
}

#[test]
fn a_briefly_unblocked_publisher_does_not_excuse_a_slow_flow() {
    let slow = |now: Duration| {
        let refused = (!secs(now).is_multiple_of(9)).then(|| 10 * secs(now));
        vec![BusyFlow { progress: (secs(now) / 9, 0), keeps: Some(8192), refused, ..FLOW }]
    };
    let (_, found) = look(false, slow, secs).expect("it is found");
    assert_eq!(found, stalled(StallCause::TooSlow));
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
    assert_eq!(
        (at, found),
        (2 * LIMIT - CHECK_INTERVAL, stalled(StallCause::NothingRead)),
        "the last excuse"
    );
    let uses = BusyFlow { keeps: None, uses_credit: true, ..FLOW };
    let (at, found) = look(true, |_| vec![uses], secs).unwrap();
    assert_eq!(
        (at, found),
        (2 * LIMIT, stalled(StallCause::NothingRead)),
        "from when it is judged"
    );
    assert_eq!(look(false, |_| vec![uses], secs), None);
    // Occasional frames do not avoid that either.
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
    let found = StallReport { stalled: Vec::new(), quiet: vec![3] };
    assert_eq!(look(false, |_| vec![quiet], secs), Some((CHECK_INTERVAL, found)));
    let (_, found) = look(false, |_| vec![BusyFlow { is_quiet: true, ..FLOW }], secs).unwrap();
    assert!(found.quiet.is_empty(), "it is judged");
}

fn peer(heard: u64) -> PeerActivity {
    PeerActivity { heard, returned: 0, is_awaited: false }
}

#[test]
fn a_number_that_was_forgotten_is_judged_anew() {
    let mut stalls = FlowStalls::new(LIMIT, Duration::ZERO);
    for second in 1..=5 {
        stalls.handle_timeout(CHECK_INTERVAL * second as u32, peer(second), [FLOW].into_iter());
    }
    assert_eq!(stalls.flows[&FLOW.id].idle, 4 * CHECK_INTERVAL);
    stalls.forget(FLOW.id);
    stalls.forget(FLOW.id);
    let found = stalls.handle_timeout(CHECK_INTERVAL + LIMIT, peer(6), [FLOW].into_iter());
    assert_eq!(found, StallReport::default());
}

/// Daemons of one host take over from each other. Each lives for `life`, and its samples are kept for `kept`
/// afterwards. `flow` returns the flow's state at a time, and `progress` its progress since the start of that
/// life. Returns the first result and its time.
fn one_after_another(
    life: Duration,
    kept: Duration,
    flow: impl Fn(Duration) -> BusyFlow,
    progress: impl Fn(Duration) -> (u64, u64),
) -> Option<(Duration, StallReport)> {
    let (mut now, mut known) = (Duration::ZERO, None::<Progress>);
    while now < Duration::from_secs(1200) {
        let (begin, end) = (now, now + life);
        let mut stalls = FlowStalls::new(LIMIT, begin);
        if let Some(known) = known {
            stalls.inherit(FLOW.id, (0, 0), known, begin);
        }
        let is = |now| BusyFlow { progress: progress(now - begin), ..flow(now) };
        while stalls.poll_timeout() < end {
            now = stalls.poll_timeout();
            let found =
                stalls.handle_timeout(now, peer(now.as_millis() as u64), [is(now)].into_iter());
            if found != StallReport::default() {
                return Some((now, found));
            }
        }
        let mut left = stalls.leave(&is(end), end);
        left.keep(kept, kept / 2);
        (known, now) = (Some(left), end + kept);
    }
    None
}

#[test]
fn one_daemon_after_another_is_no_way_around_the_limit() {
    for (life, kept) in [(9000, 500), (700, 100), (300, 5000), (1500, 9000)] {
        let [life, kept] = [life, kept].map(Duration::from_millis);
        let (at, found) = one_after_another(life, kept, held, |_| (0, 0)).expect("it is found");
        assert_eq!(found, stalled(StallCause::NothingRead));
        // Allows for the time in which samples are kept, and for the first second of the first life.
        let lives = LIMIT.as_millis().div_ceil(life.as_millis()) as u32 + 4;
        assert!(at <= lives * (life + kept), "{life:?} {kept:?}: {at:?}");
    }
}

#[test]
fn the_pace_goes_on_over_all_daemons_of_a_host() {
    let period = LIMIT * PERIOD;
    // Each daemon takes one sample of very many.
    let busy = |now: Duration| {
        let refused = Some(now.as_millis() as u64);
        BusyFlow { refused, keeps: Some(1 << 16), ..FLOW }
    };
    for (life, kept) in [(9000, 500), (700, 100), (300, 5000), (1500, 9000)] {
        let [life, kept] = [life, kept].map(Duration::from_millis);
        let one = |since: Duration| (u64::from(since * 2 > life), 0);
        let (at, found) = one_after_another(life, kept, busy, one).expect("it is found");
        assert_eq!(found, stalled(StallCause::TooSlow), "{life:?} {kept:?}");
        assert!(at <= period + 3 * (life + kept) + CHECK_INTERVAL, "{life:?} {kept:?}: {at:?}");
        // A peer that takes its share is not cut.
        let many = |since: Duration| (since.as_millis() as u64 * 2, 0);
        assert_eq!(one_after_another(life, kept, busy, many), None);
    }
}

#[test]
fn a_flow_inherits_the_longest_known_idle_time() {
    let (now, idle) = (Duration::from_secs(5), LIMIT - CHECK_INTERVAL);
    let known = |idle| Progress { idle, ..Progress::default() };
    let after = |flow: BusyFlow| {
        let mut stalls = FlowStalls::new(LIMIT, now);
        stalls.flows.insert(FLOW.id, known(CHECK_INTERVAL));
        stalls.inherit(FLOW.id, (3, 0), known(idle), now);
        stalls.inherit(FLOW.id, (3, 0), known(CHECK_INTERVAL), now);
        stalls.handle_timeout(now + CHECK_INTERVAL, peer(1), [flow].into_iter())
    };
    assert_eq!(after(BusyFlow { progress: (3, 0), ..FLOW }), stalled(StallCause::NothingRead));
    assert_eq!(after(BusyFlow { progress: (4, 0), ..FLOW }), StallReport::default());
}

#[test]
fn an_excuse_now_and_then_is_no_way_out_of_the_pace() {
    let slow = |now: Duration| BusyFlow {
        progress: (secs(now) / 9, 0),
        keeps: Some(8192),
        waits_for_others: secs(now).is_multiple_of(5),
        ..held(now)
    };
    let (at, found) = look(false, |now| vec![slow(now)], secs).expect("it is found");
    assert_eq!(found, stalled(StallCause::TooSlow));
    assert!(at <= LIMIT * PERIOD * 5 / 4 + LIMIT, "{at:?}");
    // Excuses do not avoid the limit either.
    let busy = |now| vec![BusyFlow { progress: (0, 0), ..slow(now) }];
    let (at, found) = look(false, busy, secs).expect("it is found");
    assert_eq!(found, stalled(StallCause::NothingRead));
    assert!(at <= LIMIT * 5 / 4 + 3 * CHECK_INTERVAL, "{at:?}");
    // The flow always waits for other flows of its peer, which takes those as slowly as it likes.
    let others = |now| vec![BusyFlow { waits_for_others: true, ..slow(now) }];
    let (at, found) = look(false, others, secs).expect("it is found");
    assert_eq!(found, stalled(StallCause::TooSlow));
    assert!(at <= LIMIT * PERIOD * OTHERS + LIMIT, "{at:?}");
    // The peer is not at fault for a limit of this host.
    let limited = |now: Duration| BusyFlow {
        progress: (secs(now) / 60, 0),
        waits_for_limit: !secs(now).is_multiple_of(3),
        waits_for_others: false,
        ..slow(now)
    };
    assert_eq!(look(false, |now| vec![limited(now)], secs), None);
}

#[test]
fn silence_now_and_then_is_no_way_out_of_the_pace() {
    for every in [7, 12, 19] {
        let slow = |now: Duration| {
            vec![BusyFlow { progress: (secs(now) / every, 0), keeps: Some(8192), ..held(now) }]
        };
        let (at, found) = look(false, slow, |now| secs(now) / every).expect("it is found");
        assert_eq!(found, stalled(StallCause::TooSlow), "{every}");
        assert!(at <= LIMIT * PERIOD + LIMIT, "{every}: {at:?}");
    }
}

#[test]
fn one_look_counts_for_two_seconds_at_most() {
    let mut stalls = FlowStalls::new(LIMIT, Duration::ZERO);
    stalls.handle_timeout(CHECK_INTERVAL, peer(1), [FLOW].into_iter());
    let after = Duration::from_secs(60);
    let found = stalls.handle_timeout(after, peer(2), [FLOW].into_iter());
    assert_eq!(found, StallReport::default(), "this host was stopped");
    assert_eq!(stalls.flows[&FLOW.id].idle, LONGEST_LOOK);
}

#[test]
fn the_first_stall_check_is_one_interval_after_the_first_sample() {
    let mut stalls = FlowStalls::new(LIMIT, Duration::ZERO);
    let now = Duration::from_secs(100);
    stalls.handle_first(now);
    assert_eq!(stalls.poll_timeout(), now + CHECK_INTERVAL);
    stalls.handle_first(Duration::ZERO);
    assert_eq!(stalls.poll_timeout(), now + CHECK_INTERVAL);
}

#[test]
fn a_server_that_takes_its_time_is_judged_once_a_client_finds_no_room() {
    let service = |now: Duration| BusyFlow { is_service: true, ..held(now) };
    // Calls wait, and there is room for more.
    assert_eq!(look(false, |now| vec![BusyFlow { refused: Some(7), ..service(now) }], secs), None);
    assert_eq!(look(false, |now| vec![BusyFlow { refused: None, ..service(now) }], secs), None);
    let found = look(false, |now| vec![service(now)], secs);
    assert_eq!(found, Some((CHECK_INTERVAL + LIMIT, stalled(StallCause::NothingRead))));
}
