//! Each of the eleven events calls its callback: at once for occurrences that were not reported, then for each
//! occurrence, and no more once it is unset.

use std::{
    any::Any,
    sync::{Arc, Mutex},
    thread::{self, ThreadId},
};

use axon_transport::{
    EndpointSpec, Event, NewDataCallback, Session,
    events::{EventKind, EventStatus},
    ids::Gid,
    qos::{Liveliness, Qos},
};

use super::{
    MILLI, await_event, flood, less, lossy,
    pair::Pair,
    spec,
    support::{PATIENCE, until},
};

/// Makes an event occur once, through the returned endpoint. If it returns `None`, the event occurs at least once soon.
type Cause<'a> = Box<dyn FnMut() -> Option<Gid> + 'a>;

/// An event, and the code that makes it occur.
struct Scene<'a> {
    event: Event,
    session: &'a Session,
    cause: Cause<'a>,
    /// The endpoints of the event.
    _cast: Box<dyn Any>,
}

fn scene(kind: EventKind, pair: &Pair) -> Scene<'_> {
    let (here, there) = (&pair.here, &pair.there);
    let (offered, requested) = (less()[0].1, less()[0].2);
    // Endpoints of earlier scenes may not be gone everywhere yet, so each scene has its own topic.
    let spec = |qos| spec(qos).topic(format!("/{kind:?}"));
    let other = |qos| spec(qos).type_name("U");
    let plain = Qos::default;
    // Publishers and subscriptions are created one after another and stay. Within a session, the new endpoint is the
    // last to be told.
    let publishers = |spec: EndpointSpec, theirs: EventKind| {
        let mut all = Vec::new();
        move || {
            let new = here.create_publisher(spec.clone()).unwrap();
            await_event(here, &new.event(theirs).unwrap());
            let gid = new.gid();
            all.push(new);
            Some(gid)
        }
    };
    let subscriptions = |spec: EndpointSpec, theirs: EventKind| {
        let mut all = Vec::new();
        move || {
            let new = there.create_subscription(spec.clone()).unwrap();
            await_event(there, &new.event(theirs).unwrap());
            let gid = new.gid();
            all.push(new);
            Some(gid)
        }
    };
    if kind.is_publishers() {
        let timed = plain().with_deadline(50 * MILLI);
        let manual = Liveliness::ManualByTopic;
        let own = match kind {
            EventKind::OfferedQosIncompatible => offered,
            EventKind::OfferedDeadlineMissed => timed,
            EventKind::LivelinessLost => plain().with_liveliness(manual, 50 * MILLI),
            _ => plain(),
        };
        let publisher = Arc::new(here.create_publisher(spec(own)).unwrap());
        let own = publisher.clone();
        let cause: Cause<'_> = match kind {
            EventKind::PublicationMatched => {
                Box::new(subscriptions(spec(plain()), EventKind::SubscriptionMatched))
            }
            EventKind::OfferedQosIncompatible => {
                Box::new(subscriptions(spec(requested), EventKind::RequestedQosIncompatible))
            }
            EventKind::PublisherIncompatibleType => {
                let theirs = EventKind::SubscriptionIncompatibleType;
                Box::new(subscriptions(other(plain()), theirs))
            }
            EventKind::OfferedDeadlineMissed => Box::new(move || {
                own.publish(b"and no more").unwrap();
                None
            }),
            EventKind::LivelinessLost => Box::new(move || {
                own.assert_liveliness().unwrap();
                None
            }),
            _ => unreachable!("{kind:?}"),
        };
        let event = publisher.event(kind).unwrap();
        return Scene { event, session: here, cause, _cast: Box::new(publisher) };
    }
    let timed = plain().with_deadline(50 * MILLI);
    let (_cast, event, cause): (Box<dyn Any>, _, Cause<'_>) = match kind {
        EventKind::MessageLost | EventKind::RequestedDeadlineMissed => {
            let qos = if kind == EventKind::MessageLost { lossy() } else { timed };
            let (publisher, subscription) = pair.matched_as(spec(qos), spec(qos));
            let event = subscription.event(kind).unwrap();
            let subscription = Arc::new(subscription);
            let taker = subscription.clone();
            let cause = move || {
                if kind == EventKind::MessageLost {
                    flood(&publisher);
                    // Only a thread that takes or waits detects lost samples.
                    while taker.take(&mut Vec::new()).is_some() {}
                } else {
                    publisher.publish(b"and no more").unwrap();
                }
                None
            };
            (Box::new(subscription), event, Box::new(cause))
        }
        _ => {
            let own = if kind == EventKind::RequestedQosIncompatible { requested } else { plain() };
            let subscription = there.create_subscription(spec(own)).unwrap();
            let event = subscription.event(kind).unwrap();
            let cause: Cause<'_> = match kind {
                EventKind::RequestedQosIncompatible => {
                    Box::new(publishers(spec(offered), EventKind::OfferedQosIncompatible))
                }
                EventKind::SubscriptionIncompatibleType => {
                    Box::new(publishers(other(plain()), EventKind::PublisherIncompatibleType))
                }
                EventKind::SubscriptionMatched | EventKind::LivelinessChanged => {
                    Box::new(publishers(spec(plain()), EventKind::PublicationMatched))
                }
                _ => unreachable!("{kind:?}"),
            };
            (Box::new(subscription), event, cause)
        }
    };
    Scene { event, session: there, cause, _cast }
}

impl Scene<'_> {
    /// Makes the event occur, and waits until it has.
    fn occur(&mut self) {
        match (self.cause)() {
            // When the graph shows an endpoint of another session, its effect on this session's endpoint has been
            // counted.
            Some(gid) => {
                let shown = self.session.wait_graph(PATIENCE, |g| g.endpoints.contains_key(&gid));
                assert!(shown);
            }
            None => await_event(self.session, &self.event),
        }
    }
}

/// The calls of a callback in order: the thread and the number of new occurrences.
type Calls = Arc<Mutex<Vec<(ThreadId, u64)>>>;

fn recorder() -> (NewDataCallback, Calls) {
    let calls = Calls::default();
    let told = calls.clone();
    (Arc::new(move |new| told.lock().unwrap().push((thread::current().id(), new))), calls)
}

fn told(calls: &Calls) -> Vec<u64> {
    calls.lock().unwrap().iter().map(|(_, new)| *new).collect()
}

/// Returns the total number of occurrences, for events that count them.
fn total(event: &Event) -> Option<u64> {
    match event.take() {
        EventStatus::Counted(status) => Some(status.total),
        EventStatus::IncompatibleQos(status) => Some(status.count.total),
        EventStatus::Matched(status) => Some(status.total),
        EventStatus::LivelinessChanged(status) => Some(status.alive),
    }
}

#[test]
fn each_of_the_eleven_tells_its_callback() {
    for pair in Pair::all() {
        for kind in EventKind::ALL {
            eprintln!("{kind:?}");
            let mut scene = scene(kind, &pair);
            let timed = matches!(
                kind,
                EventKind::RequestedDeadlineMissed
                    | EventKind::OfferedDeadlineMissed
                    | EventKind::LivelinessLost
            );
            if timed || kind == EventKind::MessageLost {
                each_is_told_in_all(&mut scene);
            } else {
                each_is_told_once(&mut scene);
            }
        }
    }
}

/// Checks an event that occurs once for each cause.
fn each_is_told_once(scene: &mut Scene<'_>) {
    scene.occur();
    scene.occur();
    let (callback, calls) = recorder();
    scene.event.set_callback(Some(callback));
    let me = thread::current().id();
    assert_eq!(calls.lock().unwrap()[..], [(me, 2)], "the backlog, at once");
    scene.occur();
    until("it is told", || told(&calls).len() > 1);
    scene.occur();
    until("it is told again", || told(&calls).len() > 2);
    assert_eq!(told(&calls), [2, 1, 1]);
    scene.event.set_callback(None);
    scene.occur();
    assert_eq!(told(&calls), [2, 1, 1], "nobody listens");
    let (callback, later) = recorder();
    scene.event.set_callback(Some(callback));
    assert_eq!(told(&later), [1], "what nobody was told of");
    scene.event.set_callback(None);
    scene.occur();
    assert_eq!(total(&scene.event), Some(6));
    let (callback, last) = recorder();
    scene.event.set_callback(Some(callback));
    assert!(told(&last).is_empty(), "it has been looked at");
    assert_eq!(told(&calls), [2, 1, 1]);
}

/// Checks an event that occurs at its own times, or several times at once.
fn each_is_told_in_all(scene: &mut Scene<'_>) {
    scene.occur();
    let (callback, calls) = recorder();
    scene.event.set_callback(Some(callback));
    let me = thread::current().id();
    assert_eq!(calls.lock().unwrap()[0].0, me, "the backlog, at once");
    let before = told(&calls).len();
    scene.occur();
    until("it is told", || told(&calls).len() > before);
    // Periods go on. In the end, the callback has been told of everything that was counted.
    until("it is told of all", || {
        let counted = total(&scene.event);
        counted == Some(told(&calls).iter().sum())
    });
    scene.event.set_callback(None);
    let before = told(&calls);
    total(&scene.event);
    scene.occur();
    await_event(scene.session, &scene.event);
    assert_eq!(told(&calls), before, "nobody listens");
    assert!(total(&scene.event) > Some(before.iter().sum()));
}
