//! The daemon's status of topics: publishers and readers, memory, dropped samples and their causes,
//! and readers that lag.

#[allow(dead_code, reason = "what other tests need of it")]
mod support;

use axon_shm::PublishError;
use axon_transport::{
    EndpointSpec,
    qos::{Qos, Reliability},
    status::{ReaderStatus, TopicStatus},
};
use rustix::process::Signal;
use support::{Host, PATIENCE, of_child, say, signal, until, wait_for_the_end};

const IMAGE: usize = 1 << 20;

fn spec(topic: &str, qos: Qos) -> EndpointSpec {
    EndpointSpec::new(topic, "test/Bytes", qos)
}

fn best_effort(depth: u32) -> Qos {
    Qos::default().with_reliability(Reliability::BestEffort).with_depth(depth)
}

/// The code of the other processes; not a test of its own.
#[test]
fn child() {
    let Ok(part) = std::env::var("PLAY") else { return };
    let session = of_child(&part);
    let qos = if part == "keeper" { Qos::keep_all() } else { best_effort(5) };
    let subscription = session.create_subscription(spec("/images", qos)).unwrap();
    assert!(subscription.wait_matched(1, PATIENCE));
    say("matched");
    let mut bytes = Vec::new();
    if part == "keeper" {
        // Takes nothing.
        return wait_for_the_end();
    }
    let end = std::thread::spawn(wait_for_the_end);
    while !end.is_finished() {
        let _ = subscription.recv(&mut bytes, Some(std::time::Duration::from_millis(20)));
    }
}

fn topic(host: &Host) -> TopicStatus {
    let status = host.status().unwrap();
    status.topics.into_iter().find(|t| t.topic == "/images").expect("the topic")
}

fn reader_of(topic: &TopicStatus, pid: u32) -> &ReaderStatus {
    topic.readers.iter().find(|reader| reader.pid == pid).expect("its reader")
}

#[test]
fn status_names_a_stopped_reader_with_its_backlog_and_no_active_reader() {
    let host = Host::new();
    let _daemon = host.daemon();
    let session = host.session("camera").unwrap();
    let publisher = session.create_publisher(spec("/images", best_effort(3))).unwrap();
    let (mut lively, mut stopped) = (host.play("lively"), host.play("stopped"));
    assert_eq!((lively.hear(), stopped.hear()), ("matched".into(), "matched".into()));
    assert!(publisher.wait_matched(2, PATIENCE));
    let (taking, still) = (lively.pid(), stopped.pid());

    publisher.publish(&[0; 8]).unwrap();
    until("both took one", || topic(&host).readers.iter().all(|r| r.received == 1));
    signal(stopped.pid(), Signal::STOP);
    until("it is stopped", || reader_of(&topic(&host), still).stopped);
    publisher.publish(&[0; 8]).unwrap();
    until("it leaves a sample lie", || reader_of(&topic(&host), still).is_stalled());
    let seen = topic(&host);
    assert!(!reader_of(&seen, taking).is_stalled() && !reader_of(&seen, taking).stopped);
    assert_eq!((reader_of(&seen, still).unread, reader_of(&seen, still).depth), (1, Some(5)));
    assert_eq!(seen.dropped.values().sum::<u64>(), 0);

    // More samples than any window holds: samples that it could have taken are overwritten.
    for _ in 0..100 {
        publisher.publish(&[0; 8]).unwrap();
    }
    let seen = topic(&host);
    assert!(reader_of(&seen, still).is_stalled(), "the wait is older than the oldest sample");
    assert_eq!(reader_of(&seen, still).unread, 5);

    signal(stopped.pid(), Signal::CONT);
    until("it took the rest", || {
        let seen = topic(&host);
        let reader = reader_of(&seen, still);
        reader.unread == 0 && !reader.stopped && !reader.is_stalled()
    });
    let seen = topic(&host);
    let reader = reader_of(&seen, still);
    assert_eq!(reader.received + reader.lost + reader.skipped, 102);
}

#[test]
fn memory_and_failed_publishes_are_told_of_each_publisher() {
    let host = Host::new();
    let _daemon = host.daemon();
    let session = host.session("camera").unwrap();
    let publisher = session.create_publisher(spec("/images", Qos::keep_all())).unwrap();
    let mut keeper = host.play("keeper");
    assert_eq!(keeper.hear(), "matched");
    assert!(publisher.wait_matched(1, PATIENCE));
    let before = topic(&host);
    assert_eq!((before.publishers, before.subscriptions, before.writers.len()), (1, 1, 1));
    assert_eq!(before.writers[0].depth, None);
    assert!((1..IMAGE as u64).contains(&before.bytes_committed), "{before:?}");

    let image = vec![7; IMAGE];
    let mut published = 0;
    let refused = loop {
        match publisher.publish(&image) {
            Ok(_) => published += 1,
            Err(error) => break error,
        }
    };
    assert!(matches!(refused, PublishError::Blocked { .. }), "{refused}");
    let after = topic(&host);
    assert!(published > 0 && after.bytes_committed >= published * IMAGE as u64, "{after:?}");
    assert_eq!(after.bytes_committed, after.writers[0].bytes_committed);
    assert_eq!((after.published, after.writers[0].blocked), (published, 1));
    assert_eq!(after.dropped.get("blocked"), Some(&1));
    assert_eq!(after.readers[0].unread, published);
}
