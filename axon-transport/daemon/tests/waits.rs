//! Waits for several things at once, and callbacks for samples.

#[path = "support/alone.rs"]
mod alone;

use std::{
    sync::{
        Arc, Barrier, OnceLock,
        atomic::{AtomicBool, AtomicU64, Ordering},
    },
    thread,
    time::Duration,
};

use alone::alone;
use axon_transport::{
    EndpointSpec, GuardCondition, NewDataCallback, Publisher, Session, SessionError, Subscription,
    Waitable, qos::Qos,
};

const PATIENCE: Duration = Duration::from_secs(60);
const NOT_AT_ALL: Option<Duration> = Some(Duration::ZERO);

fn spec(topic: &str) -> EndpointSpec {
    EndpointSpec::new(topic, "T", Qos::default())
}

fn pair(session: &Session, topic: &str) -> (Publisher, Subscription) {
    let publisher = session.create_publisher(spec(topic)).unwrap();
    let subscription = session.create_subscription(spec(topic)).unwrap();
    assert!(subscription.wait_matched(1, PATIENCE));
    (publisher, subscription)
}

#[test]
fn a_guard_condition_stands_until_a_wait_has_seen_it() {
    let session = alone();
    let guard = session.create_guard_condition();
    let all = [Waitable::GuardCondition(&guard)];
    assert!(session.wait_for(&all, NOT_AT_ALL).unwrap().is_empty());
    guard.trigger();
    guard.trigger();
    assert!(guard.is_triggered());
    assert_eq!(session.wait_for(&all, NOT_AT_ALL).unwrap(), [0]);
    assert!(!guard.is_triggered());
    assert!(session.wait_for(&all, Some(Duration::from_millis(20))).unwrap().is_empty());
    thread::scope(|scope| {
        let waiter = scope.spawn(|| session.wait_for(&all, None).unwrap());
        guard.trigger();
        assert_eq!(waiter.join().unwrap(), [0]);
    });
}

#[test]
fn nothing_at_all_is_waited_for_until_the_time_is_over() {
    let session = alone();
    assert!(session.wait_for(&[], NOT_AT_ALL).unwrap().is_empty());
    assert!(session.wait_for(&[], Some(Duration::from_millis(10))).unwrap().is_empty());
}

#[test]
fn wait_names_all_ready_items_and_repeats_untaken_samples() {
    let session = alone();
    let (publisher, subscription) = pair(&session, "/t");
    let (_silent, idle) = pair(&session, "/u");
    let guards = [(); 2].map(|()| session.create_guard_condition());
    let all = [
        Waitable::Subscription(&idle),
        Waitable::GuardCondition(&guards[0]),
        Waitable::Subscription(&subscription),
        Waitable::GuardCondition(&guards[1]),
    ];
    publisher.publish(b"x").unwrap();
    guards[1].trigger();
    assert_eq!(session.wait_for(&all, None).unwrap(), [2, 3]);
    assert_eq!(session.wait_for(&all, None).unwrap(), [2]);
    subscription.take(&mut Vec::new()).unwrap();
    assert!(session.wait_for(&all, NOT_AT_ALL).unwrap().is_empty());
}

#[test]
fn wait_includes_items_of_other_sessions() {
    let (session, others) = (alone(), [alone(), alone()]);
    let [one, two] = &others;
    let (foreign, own) = (one.create_guard_condition(), session.create_guard_condition());
    let (publisher, subscription) = pair(two, "/t");
    let all = [
        Waitable::GuardCondition(&foreign),
        Waitable::Subscription(&subscription),
        Waitable::GuardCondition(&own),
    ];
    assert!(session.wait_for(&all, NOT_AT_ALL).unwrap().is_empty());
    assert!(session.wait_for(&all, Some(Duration::from_millis(10))).unwrap().is_empty());
    for round in 0..300 {
        thread::scope(|scope| {
            let waiter = scope.spawn(|| session.wait_for(&all, None).unwrap());
            if round % 2 == 0 {
                // In some rounds the waiter sleeps by now.
                thread::sleep(Duration::from_micros(round * 3));
            }
            match round % 3 {
                0 => foreign.trigger(),
                1 => publisher.publish(b"x").map(drop).unwrap(),
                _ => own.trigger(),
            }
            assert_eq!(waiter.join().unwrap(), [(round % 3) as usize]);
        });
        assert_eq!(subscription.take(&mut Vec::new()).is_some(), round % 3 == 1);
    }
}

#[test]
fn sessions_that_wait_for_each_other_hear_of_both() {
    let (one, two) = (alone(), alone());
    let guards = [one.create_guard_condition(), two.create_guard_condition()];
    let (publisher, subscription) = pair(&two, "/t");
    thread::scope(|scope| {
        let waiters = [(&one, &guards[1]), (&two, &guards[0])].map(|(session, guard)| {
            let all = [Waitable::GuardCondition(guard), Waitable::Subscription(&subscription)];
            scope.spawn(move || session.wait_for(&all, None).unwrap())
        });
        thread::sleep(Duration::from_millis(20));
        publisher.publish(b"x").unwrap();
        for waiter in waiters {
            assert_eq!(waiter.join().unwrap(), [1]);
        }
    });
}

#[test]
fn waiting_on_a_guard_condition_of_a_closed_session_is_refused() {
    let (session, other) = (alone(), alone());
    let foreign = other.create_guard_condition();
    drop(other);
    let refused = session.wait_for(&[Waitable::GuardCondition(&foreign)], None).unwrap_err();
    assert!(matches!(refused, SessionError::OtherSession), "{refused}");
}

#[test]
fn one_of_thousands_is_found() {
    let session = alone();
    let pairs: Vec<_> = (0..300).map(|number| pair(&session, &format!("/t{number}"))).collect();
    let guards: Vec<_> = (0..4000).map(|_| session.create_guard_condition()).collect();
    let mut all: Vec<Waitable<'_>> = guards.iter().map(Waitable::GuardCondition).collect();
    all.extend(pairs.iter().map(|(_, subscription)| Waitable::Subscription(subscription)));
    thread::scope(|scope| {
        let waiter = scope.spawn(|| session.wait_for(&all, None).unwrap());
        pairs[123].0.publish(b"x").unwrap();
        assert_eq!(waiter.join().unwrap(), [4123]);
    });
    pairs[123].1.take(&mut Vec::new()).unwrap();
    thread::scope(|scope| {
        let waiter = scope.spawn(|| session.wait_for(&all, None).unwrap());
        guards[3999].trigger();
        assert_eq!(waiter.join().unwrap(), [3999]);
    });
}

#[test]
fn many_threads_wait_each_for_its_own() {
    let session = alone();
    let rounds = 300;
    thread::scope(|scope| {
        for number in 0..6 {
            let session = &session;
            scope.spawn(move || {
                let (publisher, subscription) = pair(session, &format!("/t{number}"));
                let guard = session.create_guard_condition();
                thread::scope(|scope| {
                    scope.spawn(|| {
                        for round in 0..rounds {
                            if round % 2 == 0 {
                                publisher.publish(b"x").unwrap();
                            } else {
                                guard.trigger();
                            }
                            // One at a time: the other side shows that it has handled it.
                            while guard.is_triggered() || subscription.has_data() {
                                thread::yield_now();
                            }
                        }
                    });
                    let all =
                        [Waitable::Subscription(&subscription), Waitable::GuardCondition(&guard)];
                    for round in 0..rounds {
                        let ready = session.wait_for(&all, Some(PATIENCE)).unwrap();
                        assert_eq!(ready, [round % 2], "thread {number}, round {round}");
                        if round % 2 == 0 {
                            assert!(subscription.take(&mut Vec::new()).is_some());
                        }
                    }
                });
            });
        }
    });
}

static HANDLED: OnceLock<GuardCondition> = OnceLock::new();

extern "C" fn handle(_: libc::c_int) {
    if let Some(guard) = HANDLED.get() {
        guard.trigger();
    }
}

#[test]
fn a_signal_handler_may_trigger() {
    let session = alone();
    let guard = HANDLED.get_or_init(|| session.create_guard_condition()).clone();
    // SAFETY: the handler does only what is async-signal-safe.
    unsafe { libc::signal(libc::SIGUSR2, handle as *const () as libc::sighandler_t) };
    let all = [Waitable::GuardCondition(&guard)];
    let over = AtomicBool::new(false);
    let pid = i32::try_from(std::process::id()).unwrap();
    thread::scope(|scope| {
        // Signals arrive in any thread, at any point.
        scope.spawn(|| {
            while !over.load(Ordering::SeqCst) {
                // SAFETY: sends this process a signal that it handles.
                unsafe { libc::kill(pid, libc::SIGUSR2) };
                while guard.is_triggered() && !over.load(Ordering::SeqCst) {
                    thread::yield_now();
                }
            }
        });
        for _ in 0..2000 {
            assert_eq!(session.wait_for(&all, Some(PATIENCE)).unwrap(), [0]);
        }
        over.store(true, Ordering::SeqCst);
    });
}

#[test]
fn new_samples_are_told_of_each_once_and_those_that_wait_at_once() {
    let session = alone();
    let (publisher, subscription) = pair(&session, "/t");
    for _ in 0..3 {
        publisher.publish(b"x").unwrap();
    }
    subscription.take(&mut Vec::new()).unwrap();
    let told = Arc::new(AtomicU64::new(0));
    let count = told.clone();
    let add = move |new| {
        count.fetch_add(new, Ordering::SeqCst);
    };
    subscription.set_on_new_sample(Some(Arc::new(add))).unwrap();
    assert_eq!(told.load(Ordering::SeqCst), 2, "what is still to be taken");
    let wait = |expected: u64| {
        let deadline = std::time::Instant::now() + PATIENCE;
        while told.load(Ordering::SeqCst) != expected {
            assert!(std::time::Instant::now() < deadline, "{told:?} instead of {expected}");
            thread::sleep(Duration::from_millis(1));
        }
    };
    for number in 0..200 {
        publisher.publish(b"x").unwrap();
        if number % 20 == 0 {
            wait(3 + number);
        }
    }
    wait(202);
    // Waiting threads are still woken.
    while subscription.take(&mut Vec::new()).is_some() {}
    thread::scope(|scope| {
        let all = [Waitable::Subscription(&subscription)];
        let waiter = scope.spawn(move || session.wait_for(&all, None).unwrap());
        thread::sleep(Duration::from_millis(10));
        publisher.publish(b"x").unwrap();
        assert_eq!(waiter.join().unwrap(), [0]);
    });
    wait(203);
    subscription.set_on_new_sample(None).unwrap();
    publisher.publish(b"x").unwrap();
    thread::sleep(Duration::from_millis(20));
    assert_eq!(told.load(Ordering::SeqCst), 203);
}

#[test]
fn a_replacement_callback_is_not_told_already_reported_samples() {
    let session = alone();
    let (publisher, subscription) = pair(&session, "/t");
    let (sender, told) = std::sync::mpsc::channel();
    let set = |name: &'static str| {
        let sender = sender.clone();
        let tell = move |new| sender.send((name, new)).unwrap();
        subscription.set_on_new_sample(Some(Arc::new(tell))).unwrap();
    };
    let publish = || {
        publisher.publish(b"x").unwrap();
    };
    set("first");
    publish();
    assert_eq!(told.recv_timeout(PATIENCE), Ok(("first", 1)));
    set("second");
    publish();
    assert_eq!(told.recv_timeout(PATIENCE), Ok(("second", 1)));
    subscription.set_on_new_sample(None).unwrap();
    (0..3).for_each(|_| publish());
    set("third");
    assert_eq!(told.recv_timeout(PATIENCE), Ok(("third", 3)));
    // A sample that was taken already is not reported, although no callback was told of it.
    subscription.set_on_new_sample(None).unwrap();
    publish();
    while subscription.take(&mut Vec::new()).is_some() {}
    set("fourth");
    publish();
    assert_eq!(told.recv_timeout(PATIENCE), Ok(("fourth", 1)));
}

/// Whichever thread comes last: a callback that stays set is told of later samples.
#[test]
fn a_callback_that_is_set_while_another_thread_unsets_it_is_told_or_gone() {
    let session = alone();
    let (publisher, subscription) = pair(&session, "/t");
    let both = Barrier::new(2);
    for round in 0..500 {
        let (sender, told) = std::sync::mpsc::channel();
        let callback: NewDataCallback = Arc::new(move |new| sender.send(new).unwrap());
        thread::scope(|scope| {
            scope.spawn(|| {
                both.wait();
                subscription.set_on_new_sample(Some(callback.clone())).unwrap();
            });
            both.wait();
            subscription.set_on_new_sample(None).unwrap();
        });
        publisher.publish(b"x").unwrap();
        if Arc::strong_count(&callback) > 1 {
            assert_eq!(told.recv_timeout(PATIENCE), Ok(1), "in round {round}");
        }
        subscription.set_on_new_sample(None).unwrap();
        while subscription.take(&mut Vec::new()).is_some() {}
        assert_eq!(Arc::strong_count(&callback), 1);
    }
}

#[test]
fn an_event_loop_and_callbacks_do_not_listen_at_once() {
    let session = alone();
    let (_publisher, subscription) = pair(&session, "/t");
    let leader = session.segment().external_leader().unwrap();
    assert!(subscription.set_on_new_sample(Some(Arc::new(|_| {}))).is_err());
    drop(leader);
    subscription.set_on_new_sample(Some(Arc::new(|_| {}))).unwrap();
    assert!(session.segment().external_leader().is_err());
    drop(subscription);
    let deadline = std::time::Instant::now() + PATIENCE;
    // The control thread releases the lead when it next checks.
    while session.segment().external_leader().is_err() {
        assert!(std::time::Instant::now() < deadline);
        thread::yield_now();
    }
}
