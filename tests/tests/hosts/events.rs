//! Tests the events that endpoints of two hosts report about each other: the eleven events, at both ends, and lifespan.

use std::{
    sync::atomic::{AtomicBool, Ordering},
    thread,
    time::{Duration, Instant},
};

use axon_transport::internal::session::from_unix_nanos;
use axon_transport::{
    EndpointSpec, Event, Publisher, Session, Subscription, Waitable,
    events::{CountStatus, EventKind, EventStatus, LivelinessChanged, Matched},
    qos::{Durability, Incompatible, Liveliness, Qos, Reliability},
};
use rustix::process::Signal;

use super::{
    mode::classic,
    pair::{Host, Plan, signal},
    process::PATIENCE,
};

const SECOND: Duration = Duration::from_secs(1);

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

fn counted(event: &Event) -> CountStatus {
    let EventStatus::Counted(status) = event.take() else { unreachable!() };
    status
}

fn matches(event: &Event) -> Matched {
    let EventStatus::Matched(status) = event.take() else { unreachable!() };
    status
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
fn matches_are_counted_on_both_hosts() {
    let [a, b] = hosts();
    let (here, there) = (a.session("publisher"), b.session("subscriptions"));
    let spec = || EndpointSpec::new("/counted", "test/Bytes", Qos::default());
    let publisher = here.create_publisher(spec()).unwrap();
    let publication = publisher.event(EventKind::PublicationMatched).unwrap();
    let first = there.create_subscription(spec()).unwrap();
    let one = Matched::new(1, 1, 1, 1);
    let subscribed = first.event(EventKind::SubscriptionMatched).unwrap();
    for (session, event) in [(&here, &publication), (&there, &subscribed)] {
        occurs(session, event);
        assert_eq!(matches(event), one);
    }
    let second = there.create_subscription(spec()).unwrap();
    occurs(&here, &publication);
    let two = Matched::new(2, 1, 2, 1);
    assert_eq!(matches(&publication), two);
    drop(first);
    occurs(&here, &publication);
    let left = Matched::new(2, 0, 1, -1);
    assert_eq!(matches(&publication), left);
    assert_eq!(publisher.matched(), [second.gid()]);
    let subscribed = second.event(EventKind::SubscriptionMatched).unwrap();
    occurs(&there, &subscribed);
    assert_eq!(matches(&subscribed), one);
    drop(publisher);
    occurs(&there, &subscribed);
    let none = Matched::new(1, 0, 0, -1);
    assert_eq!(matches(&subscribed), none);
}

#[test]
fn each_policy_that_falls_short_is_reported_on_both_hosts() {
    let [a, b] = hosts();
    let (here, there) = (a.session("publisher"), b.session("subscription"));
    let least = Qos::sensor_data();
    let manual = Liveliness::ManualByTopic;
    for (policy, requested) in [
        (Incompatible::Reliability, least.with_reliability(Reliability::Reliable)),
        (Incompatible::Durability, least.with_durability(Durability::TransientLocal)),
        (Incompatible::Deadline, least.with_deadline(3600 * SECOND)),
        (Incompatible::Liveliness, least.with_liveliness(manual, least.lease)),
        (Incompatible::LivelinessLease, least.with_lease(3600 * SECOND)),
    ] {
        let spec = |qos| EndpointSpec::new(format!("/{policy}"), "test/Bytes", qos);
        let publisher = here.create_publisher(spec(least)).unwrap();
        let offers = publisher.event(EventKind::OfferedQosIncompatible).unwrap();
        for total in 1..=2 {
            let subscription = there.create_subscription(spec(requested)).unwrap();
            let requests = subscription.event(EventKind::RequestedQosIncompatible).unwrap();
            for (session, event, total) in [(&here, &offers, total), (&there, &requests, 1)] {
                occurs(session, event);
                let EventStatus::IncompatibleQos(status) = event.take() else { unreachable!() };
                assert_eq!(status.count, CountStatus::new(total, 1));
                assert_eq!(status.last_policy, Some(policy));
            }
            assert!(publisher.matched().is_empty() && subscription.matched().is_empty());
        }
    }
}

#[test]
fn another_type_is_reported_on_both_hosts() {
    let [a, b] = hosts();
    let (here, there) = (a.session("publisher"), b.session("subscription"));
    let spec = |type_name: &str, hash: u8| {
        EndpointSpec::new("/typed", type_name, Qos::default()).type_hash(vec![hash; 32])
    };
    let publisher = here.create_publisher(spec("test/Bytes", 1)).unwrap();
    let offers = publisher.event(EventKind::PublisherIncompatibleType).unwrap();
    for (total, spec) in [(1, spec("test/Bytes", 2)), (2, spec("test/Other", 1))] {
        let subscription = there.create_subscription(spec).unwrap();
        let requests = subscription.event(EventKind::SubscriptionIncompatibleType).unwrap();
        for (session, event, total) in [(&here, &offers, total), (&there, &requests, 1)] {
            occurs(session, event);
            assert_eq!(counted(event), CountStatus::new(total, 1));
        }
        assert!(publisher.matched().is_empty() && subscription.matched().is_empty());
    }
}

#[test]
fn every_sample_is_taken_or_counted_as_lost_elsewhere() {
    let ring = || classic(&[("AXON_RING_BUFFER_SIZE_MB", "1")]);
    let [a, b] = Plan::new([ring(), ring()]).start();
    let (here, there) = (a.session("publisher"), b.session("subscription"));
    let qos = Qos::keep_all().with_reliability(Reliability::BestEffort);
    let (publisher, subscription) = matched(&here, &there, qos);
    let lost = subscription.event(EventKind::MessageLost).unwrap();
    // Losses count from the first sample that arrived.
    publisher.publish(b"first").unwrap();
    let (mut bytes, mut taken) = (Vec::new(), 1);
    assert!(subscription.recv(&mut bytes, Some(PATIENCE)).is_ok());
    assert!(!lost.is_ready());
    let flood: u64 = 2000;
    for _ in 0..flood {
        publisher.publish(&[7; 5000]).unwrap();
    }
    loop {
        let Ok(info) = subscription.recv(&mut bytes, Some(Duration::from_millis(50))) else {
            // Samples that were dropped last count as lost when the next sample arrives.
            publisher.publish(&[7; 5000]).unwrap();
            continue;
        };
        taken += 1;
        assert_eq!(taken + subscription.lost(), info.sequence, "up to this one");
        if info.sequence > flood + 1 {
            break;
        }
    }
    assert!(taken < flood, "this was more than there is room for");
    occurs(&there, &lost);
    let status = counted(&lost);
    assert_eq!((status.total, status.change), (subscription.lost(), subscription.lost()));
}

#[test]
fn a_deadline_is_missed_on_both_hosts() {
    let [a, b] = hosts();
    let (here, there) = (a.session("publisher"), b.session("subscription"));
    let qos = Qos::default().with_deadline(SECOND / 10);
    let (publisher, subscription) = matched(&here, &there, qos);
    publisher.publish(b"the only one").unwrap();
    assert!(subscription.recv(&mut Vec::new(), Some(PATIENCE)).is_ok());
    occurs(&here, &publisher.event(EventKind::OfferedDeadlineMissed).unwrap());
    occurs(&there, &subscription.event(EventKind::RequestedDeadlineMissed).unwrap());
}

#[test]
fn samples_older_than_their_lifespan_are_not_taken_on_another_host() {
    let [a, b] = hosts();
    let (here, there) = (a.session("publisher"), b.session("subscription"));
    let lasts = |seconds| {
        Qos::default().with_durability(Durability::TransientLocal).with_lifespan(seconds * SECOND)
    };
    // By its timestamp the sample is of 1970: the timestamp does not matter.
    let (publisher, subscription) = matched(&here, &there, lasts(3600));
    publisher.publish_at(from_unix_nanos(1_000_000_000), b"new").unwrap();
    let mut bytes = Vec::new();
    let info = subscription.recv(&mut bytes, Some(PATIENCE)).expect("it is not old");
    assert_eq!((&bytes[..], info.sequence, subscription.lost()), (&b"new"[..], 1, 0));
    // By its timestamp this sample is of 2262. It is four seconds old when it leaves, and that age counts.
    let spec = || EndpointSpec::new("/late", "test/Bytes", lasts(6));
    let late = here.create_publisher(spec()).unwrap();
    let over = Instant::now() + Duration::from_secs(6);
    late.publish_at(from_unix_nanos(i64::MAX), b"old").unwrap();
    thread::sleep(Duration::from_secs(4));
    let subscription = there.create_subscription(spec()).unwrap();
    while !subscription.has_data() && Instant::now() < over {
        thread::sleep(Duration::from_millis(10));
    }
    let arrived = subscription.has_data();
    // The time on the way does not count, which is far below two seconds.
    thread::sleep(over.saturating_duration_since(Instant::now()) + Duration::from_secs(2));
    assert!(subscription.take(&mut bytes).is_none());
    assert_eq!((subscription.expired(), subscription.lost()), (u64::from(arrived), 0));
}

#[test]
fn asserted_liveliness_without_a_sample_reaches_the_other_host() {
    let [a, b] = hosts();
    let (here, there) = (a.session("publisher"), b.session("subscription"));
    let liveliness = Liveliness::ManualByTopic;
    let qos = Qos::default().with_liveliness(liveliness, SECOND / 2);
    let (publisher, subscription) = matched(&here, &there, qos);
    let liveliness = subscription.event(EventKind::LivelinessChanged).unwrap();
    let lost = publisher.event(EventKind::LivelinessLost).unwrap();
    becomes(&there, &liveliness, true);
    // The publisher asserts nothing, though its process and the link live.
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
    // A sample asserts liveliness as well.
    publisher.publish(b"x").unwrap();
    becomes(&there, &liveliness, true);
    assert_eq!(publisher.matched(), [subscription.gid()], "it is no reason to part");
}

#[test]
fn a_process_that_is_stopped_is_not_alive_elsewhere() {
    let [a, b] = hosts();
    let there = b.session("subscription");
    let mut node = a.node(&["alive", "/timed"]);
    let qos = Qos::default().with_lease(SECOND / 2);
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
