//! Samples that are left when a publisher, a link or a daemon ends: they arrive, or are known not to.

use std::{thread, time::Duration};

use axon_shm::PublishError;
use axon_transport::{EndpointSpec, Publisher, Subscription, qos::Qos};
use rustix::process::Signal;

use super::{
    mode::{Kmes, Settings, classic},
    pair::{Host, Plan, kill, signal},
    process::{PATIENCE, until},
};

const TOPIC: &str = "/ending";
const SAMPLES: u64 = 5_000;

fn spec() -> EndpointSpec {
    EndpointSpec::new(TOPIC, "test/Bytes", Qos::keep_all())
}

/// Creates a publisher on the first host and a matched subscription on the second.
fn across(hosts: &[Host; 2]) -> (Publisher, Subscription) {
    let (here, there) = (hosts[0].session("publisher"), hosts[1].session("subscription"));
    let subscription = there.create_subscription(spec()).unwrap();
    let publisher = here.create_publisher(spec()).unwrap();
    assert!(publisher.wait_matched(1, PATIENCE) && subscription.wait_matched(1, PATIENCE));
    (publisher, subscription)
}

fn publish(publisher: &Publisher, samples: u64) {
    let bytes = vec![0x5a; 4000];
    for _ in 0..samples {
        while let Err(error) = publisher.publish(&bytes) {
            assert!(matches!(error, PublishError::Blocked { .. }), "{error}");
        }
    }
}

/// Returns the numbers of the samples that arrive, up to the number `last`.
pub(crate) fn take(subscription: &Subscription, last: u64) -> Vec<u64> {
    let (mut bytes, mut numbers) = (Vec::new(), Vec::new());
    while numbers.last() != Some(&last) {
        let Ok(info) = subscription.recv(&mut bytes, Some(PATIENCE)) else { break };
        numbers.push(info.sequence);
    }
    numbers
}

/// Returns the number of samples that the status counts as lost with this cause.
fn lost(host: &Host, cause: &str) -> u64 {
    let topics = host.status().topics;
    let topics = topics.iter().filter(|topic| topic.topic == TOPIC);
    topics.filter_map(|topic| topic.dropped.get(cause)).sum()
}

fn what_a_publisher_leaves_arrives(settings: [Settings; 2]) {
    let hosts = Plan::new(settings).start();
    let (publisher, subscription) = across(&hosts);
    let reader = thread::spawn(move || take(&subscription, SAMPLES));
    publish(&publisher, SAMPLES);
    drop(publisher);
    assert!(reader.join().unwrap().into_iter().eq(1..=SAMPLES));
    assert_eq!(lost(&hosts[0], "publisher_ended"), 0);
    // No host shows the publisher any more.
    until("its end is known there", || {
        hosts[1].status().topics.iter().all(|topic| topic.remote_publishers == 0)
    });
}

#[test]
fn samples_of_an_ended_publisher_arrive_in_classic() {
    what_a_publisher_leaves_arrives([classic(&[]), classic(&[])]);
}

/// It waits for keys.
#[test]
fn samples_of_an_ended_publisher_arrive_in_messages10() {
    let kmes = Kmes::start();
    let more = [("AXON_QKD_KEY_MODE", "messages10")];
    what_a_publisher_leaves_arrives([0, 1].map(|host| kmes.settings(host, &more)));
}

#[test]
fn samples_of_an_ended_publisher_keep_the_daemon_until_they_arrive() {
    let hosts = Plan { grace_s: 1, ..Plan::new([classic(&[]), classic(&[])]) }.prepare();
    // A daemon that a session started ends; one that is started by hand stays.
    let starters = hosts.each_ref().map(|host| host.node(&["subscribe", "/elsewhere", "small"]));
    hosts.iter().for_each(|host| drop(host.status()));
    let (publisher, subscription) = across(&hosts);
    drop(starters);
    let there = hosts[1].status().pid;
    signal(there, Signal::STOP);
    publish(&publisher, 100);
    drop(publisher);
    // Longer than the grace time, shorter than the time that a daemon waits for progress.
    thread::sleep(Duration::from_secs(4));
    signal(there, Signal::CONT);
    assert!(take(&subscription, 100).into_iter().eq(1..=100));
    until("the daemon ends", || hosts[0].try_status().is_none());
}

#[test]
fn undelivered_samples_of_an_ended_publisher_are_counted() {
    let hosts = Plan::new([classic(&[]), classic(&[])]).start();
    let (publisher, _subscription) = across(&hosts);
    signal(hosts[1].status().pid, Signal::STOP);
    publish(&publisher, 100);
    drop(publisher);
    until("it is given up", || lost(&hosts[0], "publisher_ended") == 100);
    hosts[0].wait_log(&[TOPIC, "samples=100", "a publisher ended"]);
    signal(hosts[1].daemon.as_ref().unwrap().0.id(), Signal::CONT);
}

#[test]
fn samples_are_acknowledged_once_the_other_host_has_them() {
    let hosts = Plan::new([classic(&[]), classic(&[])]).start();
    let (publisher, subscription) = across(&hosts);
    publish(&publisher, 10);
    assert!(publisher.wait_acknowledged(PATIENCE));
    let there = hosts[1].status().pid;
    signal(there, Signal::STOP);
    publish(&publisher, 100);
    assert!(!publisher.wait_acknowledged(Duration::from_millis(500)));
    assert_eq!((publisher.unacknowledged(), publisher.given_up()), (100, 0));
    signal(there, Signal::CONT);
    assert!(publisher.wait_acknowledged(PATIENCE));
    // It is all there: the daemon is not needed any more.
    kill(there);
    assert!(take(&subscription, 110).into_iter().eq(1..=110));
}

#[test]
fn samples_in_a_killed_daemon_are_not_acknowledged() {
    let mut hosts = Plan::new([classic(&[]), classic(&[])]).start();
    let (publisher, _subscription) = across(&hosts);
    let there = hosts[1].status().pid;
    signal(there, Signal::STOP);
    publish(&publisher, 100);
    hosts[0].kill_daemon();
    assert!(!publisher.wait_acknowledged(PATIENCE));
    assert_eq!(publisher.given_up(), 100);
    signal(there, Signal::CONT);
}

#[test]
fn samples_in_flight_to_a_killed_daemon_arrive_through_its_successor() {
    let mut hosts = Plan::new([classic(&[]), classic(&[])]).start();
    let (publisher, subscription) = across(&hosts);
    let there = hosts[1].status().pid;
    signal(there, Signal::STOP);
    publish(&publisher, 100);
    // It is killed, and has a successor on the same port.
    assert_eq!(hosts[1].daemon.take().unwrap().0.id(), there);
    assert!(publisher.wait_acknowledged(PATIENCE));
    assert_eq!((publisher.given_up(), lost(&hosts[0], "link_ended")), (0, 0));
    assert!(take(&subscription, 100).into_iter().eq(1..=100));
}

#[test]
fn a_terminated_daemon_first_sends_its_queued_samples() {
    let hosts = Plan::new([classic(&[]), classic(&[])]).start();
    let (publisher, subscription) = across(&hosts);
    let there = hosts[1].status().pid;
    signal(there, Signal::STOP);
    publish(&publisher, 100);
    signal(hosts[0].status().pid, Signal::TERM);
    hosts[0].wait_log(&["SIGTERM", "flushing samples"]);
    signal(there, Signal::CONT);
    assert!(take(&subscription, 100).into_iter().eq(1..=100));
    until("the daemon ends", || hosts[0].try_status().is_none());
    assert_eq!(publisher.given_up(), 0);
}

#[test]
fn samples_that_a_terminated_daemon_cannot_send_are_counted() {
    let hosts = Plan::new([classic(&[]), classic(&[])]).start();
    let (publisher, _subscription) = across(&hosts);
    let there = hosts[1].status().pid;
    signal(there, Signal::STOP);
    publish(&publisher, 100);
    signal(hosts[0].status().pid, Signal::TERM);
    assert!(!publisher.wait_acknowledged(PATIENCE));
    assert_eq!(publisher.given_up(), 100);
    hosts[0].wait_log(&[TOPIC, "samples=100", "the link ended"]);
    signal(there, Signal::CONT);
}
