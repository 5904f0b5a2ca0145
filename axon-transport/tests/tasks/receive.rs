//! Samples and requests that tasks wait for.

use std::{
    collections::BTreeSet,
    pin::{Pin, pin},
    sync::{Arc, Mutex},
    task::{Context, Poll, Waker},
    thread,
};

use axon_transport::{EndpointSpec, RecvError, Session, Subscription, qos::Qos};

use crate::support::{Count, PATIENCE, alone, block_on, pair, until};

type Received = Result<(axon_transport::MessageInfo, Vec<u8>), RecvError>;

fn poll(future: &mut Pin<&mut impl Future<Output = Received>>, waker: &Waker) -> Poll<Received> {
    future.as_mut().poll(&mut Context::from_waker(waker))
}

/// Waits until the control thread releases the doorbell, which it does once no task has waited for a while.
fn await_silence(session: &Session) {
    until("nobody listens", || session.segment().external_leader().is_ok());
}

#[test]
fn no_wake_up_is_lost_between_many_threads() {
    const ROUNDS: u64 = 1000;
    let session = alone();
    thread::scope(|scope| {
        for number in 0..4 {
            let (ping, pings) = pair(&session, &format!("/ping{number}"));
            let (pong, pongs) = pair(&session, &format!("/pong{number}"));
            // In lockstep: each sample finds a task that sleeps, or is about to.
            scope.spawn(move || {
                block_on(async {
                    for round in 0..ROUNDS {
                        ping.publish(&round.to_le_bytes()).unwrap();
                        let (_, bytes) = pongs.recv_async().await.unwrap();
                        assert_eq!(bytes, round.to_le_bytes());
                    }
                });
            });
            scope.spawn(move || {
                block_on(async {
                    let mut pings = pings.stream();
                    for _ in 0..ROUNDS {
                        let (_, bytes) = pings.next().await.unwrap().unwrap();
                        pong.publish(&bytes).unwrap();
                    }
                });
            });
        }
        // Threads that wait at the same doorbell lead it by turns with the control thread.
        let (stop, stops) = pair(&session, "/stop");
        scope.spawn(move || stops.recv(&mut Vec::new(), Some(PATIENCE)).unwrap());
        let (publisher, subscription) = pair(&session, "/waited");
        scope.spawn(move || {
            for round in 0..ROUNDS {
                publisher.publish(&round.to_le_bytes()).unwrap();
                block_on(subscription.recv_async()).unwrap();
                publisher.publish(&round.to_le_bytes()).unwrap();
                subscription.recv(&mut Vec::new(), Some(PATIENCE)).unwrap();
            }
            stop.publish(b"").unwrap();
        });
    });
    await_silence(&session);
}

#[test]
fn tasks_of_different_runtimes_share_a_subscription_and_each_sample_is_one_tasks() {
    const SAMPLES: u64 = 2000;
    let session = alone();
    let (publisher, subscription) = pair(&session, "/t");
    let (subscription, taken) = (Arc::new(subscription), Arc::new(Mutex::new(Vec::new())));
    let take = async |subscription: Arc<Subscription>, taken: Arc<Mutex<Vec<u64>>>| {
        loop {
            let (info, bytes) = subscription.recv_async().await.unwrap();
            if bytes == b"stop" {
                return;
            }
            taken.lock().unwrap().push(info.sequence);
        }
    };
    let runtimes = [
        tokio::runtime::Builder::new_current_thread().build().unwrap(),
        tokio::runtime::Builder::new_multi_thread().worker_threads(2).build().unwrap(),
    ];
    thread::scope(|scope| {
        let take = &take;
        for runtime in &runtimes {
            let parts = || (subscription.clone(), taken.clone());
            let ((s, t), (s2, t2)) = (parts(), parts());
            scope.spawn(move || {
                runtime.block_on(async { tokio::join!(take(s, t), take(s2, t2)) });
            });
        }
        scope.spawn(|| block_on(take(subscription.clone(), taken.clone())));
        for number in 0..SAMPLES {
            publisher.publish(&number.to_le_bytes()).unwrap();
            if number % 16 == 0 {
                thread::yield_now();
            }
        }
        (0..5).for_each(|_| assert!(publisher.publish(b"stop").is_ok()));
    });
    let taken = taken.lock().unwrap();
    assert_eq!(taken.len() as u64, SAMPLES);
    assert_eq!(taken.iter().copied().collect::<BTreeSet<_>>(), (1..=SAMPLES).collect());
}

#[test]
fn a_future_that_is_dropped_takes_nothing_and_leaves_nothing() {
    let session = alone();
    let (publisher, subscription) = pair(&session, "/t");
    let (count, waker) = Count::new();
    {
        let mut future = pin!(subscription.recv_async());
        assert!(poll(&mut future, &waker).is_pending());
        let led = session.segment().external_leader();
        assert!(led.is_err(), "the control thread listens");
    }
    drop(waker);
    assert_eq!(Arc::strong_count(&count), 1, "its waker is let go");
    publisher.publish(b"x").unwrap();
    assert_eq!(block_on(subscription.recv_async()).unwrap().1, b"x");
    assert_eq!(count.get(), 0);
    await_silence(&session);
}

#[test]
fn a_task_that_is_woken_and_dropped_takes_no_wake_up_from_another() {
    let session = alone();
    let (publisher, subscription) = pair(&session, "/t");
    let ((one, first), (two, second)) = (Count::new(), Count::new());
    let mut other = pin!(subscription.recv_async());
    {
        let mut dropped = pin!(subscription.recv_async());
        assert!(poll(&mut dropped, &first).is_pending());
        assert!(poll(&mut other, &second).is_pending());
        publisher.publish(b"x").unwrap();
        until("both are woken", || one.get() == 1 && two.get() == 1);
    }
    assert!(poll(&mut other, &second).is_ready());
}

#[test]
fn the_waker_of_the_last_poll_is_woken_and_no_earlier_one() {
    let session = alone();
    let (publisher, subscription) = pair(&session, "/t");
    let ((one, first), (two, second)) = (Count::new(), Count::new());
    let mut future = pin!(subscription.recv_async());
    assert!(poll(&mut future, &first).is_pending());
    assert!(poll(&mut future, &second).is_pending());
    drop(first);
    assert_eq!(Arc::strong_count(&one), 1);
    publisher.publish(b"x").unwrap();
    until("it is woken", || two.get() == 1);
    assert!(poll(&mut future, &second).is_ready());
    assert_eq!(one.get(), 0);
}

#[test]
fn a_task_waits_on_when_another_took_its_sample() {
    let session = alone();
    let (publisher, subscription) = pair(&session, "/t");
    let (count, waker) = Count::new();
    let mut future = pin!(subscription.recv_async());
    for round in 1..=10 {
        assert!(poll(&mut future, &waker).is_pending());
        publisher.publish(b"x").unwrap();
        until("it is woken", || count.get() == round);
        assert!(subscription.take(&mut Vec::new()).is_some());
    }
    publisher.publish(b"y").unwrap();
    assert!(matches!(poll(&mut future, &waker), Poll::Ready(Ok((_, bytes))) if bytes == b"y"));
}

#[test]
fn a_task_keeps_its_session_and_outlives_its_publishers() {
    let session = alone();
    let spec = || EndpointSpec::new("/t", "test/Bytes", Qos::keep_all());
    let (publisher, subscription) = pair(&session, "/t");
    let next = session.create_publisher(spec()).unwrap();
    assert!(subscription.wait_matched(2, PATIENCE));
    drop(session);
    let task = thread::spawn(move || {
        block_on(async {
            let mut taken = Vec::new();
            let mut samples = subscription.stream();
            while taken.last().is_none_or(|last| last != b"end") {
                taken.push(samples.next().await.unwrap().unwrap().1);
            }
            taken
        })
    });
    (0..3).for_each(|_| assert!(publisher.publish(b"one").is_ok()));
    drop(publisher);
    next.publish(b"end").unwrap();
    let taken = task.join().unwrap();
    assert_eq!(taken, [&b"one"[..], b"one", b"one", b"end"]);
}

#[test]
fn a_slow_task_misses_nothing_of_a_flood_and_lets_others_run() {
    const SAMPLES: u64 = 20_000;
    let session = alone();
    let (publisher, subscription) = pair(&session, "/t");
    let flood = thread::spawn(move || {
        for number in 1..=SAMPLES {
            publisher.publish(&number.to_le_bytes()).unwrap();
        }
        publisher
    });
    let runtime = tokio::runtime::Builder::new_current_thread().build().unwrap();
    let others = runtime.block_on(async {
        let count = Arc::new(Mutex::new(0));
        let counted = count.clone();
        let other = tokio::spawn(async move {
            loop {
                *counted.lock().unwrap() += 1;
                tokio::task::yield_now().await;
            }
        });
        let (mut samples, mut last) = (subscription.stream(), 0);
        while last < SAMPLES {
            let (info, bytes) = samples.next().await.unwrap().unwrap();
            assert!(info.sequence > last, "in order, and each once");
            assert_eq!(bytes, info.sequence.to_le_bytes());
            last = info.sequence;
            if last % 1000 == 0 {
                thread::yield_now();
            }
        }
        other.abort();
        *count.lock().unwrap()
    });
    drop(flood.join().unwrap());
    assert_eq!(subscription.received() + subscription.lost(), SAMPLES);
    assert!(others > 0, "the other task of this thread had its turn");
}

#[test]
fn samples_come_in_place_too() {
    let session = alone();
    let (publisher, subscription) = pair(&session, "/t");
    let task = thread::spawn(move || {
        let (_, sample) = block_on(subscription.recv_sample_async()).unwrap();
        let mut bytes = Vec::new();
        sample.copy_to(&mut bytes).unwrap();
        bytes
    });
    publisher.publish(&[7; 100_000]).unwrap();
    assert_eq!(task.join().unwrap(), [7; 100_000]);
}

#[test]
fn while_an_event_loop_leads_tasks_are_refused() {
    let session = alone();
    let (publisher, subscription) = pair(&session, "/t");
    let leader = session.segment().external_leader().unwrap();
    let refused = RecvError::AlreadyLed(session.id());
    assert_eq!(block_on(subscription.recv_async()).unwrap_err(), refused);
    let mut samples = subscription.stream();
    assert_eq!(block_on(samples.next()), Some(Err(refused)));
    assert_eq!(block_on(samples.next()), None, "it has ended");
    drop(leader);
    publisher.publish(b"x").unwrap();
    assert!(block_on(subscription.recv_async()).is_ok());
}

#[test]
fn callbacks_and_tasks_hear_of_the_same_samples() {
    let session = alone();
    let (publisher, subscription) = pair(&session, "/t");
    let told = Arc::new(Mutex::new(0));
    let count = told.clone();
    subscription
        .set_on_new_sample(Some(Arc::new(move |new| *count.lock().unwrap() += new)))
        .unwrap();
    for round in 1..=100 {
        let (woken, waker) = Count::new();
        let mut future = pin!(subscription.recv_async());
        assert!(poll(&mut future, &waker).is_pending());
        publisher.publish(b"x").unwrap();
        until("the task is woken", || woken.get() == 1);
        assert!(poll(&mut future, &waker).is_ready());
        until("the callback is called", || *told.lock().unwrap() == round);
    }
    // The callback ends; the task still hears.
    subscription.set_on_new_sample(None).unwrap();
    let (woken, waker) = Count::new();
    let mut future = pin!(subscription.recv_async());
    assert!(poll(&mut future, &waker).is_pending());
    publisher.publish(b"x").unwrap();
    until("the task is woken", || woken.get() == 1);
}
