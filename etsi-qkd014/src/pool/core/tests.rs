//! Tests the rules with a simulated clock, in particular with hostile orders of events.

use proptest::prelude::*;

use super::*;

const fn ms(millis: u64) -> Duration {
    Duration::from_millis(millis)
}

fn stock(stored_key_count: u64, max_key_per_request: u64) -> Stock {
    Stock { stored_key_count, max_key_per_request }
}

/// Creates a pool with a target, whose KME has reported its stock.
fn core(target: usize, stock: Stock) -> Core<u32> {
    let mut core = Core::new(Settings { target, ..Settings::default() }, || 255);
    assert_eq!(core.poll(ms(0)), Some(Ask::Status));
    core.on_stock(ms(0), stock);
    core
}

fn asks(core: &mut Core<u32>, now: Duration) -> Vec<Ask> {
    std::iter::from_fn(|| core.poll(now)).collect()
}

#[derive(Clone, Debug)]
enum Event {
    Pass(u64),
    /// The call in flight at this index returns this number of its keys.
    Keys(usize, u32),
    Fail(usize, FailureClass),
    Stock(u64, u64),
    Take,
    /// The key that was taken last is put back, this number of milliseconds older than it is.
    Put(u64),
    Target(usize),
    Elsewhere(usize),
    Hold(u64),
}

fn event() -> impl Strategy<Value = Event> {
    use FailureClass::{KeysLost, Refused, Unserved};
    prop_oneof![
        (0..3_000u64).prop_map(Event::Pass),
        (0..8usize, 0..10u32).prop_map(|(i, n)| Event::Keys(i, n)),
        (0..8usize, Just(u32::MAX)).prop_map(|(i, n)| Event::Keys(i, n)),
        (0..8usize, prop_oneof![Just(KeysLost), Just(Refused), Just(Unserved)])
            .prop_map(|(i, class)| Event::Fail(i, class)),
        (prop_oneof![Just(0), 0..200u64, Just(u64::MAX)], prop_oneof![Just(0), 0..20u64])
            .prop_map(|(stored, most)| Event::Stock(stored, most)),
        Just(Event::Take),
        Just(Event::Take),
        (0..2_000u64).prop_map(Event::Put),
        (0..40usize).prop_map(Event::Target),
        prop_oneof![0..12usize, Just(usize::MAX)].prop_map(Event::Elsewhere),
        (0..10_000u64).prop_map(Event::Hold),
    ]
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(512))]

    #[test]
    fn the_pool_keeps_its_rules_under_random_events(
        events in proptest::collection::vec(event(), 0..200),
        batch in 0..12u32,
        calls in 0..6usize,
        max_age in prop_oneof![1..20_000u64, Just(u64::MAX)],
        jitter: u8,
    ) {
        let mut settings = Settings { target: 8, batch, calls, ..Settings::default() };
        settings.max_age = if max_age == u64::MAX { Duration::MAX } else { ms(max_age) };
        let max_age = settings.max_age;
        let mut core = Core::new(settings, move || jitter);
        let (mut now, mut target, mut held_until) = (ms(0), 8, ms(0));
        let mut last_stock: Option<Stock> = None;
        let mut flying: Vec<(u32, Duration)> = Vec::new();
        let mut status_flying = false;
        // Each key is (number, time of its request).
        let mut made = 0u32;
        let mut taken = std::collections::HashSet::new();
        let (mut last_taken, mut takes, mut elsewhere) = (None, 0, 0);
        for event in events {
            match event {
                Event::Pass(millis) => now += ms(millis),
                Event::Keys(i, given) if !flying.is_empty() => {
                    let (n, _) = flying.remove(i % flying.len());
                    // The core may have counted another call of the same size as ended, so the age
                    // known here is the lowest possible one.
                    let keys: Vec<(u32, Duration)> =
                        (0..n.min(given)).map(|k| (made + k, now)).collect();
                    made += n;
                    core.on_keys(now, n, keys);
                }
                Event::Fail(i, class) if !flying.is_empty() => {
                    let (n, _) = flying.remove(i % flying.len());
                    core.on_failure(now, Ask::Keys(n), class);
                }
                Event::Stock(stored, most) if status_flying => {
                    status_flying = false;
                    let told = stock(stored, most);
                    last_stock = Some(told);
                    core.on_stock(now, told);
                }
                Event::Fail(_, class) if status_flying => {
                    status_flying = false;
                    core.on_failure(now, Ask::Status, class);
                }
                Event::Take => {
                    if let Some((key, came)) = core.take(now) {
                        prop_assert!(taken.insert(key), "taken twice");
                        prop_assert!(now - came < max_age, "too old");
                        last_taken = Some((key, came));
                        takes += 1;
                    }
                }
                Event::Put(millis) => {
                    if let Some((key, came)) = last_taken.take() {
                        taken.remove(&key);
                        core.put(came.saturating_sub(ms(millis)), (key, came));
                    }
                }
                Event::Elsewhere(keys) => {
                    elsewhere = keys;
                    core.set_elsewhere(keys);
                }
                Event::Target(keys) => {
                    target = keys;
                    core.set_target(keys);
                }
                Event::Hold(millis) => {
                    held_until = held_until.max(now + ms(millis));
                    core.hold_until(now + ms(millis));
                }
                _ => {}
            }
            while let Some(ask) = core.poll(now) {
                match ask {
                    Ask::Status => {
                        prop_assert!(!status_flying, "one status call at a time");
                        status_flying = true;
                    }
                    Ask::Keys(n) => {
                        flying.push((n, now));
                        let status = core.status(now);
                        prop_assert!(n >= 1 && n <= batch.max(1));
                        prop_assert!(flying.len() <= calls.max(1));
                        prop_assert!(now >= held_until);
                        let counted = status.asked - status.overdue;
                        let ahead = status.held + counted + elsewhere;
                        prop_assert!(ahead <= target);
                        match last_stock {
                            None => prop_assert_eq!(n, 1, "nothing is known"),
                            Some(stock) => {
                                let most = stock.max_key_per_request;
                                prop_assert!(most == 0 || u64::from(n) <= most);
                                let count = stock.stored_key_count;
                                prop_assert!(count == 0 || ahead as u64 <= (count / 4).max(1));
                            }
                        }
                    }
                }
            }
            let status = core.status(now);
            let asked: u32 = flying.iter().map(|(n, _)| n).sum();
            prop_assert_eq!(status.asked, asked as usize);
            let gone = status.taken + status.expired + status.held as u64;
            let came = status.obtained + status.put;
            prop_assert_eq!(came, gone, "no key comes or goes unseen");
            prop_assert_eq!(status.taken, takes);
            if let Some(at) = core.poll_timeout() {
                prop_assert!(at > now, "polled out, so the next thing is later");
            }
        }
        // The pool never sleeps without a timeout while keys are missing.
        if flying.is_empty() && !status_flying {
            core.set_target(1000);
            core.set_elsewhere(0);
            // Keys may grow too old before that, each batch at its own time.
            let asked = (0..1000).any(|_| {
                now = core.poll_timeout().expect("something is to come").max(now);
                core.poll(now).is_some()
            });
            prop_assert!(asked);
        }
    }
}

#[test]
fn a_kme_that_tells_nothing_is_asked_for_one_key_at_a_time() {
    let mut core: Core<u32> = Core::new(Settings::default(), || 0);
    assert_eq!(asks(&mut core, ms(0)), [Ask::Status], "no key before the KME's limits are known");
    core.on_failure(ms(0), Ask::Status, FailureClass::Unserved);
    assert_eq!(asks(&mut core, ms(0)), [Ask::Keys(1); 4]);
}

#[test]
fn zeros_in_a_status_say_nothing() {
    let mut core = core(16, stock(0, 0));
    assert_eq!(asks(&mut core, ms(0)), [Ask::Keys(8); 2]);
}

#[test]
fn the_stock_and_the_request_limit_bound_the_requested_keys() {
    let mut small = core(16, stock(20, 3));
    assert_eq!(asks(&mut small, ms(0)), [Ask::Keys(3), Ask::Keys(2)], "a quarter of 20");
    let mut last = core(16, stock(1, 8));
    assert_eq!(asks(&mut last, ms(0)), [Ask::Keys(1)]);
    let mut none = core(0, stock(1000, 8));
    assert_eq!(asks(&mut none, ms(0)), []);
}

#[test]
fn an_empty_store_halves_the_batch_and_a_success_doubles_it() {
    let mut core = core(8, stock(0, 0));
    let mut now = ms(0);
    for expected in [8, 4, 2, 1, 1] {
        now = core.poll_timeout().unwrap().max(now);
        assert_eq!(core.poll(now), Some(Ask::Keys(expected)));
        core.on_failure(now, Ask::Keys(expected), FailureClass::Refused);
        assert_eq!(core.poll(now), None, "not before the pause is over");
    }
    now = core.poll_timeout().unwrap();
    assert_eq!(core.poll(now), Some(Ask::Keys(1)));
    core.on_keys(now, 1, [0]);
    core.take(now);
    assert_eq!(core.poll(now), Some(Ask::Keys(2)));
}

#[test]
fn failures_that_may_cost_keys_wait_longer_and_jitter_stays_in_the_upper_half() {
    for (class, waits) in [
        (FailureClass::Unserved, [100, 200, 400, 800, 1_600, 2_000, 2_000]),
        (FailureClass::KeysLost, [1_000, 2_000, 4_000, 8_000, 16_000, 30_000, 30_000]),
    ] {
        for (jitter, share) in [(0, 2), (255, 1)] {
            let settings = Settings { target: 1, ..Settings::default() };
            let mut core: Core<u32> = Core::new(settings, move || jitter);
            core.poll(ms(0));
            core.on_stock(ms(0), stock(0, 0));
            // One status call is in flight all the time, so that status calls do not interfere.
            let mut now = ms(5_000);
            assert_eq!(core.poll(now), Some(Ask::Status));
            for wait in waits {
                assert_eq!(core.poll(now), Some(Ask::Keys(1)));
                core.on_failure(now, Ask::Keys(1), class);
                assert_eq!(core.poll_timeout(), Some(now + ms(wait / share)));
                now += ms(wait / share);
            }
        }
    }
}

#[test]
fn a_call_that_hangs_is_not_waited_for() {
    let mut core = core(4, stock(0, 0));
    assert_eq!(core.poll(ms(0)), Some(Ask::Keys(4)));
    assert_eq!(core.poll(ms(999)), None);
    assert_eq!(core.poll_timeout(), Some(ms(1_000)));
    for calls in 1..4 {
        assert_eq!(core.poll(ms(1_000 * calls)), Some(Ask::Keys(4)), "call {calls}");
        assert_eq!(core.poll(ms(1_000 * calls)), None);
    }
    assert_eq!(core.poll(ms(4_000)), None, "as many calls as may be");
    let status = core.status(ms(4_000));
    assert_eq!((status.asked, status.overdue), (16, 16));
    // Keys of calls that answer late are accepted, the oldest first.
    core.on_keys(ms(4_100), 4, 0..4);
    assert_eq!(core.poll(ms(4_100)), None, "nothing is missing");
    core.on_keys(ms(4_200), 4, 4..8);
    assert_eq!(core.status(ms(4_200)).held, 8);
    assert_eq!(core.take(ms(4_200)), Some(0));
}

#[test]
fn calls_that_hang_together_are_one_cause_to_wait() {
    let mut core = core(4, stock(0, 0));
    for at in [0, 1_000, 2_000, 3_000] {
        assert_eq!(core.poll(ms(at)), Some(Ask::Keys(4)));
    }
    core.on_failure(ms(3_000), Ask::Keys(4), FailureClass::KeysLost);
    for _ in 0..2 {
        core.on_failure(ms(3_500), Ask::Keys(4), FailureClass::KeysLost);
    }
    assert_eq!(core.status(ms(3_500)).failures, 1);
    assert_eq!(core.poll(ms(3_999)), None);
    assert_eq!(core.poll(ms(4_000)), Some(Ask::Keys(4)), "a second, not four");
}

#[test]
fn a_kme_that_gives_only_repeated_keys_is_not_asked_in_a_loop() {
    let mut core = core(8, stock(0, 0));
    assert_eq!(core.poll(ms(0)), Some(Ask::Keys(8)));
    core.on_keys(ms(0), 8, []);
    assert_eq!(core.poll(ms(999)), None);
    let status = core.status(ms(1_000));
    assert_eq!((status.unusable, status.failures, status.obtained), (8, 1, 0));
    assert!(status.is_stalled());
    assert_eq!(core.poll(ms(1_000)), Some(Ask::Keys(8)));
}

#[test]
fn untaken_keys_are_dropped_at_their_maximum_age() {
    struct Counted(std::sync::Arc<()>);
    let live = std::sync::Arc::new(());
    let settings = Settings { target: 2, max_age: ms(1_000), ..Settings::default() };
    let mut core: Core<Counted> = Core::new(settings, || 0);
    core.poll(ms(0));
    core.on_stock(ms(0), stock(0, 0));
    assert_eq!(core.poll(ms(0)), Some(Ask::Keys(2)));
    // The age counts from the request, because the KME deletes the keys that long after it.
    core.on_keys(ms(400), 2, [Counted(live.clone()), Counted(live.clone())]);
    assert_eq!(core.poll_timeout(), Some(ms(1_000)));
    assert!(core.take(ms(999)).is_some_and(|key| std::sync::Arc::ptr_eq(&key.0, &live)));
    assert!(core.take(ms(1_000)).is_none());
    assert_eq!(std::sync::Arc::strong_count(&live), 1, "dropped, not only hidden");
    assert_eq!(core.status(ms(1_000)).expired, 1);
}

#[test]
fn the_oldest_key_goes_first_though_answers_overtake_each_other() {
    let mut core = core(12, stock(0, 0));
    assert_eq!(core.poll(ms(0)), Some(Ask::Keys(8)));
    assert_eq!(core.poll(ms(10)), Some(Ask::Keys(4)));
    core.on_keys(ms(20), 4, 8..12);
    core.on_keys(ms(30), 8, 0..8);
    let taken: Vec<u32> = std::iter::from_fn(|| core.take(ms(40))).collect();
    assert_eq!(taken, (0..12).collect::<Vec<_>>());
}

#[test]
fn a_key_that_comes_back_takes_its_place_by_age_and_comes_out_once() {
    let settings = Settings { max_age: ms(1_000), ..Settings::default() };
    let mut core: Core<&str> = Core::new(settings, || 0);
    core.poll(ms(0));
    core.on_stock(ms(0), stock(0, 0));
    assert_eq!(core.poll(ms(100)), Some(Ask::Keys(8)));
    core.on_keys(ms(100), 8, ["b", "c"]);
    core.put(ms(0), "a");
    core.put(ms(200), "d");
    core.put(ms(100), "b again");
    let taken: Vec<&str> = std::iter::from_fn(|| core.take(ms(300))).collect();
    assert_eq!(taken, ["a", "b", "c", "b again", "d"]);
    core.set_target(2);
    core.put(ms(0), "old");
    core.put(ms(200), "d");
    assert_eq!(core.poll_timeout(), Some(ms(1_000)));
    assert_eq!(core.take(ms(1_000)), Some("d"));
    assert_eq!(core.take(ms(1_000)), None);
    let status = core.status(ms(1_000));
    assert_eq!((status.obtained, status.put, status.taken, status.expired), (2, 5, 6, 1));
}

#[test]
fn keys_that_the_owner_keeps_ready_count_towards_target_and_stock() {
    let mut pool = core(16, stock(0, 0));
    pool.set_elsewhere(10);
    assert_eq!(asks(&mut pool, ms(0)), [Ask::Keys(6)]);
    pool.on_keys(ms(0), 6, 0..6);
    while pool.take(ms(0)).is_some() {}
    pool.set_elsewhere(16);
    assert_eq!(asks(&mut pool, ms(0)), []);
    pool.set_elsewhere(13);
    assert_eq!(asks(&mut pool, ms(0)), [], "a quarter of the target is not missing yet");
    pool.set_elsewhere(usize::MAX);
    assert_eq!(asks(&mut pool, ms(0)), []);
    pool.set_elsewhere(12);
    assert_eq!(asks(&mut pool, ms(0)), [Ask::Keys(4)]);

    let mut small = core(16, stock(20, 0));
    small.set_elsewhere(3);
    assert_eq!(asks(&mut small, ms(0)), [Ask::Keys(2)], "a quarter of 20, with those elsewhere");
}

#[test]
fn a_refill_waits_for_a_batch_to_be_missing() {
    let mut core = core(16, stock(0, 0));
    assert_eq!(asks(&mut core, ms(0)), [Ask::Keys(8); 2]);
    core.on_keys(ms(0), 8, 0..8);
    core.on_keys(ms(0), 8, 8..16);
    for _ in 0..3 {
        core.take(ms(1));
        assert!(!core.wants_keys(ms(1)));
        assert_eq!(core.poll(ms(1)), None);
    }
    core.take(ms(1));
    assert!(core.wants_keys(ms(1)));
    assert_eq!(asks(&mut core, ms(1)), [Ask::Keys(4)]);
    // One key came instead of four, so the pool asks for the rest.
    core.on_keys(ms(2), 4, [16]);
    assert_eq!(asks(&mut core, ms(2)), [Ask::Keys(3)]);
}

#[test]
fn a_stall_is_seen_while_calls_hang_and_ends_with_the_first_key() {
    let mut core = core(1, stock(0, 0));
    assert_eq!(core.poll(ms(0)), Some(Ask::Keys(1)));
    assert!(!core.status(ms(999)).is_stalled());
    assert!(core.status(ms(1_000)).is_stalled());
    core.on_keys(ms(1_000), 1, [0]);
    assert_eq!(core.poll(ms(1_000)), None);
    assert_eq!(core.status(ms(9_000)).waiting, None);
}

#[test]
fn the_debug_output_of_a_pool_shows_no_key() {
    let mut core = Core::new(Settings::default(), || 0);
    core.on_keys(ms(0), 1, ["secret"]);
    let shown = format!("{core:?}");
    assert!(!shown.contains("secret") && shown.contains("held: 1"), "{shown}");
}
