//! Tests that samples that are dropped on the way to another host are counted and logged by topic where they are
//! dropped.

use std::{thread, time::Instant};

use axon_transport::{EndpointSpec, Publisher, Subscription, qos::Qos};
use etsi_qkd014::sim::{Fault, FaultPlan, Method};
use rustix::process::Signal;

use super::{
    mode::{Kmes, classic},
    pair::{Host, Plan, signal},
    process::{PATIENCE, until},
};

const TYPE: &str = "test/Bytes";

/// Creates a publisher on the first host and a matched subscription on the second.
fn across(hosts: &[Host; 2], topic: &str, qos: Qos) -> (Publisher, Subscription) {
    let (here, there) = (hosts[0].session("publisher"), hosts[1].session("subscription"));
    let spec = || EndpointSpec::new(topic, TYPE, qos);
    let subscription = there.create_subscription(spec()).unwrap();
    let publisher = here.create_publisher(spec()).unwrap();
    assert!(publisher.wait_matched(1, PATIENCE) && subscription.wait_matched(1, PATIENCE));
    (publisher, subscription)
}

/// Returns how many samples of a topic the host reports as dropped for this cause.
fn dropped(host: &Host, topic: &str, cause: &str) -> u64 {
    let topics = host.status().topics;
    let of = topics.iter().filter(|of| of.topic == topic);
    of.filter_map(|of| of.dropped.get(cause)).sum()
}

fn of_link(host: &Host, cause: &str) -> u64 {
    host.status().links.iter().filter_map(|link| link.dropped.get(cause)).sum()
}

/// Publishes until samples of the topic are dropped for this cause.
fn drops(hosts: &[Host; 2], topic: &str, cause: &str, publisher: &Publisher, len: usize) {
    let bytes = vec![0x5a; len];
    until(cause, || {
        for _ in 0..50 {
            publisher.publish(&bytes).unwrap();
        }
        dropped(&hosts[0], topic, cause) > 0
    });
    hosts[0].wait_log(&["WARN", "samples are dropped", topic, cause]);
    assert_eq!(dropped(&hosts[1], topic, cause), 0, "it was not dropped there");
}

#[test]
fn samples_that_a_slow_peer_is_spared_are_counted_by_topic() {
    let hosts = Plan::new([classic(&[]), classic(&[])]).start();
    let (newest, _reads) = across(&hosts, "/newest", Qos::default());
    let (lossy, _also) = across(&hosts, "/lossy", Qos::sensor_data());
    let (quiet, reads) = across(&hosts, "/quiet", Qos::keep_all());
    let there = hosts[1].status().pid;
    signal(there, Signal::STOP);
    // The test asks the other host nothing meanwhile, because it cannot answer.
    let bytes = vec![0x5a; 300_000];
    until("samples are dropped", || {
        for publisher in [&newest, &lossy] {
            publisher.publish(&bytes).unwrap();
        }
        let of_lossy = dropped(&hosts[0], "/lossy", "queue") + dropped(&hosts[0], "/lossy", "late");
        dropped(&hosts[0], "/newest", "queue") > 0 && of_lossy > 0
    });
    signal(there, Signal::CONT);
    hosts[0].wait_log(&["WARN", "samples are dropped", "samples="]);
    quiet.publish(b"one").unwrap();
    assert!(reads.recv(&mut Vec::new(), Some(PATIENCE)).is_ok());
    // The counts of the link are the sums over its topics, once both are reported.
    until("the counts agree", || {
        ["queue", "late"].iter().all(|cause| {
            let topics = ["/newest", "/lossy", "/quiet"].map(|t| dropped(&hosts[0], t, cause));
            topics[2] == 0 && topics.iter().sum::<u64>() == of_link(&hosts[0], cause)
        })
    });
}

#[test]
fn best_effort_that_a_link_had_when_it_broke_is_counted() {
    const SAMPLES: u64 = 100;
    let mut hosts = Plan::new([classic(&[]), classic(&[])]).start();
    let (lossy, _reads) = across(&hosts, "/lossy", Qos::sensor_data());
    let there = hosts[1].status().pid;
    signal(there, Signal::STOP);
    for _ in 0..SAMPLES {
        lossy.publish(&[0x5a; 1_000]).unwrap();
    }
    // It is killed, and has a successor on the same port.
    assert_eq!(hosts[1].daemon.take().unwrap().0.id(), there);
    until("what waited is counted", || dropped(&hosts[0], "/lossy", "no_link") > 0);
    let address = hosts[1].address.to_string();
    hosts[0].wait_log(&["WARN", "samples are dropped", "/lossy", "no_link", &address]);
}

#[test]
fn samples_without_a_key_are_counted_by_topic() {
    let kmes = Kmes::start();
    let more = [("AXON_QKD_KEY_MODE", "messages10")];
    let hosts = Plan::new([0, 1].map(|host| kmes.settings(host, &more))).start();
    let (publisher, _subscription) = across(&hosts, "/keyless", Qos::sensor_data());
    for host in 0..2 {
        kmes.plan(host, FaultPlan::new(Fault::Empty).on(Method::EncKeys));
    }
    drops(&hosts, "/keyless", "no_key", &publisher, 100);
    kmes.clear_faults();
}

#[test]
fn samples_of_a_route_that_ended_are_counted_by_topic() {
    let hosts = Plan::new([classic(&[]), classic(&[])]).start();
    let counted = |host: &Host| {
        let topics = host.status().topics;
        topics.iter().filter_map(|topic| topic.dropped.get("no_route")).sum::<u64>()
    };
    let mut tries = 0;
    until("some were under way when it ended", || {
        tries += 1;
        // Each try has a topic of its own: endpoints of the last try may still be in the graph.
        let topic = format!("/ends_{tries}");
        let (publisher, subscription) = across(&hosts, &topic, Qos::default());
        thread::scope(|scope| {
            // The loop runs until the subscription's end is known here: samples that are sent meanwhile have no route
            // there.
            let flood = scope.spawn(|| {
                let end = Instant::now() + PATIENCE;
                while !publisher.matched().is_empty() {
                    assert!(Instant::now() < end, "the subscription's end is not known");
                    publisher.publish(&[0x5a; 1_000]).unwrap();
                }
            });
            assert!(subscription.recv(&mut Vec::new(), Some(PATIENCE)).is_ok());
            drop(subscription);
            flood.join().unwrap();
        });
        hosts.iter().map(counted).sum::<u64>() > 0
    });
    until("the counts agree", || {
        hosts.iter().all(|host| counted(host) == of_link(host, "no_route"))
    });
}
