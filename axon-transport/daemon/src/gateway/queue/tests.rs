//! A queue whose samples are offered, taken, acknowledged and sent again.

use axon_transport::internal::session::Lifetime;

use super::*;

fn sample(sequence: u64, size: usize) -> Sample {
    let info = MessageInfo::of(Gid::default(), sequence);
    Sample { info, client: None, payload: vec![0; size].into(), since: std::time::Instant::now() }
}

/// Room in which each queue has some for so many samples of so many bytes.
fn room(samples: usize, size: usize) -> Arc<QueueBudget> {
    QueueBudget::new(32 * (samples * sample(0, size).size()) as u64)
}

/// A queue with room for so many samples of so many bytes.
fn queue(qos: &Qos, samples: usize, size: usize) -> Queue {
    Queue::new(qos, room(samples, size).of_peer(), false)
}

fn offer(queue: &mut Queue, sequence: u64, size: usize) -> Result<u64, u64> {
    match queue.offer(sample(sequence, size)) {
        Offered::Queued { dropped } => Ok(dropped),
        Offered::Full(s) | Offered::Over(s) => Err(s.info.sequence),
    }
}

#[test]
fn keep_all_hands_the_sample_back_and_loses_nothing() {
    let mut queue = queue(&Qos::keep_all(), 1, 60);
    assert_eq!(offer(&mut queue, 1, 60), Ok(0));
    assert_eq!(offer(&mut queue, 2, 60), Err(2));
    assert_eq!(queue.pop().unwrap().info.sequence, 1);
    assert_eq!(offer(&mut queue, 2, 60), Ok(0));
    assert_eq!(queue.pop().unwrap().info.sequence, 2);
    assert!(queue.pop().is_none());
}

#[test]
fn one_sample_over_the_bound_still_passes() {
    let mut queue = queue(&Qos::keep_all(), 1, 60);
    assert_eq!(offer(&mut queue, 1, 1000), Ok(0));
}

#[test]
fn keep_last_drops_the_oldest_and_says_how_many() {
    let mut queue = queue(&Qos::default(), 5, 20);
    for sequence in 1..=5 {
        assert_eq!(offer(&mut queue, sequence, 20), Ok(0));
    }
    let of_three = 2 * sample(0, 20).size() + 20;
    assert_eq!(offer(&mut queue, 6, of_three), Ok(3));
    assert_eq!(queue.pop().unwrap().info.sequence, 4);
}

#[test]
fn samples_without_bytes_take_room_too() {
    let mut queue = queue(&Qos::default(), 3, 0);
    let dropped: Vec<_> = (1..=5).map(|sequence| offer(&mut queue, sequence, 0)).collect();
    assert_eq!(dropped, [Ok(0), Ok(0), Ok(0), Ok(1), Ok(1)]);
}

#[test]
fn together_go_as_many_as_have_the_bytes_and_at_least_one() {
    let mut queue = queue(&Qos::keep_all(), 9, 1000);
    for sequence in 1..=4 {
        assert_eq!(offer(&mut queue, sequence, 1000), Ok(0));
    }
    let mut together = |bytes| {
        let mut into = VecDeque::new();
        queue.pop_together(bytes, &mut into);
        into.iter().map(|sample| sample.info.sequence).collect::<Vec<_>>()
    };
    assert_eq!(together(1), [1]);
    assert_eq!(together(1500), [2, 3]);
    assert_eq!(together(1 << 20), [4]);
    assert!(together(1).is_empty());
}

#[test]
fn queues_towards_a_peer_share_its_room_and_give_it_back() {
    let peer = room(4, 20).of_peer();
    let [keeping, dropping] = [Qos::keep_all(), Qos::default()];
    // A quarter of 32 times as much as one has: that of eight.
    let mut full: Vec<_> = (0..8).map(|_| Queue::new(&keeping, peer.clone(), false)).collect();
    for queue in &mut full {
        (1..=4).for_each(|sequence| assert_eq!(offer(queue, sequence, 20), Ok(0)));
    }
    let mut waits = Queue::new(&keeping, peer.clone(), false);
    assert_eq!(offer(&mut waits, 1, 20), Ok(0), "one may always wait");
    assert_eq!(offer(&mut waits, 2, 20), Err(2));
    let mut drops = Queue::new(&dropping, peer.clone(), false);
    assert_eq!(offer(&mut drops, 1, 20), Ok(0));
    assert_eq!(offer(&mut drops, 2, 20), Ok(1));
    // Best effort takes none of it.
    let mut lossy = Queue::new(&Qos::sensor_data(), peer.clone(), false);
    (1..=4).for_each(|sequence| assert_eq!(offer(&mut lossy, sequence, 20), Ok(0)));
    full[0].pop().unwrap();
    drop(full.pop());
    for sequence in 2..=4 {
        assert_eq!(offer(&mut waits, sequence, 20), Ok(0));
    }
    assert_eq!(offer(&mut waits, 5, 20), Err(5), "it has as much as a queue may");
    assert_eq!(offer(&mut drops, 3, 20), Ok(1), "no room is left");
}

#[test]
fn who_takes_over_is_served_as_it_asks_from_the_next_sample_on() {
    let mut queue = queue(&Qos { depth: 1, ..Qos::sensor_data() }, 2, 10);
    assert_eq!((offer(&mut queue, 1, 10), offer(&mut queue, 2, 10)), (Ok(0), Ok(1)));
    queue.serve(&Qos::keep_all());
    assert_eq!(queue.delivery(), Delivery::Reliable);
    assert_eq!((offer(&mut queue, 3, 10), offer(&mut queue, 4, 10)), (Ok(0), Err(4)));
    queue.serve(&Qos::default());
    assert_eq!(offer(&mut queue, 4, 10), Ok(1));
    queue.serve(&Qos { depth: 1, ..Qos::sensor_data() });
    assert_eq!((offer(&mut queue, 5, 10), queue.delivery()), (Ok(2), Delivery::BestEffort));
}

#[test]
fn who_takes_over_takes_the_room_and_gives_it_back() {
    let daemon = room(2, 10);
    let peer = daemon.of_peer();
    let all = peer.of_queue() * 8;
    for (qos, next) in
        [(Qos::sensor_data(), Qos::keep_all()), (Qos::keep_all(), Qos::sensor_data())]
    {
        let mut queue = Queue::new(&qos, peer.clone(), false);
        (1..=2).for_each(|sequence| assert_eq!(offer(&mut queue, sequence, 10), Ok(0)));
        queue.serve(&next);
        assert_eq!(peer.take(all), next.reliability == Reliability::BestEffort);
        if next.reliability == Reliability::BestEffort {
            peer.give_back(all);
        }
        drop(queue);
        assert!(peer.take(all), "nothing is left of it");
        peer.give_back(all);
    }
}

#[test]
fn it_does_not_end_with_something_in_it() {
    let mut queue = queue(&Qos::keep_all(), 2, 10);
    assert_eq!(offer(&mut queue, 1, 10), Ok(0));
    assert!(!queue.end() && !queue.is_over());
    queue.pop().unwrap();
    assert!(queue.end() && queue.is_over());
}

fn taken(queue: &mut Queue) -> Vec<u64> {
    let mut into = VecDeque::new();
    queue.pop_together(1 << 20, &mut into);
    into.iter().map(|sample| sample.info.sequence).collect()
}

#[test]
fn a_sample_keeps_its_room_until_it_is_acknowledged() {
    let mut queue = Queue::new(&Qos::keep_all(), room(3, 10).of_peer(), true);
    (1..=3).for_each(|sequence| assert_eq!(offer(&mut queue, sequence, 10), Ok(0)));
    assert_eq!(taken(&mut queue), [1, 2, 3]);
    // One may always wait, but is not taken.
    assert_eq!((offer(&mut queue, 4, 10), offer(&mut queue, 5, 10)), (Ok(0), Err(5)));
    assert!(taken(&mut queue).is_empty());
    assert_eq!(queue.acknowledge(2), (2, Some(2)));
    assert_eq!(queue.acknowledge(2), (0, None), "said again");
    assert_eq!(taken(&mut queue), [4]);
    assert!(!queue.end());
    // A peer may claim what it likes.
    assert_eq!(queue.acknowledge(u64::MAX), (2, Some(4)));
    assert!(queue.end());
    assert_eq!(queue.bytes, 0);
}

#[test]
fn what_is_not_acknowledged_is_sent_again_in_order() {
    let peer = room(9, 10).of_peer();
    let mut queue = Queue::new(&Qos::default(), peer.clone(), true);
    (1..=3).for_each(|sequence| assert_eq!(offer(&mut queue, sequence, 10), Ok(0)));
    assert_eq!(taken(&mut queue), [1, 2, 3]);
    assert_eq!((queue.acknowledge(1), offer(&mut queue, 4, 10)), ((1, Some(1)), Ok(0)));
    queue.rewind();
    assert_eq!(queue.acknowledge(2), (1, Some(2)), "the peer had it before the link broke");
    assert_eq!(taken(&mut queue), [3, 4]);
    queue.rewind();
    assert_eq!((queue.acknowledge(u64::MAX), offer(&mut queue, 5, 10)), ((2, Some(4)), Ok(0)));
    assert_eq!(queue.acknowledge(u64::MAX), (0, None), "the fifth was never sent");
    drop(queue);
    assert!(peer.take(8 * peer.of_queue()), "nothing is left of it");
}

#[test]
fn what_was_taken_once_is_acknowledged_though_a_part_alone_is_taken_again() {
    let mut queue = Queue::new(&Qos::keep_all(), room(9, 10).of_peer(), true);
    (1..=4).for_each(|sequence| assert_eq!(offer(&mut queue, sequence, 10), Ok(0)));
    let mut into = VecDeque::new();
    (0..3).for_each(|_| queue.pop_together(1, &mut into));
    assert_eq!(into.len(), 3);
    queue.rewind();
    queue.pop_together(1, &mut into);
    assert_eq!(queue.acknowledge(3), (3, Some(3)), "the peer had them over the last link");
    assert_eq!(queue.acknowledge(4), (0, None), "the fourth was never sent");
}

#[test]
fn best_effort_that_waited_too_long_gives_way_to_newer_samples() {
    let mut queue = queue(&Qos { depth: 5, ..Qos::sensor_data() }, 9, 1);
    (1..=3).for_each(|sequence| assert_eq!(offer(&mut queue, sequence, 1), Ok(0)));
    assert_eq!(queue.drop_late(Duration::from_secs(1000), Duration::ZERO), 0);
    std::thread::sleep(Duration::from_millis(2));
    // The newest stays, however old, and however long the way seems.
    assert_eq!(queue.drop_late(Duration::from_millis(1), Duration::from_secs(9)), 2);
    assert_eq!(taken(&mut queue), [3]);
}

#[test]
fn best_effort_ages_by_its_publishers_lifespan_from_publication_on() {
    let [life, age] = [1000, 900].map(Duration::from_secs);
    let transit = Duration::from_secs(200);
    let mortal = |sequence, age| {
        let lifetime = Some(Lifetime::new(age, Duration::from_secs(1000)));
        let mut sample = sample(sequence, 1);
        sample.info.lifetime = lifetime;
        sample
    };
    assert!(mortal(1, age).age() >= age, "it was as old when it was copied out");
    assert!(mortal(1, age).left().unwrap() <= Duration::from_secs(100));
    let mut queue = queue(&Qos { depth: 5, ..Qos::sensor_data() }, 9, 1);
    for (sequence, age) in [(1, age), (2, Duration::ZERO), (3, age)] {
        assert!(matches!(queue.offer(mortal(sequence, age)), Offered::Queued { dropped: 0 }));
    }
    assert_eq!(queue.drop_late(life, Duration::ZERO), 0);
    // The first would arrive too late. The last might, too, but nothing newer is there.
    assert_eq!(queue.drop_late(life, transit), 1);
    assert_eq!(queue.pop().unwrap().info.sequence, 2);
    assert_eq!(queue.drop_late(life, transit), 0);
    assert_eq!(taken(&mut queue), [3]);
    // One whose lifespan is over goes, with nothing newer.
    assert!(matches!(queue.offer(mortal(4, life)), Offered::Queued { dropped: 0 }));
    assert_eq!(queue.drop_late(life, Duration::ZERO), 1);
}

#[test]
fn best_effort_goes_one_by_one() {
    let mut queue = queue(&Qos::sensor_data(), 9, 1);
    (1..=2).for_each(|sequence| assert_eq!(offer(&mut queue, sequence, 1), Ok(0)));
    let mut into = VecDeque::new();
    queue.pop_together(1 << 20, &mut into);
    assert_eq!(into.len(), 1);
}

#[test]
fn best_effort_keeps_no_more_than_its_depth() {
    let mut queue = queue(&Qos { depth: 2, ..Qos::sensor_data() }, 10, 1);
    assert_eq!(offer(&mut queue, 1, 1), Ok(0));
    assert_eq!(offer(&mut queue, 2, 1), Ok(0));
    assert_eq!(offer(&mut queue, 3, 1), Ok(1));
    assert_eq!(queue.pop().unwrap().info.sequence, 2);
}
