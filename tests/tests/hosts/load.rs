//! More samples than get through: which publisher waits for which reader, and that the newest arrives.

use std::{thread, time::Duration};

use axon_shm::PublishError;
use axon_transport::{EndpointSpec, Publisher, Subscription, qos::Qos};
use rustix::process::Signal;

use super::{
    mode::classic,
    pair::{Host, Plan, signal},
    process::PATIENCE,
};

fn hosts() -> [Host; 2] {
    Plan::new([classic(&[]), classic(&[])]).start()
}

/// Creates a publisher on the first host and a matched subscription on the second.
pub(crate) fn across(hosts: &[Host; 2], topic: &str, qos: Qos) -> (Publisher, Subscription) {
    let (here, there) = (hosts[0].session("publisher"), hosts[1].session("subscription"));
    let spec = || EndpointSpec::new(topic, "test/Bytes", qos);
    let subscription = there.create_subscription(spec()).unwrap();
    let publisher = here.create_publisher(spec()).unwrap();
    assert!(publisher.wait_matched(1, PATIENCE) && subscription.wait_matched(1, PATIENCE));
    (publisher, subscription)
}

fn take(subscription: &Subscription, bytes: &mut Vec<u8>) -> u64 {
    subscription.recv(bytes, Some(PATIENCE)).expect("a sample").sequence
}

#[test]
fn a_flood_that_overtakes_its_reader_arrives_in_order_with_its_end() {
    const SAMPLES: u64 = 100_000;
    let hosts = hosts();
    let (publisher, subscription) = across(&hosts, "/flood", Qos::default());
    let reader = thread::spawn(move || {
        let (mut bytes, mut taken, mut last) = (Vec::new(), 0, 0);
        while last < SAMPLES {
            let sequence = take(&subscription, &mut bytes);
            assert!(sequence > last, "{sequence} after {last}");
            assert_eq!((bytes.len(), &bytes[..8]), (1024, &sequence.to_ne_bytes()[..]));
            (taken, last) = (taken + 1, sequence);
        }
        (taken, subscription.lost())
    });
    let mut bytes = [0x5a; 1024];
    for number in 1..=SAMPLES {
        bytes[..8].copy_from_slice(&number.to_ne_bytes());
        assert_eq!(publisher.publish(&bytes).unwrap(), number);
    }
    let (taken, lost) = reader.join().unwrap();
    // Samples that the depth skips, and samples before the first taken one, are not losses of the subscription.
    assert!(taken + lost <= SAMPLES, "{taken} taken, {lost} lost");
}

#[test]
fn an_unread_topic_blocks_only_its_own_publisher() {
    const TINY: u64 = 2_000;
    let hosts = hosts();
    let (huge, unread) = across(&hosts, "/huge", Qos::keep_all());
    let (tiny, read) = across(&hosts, "/tiny", Qos::keep_all());
    let large = vec![0x5a; 1 << 20];
    let mut sent = 0;
    loop {
        match huge.publish(&large) {
            Ok(sequence) => sent = sequence,
            Err(PublishError::Blocked { .. }) => break,
            Err(error) => panic!("{error}"),
        }
    }
    let mut bytes = Vec::new();
    let reader = thread::spawn(move || {
        for number in 1..=TINY {
            assert_eq!((take(&read, &mut bytes), &bytes[..]), (number, &number.to_ne_bytes()[..]));
        }
    });
    for number in 1..=TINY {
        while let Err(error) = tiny.publish(&number.to_ne_bytes()) {
            assert!(matches!(error, PublishError::Blocked { .. }), "{error}");
        }
    }
    reader.join().unwrap();
    // All delayed samples arrive.
    let mut bytes = Vec::new();
    for number in 1..=sent {
        assert_eq!((take(&unread, &mut bytes), bytes.len()), (number, large.len()));
    }
}

/// Returns how many samples of a flood towards a stopped daemon arrive when the daemon goes on.
fn survivors(queue_mb: &str) -> usize {
    const SAMPLES: u64 = 300;
    // Samples that do not fit the queue wait in the ring.
    let ring = ("AXON_RING_BUFFER_SIZE_MB", "8");
    let settings = classic(&[("AXON_RELIABLE_QUEUE_MB", queue_mb), ring]);
    let hosts = Plan::new([settings, classic(&[])]).start();
    let newest = Qos::default().with_depth(1000);
    let (publisher, subscription) = across(&hosts, "/newest", newest);
    let daemon = hosts[1].status().pid;
    signal(daemon, Signal::STOP);
    let mut bytes = vec![0x5a; 300_000];
    for number in 1..=SAMPLES {
        assert_eq!(publisher.publish(&bytes).unwrap(), number);
        // Slower than this host's daemon takes it over, and a burst for its queue.
        thread::sleep(Duration::from_millis(1));
    }
    signal(daemon, Signal::CONT);
    let mut taken = 0;
    while take(&subscription, &mut bytes) < SAMPLES {
        taken += 1;
    }
    taken
}

/// A queue may take a thirty-second of all: 2 MiB, and 32.
#[test]
fn the_queue_for_a_slow_peer_has_its_configured_bound() {
    let [few, many] = ["64", "1024"].map(survivors);
    assert!(few + 80 < many, "{few} and {many} of 300 samples of 300 kB");
}
