//! A reader that was stopped, and was never told of a publisher that had counted it: the reader counts what it lost.

use std::time::{Duration, Instant};

use super::*;
use crate::support::of_child;

/// Number of samples that the publisher leaves.
const SAMPLES: u64 = 24;
/// Longer than a dropped publisher stays for a reader.
const PUBLISHER_STAYS: Duration = Duration::from_secs(12);

/// The way in which a publisher ends.
#[derive(PartialEq)]
enum End {
    Publisher,
    Process,
    Killed,
}

/// A child: publishes once it has a reader. Then it ends its publisher or itself, or waits to be killed.
fn publish_and(end: &End) {
    let session = of_child("publisher");
    let publisher = session.create_publisher(spec("/unmet")).unwrap();
    say("created");
    assert!(publisher.wait_matched(1, PATIENCE));
    say("matched");
    (1..=SAMPLES).for_each(|number| publish(&publisher, number));
    if *end == End::Killed {
        // The next daemon has been told everything about this process.
        until("a daemon answers", || session.status_json().is_ok());
        say("published");
        wait_for_the_end();
    }
    drop(publisher);
    if *end == End::Publisher {
        say("ended");
        wait_for_the_end();
    }
}

/// A child: waits to be killed.
pub(crate) fn killed() {
    publish_and(&End::Killed);
}

/// A child: ends its publisher and lives on.
pub(crate) fn publisher() {
    publish_and(&End::Publisher);
}

/// A child: ends, and its publisher with it.
pub(crate) fn process() {
    publish_and(&End::Process);
}

/// A child: reports how many samples came and how many count as lost, once all are accounted for.
pub(crate) fn taker() {
    let session = of_child("taker");
    let subscription = session.create_subscription(spec("/unmet")).unwrap();
    say("created");
    let (mut bytes, mut came) = (Vec::new(), 0);
    let patience = Instant::now() + PATIENCE;
    while came + subscription.lost() < SAMPLES && Instant::now() < patience {
        let Ok(info) = subscription.recv(&mut bytes, Some(Duration::from_millis(100))) else {
            continue;
        };
        assert_eq!(bytes, info.sequence.to_le_bytes());
        came += 1;
    }
    say(format!("{came} came, {} lost", subscription.lost()));
    wait_for_the_end();
}

/// Stops a reader after its request, and kills the daemon before the publisher's answer.
fn publisher_of_a_stopped_reader(part: &str, meanwhile: impl FnOnce(Player)) {
    let host = Host::new();
    let mut publisher = host.play(part);
    assert_eq!(publisher.hear(), "created");
    until("the daemon knows it", || !host.status().unwrap().topics.is_empty());
    signal(publisher.pid(), Signal::STOP);
    let mut taker = host.play("takes what is unmet");
    assert_eq!(taker.hear(), "created");
    let asked = |status: Status| status.topics.iter().any(|topic| !topic.readers.is_empty());
    until("the reader has asked", || asked(host.status().unwrap()));
    signal(taker.pid(), Signal::STOP);
    signal(host.status().unwrap().pid, Signal::KILL);
    signal(publisher.pid(), Signal::CONT);
    assert_eq!(publisher.hear(), "matched");
    meanwhile(publisher);
    signal(taker.pid(), Signal::CONT);
    let said = taker.hear();
    let (came, lost) = said.split_once(" came, ").unwrap();
    let lost = lost.strip_suffix(" lost").unwrap();
    let sum = came.parse::<u64>().unwrap() + lost.parse::<u64>().unwrap();
    assert_eq!(sum, SAMPLES, "{said}");
    taker.finish();
}

#[test]
fn a_reader_stopped_past_the_linger_of_a_dropped_publisher_counts_losses() {
    let mut ended = None;
    publisher_of_a_stopped_reader("ends its publisher", |mut publisher| {
        assert_eq!(publisher.hear(), "ended");
        std::thread::sleep(PUBLISHER_STAYS);
        ended = Some(publisher);
    });
    ended.unwrap().finish();
}

#[test]
fn a_reader_stopped_past_the_linger_of_an_exiting_process_counts_losses() {
    publisher_of_a_stopped_reader("ends with its publisher", Player::finish);
}

#[test]
fn a_stopped_reader_accounts_for_every_sample_of_a_killed_publisher() {
    publisher_of_a_stopped_reader("is killed", |mut publisher| {
        assert_eq!(publisher.hear(), "published");
        signal(publisher.pid(), Signal::KILL);
    });
}
