//! Tests the history that a KEEP_ALL, TRANSIENT_LOCAL publisher keeps for late subscriptions: everything that fits its
//! memory.

use axon_transport::{
    EndpointSpec, Publisher, Subscription,
    qos::{Durability, Qos},
};

use super::{
    mode::classic,
    pair::{Host, Plan},
    process::{PATIENCE, until},
};

fn spec() -> EndpointSpec {
    let qos = Qos::keep_all().with_durability(Durability::TransientLocal);
    EndpointSpec::new("/history", "test/Bytes", qos)
}

fn publish(publisher: &Publisher, samples: std::ops::RangeInclusive<u64>) {
    let mut bytes = [0x5a; 64];
    for number in samples {
        bytes[..8].copy_from_slice(&number.to_ne_bytes());
        assert_eq!(publisher.publish(&bytes).unwrap(), number);
    }
}

/// Creates a subscription, and checks that it takes these samples, in order, and no others.
fn joins_late(host: &Host, samples: std::ops::RangeInclusive<u64>) -> Subscription {
    let subscription = host.session("late").create_subscription(spec()).unwrap();
    let mut bytes = Vec::new();
    for number in samples {
        let taken = subscription.recv(&mut bytes, Some(PATIENCE)).expect("a sample");
        assert_eq!((taken.sequence, &bytes[..8]), (number, &number.to_ne_bytes()[..]));
        assert_eq!(bytes.len(), 64);
    }
    assert!(!subscription.has_data());
    assert_eq!(subscription.lost(), 0);
    subscription
}

#[test]
fn a_late_joiner_gets_twenty_thousand_small_samples_on_each_host() {
    const SAMPLES: u64 = 20_000;
    let hosts = Plan::new([classic(&[]), classic(&[])]).start();
    let session = hosts[0].session("publisher");
    let publisher = session.create_publisher(spec()).unwrap();
    publish(&publisher, 1..=SAMPLES);
    let _here = joins_late(&hosts[0], 1..=SAMPLES);
    let _there = joins_late(&hosts[1], 1..=SAMPLES);
    // This history comes from the samples that the other host already has.
    let _another = joins_late(&hosts[1], 1..=SAMPLES);
    assert!(publisher.wait_acknowledged(PATIENCE));
}

#[test]
fn history_is_bounded_by_bytes_and_keeps_the_newest() {
    // A sample of 64 bytes takes 128.
    const KEPT: u64 = (2 << 20) / 128;
    const SAMPLES: u64 = 10 * KEPT + 12_345;
    let settings = || classic(&[("AXON_RING_BUFFER_SIZE_MB", "2")]);
    let hosts = Plan::new([settings(), settings()]).start();
    let session = hosts[0].session("publisher");
    let publisher = session.create_publisher(spec()).unwrap();
    publish(&publisher, 1..=SAMPLES);
    let here = joins_late(&hosts[0], SAMPLES - KEPT + 1..=SAMPLES);
    let there = joins_late(&hosts[1], SAMPLES - KEPT + 1..=SAMPLES);
    drop((here, there));
    until("nobody reads", || publisher.matched().is_empty());
    publish(&publisher, SAMPLES + 1..=2 * SAMPLES);
    joins_late(&hosts[1], 2 * SAMPLES - KEPT + 1..=2 * SAMPLES);
}
