//! Links that are made anew under a new key while samples flow.

use std::{thread, time::Duration};

use axon_shm::PublishError;
use axon_tests::{Sizes, Tally};
use axon_transport::{EndpointSpec, Publisher, qos::Qos};

use super::{
    mode::Kmes,
    pair::{Host, Plan},
    process::{Node, PATIENCE, until},
};

/// Longer than a superseded link is kept for nothing.
const LONG: Duration = Duration::from_secs(6);

/// Renews links with keys of this age in seconds.
fn renew(key_mode: &str, age: &str, publish: impl Fn(&Host) -> Node) -> (u64, Tally) {
    let kmes = Kmes::start();
    let more = [("AXON_QKD_KEY_MODE", key_mode), ("AXON_QKD_SESSION_MAX_AGE", age)];
    let [a, b] = Plan::new([0, 1].map(|host| kmes.settings(host, &more))).start();
    let mut there = b.subscribe(Sizes::Small);
    let mut publisher = publish(&a);
    there.wait_taken(1);
    let (mut renewals, mut since) = (0, b.link().since);
    let before = kmes.keys();
    until("the link is renewed three times", || {
        // Between two links there may be none to be seen.
        let now = b.status().links.first().map_or(since, |link| link.since);
        renewals += u32::from(now != since);
        since = now;
        renewals >= 3
    });
    let after = kmes.keys();
    assert!(after.0 >= before.0 + 3 && after.1 >= before.1 + 3, "{before:?}, {after:?}");
    let now = publisher.published();
    there.wait_taken(now + 100);
    let sent = publisher.stop();
    there.wait_taken(sent);
    until("all that is missing is known to be lost", || {
        let tally = there.tally();
        tally.lost == tally.missing
    });
    let tally = there.tally();
    for node in [publisher, there] {
        node.finish();
    }
    (sent, tally)
}

#[track_caller]
fn nothing_lost(sent: u64, tally: &Tally) {
    assert_eq!(*tally, Tally { taken: sent, first: 1, last: sent, ..Tally::default() });
}

/// Maximum age of keys, in seconds, in tests with floods. A link whose key expires and that has no successor is cut,
/// and its samples are lost without a count. A flood takes so much of a processor that this may happen within a second.
const OF_FLOODS: &str = "3";

/// Checks that samples arrived in order and that missing ones are counted. A superseded link can carry its remaining
/// samples only until its key expires, and a flood may have more.
#[track_caller]
fn in_order_and_counted(sent: u64, tally: &Tally) {
    assert_eq!((tally.repeated, tally.corrupt, tally.first), (0, 0, 1), "{tally:?}");
    assert_eq!(tally.taken + tally.missing, sent, "{tally:?}");
}

fn stream(host: &Host) -> Node {
    host.publish(Sizes::Small, 1, None)
}

fn flood(host: &Host) -> Node {
    host.flood(Sizes::Small, 1)
}

#[test]
fn in_session_nothing_is_lost() {
    let (sent, tally) = renew("session", "1", stream);
    nothing_lost(sent, &tally);
}

#[test]
fn in_session_a_flood_stays_in_order() {
    let (sent, tally) = renew("session", OF_FLOODS, flood);
    in_order_and_counted(sent, &tally);
}

#[test]
fn in_messages10_nothing_is_lost() {
    let (sent, tally) = renew("messages10", "1", stream);
    nothing_lost(sent, &tally);
}

/// The keys and the connection change in the middle of data that is written together.
#[test]
fn in_messages10_a_flood_stays_in_order() {
    let (sent, tally) = renew("messages10", OF_FLOODS, flood);
    in_order_and_counted(sent, &tally);
}

/// Publishes until nothing more fits anywhere on the way; how many samples.
fn fill(publisher: &Publisher) -> u64 {
    let (mut sent, mut refused) = (0, 0);
    while refused < 5 {
        match publisher.publish(&[0x5a; 50_000]) {
            Ok(sequence) => (sent, refused) = (sequence, 0),
            Err(PublishError::Blocked { .. }) => refused += 1,
            Err(error) => panic!("{error}"),
        }
    }
    sent
}

/// Starts hosts that keep little, with keys of `max_age` seconds.
fn little_room(key_mode: &str, max_age: &str) -> (Kmes, [Host; 2]) {
    let kmes = Kmes::start();
    let more = [
        ("AXON_QKD_KEY_MODE", key_mode),
        ("AXON_QKD_SESSION_MAX_AGE", max_age),
        ("AXON_RING_BUFFER_SIZE_MB", "1"),
        ("AXON_MAX_MESSAGE_MB", "1"),
    ];
    let hosts = Plan::new([0, 1].map(|host| kmes.settings(host, &more))).start();
    (kmes, hosts)
}

/// A reader that takes nothing while the link is renewed, and for a while after that.
fn what_waits_is_not_lost(key_mode: &str) {
    let (_kmes, [a, b]) = little_room(key_mode, "20");
    let (here, there) = (a.session("publisher"), b.session("subscription"));
    let spec = || EndpointSpec::new("/kept", "test/Bytes", Qos::keep_all());
    let subscription = there.create_subscription(spec()).unwrap();
    let publisher = here.create_publisher(spec()).unwrap();
    assert!(publisher.wait_matched(1, PATIENCE) && subscription.wait_matched(1, PATIENCE));
    let since = b.link().since;
    let sent = fill(&publisher);
    until("the link is renewed", || {
        b.status().links.first().is_some_and(|link| link.since != since)
    });
    thread::sleep(LONG);
    let mut bytes = Vec::new();
    for number in 1..=sent {
        let info = subscription.recv(&mut bytes, Some(PATIENCE)).expect("what was sent");
        assert_eq!((info.sequence, bytes.len()), (number, 50_000), "of {sent}");
    }
    // The successor carries the next sample.
    let next = publisher.publish(b"next").unwrap();
    assert_eq!(subscription.recv(&mut bytes, Some(PATIENCE)).unwrap().sequence, next);
    assert_eq!(subscription.lost(), 0);
}

/// Samples that a link still carries when its key expires are counted, and no peer is blamed for them.
#[test]
fn in_messages10_samples_older_than_their_key_cause_no_envelope_refusal() {
    let (_kmes, [a, b]) = little_room("messages10", "4");
    let (here, there) = (a.session("publisher"), b.session("subscription"));
    let spec = || EndpointSpec::new("/kept", "test/Bytes", Qos::keep_all());
    let subscription = there.create_subscription(spec()).unwrap();
    let publisher = here.create_publisher(spec()).unwrap();
    assert!(publisher.wait_matched(1, PATIENCE) && subscription.wait_matched(1, PATIENCE));
    fill(&publisher);
    until("the samples dropped with the old link are counted", || {
        let links = b.status().links;
        links.iter().any(|link| link.dropped.get("no_link").is_some_and(|lost| *lost > 0))
    });
    let refusals = b.status().refusals;
    assert!(refusals.iter().all(|refusal| refusal.what != "ENVELOPE_REFUSED"), "{refusals:?}");
}

#[test]
fn in_session_samples_waiting_for_their_reader_are_not_lost() {
    what_waits_is_not_lost("session");
}

#[test]
fn in_messages10_samples_waiting_for_their_reader_are_not_lost() {
    what_waits_is_not_lost("messages10");
}
