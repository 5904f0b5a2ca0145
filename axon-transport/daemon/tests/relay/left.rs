//! The samples that a process leaves when it ends: readers take them, or the daemon counts and reports them.

use std::fs;

use axon_transport::internal::session::relayed::flow::OVERHEAD;

use super::{hostile::*, *};

/// Length of each sample in bytes.
const LENGTH: usize = 1000;

/// Publishes by hand, within the credit, until the reader's ring is full. Returns the number of samples that were sent
/// whole. A part of one more follows.
fn send_until_held_back(host: &Host, socket: &OwnedFd, mut credit: u64) -> u64 {
    let cost = LENGTH as u64 + OVERHEAD;
    let mut sent = 0;
    let written = || relays(&host.status().unwrap())[0].samples_in;
    let mut before = 0;
    loop {
        while credit >= 2 * cost {
            sent += 1;
            say_to(socket, &fragment(sent, LENGTH));
            credit -= cost;
        }
        // Everything that was sent before has reached the daemon when it shows its status a second time.
        let now = written();
        let is_held_back = now > 0 && now < sent && std::mem::replace(&mut before, now) == now;
        let more = credits(socket);
        credit += more;
        if is_held_back && more == 0 {
            say_to(socket, &fragment(sent + 1, LENGTH / 2));
            return sent;
        }
        thread::sleep(Duration::from_millis(10));
    }
}

/// Returns the message with the first `bytes` bytes of the sample of this number.
fn fragment(sequence: u64, bytes: usize) -> SessionMessage {
    after_loss(sequence, bytes, 0)
}

/// Like [`fragment`], for a publisher that lost `lost` samples before it.
fn after_loss(sequence: u64, bytes: usize, lost: u64) -> SessionMessage {
    let (length, source_timestamp, published) = (LENGTH as u32, 0, 0);
    let head = Some(SampleHeader { length, sequence, source_timestamp, lost, published });
    let bytes = pattern(sequence, bytes);
    SessionMessage::SampleFragment(SampleFragment { publisher: own(), head, bytes, client: None })
}

/// Returns the bytes of the credit that has arrived.
fn credits(socket: &OwnedFd) -> u64 {
    let mut bytes = 0;
    while let Ok(received) = socket::receive(socket, &mut Vec::new()) {
        if let SessionMessage::Credit(credit) = received.message {
            bytes += credit.bytes;
        }
    }
    bytes
}

/// Returns the samples of "/t" that the status counts as lost with this cause.
pub(super) fn dropped(host: &Host, cause: &str) -> u64 {
    let topics = host.status().unwrap().topics;
    topics.iter().filter(|t| t.topic == "/t").filter_map(|t| t.dropped.get(cause)).sum()
}

#[test]
fn undelivered_samples_of_an_ended_process_are_counted_by_topic() {
    let host = host();
    let _daemon = host.daemon();
    let listener = session(&host, "listener", true);
    let subscription = listener.create_subscription(spec("/t", Qos::keep_all())).unwrap();
    let socket = by_hand(&host, hello(&host));
    let credit = announce_and_await_credit(&socket);
    until("it is received from", || subscription.matched() == [own()]);
    let sent = send_until_held_back(&host, &socket, credit);
    drop(socket);
    until("nobody is relayed any more", || relays(&host.status().unwrap()).is_empty());
    let mut bytes = Vec::new();
    let taken = std::iter::from_fn(|| Some(subscription.take(&mut bytes)?.sequence));
    let taken: Vec<u64> = taken.collect();
    assert!(taken.iter().copied().eq(1..=taken.len() as u64), "{taken:?}");
    // The partial sample is lost as well.
    assert_eq!(taken.len() as u64 + dropped(&host, "publisher_ended"), sent + 1);
    let log = fs::read_to_string(host.log()).unwrap();
    let told = |line: &str| line.contains("discarded samples") && line.contains("topic=\"/t\"");
    assert!(log.lines().any(told), "the log does not name the topic:\n{log}");
}

#[test]
fn samples_lost_at_the_start_and_the_end_are_counted_by_topic() {
    let host = host();
    let _daemon = host.daemon();
    let listener = session(&host, "listener", true);
    let subscription = listener.create_subscription(spec("/t", Qos::keep_all())).unwrap();
    let socket = by_hand(&host, hello(&host));
    announce_and_await_credit(&socket);
    until("it is received from", || subscription.matched() == [own()]);
    say_to(&socket, &after_loss(8, LENGTH, 7));
    say_to(&socket, &after_loss(12, LENGTH, 3));
    let mut bytes = Vec::new();
    for number in [8, 12] {
        let sample = subscription.recv(&mut bytes, Some(PATIENCE)).expect("a sample");
        assert_eq!(sample.sequence, number);
    }
    // The subscription knows the losses between two samples. Only the status knows the losses before the first.
    assert_eq!(subscription.lost(), 3);
    until("the topic's count", || dropped(&host, "queue") == 10);
    // A part of one more sample, and the end of the process.
    say_to(&socket, &after_loss(13, LENGTH / 2, 0));
    drop(socket);
    until("nobody is relayed any more", || relays(&host.status().unwrap()).is_empty());
    assert_eq!((dropped(&host, "queue"), dropped(&host, "publisher_ended")), (10, 1));
    assert_eq!(subscription.lost(), 3);
}

#[test]
fn losses_that_cannot_be_are_not_counted() {
    let host = host();
    let _daemon = host.daemon();
    let listener = session(&host, "listener", true);
    let subscription = listener.create_subscription(spec("/t", Qos::keep_all())).unwrap();
    let socket = by_hand(&host, hello(&host));
    announce_and_await_credit(&socket);
    until("it is received from", || subscription.matched() == [own()]);
    say_to(&socket, &after_loss(8, LENGTH, u64::MAX));
    say_to(&socket, &after_loss(12, LENGTH, u64::MAX));
    // The number is impossible, too: this sample is refused.
    say_to(&socket, &after_loss(1 << 63, LENGTH, u64::MAX));
    say_to(&socket, &after_loss(13, LENGTH, u64::MAX));
    let mut bytes = Vec::new();
    for number in [8, 12, 13] {
        let sample = subscription.recv(&mut bytes, Some(PATIENCE)).expect("a sample");
        assert_eq!(sample.sequence, number);
    }
    until("the refused sample's count", || dropped(&host, "ring") == 1);
    // At most as many as numbers are missing.
    assert_eq!(dropped(&host, "queue"), 10);
    assert_eq!(relays(&host.status().unwrap())[0].lost, 11);
    assert_eq!(subscription.lost(), 3);
}
