//! What endpoints report of themselves: the eleven events, by status and by callback.

#[path = "support/alone.rs"]
mod alone;

use std::{
    collections::BTreeMap,
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
    },
    time::Duration,
};

use alone::alone;
use axon_transport::{
    events::{Counted, EventKind, EventStatus, LivelinessChanged, Matched},
    graph::{Pairing, pairing},
    ids::Gid,
    qos::{Durability, Incompatible, Liveliness, Qos, Reliability},
    session::{EndpointSpec, Event, OnNew, Publisher, Session, Subscription, Waitable},
};
use proptest::prelude::*;

const PATIENCE: Duration = Duration::from_secs(60);
const MILLI: u64 = 1_000_000;

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

fn counted(event: &Event) -> Counted {
    let EventStatus::Counted(status) = event.take() else { panic!("{event:?}") };
    status
}

fn liveliness(event: &Event) -> LivelinessChanged {
    let EventStatus::LivelinessChanged(status) = event.take() else { panic!("{event:?}") };
    status
}

fn counter() -> (OnNew, Arc<AtomicU64>) {
    let count = Arc::new(AtomicU64::new(0));
    let told = count.clone();
    let tell = move |new| {
        told.fetch_add(new, Ordering::SeqCst);
    };
    (Arc::new(tell), count)
}

#[track_caller]
fn until(what: &str, mut reached: impl FnMut() -> bool) {
    let deadline = std::time::Instant::now() + PATIENCE;
    while !reached() {
        assert!(std::time::Instant::now() < deadline, "in vain: {what}");
        std::thread::sleep(Duration::from_millis(2));
    }
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
fn matches_are_counted_at_both_ends_with_what_changed() {
    let session = alone();
    let publisher = session.create_publisher(spec(Qos::default())).unwrap();
    let publication = of_publisher(&publisher, EventKind::PublicationMatched);
    assert_eq!(matched(&publication), Matched::default());
    let first = session.create_subscription(spec(Qos::default())).unwrap();
    let subscribed = of_subscription(&first, EventKind::SubscriptionMatched);
    let one = Matched { total: 1, total_change: 1, current: 1, current_change: 1 };
    assert_eq!(matched(&publication), one, "created means matched");
    assert_eq!(matched(&subscribed), one);
    let second = session.create_subscription(spec(Qos::default())).unwrap();
    drop(first);
    until("one is gone", || publisher.matched() == [second.gid()]);
    await_event(&session, &publication);
    until("it is told", || publication.is_ready());
    let now = matched(&publication);
    assert_eq!((now.total, now.total_change, now.current), (2, 1, 1));
    drop(publisher);
    let subscribed = of_subscription(&second, EventKind::SubscriptionMatched);
    until("the other end hears of it", || second.matched().is_empty());
    until(
        "and counts it",
        || matches!(subscribed.take(), EventStatus::Matched(m) if m.current == 0 && m.total == 1),
    );
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

#[test]
fn incompatible_profiles_are_reported_at_both_ends_with_the_policy() {
    let session = alone();
    let publisher = session.create_publisher(spec(Qos::sensor_data())).unwrap();
    let latched = Qos { durability: Durability::TransientLocal, ..Qos::sensor_data() };
    for (number, (qos, policy)) in
        [(Qos::default(), Incompatible::Reliability), (latched, Incompatible::Durability)]
            .into_iter()
            .enumerate()
    {
        let subscription = session.create_subscription(spec(qos)).unwrap();
        let ends = [
            of_publisher(&publisher, EventKind::OfferedQosIncompatible),
            of_subscription(&subscription, EventKind::RequestedQosIncompatible),
        ];
        for (end, total) in ends.iter().zip([number as u64 + 1, 1]) {
            await_event(&session, end);
            let EventStatus::IncompatibleQos(status) = end.take() else { panic!("{end:?}") };
            assert_eq!(status.count, Counted { total, change: 1 });
            assert_eq!(status.last_policy, Some(policy));
        }
        assert!(subscription.matched().is_empty());
    }
}

#[test]
fn another_type_under_the_same_name_is_reported_at_both_ends() {
    let session = alone();
    let hashed = |hash: &[u8]| EndpointSpec { type_hash: hash.into(), ..spec(Qos::default()) };
    let publisher = session.create_publisher(hashed(&[1; 32])).unwrap();
    let named = EndpointSpec::new("/t", "U", Qos::default());
    for (total, spec) in [(1, hashed(&[2; 32])), (2, named)] {
        let subscription = session.create_subscription(spec).unwrap();
        let offered = of_publisher(&publisher, EventKind::PublisherIncompatibleType);
        let requested = of_subscription(&subscription, EventKind::SubscriptionIncompatibleType);
        await_event(&session, &offered);
        await_event(&session, &requested);
        assert_eq!(counted(&offered), Counted { total, change: 1 });
        assert_eq!(counted(&requested), Counted { total: 1, change: 1 });
        assert!(publisher.matched().is_empty());
    }
    let unknown = session.create_subscription(spec(Qos::default())).unwrap();
    assert_eq!(publisher.matched(), [unknown.gid()], "who knows no hash takes any");
}

#[test]
fn every_lost_sample_is_counted_whether_or_not_somebody_takes() {
    let session = alone();
    let publisher = session.create_publisher(spec(Qos::sensor_data())).unwrap();
    let all = Qos { reliability: Reliability::BestEffort, ..Qos::keep_all() };
    let subscription = session.create_subscription(spec(all)).unwrap();
    let lost = of_subscription(&subscription, EventKind::MessageLost);
    assert!(!lost.is_ready());
    let published = 40_000;
    for _ in 0..published {
        publisher.publish(b"x").unwrap();
    }
    await_event(&session, &lost);
    let mut bytes = Vec::new();
    let mut taken = 0;
    while subscription.take(&mut bytes).is_some() {
        taken += 1;
    }
    let status = counted(&lost);
    assert_eq!(status.total, subscription.lost());
    assert_eq!(taken + status.total, published);
}

#[test]
fn deadlines_are_missed_at_both_ends_from_the_first_sample_on() {
    let session = alone();
    let timed = Qos { deadline: Some(20 * MILLI), ..Qos::default() };
    let publisher = session.create_publisher(spec(timed)).unwrap();
    let subscription = session.create_subscription(spec(timed)).unwrap();
    let ends = [
        of_publisher(&publisher, EventKind::OfferedDeadlineMissed),
        of_subscription(&subscription, EventKind::RequestedDeadlineMissed),
    ];
    std::thread::sleep(Duration::from_millis(100));
    assert!(ends.iter().all(|end| !end.is_ready()), "nothing was published yet");
    publisher.publish(b"x").unwrap();
    for end in &ends {
        await_event(&session, end);
        let first = counted(end);
        assert!(first.total >= 1 && first.change == first.total);
        await_event(&session, end);
        assert!(counted(end).total > first.total, "one for every period");
    }
    // Without a publisher nobody is late.
    drop(publisher);
    until("it is gone", || subscription.matched().is_empty());
}

#[test]
fn a_lease_that_is_not_asserted_runs_out_and_comes_back() {
    let session = alone();
    let manual =
        Qos { liveliness: Liveliness::ManualByTopic, lease: Some(50 * MILLI), ..Qos::default() };
    let publisher = session.create_publisher(spec(manual)).unwrap();
    // One that asks for no lease is told all the same.
    let subscription = session.create_subscription(spec(Qos::default())).unwrap();
    let changed = of_subscription(&subscription, EventKind::LivelinessChanged);
    let lost = of_publisher(&publisher, EventKind::LivelinessLost);
    await_event(&session, &lost);
    assert_eq!(counted(&lost), Counted { total: 1, change: 1 });
    until("it counts as not alive", || {
        await_event(&session, &changed);
        let status = liveliness(&changed);
        (status.alive, status.not_alive) == (0, 1)
    });
    for assert in [(|p| p.assert_liveliness().unwrap()) as fn(&Publisher), |p| {
        p.publish(b"x").unwrap();
    }] {
        until("it is alive again", || {
            assert(&publisher);
            let ready = session
                .wait_for(&[Waitable::Event(&changed)], Some(Duration::from_millis(20)))
                .unwrap();
            !ready.is_empty() && liveliness(&changed).alive == 1
        });
        await_event(&session, &lost);
        counted(&lost);
        until("and runs out again", || {
            await_event(&session, &changed);
            liveliness(&changed).not_alive == 1
        });
    }
    drop(publisher);
    until("it is forgotten", || {
        await_event(&session, &changed);
        let status = liveliness(&changed);
        (status.alive, status.not_alive) == (0, 0)
    });
}

#[test]
fn a_sample_older_than_its_lifespan_is_not_delivered() {
    let session = alone();
    let mortal = Qos { lifespan: Some(3_600_000 * MILLI), ..Qos::default() };
    let publisher = session.create_publisher(spec(mortal)).unwrap();
    let subscription = session.create_subscription(spec(Qos::default())).unwrap();
    // Published by a clock that is two hours late.
    publisher.publish_at(1_000_000_000, b"old").unwrap();
    publisher.publish(b"new").unwrap();
    let mut bytes = Vec::new();
    assert_eq!(subscription.take(&mut bytes).unwrap().sequence, 2);
    assert_eq!((subscription.expired(), subscription.received(), subscription.lost()), (1, 1, 0));
    let immortal = session.create_publisher(spec(Qos::default())).unwrap();
    immortal.publish_at(1_000_000_000, b"old").unwrap();
    assert!(subscription.take(&mut bytes).is_some(), "only whose publisher says so");
}

#[derive(Clone, Debug)]
enum Step {
    Publisher(Profile),
    Subscription(Profile),
    /// Ends the one that this number comes to.
    End(u8),
}

#[derive(Clone, Debug)]
struct Profile {
    qos: Qos,
    type_name: &'static str,
    hash: u8,
}

fn profile() -> impl Strategy<Value = Profile> {
    let period = || prop_oneof![Just(None), Just(Some(3_600_000 * MILLI)), Just(Some(MILLI << 40))];
    (any::<[bool; 3]>(), period(), period(), 0..3u8, 0..2u8).prop_map(
        |([reliable, latched, manual], deadline, lease, type_name, hash)| Profile {
            qos: Qos {
                reliability: if reliable { Reliability::Reliable } else { Reliability::BestEffort },
                durability: if latched { Durability::TransientLocal } else { Durability::Volatile },
                liveliness: if manual { Liveliness::ManualByTopic } else { Liveliness::Automatic },
                deadline,
                lease,
                ..Qos::default()
            },
            type_name: ["T", "T", "U"][usize::from(type_name)],
            hash,
        },
    )
}

fn step() -> impl Strategy<Value = Step> {
    prop_oneof![
        profile().prop_map(Step::Publisher),
        profile().prop_map(Step::Subscription),
        any::<u8>().prop_map(Step::End),
    ]
}

enum Living {
    Publisher(Publisher),
    Subscription(Subscription),
}

/// What one endpoint must report.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
struct Expected {
    matched: Vec<Gid>,
    ever: u64,
    qos: u64,
    types: u64,
}

impl Living {
    fn gid(&self) -> Gid {
        match self {
            Self::Publisher(publisher) => publisher.gid(),
            Self::Subscription(subscription) => subscription.gid(),
        }
    }

    fn relation(&self, other: &Self) -> Pairing {
        match (self, other) {
            (Self::Publisher(w), Self::Subscription(r))
            | (Self::Subscription(r), Self::Publisher(w)) => pairing(w.endpoint(), r.endpoint()),
            _ => Pairing::Unrelated,
        }
    }

    /// `None` where it changes meanwhile.
    fn reported(&self) -> Option<Expected> {
        let (mut matched, events) = match self {
            Self::Publisher(p) => (
                p.matched(),
                [
                    EventKind::PublicationMatched,
                    EventKind::OfferedQosIncompatible,
                    EventKind::PublisherIncompatibleType,
                ]
                .map(|kind| of_publisher(p, kind)),
            ),
            Self::Subscription(s) => (
                s.matched(),
                [
                    EventKind::SubscriptionMatched,
                    EventKind::RequestedQosIncompatible,
                    EventKind::SubscriptionIncompatibleType,
                ]
                .map(|kind| of_subscription(s, kind)),
            ),
        };
        matched.sort();
        let [all, qos, types] = events;
        let all = self::matched(&all);
        let EventStatus::IncompatibleQos(qos) = qos.take() else { panic!() };
        let (ever, qos, types) = (all.total, qos.count.total, counted(&types).total);
        (all.current == matched.len() as u64).then_some(Expected { matched, ever, qos, types })
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 24, ..ProptestConfig::default() })]

    /// A random program against the rule itself.
    #[test]
    fn whatever_comes_and_goes_the_statuses_say_so(
        steps in prop::collection::vec(step(), 1..24),
    ) {
        let session = alone();
        let mut living: Vec<Living> = Vec::new();
        let mut model: BTreeMap<Gid, Expected> = BTreeMap::new();
        for step in steps {
            let spec = |p: &Profile| EndpointSpec {
                type_hash: vec![p.hash; usize::from(p.hash)],
                ..EndpointSpec::new("/t", p.type_name, p.qos)
            };
            let new = match &step {
                Step::Publisher(p) => Living::Publisher(session.create_publisher(spec(p)).unwrap()),
                Step::Subscription(p) => {
                    Living::Subscription(session.create_subscription(spec(p)).unwrap())
                }
                Step::End(_) if living.is_empty() => continue,
                Step::End(which) => {
                    let ended = living.swap_remove(usize::from(*which) % living.len()).gid();
                    model.remove(&ended);
                    model.values_mut().for_each(|e| e.matched.retain(|gid| *gid != ended));
                    until("the statuses are as they must be", || {
                        living.iter().all(|l| l.reported().as_ref() == model.get(&l.gid()))
                    });
                    continue;
                }
            };
            let mut expected = Expected::default();
            for other in &living {
                let theirs = model.get_mut(&other.gid()).unwrap();
                for (side, gid) in [(&mut expected, other.gid()), (theirs, new.gid())] {
                    match new.relation(other) {
                        Pairing::Match => {
                            side.matched.push(gid);
                            side.matched.sort();
                            side.ever += 1;
                        }
                        Pairing::IncompatibleQos(_) => side.qos += 1,
                        Pairing::IncompatibleType => side.types += 1,
                        Pairing::Unrelated => {}
                    }
                }
            }
            model.insert(new.gid(), expected);
            living.push(new);
            until("the statuses are as they must be", || {
                living.iter().all(|l| l.reported().as_ref() == model.get(&l.gid()))
            });
        }
    }
}
