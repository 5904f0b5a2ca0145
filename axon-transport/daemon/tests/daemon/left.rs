//! Readers get the samples of a process that ended after the daemon was killed, so that no daemon could pass its memory
//! on.

use std::time::Duration;

use super::*;
use crate::support::of_child;

/// Number of samples that the publisher leaves. Each is longer than the memory that is ready for it.
const SAMPLES: u64 = 24;
const LENGTH: usize = 300_000;

fn sample(number: u64) -> Vec<u8> {
    let mut bytes = vec![number as u8; LENGTH];
    bytes[..8].copy_from_slice(&number.to_le_bytes());
    bytes
}

/// A child: publishes when the test tells it to, and ends.
pub(crate) fn publisher() {
    let session = of_child("publisher");
    let publisher = session.create_publisher(spec("/left")).unwrap();
    assert!(publisher.wait_matched(1, PATIENCE));
    say("matched");
    wait_for_the_end();
    for number in 1..=SAMPLES {
        while let Err(error) = publisher.publish(&sample(number)) {
            assert!(matches!(error, PublishError::Blocked { .. }), "{error}");
        }
    }
}

/// A child: takes the samples that the publisher left, and reports how many it took and how many count as lost.
pub(crate) fn taker() {
    let session = of_child("taker");
    let subscription = session.create_subscription(spec("/left")).unwrap();
    assert!(subscription.wait_matched(1, PATIENCE));
    say("matched");
    let (mut bytes, mut came) = (Vec::new(), 0);
    let patience = std::time::Instant::now() + PATIENCE;
    while came + subscription.lost() < SAMPLES && std::time::Instant::now() < patience {
        let Ok(info) = subscription.recv(&mut bytes, Some(Duration::from_secs(1))) else {
            continue;
        };
        assert!(bytes == sample(info.sequence), "sample {} is whole", info.sequence);
        came += 1;
    }
    say(format!("{came} came, {} lost", subscription.lost()));
    wait_for_the_end();
}

/// Kills the daemon of a publisher and its reader. Then the publisher publishes and ends.
fn daemon_killed(reader_stops: bool) {
    let host = Host::new();
    let (mut publisher, mut taker) = (host.play("leaves samples"), host.play("takes samples"));
    assert_eq!((publisher.hear(), taker.hear()), ("matched".into(), "matched".into()));
    let daemon = host.status().unwrap().pid;
    if reader_stops {
        signal(taker.pid(), Signal::STOP);
    }
    signal(daemon, Signal::KILL);
    publisher.finish();
    if reader_stops {
        std::thread::sleep(Duration::from_secs(2));
        signal(taker.pid(), Signal::CONT);
    }
    assert_eq!(taker.hear(), format!("{SAMPLES} came, 0 lost"));
    taker.finish();
}

/// A child: answers a call when the test tells it to, and ends.
pub(crate) fn server() {
    let session = of_child("server");
    let server = session.create_server(spec("/left")).unwrap();
    let request = server.recv_request(&mut Vec::new(), Some(PATIENCE)).unwrap();
    say("called");
    wait_for_the_end();
    server.send_response(request.publisher, request.sequence, &sample(1)).unwrap();
}

#[test]
fn response_sent_between_the_kill_of_the_daemon_and_the_end_of_the_server_arrives() {
    let host = Host::new();
    let mut server = host.play("leaves a response");
    let session = Session::open(&host.config(), SessionOptions::new("client")).unwrap();
    let client = session.create_client(spec("/left")).unwrap();
    assert!(client.wait_available(PATIENCE));
    client.send_request(b"question").unwrap();
    assert_eq!(server.hear(), "called");
    signal(host.status().unwrap().pid, Signal::KILL);
    server.finish();
    let mut response = Vec::new();
    client.recv_response(&mut response, Some(PATIENCE)).expect("the response in time");
    assert!(response == sample(1));
}

#[test]
fn a_reader_gets_samples_an_ended_publisher_published_without_a_daemon() {
    daemon_killed(false);
}

#[test]
fn a_stopped_reader_gets_samples_published_after_the_daemon_was_killed() {
    daemon_killed(true);
}
