//! Tests that nothing is lost at a seam: cut links, publishers that end, killed daemons.

use std::{thread, time::Duration};

use axon_shm::PublishError;
use axon_tests::Sizes;
use axon_transport::{EndpointSpec, Publisher, Subscription, qos::Qos};

use super::{
    cut::wired,
    ending::take,
    mode::classic,
    pair::{self, Host, Plan, kill},
    process::{PATIENCE, until},
};

const TOPIC: &str = "/seam";

fn spec(qos: Qos) -> EndpointSpec {
    EndpointSpec::new(TOPIC, "test/Bytes", qos)
}

/// Creates a publisher on the first host and a matched subscription on the second.
fn across(hosts: &[Host; 2], qos: Qos) -> (Publisher, Subscription) {
    across_with(hosts, qos, [true, true])
}

/// Does the same. `shm` says for each session whether it shares memory with its daemon.
fn across_with(hosts: &[Host; 2], qos: Qos, shm: [bool; 2]) -> (Publisher, Subscription) {
    let session = |host: usize, name| match shm[host] {
        true => hosts[host].session(name),
        false => hosts[host].relayed_session(name),
    };
    let (here, there) = (session(0, "publisher"), session(1, "subscription"));
    let subscription = there.create_subscription(spec(qos)).unwrap();
    let publisher = here.create_publisher(spec(qos)).unwrap();
    assert!(publisher.wait_matched(1, PATIENCE) && subscription.wait_matched(1, PATIENCE));
    (publisher, subscription)
}

fn publish(publisher: &Publisher, samples: u64, length: usize, every: Duration) {
    let bytes = vec![0x5a; length];
    for _ in 0..samples {
        while let Err(error) = publisher.publish(&bytes) {
            assert!(matches!(error, PublishError::Blocked { .. }), "{error}");
        }
        thread::sleep(every);
    }
}

/// Returns the losses in the status of a host, by cause.
fn lost(host: &Host) -> Vec<(String, u64)> {
    let topics = host.status().topics;
    let topics = topics.into_iter().filter(|topic| topic.topic == TOPIC);
    topics.flat_map(|topic| topic.dropped).filter(|(_, samples)| *samples > 0).collect()
}

fn all_came(case: &str, hosts: &[Host; 2], numbers: &[u64], last: u64) {
    let causes = hosts.each_ref().map(lost);
    let came = numbers.len();
    let missing: Vec<_> = (1..=last).filter(|number| !numbers.contains(number)).collect();
    assert!(
        numbers.iter().copied().eq(1..=last),
        "{case}: {came} of {last} came, {missing:?} did not; lost {causes:?}"
    );
}

#[test]
fn a_burst_within_the_depth_outlasts_a_cut() {
    let (hosts, wire) = wired([classic(&[]), classic(&[])]);
    let (publisher, subscription) = across(&hosts, Qos::default().with_depth(1024));
    wire.cut();
    publish(&publisher, 1024, 4096, Duration::ZERO);
    thread::sleep(Duration::from_secs(3));
    wire.mend();
    all_came("burst", &hosts, &take(&subscription, 1024), 1024);
}

#[test]
fn samples_published_during_a_cut_longer_than_the_link_timeout_arrive() {
    let (hosts, wire) = wired([classic(&[]), classic(&[])]);
    let (publisher, subscription) = across(&hosts, Qos::keep_all());
    publish(&publisher, 20, 4096, Duration::ZERO);
    wire.cut();
    publish(&publisher, 300, 4096, Duration::from_millis(80));
    assert!(hosts.iter().all(|host| host.status().links.is_empty()), "each is taken for gone");
    wire.mend();
    all_came("cut", &hosts, &take(&subscription, 320), 320);
    assert!(publisher.wait_acknowledged(PATIENCE));
}

fn what_a_publisher_leaves_in_a_cut_link_arrives(qos: Qos) {
    let (hosts, wire) = wired([classic(&[]), classic(&[])]);
    let (publisher, subscription) = across(&hosts, qos);
    wire.cut();
    publish(&publisher, 100, 4096, Duration::ZERO);
    drop(publisher);
    thread::sleep(Duration::from_secs(5));
    wire.mend();
    all_came("left", &hosts, &take(&subscription, 100), 100);
}

#[test]
fn samples_of_an_ended_keep_all_publisher_survive_a_cut() {
    what_a_publisher_leaves_in_a_cut_link_arrives(Qos::keep_all());
}

#[test]
fn samples_of_an_ended_keep_last_publisher_survive_a_cut() {
    what_a_publisher_leaves_in_a_cut_link_arrives(Qos::default().with_depth(100));
}

#[test]
fn samples_of_a_process_killed_during_a_cut_arrive() {
    let (hosts, wire) = wired([classic(&[]), classic(&[])]);
    let mut there = hosts[1].subscribe(Sizes::Small);
    let mut publisher = hosts[0].publish(Sizes::Small, 2, Some(100));
    until("one of the two readers is there", || {
        let topics = hosts[0].status().topics;
        topics.iter().any(|topic| topic.topic == pair::TOPIC && topic.remote_subscriptions == 1)
    });
    thread::sleep(Duration::from_millis(500));
    wire.cut();
    // The other reader has it begin.
    let here = hosts[0].session("here");
    let spec = EndpointSpec::new(pair::TOPIC, "test/Bytes", Qos::keep_all());
    let _subscription = here.create_subscription(spec).unwrap();
    publisher.wait_sent();
    kill(publisher.pid());
    thread::sleep(Duration::from_secs(5));
    wire.mend();
    there.wait_taken(100);
    let tally = there.tally();
    assert_eq!((tally.taken, tally.lost), (100, 0), "{tally:?}");
}

/// Publishes while daemons are killed and started again; `shm` says for each end whether it shares memory with its
/// daemon.
fn outlasts(killed: &[usize], shm: [bool; 2]) {
    const SAMPLES: u64 = 500;
    let mut hosts = Plan::new([classic(&[]), classic(&[])]).start();
    let (publisher, subscription) = across_with(&hosts, Qos::keep_all(), shm);
    let publishing = thread::spawn(move || {
        publish(&publisher, SAMPLES, 4096, Duration::from_millis(5));
        publisher
    });
    let taking = thread::spawn(move || (take(&subscription, SAMPLES), subscription));
    thread::sleep(Duration::from_millis(500));
    for host in killed {
        kill(hosts[*host].status().pid);
    }
    for host in killed {
        hosts[*host].daemon = None;
        hosts[*host].start();
    }
    let publisher = publishing.join().unwrap();
    let (numbers, subscription) = taking.join().unwrap();
    all_came(&format!("{killed:?}, {shm:?}"), &hosts, &numbers, SAMPLES);
    assert!(publisher.wait_acknowledged(PATIENCE), "all came");
    assert!(subscription.take(&mut Vec::new()).is_none(), "nothing is repeated");
    assert_eq!((subscription.lost(), publisher.given_up()), (0, 0));
}

#[test]
fn keep_all_outlasts_a_killed_daemon_of_the_publisher() {
    outlasts(&[0], [true, true]);
}

#[test]
fn keep_all_outlasts_a_killed_daemon_of_the_subscription() {
    outlasts(&[1], [true, true]);
}

#[test]
fn keep_all_outlasts_killed_daemons_of_both() {
    outlasts(&[0, 1], [true, true]);
}

#[test]
fn keep_all_of_a_relayed_publisher_outlasts_a_killed_daemon_of_its_own() {
    outlasts(&[0], [false, true]);
}

#[test]
fn keep_all_of_a_relayed_publisher_outlasts_a_killed_daemon_of_the_subscription() {
    outlasts(&[1], [false, true]);
}

#[test]
fn keep_all_of_a_relayed_publisher_outlasts_killed_daemons_of_both() {
    outlasts(&[0, 1], [false, true]);
}

#[test]
fn keep_all_for_a_relayed_subscription_outlasts_a_killed_daemon_of_the_publisher() {
    outlasts(&[0], [true, false]);
}

#[test]
fn keep_all_for_a_relayed_subscription_outlasts_a_killed_daemon_of_its_own() {
    outlasts(&[1], [true, false]);
}

#[test]
fn keep_all_for_a_relayed_subscription_outlasts_killed_daemons_of_both() {
    outlasts(&[0, 1], [true, false]);
}

#[test]
fn keep_all_between_relayed_sessions_outlasts_a_killed_daemon_of_the_publisher() {
    outlasts(&[0], [false, false]);
}

#[test]
fn keep_all_between_relayed_sessions_outlasts_a_killed_daemon_of_the_subscription() {
    outlasts(&[1], [false, false]);
}

#[test]
fn keep_all_between_relayed_sessions_outlasts_killed_daemons_of_both() {
    outlasts(&[0, 1], [false, false]);
}
