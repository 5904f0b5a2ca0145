//! The events of endpoints: all eleven, by status and by callback, within a session and between two sessions that a
//! daemon connects.

#[path = "../support/alone.rs"]
mod alone;
mod callbacks;
mod pair;
mod property;
#[path = "../support/rules.rs"]
#[allow(dead_code, reason = "what other tests need of it")]
mod rules;
#[path = "../support/mod.rs"]
#[allow(dead_code, reason = "what other tests need of it")]
mod support;

use std::{
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
    },
    time::Duration,
};

use alone::alone;
use axon_transport::internal::session::from_unix_nanos;
use axon_transport::{
    EndpointSpec, Event, NewDataCallback, Publisher, Session, Subscription, Waitable,
    events::{CountStatus, EventKind, EventStatus, LivelinessChanged, Matched},
    qos::{Durability, Incompatible, Liveliness, Qos, Reliability},
};
use pair::Pair;
use support::{PATIENCE, until};

const MILLI: Duration = Duration::from_millis(1);

fn spec(qos: Qos) -> EndpointSpec {
    EndpointSpec::new("/t", "T", qos)
}

fn of_publisher(publisher: &Publisher, kind: EventKind) -> Event {
    publisher.event(kind).unwrap()
}

fn of_subscription(subscription: &Subscription, kind: EventKind) -> Event {
    subscription.event(kind).unwrap()
}

#[track_caller]
fn await_event(session: &Session, event: &Event) {
    let ready = session.wait_for(&[Waitable::Event(event)], Some(PATIENCE)).unwrap();
    assert_eq!(ready, [0], "{event:?}");
}

fn matched(event: &Event) -> Matched {
    let EventStatus::Matched(status) = event.take() else { panic!("{event:?}") };
    status
}

fn counted(event: &Event) -> CountStatus {
    let EventStatus::Counted(status) = event.take() else { panic!("{event:?}") };
    status
}

fn liveliness_of(event: &Event) -> LivelinessChanged {
    let EventStatus::LivelinessChanged(status) = event.take() else { panic!("{event:?}") };
    status
}

fn counter() -> (NewDataCallback, Arc<AtomicU64>) {
    let count = Arc::new(AtomicU64::new(0));
    let told = count.clone();
    let tell = move |new| {
        told.fetch_add(new, Ordering::SeqCst);
    };
    (Arc::new(tell), count)
}

#[test]
fn an_endpoint_has_the_events_of_its_kind_and_no_others() {
    let session = alone();
    let publisher = session.create_publisher(spec(Qos::default())).unwrap();
    let subscription = session.create_subscription(spec(Qos::default())).unwrap();
    for kind in EventKind::ALL {
        assert_eq!(publisher.event(kind).is_some(), kind.is_publishers(), "{kind:?}");
        assert_eq!(subscription.event(kind).is_some(), !kind.is_publishers(), "{kind:?}");
    }
}

#[test]
fn matches_are_counted_with_their_changes_at_both_ends() {
    for pair in Pair::all() {
        let publisher = pair.here.create_publisher(spec(Qos::default())).unwrap();
        let publication = of_publisher(&publisher, EventKind::PublicationMatched);
        assert_eq!(matched(&publication), Matched::default());
        let first = pair.there.create_subscription(spec(Qos::default())).unwrap();
        let subscribed = of_subscription(&first, EventKind::SubscriptionMatched);
        let one = Matched::new(1, 1, 1, 1);
        for (session, event) in [(&pair.here, &publication), (&pair.there, &subscribed)] {
            await_event(session, event);
            assert_eq!(matched(event), one);
        }
        let second = pair.there.create_subscription(spec(Qos::default())).unwrap();
        drop(first);
        let mut changes = (0, 0);
        until("one is new, and one is gone", || {
            await_event(&pair.here, &publication);
            let now = matched(&publication);
            changes = (changes.0 + now.total_change, changes.1 + now.current_change);
            (now.total, now.current) == (2, 1) && publisher.matched() == [second.gid()]
        });
        assert_eq!(changes, (1, 0));
        let subscribed = of_subscription(&second, EventKind::SubscriptionMatched);
        await_event(&pair.there, &subscribed);
        assert_eq!(matched(&subscribed), one);
        drop(publisher);
        await_event(&pair.there, &subscribed);
        let none = Matched::new(1, 0, 0, -1);
        assert_eq!(matched(&subscribed), none);
        assert!(second.matched().is_empty());
    }
}

#[test]
fn a_callback_is_told_of_the_backlog_and_then_of_each() {
    let session = alone();
    let publisher = session.create_publisher(spec(Qos::default())).unwrap();
    let event = of_publisher(&publisher, EventKind::PublicationMatched);
    let subscriptions: Vec<_> =
        (0..3).map(|_| session.create_subscription(spec(Qos::default())).unwrap()).collect();
    let (callback, told) = counter();
    event.set_callback(Some(callback));
    assert_eq!(told.load(Ordering::SeqCst), 3);
    drop(subscriptions);
    until("all are told of", || told.load(Ordering::SeqCst) == 6);
    event.set_callback(None);
    let _more = session.create_subscription(spec(Qos::default())).unwrap();
    assert_eq!(told.load(Ordering::SeqCst), 6);
    assert_eq!(matched(&event).total, 4);
    let (callback, told) = counter();
    event.set_callback(Some(callback));
    assert_eq!(told.load(Ordering::SeqCst), 0, "it has been looked at");
}

/// For each policy, a pair in which the publisher offers less than the subscription requests in that policy alone.
fn less() -> [(Incompatible, Qos, Qos); 5] {
    let (least, period) = (Qos::sensor_data(), Some(3_600_000 * MILLI));
    let longer = Some(7_200_000 * MILLI);
    let manual = Liveliness::ManualByTopic;
    [
        (Incompatible::Reliability, least, least.with_reliability(Reliability::Reliable)),
        (Incompatible::Durability, least, least.with_durability(Durability::TransientLocal)),
        (Incompatible::Deadline, least, least.with_deadline(period)),
        (Incompatible::Liveliness, least, least.with_liveliness(manual, least.lease)),
        (Incompatible::LivelinessLease, least.with_lease(longer), least.with_lease(period)),
    ]
}

#[test]
fn incompatible_profiles_are_reported_at_both_ends_with_the_policy() {
    for pair in Pair::all() {
        for (policy, offered, requested) in less() {
            // Endpoints of earlier rounds may not be gone everywhere yet, so each round has its own topic.
            let spec = |qos| spec(qos).topic(format!("/{policy}"));
            let publisher = pair.here.create_publisher(spec(offered)).unwrap();
            let offers = of_publisher(&publisher, EventKind::OfferedQosIncompatible);
            for total in 1..=2 {
                let subscription = pair.there.create_subscription(spec(requested)).unwrap();
                let requests = of_subscription(&subscription, EventKind::RequestedQosIncompatible);
                for (session, end, total) in
                    [(&pair.here, &offers, total), (&pair.there, &requests, 1)]
                {
                    await_event(session, end);
                    let EventStatus::IncompatibleQos(status) = end.take() else { panic!() };
                    assert_eq!(status.count, CountStatus::new(total, 1));
                    assert_eq!(status.last_policy, Some(policy));
                }
                assert!(subscription.matched().is_empty() && publisher.matched().is_empty());
            }
        }
    }
}

#[test]
fn another_type_under_the_same_name_is_reported_at_both_ends() {
    for pair in Pair::all() {
        let hashed = |hash: &[u8]| spec(Qos::default()).type_hash(hash);
        let publisher = pair.here.create_publisher(hashed(&[1; 32])).unwrap();
        let named = EndpointSpec::new("/t", "U", Qos::default());
        for (total, spec) in [(1, hashed(&[2; 32])), (2, named)] {
            let subscription = pair.there.create_subscription(spec).unwrap();
            let offered = of_publisher(&publisher, EventKind::PublisherIncompatibleType);
            let requested = of_subscription(&subscription, EventKind::SubscriptionIncompatibleType);
            await_event(&pair.here, &offered);
            await_event(&pair.there, &requested);
            assert_eq!(counted(&offered), CountStatus::new(total, 1));
            assert_eq!(counted(&requested), CountStatus::new(1, 1));
            assert!(publisher.matched().is_empty());
        }
        let unknown = pair.there.create_subscription(spec(Qos::default())).unwrap();
        assert!(publisher.wait_matched(1, PATIENCE), "who knows no hash takes any");
        assert_eq!(publisher.matched(), [unknown.gid()]);
    }
}

#[test]
fn every_lost_sample_is_counted_with_or_without_a_take() {
    for pair in Pair::all() {
        let (publisher, subscription) = pair.matched(lossy(), lossy());
        let lost = of_subscription(&subscription, EventKind::MessageLost);
        assert!(!lost.is_ready());
        flood(&publisher);
        await_event(&pair.there, &lost);
        let mut bytes = Vec::new();
        let mut taken = 0;
        while subscription.take(&mut bytes).is_some() {
            taken += 1;
        }
        let status = counted(&lost);
        assert_eq!(status.total, subscription.lost());
        assert_eq!((taken + status.total, status.change), (FLOOD, status.total));
    }
}

/// A profile that keeps what fits and waits for nobody.
fn lossy() -> Qos {
    Qos::keep_all().with_reliability(Reliability::BestEffort)
}

/// More samples than fit in a ring.
const FLOOD: u64 = 40_000;

fn flood(publisher: &Publisher) {
    for _ in 0..FLOOD {
        publisher.publish(b"x").unwrap();
    }
}

#[test]
fn deadlines_are_missed_at_both_ends_from_the_first_sample_on() {
    for pair in Pair::all() {
        let timed = Qos::default().with_deadline(20 * MILLI);
        let (publisher, subscription) = pair.matched(timed, timed);
        let ends = [
            (&pair.here, of_publisher(&publisher, EventKind::OfferedDeadlineMissed)),
            (&pair.there, of_subscription(&subscription, EventKind::RequestedDeadlineMissed)),
        ];
        std::thread::sleep(Duration::from_millis(100));
        assert!(ends.iter().all(|(_, end)| !end.is_ready()), "nothing was published yet");
        publisher.publish(b"x").unwrap();
        for (session, end) in &ends {
            await_event(session, end);
            let first = counted(end);
            assert!(first.total >= 1 && first.change == first.total);
            await_event(session, end);
            let second = counted(end);
            assert!(second.total > first.total, "one for every period");
            assert_eq!(second.change, second.total - first.total);
        }
        // Without a publisher, no deadline is missed.
        drop(publisher);
        until("it is gone", || subscription.matched().is_empty());
    }
}

#[test]
fn a_lease_that_is_not_asserted_runs_out_and_comes_back() {
    for pair in Pair::all() {
        let (liveliness, lease) = (Liveliness::ManualByTopic, Some(50 * MILLI));
        let manual = Qos::default().with_liveliness(liveliness, lease);
        // A subscription that requests no lease is told as well.
        let (publisher, subscription) = pair.matched(manual, Qos::default());
        let changed = of_subscription(&subscription, EventKind::LivelinessChanged);
        let lost = of_publisher(&publisher, EventKind::LivelinessLost);
        await_event(&pair.here, &lost);
        assert_eq!(counted(&lost), CountStatus::new(1, 1));
        until("it counts as not alive", || {
            await_event(&pair.there, &changed);
            let status = liveliness_of(&changed);
            (status.alive, status.not_alive) == (0, 1)
        });
        for assert in [(|p| p.assert_liveliness().unwrap()) as fn(&Publisher), |p| {
            p.publish(b"x").unwrap();
        }] {
            until("it is alive again", || {
                assert(&publisher);
                let events = [Waitable::Event(&changed)];
                let ready = pair.there.wait_for(&events, Some(Duration::from_millis(20))).unwrap();
                !ready.is_empty() && liveliness_of(&changed).alive == 1
            });
            await_event(&pair.here, &lost);
            counted(&lost);
            until("and runs out again", || {
                await_event(&pair.there, &changed);
                liveliness_of(&changed).not_alive == 1
            });
        }
        drop(publisher);
        until("it is forgotten", || {
            await_event(&pair.there, &changed);
            let status = liveliness_of(&changed);
            (status.alive, status.not_alive) == (0, 0)
        });
    }
}

#[test]
fn a_sample_older_than_its_lifespan_is_not_delivered() {
    let session = alone();
    let mortal = |lifespan| Qos::default().with_lifespan(lifespan);
    let short = session.create_publisher(spec(mortal(Duration::from_nanos(1)))).unwrap();
    let long = session.create_publisher(spec(mortal(3_600_000 * MILLI))).unwrap();
    let immortal = session.create_publisher(spec(Qos::default())).unwrap();
    let subscription = session.create_subscription(spec(Qos::keep_all())).unwrap();
    // The wall clock does not matter; by it one sample is from 1970 and the other from 2262. The samples are in a
    // descriptor, in a block and in a slot.
    for len in [8, 88, 89, 96, 97, 20_000] {
        short.publish_at(from_unix_nanos(i64::MAX), &vec![1; len]).unwrap();
        long.publish_at(from_unix_nanos(1_000_000_000), &vec![2; len]).unwrap();
    }
    immortal.publish_at(from_unix_nanos(1_000_000_000), b"of no lifespan").unwrap();
    let mut bytes = Vec::new();
    let mut taken = Vec::new();
    while let Some(info) = subscription.take(&mut bytes) {
        assert!(
            info.publisher != short.gid() && (info.publisher == immortal.gid() || bytes[0] == 2)
        );
        taken.push(bytes.len());
    }
    taken.sort_unstable();
    assert_eq!(taken, [8, 14, 88, 89, 96, 97, 20_000]);
    assert_eq!((subscription.expired(), subscription.received(), subscription.lost()), (6, 7, 0));
}
