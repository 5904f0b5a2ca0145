use axon_shm::ids::Gid;
use axon_transport::{Lifetime, MessageInfo};

use super::*;

const MIB: u64 = 1 << 20;

fn at(millis: u64) -> Duration {
    Duration::from_millis(millis)
}

fn sample(sequence: u64, length: usize, now: Duration) -> RingSample {
    RingSample::new(MessageInfo::of(Gid([1; 16]), sequence), vec![0; length].into(), now)
}

fn keep_last(depth: u32) -> Qos {
    Qos::default().with_depth(depth)
}

fn dropped(offered: Offered) -> u64 {
    match offered {
        Offered::Queued { dropped } => dropped,
        Offered::Full(_) => panic!("full"),
    }
}

fn numbers(queue: &mut Queue) -> Vec<u64> {
    std::iter::from_fn(|| queue.send().map(|sample| sample.info.sequence)).collect()
}

#[test]
fn a_burst_of_keep_last_is_lossless_within_its_bytes() {
    let budget = Budget::new(256 * MIB);
    let mut queue = Queue::new(&keep_last(1), budget.of_peer());
    for sequence in 1..=1000 {
        assert_eq!(dropped(queue.offer(sample(sequence, 100, at(0)), at(0))), 0);
    }
    assert_eq!(numbers(&mut queue).len(), 1000);
}

#[test]
fn keep_last_that_is_behind_holds_its_depth_and_the_newest() {
    let budget = Budget::new(256 * MIB);
    let mut queue = Queue::new(&keep_last(2), budget.of_peer());
    for sequence in 1..=10 {
        dropped(queue.offer(sample(sequence, 100, at(0)), at(0)));
    }
    // A newer sample evicts the excess samples of the burst. Nothing else evicts them.
    assert!(queue.wants_more(at(499)) && queue.wants_more(at(500)));
    assert_eq!(queue.waiting(), 10);
    assert_eq!(dropped(queue.offer(sample(11, 100, at(600)), at(600))), 9);
    assert!(!queue.wants_more(at(600)));
    assert_eq!(numbers(&mut queue), [10, 11]);
    // The queue is empty, but the ring is not: it is still behind.
    assert!(queue.wants_more(at(700)) && queue.is_behind(at(700)));
    for sequence in 12..=14 {
        dropped(queue.offer(sample(sequence, 100, at(800)), at(800)));
    }
    assert_eq!(numbers(&mut queue), [13, 14]);
    queue.handle_empty_ring(at(1000));
    // It has caught up, and time has passed: the next samples are a burst.
    assert!(queue.wants_more(at(1500)));
    for sequence in 15..=20 {
        assert_eq!(dropped(queue.offer(sample(sequence, 100, at(1500)), at(1500))), 0);
    }
}

#[test]
fn keep_all_refuses_beyond_its_bytes_and_takes_one_sample_of_any_length() {
    let budget = Budget::new(32 * MIB);
    let mut queue = Queue::new(&Qos::keep_all(), budget.of_peer());
    assert_eq!(dropped(queue.offer(sample(1, 9 << 20, at(0)), at(0))), 0);
    assert!(
        matches!(queue.offer(sample(2, 1, at(0)), at(0)), Offered::Full(s) if s.info.sequence == 2)
    );
    assert_eq!(queue.send().unwrap().info.sequence, 1);
    assert!(
        matches!(queue.offer(sample(2, 1, at(1)), at(1)), Offered::Full(_)),
        "not acknowledged, and the peer's share is used up"
    );
    assert_eq!(queue.acknowledge(1), (1, Some(1)));
    assert_eq!(dropped(queue.offer(sample(2, 1, at(2)), at(2))), 0);
    drop(queue);
    assert_eq!(budget.taken(), 0);
}

#[test]
fn two_long_samples_are_in_flight_and_a_third_waits() {
    for qos in [Qos::keep_all(), keep_last(1)] {
        // 1 MiB a flow, 8 MiB towards one peer.
        let budget = Budget::new(32 * MIB);
        let mut queue = Queue::new(&qos, budget.of_peer());
        for sequence in 1..=2 {
            dropped(queue.offer(sample(sequence, 3 << 20, at(0)), at(0)));
            assert_eq!(queue.send().unwrap().info.sequence, sequence);
        }
        let third = queue.offer(sample(3, 1, at(0)), at(0));
        assert_eq!(matches!(third, Offered::Full(_)), qos == Qos::keep_all(), "{third:?}");
        assert!(queue.send().is_none());
        assert_eq!(queue.acknowledge(2), (2, Some(2)));
    }
}

#[test]
fn keep_last_sends_the_newest_while_a_long_one_is_not_acknowledged() {
    let budget = Budget::new(32 * MIB);
    let mut queue = Queue::new(&keep_last(1), budget.of_peer());
    dropped(queue.offer(sample(1, 3 << 20, at(0)), at(0)));
    queue.send().unwrap();
    for sequence in 2..=9 {
        dropped(queue.offer(sample(sequence, 3 << 20, at(sequence)), at(sequence)));
    }
    assert_eq!(queue.waiting(), 1);
    assert_eq!(queue.acknowledge(1), (1, Some(1)));
    assert_eq!(numbers(&mut queue), [9]);
}

#[test]
fn keep_last_drops_nothing_of_its_depth_for_want_of_bytes() {
    // 1 MiB a flow.
    let budget = Budget::new(32 * MIB);
    let mut queue = Queue::new(&keep_last(3), budget.of_peer());
    for sequence in 1..=2 {
        assert_eq!(dropped(queue.offer(sample(sequence, 400 << 10, at(0)), at(0))), 0);
    }
    for now in [at(0), at(600)] {
        let third = queue.offer(sample(3, 400 << 10, now), now);
        assert!(matches!(third, Offered::Full(_)), "{third:?}");
    }
    assert_eq!(queue.send().unwrap().info.sequence, 1);
    assert_eq!(queue.acknowledge(1), (1, Some(1)));
    assert_eq!(dropped(queue.offer(sample(3, 400 << 10, at(600)), at(600))), 0);
    assert_eq!(numbers(&mut queue), [2, 3]);
}

#[test]
fn numbers_that_were_not_sent_acknowledge_nothing() {
    let budget = Budget::new(256 * MIB);
    let mut queue = Queue::new(&Qos::keep_all(), budget.of_peer());
    for sequence in 1..=3 {
        dropped(queue.offer(sample(sequence, 1, at(0)), at(0)));
    }
    assert_eq!(queue.acknowledge(u64::MAX), (0, None));
    queue.send().unwrap();
    assert_eq!(queue.acknowledge(u64::MAX), (1, Some(1)));
    assert_eq!(numbers(&mut queue), [2, 3]);
}

#[test]
fn a_link_that_ended_has_its_samples_sent_again_in_order() {
    let budget = Budget::new(256 * MIB);
    let mut queue = Queue::new(&Qos::keep_all(), budget.of_peer());
    for sequence in 1..=4 {
        dropped(queue.offer(sample(sequence, 1, at(0)), at(0)));
    }
    queue.send().unwrap();
    queue.send().unwrap();
    queue.rewind();
    // The acknowledgement of the old link came after it ended.
    assert_eq!(queue.acknowledge(1), (1, Some(1)));
    assert_eq!(numbers(&mut queue), [2, 3, 4]);
    assert!(!queue.is_empty());
}

#[test]
fn a_best_effort_queue_keeps_its_depth_and_drops_late_samples() {
    let budget = Budget::new(256 * MIB);
    let qos = Qos::sensor_data().with_depth(3);
    let mut queue = Queue::new(&qos, budget.of_peer());
    for sequence in 1..=5 {
        dropped(queue.offer(sample(sequence, 1, at(10 * sequence)), at(10 * sequence)));
    }
    assert_eq!(queue.waiting(), 3);
    assert_eq!(budget.taken(), 0, "best effort takes no other's room");
    assert_eq!(queue.drop_late(at(200), at(100), at(145)), 2);
    assert_eq!(queue.drop_late(at(200), at(100), at(9000)), 0, "the newest is sent however old");
    let last = queue.pop_best_effort().unwrap();
    assert_eq!((last.info.sequence, queue.is_empty()), (5, true));
}

#[test]
fn best_effort_sample_expires_at_the_end_of_its_lifespan() {
    let budget = Budget::new(256 * MIB);
    let mut queue = Queue::new(&Qos::sensor_data().with_depth(3), budget.of_peer());
    for sequence in 1..=3 {
        let mut sample = sample(sequence, 1, at(0));
        sample.info.lifetime = Some(Lifetime::new(at(50), at(1000)));
        dropped(queue.offer(sample, at(0)));
    }
    assert_eq!(queue.drop_late(at(200), at(600), at(0)), 0);
    assert_eq!(queue.drop_late(at(200), at(600), at(349)), 0);
    assert_eq!(queue.drop_late(at(200), at(600), at(350)), 2, "the newest crosses in no time");
    assert_eq!(queue.drop_late(at(200), at(600), at(950)), 1);
}

#[test]
fn responses_leave_in_the_order_of_the_calls_that_were_answered() {
    let budget = Budget::new(256 * MIB);
    let mut queue = Queue::new(&Qos::keep_all(), budget.of_peer());
    for sequence in [5, 3, 4] {
        dropped(queue.offer(sample(sequence, 1, at(0)), at(0)));
    }
    assert_eq!(numbers(&mut queue), [5, 3, 4]);
    queue.written(1);
    queue.rewind();
    assert_eq!(numbers(&mut queue), [3, 4], "response 5 is with QUIC, the others are not");
}

#[test]
fn another_delivery_moves_the_bytes_of_the_budget() {
    let budget = Budget::new(256 * MIB);
    let mut queue = Queue::new(&Qos::sensor_data(), budget.of_peer());
    dropped(queue.offer(sample(1, 100, at(0)), at(0)));
    queue.set_qos(&Qos::keep_all());
    assert!(budget.taken() > 100);
    queue.set_qos(&Qos::sensor_data());
    assert_eq!(budget.taken(), 0);
    drop(queue);
    assert_eq!(budget.taken(), 0);
}
