//! What endpoints of two hosts report of each other: deadlines, lifespan, liveliness.

use std::{
    sync::atomic::{AtomicBool, Ordering},
    thread,
    time::{Duration, SystemTime},
};

use axon_transport::{
    events::{EventKind, EventStatus, LivelinessChanged},
    qos::{Liveliness, Qos},
    session::{EndpointSpec, Event, Publisher, Session, Subscription, Waitable},
};
use rustix::process::Signal;

use super::{
    mode::classic,
    pair::{Host, Plan, signal},
    process::PATIENCE,
};

const SECOND: u64 = 1_000_000_000;

fn hosts() -> [Host; 2] {
    Plan::new([classic(&[]), classic(&[])]).start()
}

fn matched(here: &Session, there: &Session, qos: Qos) -> (Publisher, Subscription) {
    let spec = || EndpointSpec::new("/timed", "test/Bytes", qos);
    let subscription = there.create_subscription(spec()).unwrap();
    let publisher = here.create_publisher(spec()).unwrap();
    assert!(publisher.wait_matched(1, PATIENCE) && subscription.wait_matched(1, PATIENCE));
    (publisher, subscription)
}

#[track_caller]
fn occurs(session: &Session, event: &Event) {
    assert_eq!(session.wait_for(&[Waitable::Event(event)], Some(PATIENCE)).unwrap(), [0]);
}

fn changed(event: &Event) -> LivelinessChanged {
    let EventStatus::LivelinessChanged(status) = event.take() else { unreachable!() };
    status
}

/// Waits until the one publisher is `alive`, or is not.
#[track_caller]
fn becomes(session: &Session, event: &Event, alive: bool) {
    loop {
        occurs(session, event);
        let status = changed(event);
        assert_eq!(status.alive + status.not_alive, 1, "{status:?}");
        if (status.alive == 1) == alive {
            return;
        }
    }
}

#[test]
fn a_deadline_is_missed_on_both_hosts() {
    let [a, b] = hosts();
    let (here, there) = (a.session("publisher"), b.session("subscription"));
    let qos = Qos { deadline: Some(SECOND / 10), ..Qos::default() };
    let (publisher, subscription) = matched(&here, &there, qos);
    publisher.publish(b"the only one").unwrap();
    assert!(subscription.recv(&mut Vec::new(), Some(PATIENCE)).is_some());
    occurs(&here, &publisher.event(EventKind::OfferedDeadlineMissed).unwrap());
    occurs(&there, &subscription.event(EventKind::RequestedDeadlineMissed).unwrap());
}

#[test]
fn what_is_older_than_its_lifespan_is_not_taken_elsewhere() {
    let [a, b] = hosts();
    let (here, there) = (a.session("publisher"), b.session("subscription"));
    let qos = Qos { lifespan: Some(3600 * SECOND), ..Qos::default() };
    let (publisher, subscription) = matched(&here, &there, qos);
    let now = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).unwrap();
    let now = i64::try_from(now.as_nanos()).unwrap();
    publisher.publish_at(now - 2 * 3600 * i64::try_from(SECOND).unwrap(), b"old").unwrap();
    publisher.publish_at(now, b"new").unwrap();
    let mut bytes = Vec::new();
    let info = subscription.recv(&mut bytes, Some(PATIENCE)).expect("the new one");
    assert_eq!((&bytes[..], info.sequence, subscription.lost()), (&b"new"[..], 2, 0));
}

#[test]
fn who_says_without_a_sample_that_it_is_alive_is_so_elsewhere() {
    let [a, b] = hosts();
    let (here, there) = (a.session("publisher"), b.session("subscription"));
    let liveliness = Liveliness::ManualByTopic;
    let qos = Qos { liveliness, lease: Some(SECOND / 2), ..Qos::default() };
    let (publisher, subscription) = matched(&here, &there, qos);
    let liveliness = subscription.event(EventKind::LivelinessChanged).unwrap();
    let lost = publisher.event(EventKind::LivelinessLost).unwrap();
    becomes(&there, &liveliness, true);
    // It says nothing, though its process and the link live.
    becomes(&there, &liveliness, false);
    occurs(&here, &lost);
    let enough = AtomicBool::new(false);
    thread::scope(|scope| {
        scope.spawn(|| {
            while !enough.load(Ordering::Relaxed) {
                publisher.assert_liveliness().unwrap();
                thread::sleep(Duration::from_millis(50));
            }
        });
        becomes(&there, &liveliness, true);
        enough.store(true, Ordering::Relaxed);
    });
    becomes(&there, &liveliness, false);
    // A sample says it as well.
    publisher.publish(b"x").unwrap();
    becomes(&there, &liveliness, true);
    assert_eq!(publisher.matched(), [subscription.gid()], "it is no reason to part");
}

#[test]
fn a_process_that_is_stopped_is_not_alive_elsewhere() {
    let [a, b] = hosts();
    let there = b.session("subscription");
    let mut node = a.node(&["alive", "/timed"]);
    let qos = Qos { lease: Some(SECOND / 2), ..Qos::default() };
    let spec = EndpointSpec::new("/timed", "test/Bytes", qos);
    let subscription = there.create_subscription(spec).unwrap();
    node.wait_ready();
    assert!(subscription.wait_matched(1, PATIENCE));
    let liveliness = subscription.event(EventKind::LivelinessChanged).unwrap();
    becomes(&there, &liveliness, true);
    signal(node.pid(), Signal::STOP);
    becomes(&there, &liveliness, false);
    signal(node.pid(), Signal::CONT);
    becomes(&there, &liveliness, true);
    // One that is gone is neither.
    signal(node.pid(), Signal::KILL);
    let gone = || {
        occurs(&there, &liveliness);
        let status = changed(&liveliness);
        (status.alive, status.not_alive) == (0, 0)
    };
    while !gone() {}
}
