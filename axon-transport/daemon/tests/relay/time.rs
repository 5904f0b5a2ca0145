//! Deadlines, leases and lifespans if samples pass through the daemon: each is judged in the process of its endpoint.

use axon_transport::internal::session::from_unix_nanos;
use axon_transport::{
    Event, Waitable,
    events::{CountStatus, EventKind, EventStatus, LivelinessChanged},
    qos::Liveliness,
};

use super::*;

const MILLI: Duration = Duration::from_millis(1);

fn await_counted(session: &Session, event: &Event) -> CountStatus {
    let ready = session.wait_for(&[Waitable::Event(event)], Some(PATIENCE)).unwrap();
    assert_eq!(ready, [0], "{event:?}");
    let EventStatus::Counted(counted) = event.take() else { panic!("{event:?}") };
    counted
}

/// Returns how many publishers are alive, and how many are not.
fn alive(event: &Event) -> (u64, u64) {
    let EventStatus::LivelinessChanged(LivelinessChanged { alive, not_alive, .. }) = event.take()
    else {
        panic!("{event:?}")
    };
    (alive, not_alive)
}

#[test]
fn deadlines_are_missed_at_both_ends_of_a_relay() {
    with_both_ends(|from, to| {
        let timed = Qos::default().with_deadline(50 * MILLI);
        let (publisher, subscription) = connect(from, to, "/t", timed);
        let offered = publisher.event(EventKind::OfferedDeadlineMissed).unwrap();
        let requested = subscription.event(EventKind::RequestedDeadlineMissed).unwrap();
        publisher.publish(b"x").unwrap();
        for (session, event) in [(from, &offered), (to, &requested)] {
            let first = await_counted(session, event).total;
            assert!(await_counted(session, event).total > first, "one for every period");
        }
        assert!(subscription.recv(&mut Vec::new(), Some(PATIENCE)).is_ok());
    });
}

#[test]
fn a_lease_runs_out_beyond_a_relay_and_a_sample_renews_it() {
    with_both_ends(|from, to| {
        let manual = Qos::default().with_liveliness(Liveliness::ManualByTopic, 100 * MILLI);
        let (publisher, subscription) = connect(from, to, "/t", manual);
        let changed = subscription.event(EventKind::LivelinessChanged).unwrap();
        until("it counts as not alive", || alive(&changed) == (0, 1));
        until("it is alive again", || {
            publisher.publish(b"x").unwrap();
            alive(&changed) == (1, 0)
        });
        until("it runs out again", || alive(&changed) == (0, 1));
        drop(publisher);
        until("it is forgotten", || alive(&changed) == (0, 0));
    });
}

#[test]
fn asserted_liveliness_without_a_sample_crosses_a_relay() {
    with_both_ends(|from, to| {
        let liveliness = Liveliness::ManualByTopic;
        let manual = Qos::default().with_liveliness(liveliness, 200 * MILLI);
        let (publisher, subscription) = connect(from, to, "/t", manual);
        let changed = subscription.event(EventKind::LivelinessChanged).unwrap();
        until("it counts as not alive", || alive(&changed) == (0, 1));
        until("it is alive again", || {
            publisher.assert_liveliness().unwrap();
            alive(&changed) == (1, 0)
        });
        until("it runs out again", || alive(&changed) == (0, 1));
        assert_eq!(subscription.received(), 0);
    });
}

#[test]
fn a_process_that_is_stopped_is_not_alive_beyond_a_relay() {
    let host = host();
    let _daemon = host.daemon();
    let relaying = relaying(&host);
    for (shares, other_shares) in ENDS {
        let mut automatic = if shares { &host } else { &relaying }.play("alive");
        assert_eq!(automatic.hear(), "there");
        let to = session(&host, "to", other_shares);
        let subscription = to.create_subscription(spec("/t", automatic_lease())).unwrap();
        let changed = subscription.event(EventKind::LivelinessChanged).unwrap();
        assert!(subscription.wait_matched(1, PATIENCE));
        until("it is alive", || alive(&changed) == (1, 0));
        signal(automatic.pid(), Signal::STOP);
        until("it is not alive", || alive(&changed) == (0, 1));
        signal(automatic.pid(), Signal::CONT);
        until("it is alive again", || alive(&changed) == (1, 0));
        automatic.finish();
        until("it is forgotten", || alive(&changed) == (0, 0));
    }
}

/// A lease that a process keeps as long as it runs.
pub(crate) fn automatic_lease() -> Qos {
    Qos::default().with_lease(400 * MILLI)
}

#[test]
fn a_sample_that_outlived_its_lifespan_is_not_delivered_beyond_a_relay() {
    with_both_ends(|from, to| {
        let mortal = |lifespan| Qos::default().with_lifespan(lifespan);
        // The wall clock does not matter; by it this sample is from 1970.
        let (publisher, subscription) = connect(from, to, "/long", mortal(3_600_000 * MILLI));
        publisher.publish_at(from_unix_nanos(1_000_000_000), b"new").unwrap();
        let mut bytes = Vec::new();
        let info = subscription.recv(&mut bytes, Some(PATIENCE)).unwrap();
        assert_eq!((info.sequence, &bytes[..]), (1, &b"new"[..]));
        // The age counts from publication, not from the arrival at the relay: here the sample is taken later.
        let (publisher, subscription) = connect(from, to, "/short", mortal(300 * MILLI));
        publisher.publish_at(from_unix_nanos(i64::MAX), b"old").unwrap();
        thread::sleep(Duration::from_millis(400));
        publisher.publish(b"the last").unwrap();
        until("the last came, or its lifespan was over", || {
            subscription.take(&mut bytes).is_some_and(|info| {
                assert_eq!(info.sequence, 2);
                true
            }) || subscription.expired() == 2
        });
        assert_eq!((subscription.expired() + subscription.received(), subscription.lost()), (2, 0));
    });
}
