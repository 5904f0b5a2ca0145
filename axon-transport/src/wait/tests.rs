//! No ring is ever lost: under the model checker and under load.

use std::{
    os::fd::AsFd,
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicU64, Ordering},
    },
    thread,
    time::{Duration, Instant},
};

use rustix::event::{PollFd, PollFlags, poll};

use super::{arm, disarm, due, settle};
use crate::{ids::SessionId, shm::SessionSegment};

/// Only a wake-up that was lost takes this long.
const EVER: Duration = Duration::from_secs(60);

/// Waits for `ready`, which must come true because the wait is woken.
fn await_woken(session: &SessionSegment, ready: impl FnMut() -> bool) {
    let start = Instant::now();
    assert!(session.wait(ready, Some(EVER)) && start.elapsed() < EVER, "a wake-up was lost");
}

#[test]
fn the_last_look_or_the_ring_finds_what_came() {
    use loom::{
        sync::{Arc, Condvar, Mutex, atomic::AtomicU64},
        thread,
    };

    loom::model(|| {
        let head = Arc::new(AtomicU64::new(0));
        let armed = Arc::new(AtomicU64::new(0));
        let bell = Arc::new((Mutex::new(false), Condvar::new()));
        let waker = {
            let (head, armed, bell) = (head.clone(), armed.clone(), bell.clone());
            thread::spawn(move || {
                let rung = AtomicU64::new(0);
                for position in 1..=2 {
                    head.store(position, Ordering::Release);
                    settle::<AtomicU64>();
                    if due(&*armed, &rung) {
                        *bell.0.lock().unwrap() = true;
                        bell.1.notify_one();
                    }
                }
            })
        };
        let mut ticket = 0;
        for wanted in 1..=2 {
            loop {
                ticket += 1;
                arm(&*armed, ticket);
                if head.load(Ordering::Acquire) >= wanted {
                    break;
                }
                let mut rung = bell.0.lock().unwrap();
                while !*rung {
                    // The model fails here when nobody is left to ring.
                    rung = bell.1.wait(rung).unwrap();
                }
                *rung = false;
            }
        }
        disarm(&*armed);
        waker.join().unwrap();
    });
}

#[test]
fn each_waiter_of_a_crowd_is_woken() {
    let session = SessionSegment::create(SessionId::random()).unwrap();
    let turn = AtomicU64::new(0);
    let threads = 4;
    let rounds = 3000;
    thread::scope(|scope| {
        for me in 0..threads {
            let (session, turn) = (&session, &turn);
            scope.spawn(move || {
                for round in 0..rounds {
                    let mine = round * threads + me;
                    await_woken(session, || turn.load(Ordering::Acquire) == mine);
                    turn.store(mine + 1, Ordering::Release);
                    session.notify();
                }
            });
        }
    });
}

#[test]
fn a_ring_that_another_thread_takes_is_not_slept_over() {
    let session = SessionSegment::create(SessionId::random()).unwrap();
    let (looks, over) = (AtomicU64::new(0), AtomicBool::new(false));
    thread::scope(|scope| {
        scope.spawn(|| {
            await_woken(&session, || {
                looks.fetch_add(1, Ordering::AcqRel);
                over.load(Ordering::Acquire)
            });
        });
        while looks.load(Ordering::Acquire) < 2 {
            thread::yield_now();
        }
        // The other thread leads. This one has armed and looked in vain when what it waits for
        // comes, and the other takes the ring before this one gets to sleep.
        let mut mine = 0;
        await_woken(&session, || {
            mine += 1;
            if mine == 2 {
                let before = looks.load(Ordering::Acquire);
                session.doorbell_hub().bell().ring();
                while looks.load(Ordering::Acquire) == before {
                    thread::yield_now();
                }
            }
            mine > 2
        });
        over.store(true, Ordering::Release);
        session.notify();
    });
}

#[test]
fn a_wait_ends_with_its_time_and_disarms() {
    use crate::wait::Purpose;
    let session = SessionSegment::create(SessionId::random()).unwrap();
    assert!(!session.wait(|| false, Some(Duration::from_millis(5))));
    assert!(!session.wait(|| false, Some(Duration::ZERO)));
    assert!(session.wait(|| true, None));
    assert_eq!(session.armed_word(Purpose::Samples).load(Ordering::Relaxed), 0);
}

#[test]
fn an_external_leader_and_blocked_threads_share_the_doorbell() {
    let session = SessionSegment::create(SessionId::random()).unwrap();
    let rounds = 2000;
    let (ping, pong) = (AtomicU64::new(0), AtomicU64::new(0));
    let over = AtomicBool::new(false);
    thread::scope(|scope| {
        // Leads for a while as a thread, then follows.
        scope.spawn(|| {
            for round in 1..=rounds {
                await_woken(&session, || ping.load(Ordering::Acquire) == round);
                pong.store(round, Ordering::Release);
                session.notify();
            }
            over.store(true, Ordering::Release);
            session.notify();
        });
        let leader = session.external_leader().unwrap();
        assert!(session.external_leader().is_err());
        let mut round = 1;
        ping.store(round, Ordering::Release);
        session.notify();
        loop {
            leader.clear();
            leader.arm(true);
            if pong.load(Ordering::Acquire) == round {
                leader.disarm();
                if round == rounds {
                    break;
                }
                round += 1;
                ping.store(round, Ordering::Release);
                session.notify();
                continue;
            }
            let mut fds = [PollFd::from_borrowed_fd(leader.as_fd(), PollFlags::IN)];
            assert_eq!(poll(&mut fds, Some(&EVER.try_into().unwrap())), Ok(1));
        }
        drop(leader);
        await_woken(&session, || over.load(Ordering::Acquire));
    });
    assert!(Arc::clone(&session).external_leader().is_ok());
}
