//! Checks that no ring is ever lost: under the model checker and under load.

use std::{
    os::fd::AsFd,
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicU64, Ordering},
    },
    thread,
    time::{Duration, Instant},
};

use rustix::{
    event::{PollFd, PollFlags, poll},
    fs::{OFlags, fcntl_getfl, fcntl_setfl},
    net::{RecvFlags, Shutdown, recv, shutdown},
};

use super::{
    Doorbell, DoorbellSender, Purpose, WakeCheck, arm, disarm, due, receiver::whole_millis, settle,
};
use crate::{
    ids::SessionId,
    os::descriptors::{
        PassedFd,
        tests::{pair, reluctant, send_away},
    },
    session::segment::SessionSegment,
};

/// Only a lost wake-up makes a wait take this long.
const EVER: Duration = Duration::from_secs(60);

/// Waits until `ready` returns true; only a wake-up can make the wait end in time.
fn await_woken(session: &SessionSegment, ready: impl FnMut() -> bool) {
    let start = Instant::now();
    assert!(session.wait(ready, Some(EVER)) && start.elapsed() < EVER, "a wake-up was lost");
}

#[test]
fn the_last_check_or_the_doorbell_finds_every_sample() {
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
                    // The model fails here if no thread is left to ring.
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
        // The other thread leads. This one has armed and found nothing when the event comes; the
        // other takes the ring before this one sleeps.
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
        // This thread leads for a while, then follows.
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

/// Returns the end of a session's doorbell that other processes hold.
fn handed_out(session: &SessionSegment) -> PassedFd {
    session.descriptors().unwrap().doorbell
}

#[test]
fn ringing_never_blocks() {
    let session = SessionSegment::create(SessionId::random()).unwrap();
    let fd = handed_out(&session);
    let flags = fcntl_getfl(&fd).unwrap();
    // The flag is shared by all processes that hold the socket.
    fcntl_setfl(&fd, flags - OFlags::NONBLOCK).unwrap();
    let bell = DoorbellSender::received(fd).unwrap();
    for _ in 0..10_000 {
        bell.ring();
    }
    // A thread that listens or notifies does not block either while nobody takes the rings.
    session.notify();
    assert!(session.wait(|| true, None));
    let looks = AtomicU64::new(0);
    await_woken(&session, || looks.fetch_add(1, Ordering::Relaxed) == 2);
}

#[test]
fn a_full_queue_swallows_no_ring() {
    let session = SessionSegment::create(SessionId::random()).unwrap();
    let bell = DoorbellSender::received(handed_out(&session)).unwrap();
    let turn = AtomicU64::new(0);
    let (rounds, over) = (2000, AtomicBool::new(false));
    thread::scope(|scope| {
        scope.spawn(|| {
            for round in (0..rounds).map(|n| 2 * n + 1) {
                while turn.load(Ordering::Acquire) != round {
                    thread::yield_now();
                }
                // A burst fills the queue. No single ring that follows may be lost.
                let burst = if round % 100 == 1 { 1000 } else { 1 };
                turn.store(round + 1, Ordering::Release);
                (0..burst).for_each(|_| assert!(bell.ring()));
            }
            over.store(true, Ordering::Release);
        });
        for round in (0..rounds).map(|n| 2 * n + 1) {
            turn.store(round, Ordering::Release);
            await_woken(&session, || turn.load(Ordering::Acquire) == round + 1);
        }
    });
    assert!(over.load(Ordering::Acquire));
}

#[test]
fn a_bell_that_was_closed_is_looked_after_by_time() {
    let session = SessionSegment::create(SessionId::random()).unwrap();
    let over = AtomicBool::new(false);
    thread::scope(|scope| {
        let waiters: Vec<_> = (0..3)
            .map(|_| scope.spawn(|| await_woken(&session, || over.load(Ordering::Acquire))))
            .collect();
        shutdown(handed_out(&session), Shutdown::Both).unwrap();
        // From now on no thread rings.
        over.store(true, Ordering::Release);
        waiters.into_iter().for_each(|waiter| waiter.join().unwrap());
    });
    // An event loop is woken as well.
    let leader = session.external_leader().unwrap();
    leader.clear();
    leader.arm(false);
    let mut fds = [PollFd::from_borrowed_fd(leader.as_fd(), PollFlags::IN)];
    assert_eq!(poll(&mut fds, Some(&EVER.try_into().unwrap())), Ok(1));
}

#[test]
fn descriptors_sent_to_a_doorbell_are_not_received_and_delay_no_wait() {
    let mut doorbell = Doorbell::new().unwrap();
    // Acts like a kernel that cannot keep descriptors out of the bell.
    doorbell.let_rights_pass();
    let words = [AtomicU64::new(0), AtomicU64::new(0)];
    let words = words.each_ref();
    let (kept, sent) = pair();
    send_away(doorbell.bell(), b"x", sent);
    let mut peers = Vec::new();
    for _ in 0..4 {
        let (reluctant, peer) = reluctant();
        send_away(doorbell.bell(), b"x", reluctant);
        peers.push(peer);
    }
    let (mut looks, start) = (0, Instant::now());
    let ready = || {
        looks += 1;
        doorbell.bell().ring();
        looks == 8
    };
    assert!(doorbell.wait(words, Purpose::Samples, ready, None, &[], Some(EVER)));
    // The session no longer listens to the bell and polls instead.
    let deaf = || start.elapsed() > Duration::from_millis(50);
    assert!(doorbell.wait(words, Purpose::Samples, deaf, None, &[], Some(EVER)));
    assert!(start.elapsed() < EVER, "a wake-up was lost");
    // The sent descriptor is still only in the queue, as its other end shows.
    let stands = recv(&kept, &mut [0; 1], RecvFlags::DONTWAIT);
    assert_eq!(stands.err(), Some(rustix::io::Errno::AGAIN));
}

#[test]
fn epoll_gets_whole_milliseconds_only() {
    let whole = |time: Duration| whole_millis(Some(time)).unwrap();
    for short in [0, 1, 999, 200_000, 999_999] {
        assert!(whole(Duration::from_nanos(short)).is_zero(), "{short} ns");
    }
    for odd in [1_000_001, 1_500_000, 1_000_000_001, 2_999_999_999] {
        let odd = Duration::from_nanos(odd);
        let left = odd - whole(odd);
        assert!(!left.is_zero() && left < Duration::from_millis(1), "{odd:?}");
        assert!(whole(odd).subsec_nanos().is_multiple_of(1_000_000), "{odd:?}");
    }
    for even in [1, 7, 999, 1000, 1001, 60_000].map(Duration::from_millis) {
        assert_eq!(whole(even), even);
    }
    assert_eq!(whole_millis(None), None, "for ever");
}

#[test]
fn a_wait_is_as_long_as_it_was_told() {
    let session = SessionSegment::create(SessionId::random()).unwrap();
    for micros in [1, 200, 1000, 1700] {
        let (start, time) = (Instant::now(), Duration::from_micros(micros));
        assert!(!session.wait(|| false, Some(time)));
        assert!(start.elapsed() >= time, "{micros} us");
    }
}

/// A follower's condition, and how often it was checked.
#[derive(Default)]
struct Flag {
    up: AtomicBool,
    asked: AtomicU64,
}

impl WakeCheck for Flag {
    fn ready(&self) -> bool {
        self.asked.fetch_add(1, Ordering::AcqRel);
        self.up.load(Ordering::Acquire)
    }
}

#[test]
fn of_those_that_follow_the_right_one_is_woken() {
    let session = SessionSegment::create(SessionId::random()).unwrap();
    let bell = DoorbellSender::received(handed_out(&session)).unwrap();
    let flags: Vec<Arc<Flag>> = (0..4).map(|_| Arc::default()).collect();
    let start = Instant::now();
    thread::scope(|scope| {
        let mut waiters: Vec<_> = flags
            .iter()
            .map(|flag| {
                let session = &session;
                let look = move || -> Arc<dyn WakeCheck> { flag.clone() };
                scope.spawn(move || session.wait_for(|| flag.ready(), &look, Some(EVER)))
            })
            .collect();
        let armed = session.armed_word(Purpose::Samples);
        // In another order than they arrived. Each time a thread leads that has nothing, or leaves.
        for index in [2, 0, 2, 0] {
            while armed.load(Ordering::Relaxed) == 0 {
                thread::yield_now();
            }
            let index = index.min(waiters.len() - 1);
            let flag = flags.iter().filter(|f| !f.up.load(Ordering::Acquire)).nth(index).unwrap();
            flag.up.store(true, Ordering::Release);
            settle::<AtomicU64>();
            bell.ring();
            assert!(waiters.remove(index).join().unwrap());
        }
    });
    assert!(start.elapsed() < EVER, "a wake-up was lost");
}
