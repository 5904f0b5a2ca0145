//! Processes that are stopped or killed in the middle of an attachment.

use std::{thread, time::Duration};

use axon_shm::PublishError;
use axon_transport::Session;
use rustix::process::Signal;

use crate::{
    spec,
    support::{Host, PATIENCE, signal, until},
};

#[test]
fn a_reader_stopped_during_its_attachment_blocks_no_other_reader() {
    let host = Host::new();
    let _daemon = host.daemon();
    let session = host.session("writer").unwrap();
    let publisher = session.create_publisher(spec("/t")).unwrap();
    let witness = host.session("witness").unwrap();
    let other = witness.create_subscription(spec("/t")).unwrap();
    assert!(other.wait_matched(1, PATIENCE) && publisher.wait_matched(1, PATIENCE));
    let mut published = 0;
    for round in 0..24 {
        let mut reader = host.play("listener");
        thread::sleep(Duration::from_millis(round * 2));
        signal(reader.pid(), Signal::STOP);
        // The other processes go on, whatever point it has reached.
        for _ in 0..5 {
            match publisher.publish(b"x") {
                Ok(_) => published += 1,
                // The stopped subscriber is attached already, and KEEP_ALL waits for it.
                Err(PublishError::Blocked { .. }) => {}
                Err(error) => panic!("{error}"),
            }
        }
        if round % 3 == 0 {
            signal(reader.pid(), Signal::KILL);
            until("it is forgotten", || publisher.matched() == [other.gid()]);
            continue;
        }
        signal(reader.pid(), Signal::CONT);
        until("it is attached", || publisher.matched().len() == 2);
        publisher.publish(b"x").unwrap();
        published += 1;
        assert_eq!(reader.hear(), "heard");
        reader.finish();
        until("it is forgotten", || publisher.matched() == [other.gid()]);
    }
    let mut bytes = Vec::new();
    for _ in 0..published {
        assert!(other.recv(&mut bytes, Some(PATIENCE)).is_ok());
    }
    assert_eq!((other.received(), other.lost()), (published, 0));
}

#[test]
fn successor_completes_the_attachments_of_a_killed_daemon() {
    let host = Host::new();
    // The first process starts the daemon, and so does each that follows.
    let mut idle = host.play("listener");
    until("a daemon is there", || host.status().is_ok());
    for round in 0..12 {
        let (a, b) = (host_session(&host, "a"), host_session(&host, "b"));
        let topic = format!("/round{round}");
        let publisher = a.create_publisher(spec(&topic)).unwrap();
        let subscription = b.create_subscription(spec(&topic)).unwrap();
        thread::sleep(Duration::from_micros(400 * round));
        if let Ok(status) = host.status() {
            signal(status.pid, Signal::KILL);
        }
        assert!(publisher.wait_matched(1, PATIENCE) && subscription.wait_matched(1, PATIENCE));
        publisher.publish(b"x").unwrap();
        assert!(subscription.recv(&mut Vec::new(), Some(PATIENCE)).is_ok());
    }
    let publisher = host_session(&host, "c").create_publisher(spec("/t")).unwrap();
    assert!(publisher.wait_matched(1, PATIENCE));
    publisher.publish(b"x").unwrap();
    assert_eq!(idle.hear(), "heard");
    idle.finish();
}

/// Opens a session in this process, with a daemon that another process starts.
fn host_session(host: &Host, name: &str) -> Session {
    let mut session = None;
    until("a daemon takes it", || {
        session = host.session(name).ok();
        session.is_some()
    });
    session.unwrap()
}
