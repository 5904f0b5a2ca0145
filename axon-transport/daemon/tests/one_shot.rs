//! A publisher that counts a reader, publishes, and ends at once.

mod support;

use axon_transport::{EndpointSpec, Session, Subscription, qos::Qos};
use rustix::process::{Pid, Signal, WaitId, WaitIdOptions, waitid};
use support::{Host, Kept, PATIENCE, Player, of_child, say, signal, until, wait_for_the_end};

const SAMPLES: u64 = 10;

fn spec() -> EndpointSpec {
    EndpointSpec::new("/t", "test/Bytes", Qos::keep_all())
}

/// The code of the child. It does nothing in a run of the tests themselves.
#[test]
fn child() {
    let Ok(part) = std::env::var("PLAY") else { return };
    let session = of_child(&part);
    let publisher = session.create_publisher(spec()).unwrap();
    say("there");
    assert!(publisher.wait_matched(1, PATIENCE));
    for number in 0..SAMPLES {
        publisher.publish(&number.to_be_bytes()).unwrap();
    }
    drop(publisher);
    say("ended");
    wait_for_the_end();
}

/// Stops a child of this process, and waits until it is stopped.
fn stop(pid: u32) {
    signal(pid, Signal::STOP);
    let id = WaitId::Pid(Pid::from_raw(pid.cast_signed()).unwrap());
    waitid(id, WaitIdOptions::STOPPED).unwrap();
}

/// A stopped publisher, and a reader that has requested its samples.
struct Asked {
    _host: Host,
    _daemon: Kept,
    publisher: Player,
    _session: Session,
    subscription: Subscription,
}

impl Asked {
    fn new() -> Self {
        let host = Host::new().with("AXON_DAEMON", "require");
        let _daemon = host.daemon();
        let mut publisher = host.play("one shot");
        assert_eq!(publisher.hear(), "there");
        stop(publisher.pid());
        let session = host.session("reader").unwrap();
        let subscription = session.create_subscription(spec()).unwrap();
        // The session has waited a second for the stopped process. Its request is on its way since then.
        until("the daemon shows the reader", || {
            let topics = host.status().unwrap().topics;
            topics.iter().any(|topic| topic.topic == "/t" && topic.subscriptions == 1)
        });
        Self { _host: host, _daemon, publisher, _session: session, subscription }
    }

    fn all_came_or_are_counted(&self) {
        let (mut taken, mut bytes) = (0, Vec::new());
        until("all samples are taken or counted", || {
            taken += u64::from(self.subscription.take(&mut bytes).is_some());
            taken + self.subscription.lost() == SAMPLES
        });
    }
}

#[test]
fn samples_of_a_publisher_that_counted_a_reader_and_ended_reach_it() {
    let mut asked = Asked::new();
    signal(asked.publisher.pid(), Signal::CONT);
    assert_eq!(asked.publisher.hear(), "ended");
    asked.all_came_or_are_counted();
    asked.publisher.finish();
}
