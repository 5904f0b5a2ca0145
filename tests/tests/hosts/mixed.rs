//! Subscriptions of one host that ask for different things, and servers that come while others are asked.

use std::{
    sync::atomic::{AtomicBool, Ordering},
    thread,
};

use axon_shm::PublishError;
use axon_transport::{EndpointSpec, Publisher, Session, Subscription, qos::Qos};

use super::{
    mode::classic,
    pair::{Host, Plan},
    process::{PATIENCE, until},
};

fn hosts() -> [Host; 2] {
    Plan::new([classic(&[]), classic(&[])]).start()
}

fn spec(topic: &str, qos: Qos) -> EndpointSpec {
    EndpointSpec::new(topic, "test/Bytes", qos)
}

/// Publishes one more, held back by its readers as it may be; its number.
#[track_caller]
fn publish(publisher: &Publisher, bytes: &[u8]) -> u64 {
    let mut published = None;
    until("there is room for one more", || match publisher.publish(bytes) {
        Ok(number) => {
            published = Some(number);
            true
        }
        Err(PublishError::Blocked { .. }) => false,
        Err(error) => panic!("{error}"),
    });
    published.unwrap()
}

fn take(subscription: &Subscription, bytes: &mut Vec<u8>) -> u64 {
    subscription.recv(bytes, Some(PATIENCE)).expect("a sample").sequence
}

/// Takes `from` to `last`, of which nothing may be missing.
#[track_caller]
fn take_all(subscription: &Subscription, from: u64, last: u64) {
    let mut bytes = Vec::new();
    let mut taken = take(subscription, &mut bytes);
    while taken < from {
        // The sample was in flight when the subscription came.
        taken = take(subscription, &mut bytes);
    }
    assert_eq!(taken, from, "the first");
    for number in from + 1..=last {
        assert_eq!(take(subscription, &mut bytes), number, "the next of {from} to {last}");
    }
    assert_eq!(subscription.lost(), 0);
}

/// Creates a publisher on the first host, a session on the second, and a subscription there, and waits until samples
/// cross.
fn crossing(hosts: &[Host; 2], topic: &str, qos: Qos) -> (Publisher, Session, Subscription) {
    let (here, there) = (hosts[0].session("publisher"), hosts[1].session("subscriptions"));
    let publisher = here.create_publisher(spec(topic, Qos::keep_all())).unwrap();
    let first = there.create_subscription(spec(topic, qos)).unwrap();
    assert!(publisher.wait_matched(1, PATIENCE) && first.wait_matched(1, PATIENCE));
    let mut bytes = Vec::new();
    until("something crosses", || {
        publish(&publisher, b"before");
        first.take(&mut bytes).is_some()
    });
    (publisher, there, first)
}

/// Creates another subscription, and waits until the publisher is matched with it: samples cross to it from then on.
fn join(publisher: &Publisher, there: &Session, topic: &str, qos: Qos) -> Subscription {
    let subscription = there.create_subscription(spec(topic, qos)).unwrap();
    let gid = subscription.gid();
    until("it is counted", || publisher.matched().contains(&gid));
    subscription
}

#[test]
fn a_reliable_subscription_gets_all_that_a_best_effort_one_before_it_may_miss() {
    // Maximum number of samples at once that every ring keeps for a late reader.
    const BURST: u64 = 8;
    let hosts = hosts();
    let topic = "/lossy_first";
    let lossy = Qos::sensor_data().with_depth(1);
    let (publisher, there, _first) = crossing(&hosts, topic, lossy);
    for qos in [Qos::default(), Qos::keep_all()] {
        let next = join(&publisher, &there, topic, qos);
        for _ in 0..200 {
            let from = publish(&publisher, &[0x5a; 2000]);
            (1..BURST).for_each(|_| assert!(publish(&publisher, &[0x5a; 2000]) > from));
            take_all(&next, from, from + BURST - 1);
        }
    }
}

#[test]
fn keep_all_reader_holds_a_publisher_back_beside_an_earlier_keep_last_reader() {
    let hosts = hosts();
    let topic = "/dropping_first";
    let (publisher, there, _first) = crossing(&hosts, topic, Qos::default());
    let next = join(&publisher, &there, topic, Qos::keep_all());
    let from = publish(&publisher, b"first");
    let large = vec![0x5a; 1 << 20];
    // There are more samples than all rings, windows and queues on the way hold.
    let numbers = (0..500).map_while(|_| publisher.publish(&large).ok());
    let last = numbers.last().expect("some of them have room");
    take_all(&next, from, last);
}

#[test]
fn a_subscription_loses_no_samples_when_another_requests_more_depth() {
    let hosts = hosts();
    let (here, there) = (hosts[0].session("publisher"), hosts[1].session("subscriptions"));
    let publisher = here.create_publisher(spec("/deeper", Qos::keep_all())).unwrap();
    let all = |depth| spec("/deeper", Qos::keep_all().with_depth(depth));
    let first = there.create_subscription(all(1)).unwrap();
    let gid = first.gid();
    assert!(publisher.wait_matched(1, PATIENCE) && first.wait_matched(1, PATIENCE));
    let over = AtomicBool::new(false);
    thread::scope(|scope| {
        let publishing = scope.spawn(|| {
            let mut sent = 0;
            // Relaxed: `over` is a hint, and `join` passes on the other thread's result.
            while !over.load(Ordering::Relaxed) {
                publish(&publisher, &[0x5a; 4000]);
                assert!(publisher.matched().contains(&gid), "it is there all the time");
                sent += 1;
            }
            sent
        });
        let reader = scope.spawn(|| {
            let (mut bytes, mut number) = (Vec::new(), 0);
            while let Ok(info) = first.recv(&mut bytes, Some(PATIENCE)) {
                assert_eq!(info.sequence, number + 1, "in order, and none is missing");
                number = info.sequence;
                if bytes == b"last" {
                    break;
                }
            }
            number
        });
        for depth in [20, 300, 5_000, 80_000, 100_000] {
            let other = there.create_subscription(all(depth)).unwrap();
            let mut bytes = Vec::new();
            let number = take(&other, &mut bytes);
            assert_eq!(take(&other, &mut bytes), number + 1);
        }
        over.store(true, Ordering::Relaxed);
        let sent = publishing.join().unwrap();
        publish(&publisher, b"last");
        assert_eq!(reader.join().unwrap(), sent + 1);
    });
}

#[test]
fn servers_that_come_take_no_request_from_one_that_is_there() {
    const SERVERS: usize = 20;
    let hosts = hosts();
    let (here, there) = (hosts[0].session("client"), hosts[1].session("server"));
    let service = || EndpointSpec::new("/asked", "test/Echo", Qos::keep_all());
    let server = there.create_server(service()).unwrap();
    let client = here.create_client(service()).unwrap();
    assert!(client.wait_available(PATIENCE));
    let over = AtomicBool::new(false);
    thread::scope(|scope| {
        let asking = scope.spawn(|| {
            let mut sent = 0;
            while !over.load(Ordering::Relaxed) {
                match client.send_request(&[0x5a; 500]) {
                    Ok(number) => sent = number,
                    Err(error) => assert!(matches!(error, PublishError::Blocked { .. }), "{error}"),
                }
            }
            sent
        });
        let reader = scope.spawn(|| {
            let (mut bytes, mut number) = (Vec::new(), 0);
            while let Ok(info) = server.recv_request(&mut bytes, Some(PATIENCE)) {
                assert_eq!(info.sequence, number + 1, "in order, and none is missing");
                number = info.sequence;
                if bytes == b"last" {
                    break;
                }
            }
            number
        });
        for _ in 0..SERVERS {
            // The server belongs to a session of its own, whose GIDs may be below those of the first.
            let session = hosts[1].session("another");
            let other = session.create_server(service()).unwrap();
            until("it is reached", || client.servers().contains(&other.gid()));
            let mut bytes = Vec::new();
            assert!(other.recv_request(&mut bytes, Some(PATIENCE)).is_ok());
        }
        over.store(true, Ordering::Relaxed);
        let sent = asking.join().unwrap();
        let mut number = Err(PublishError::Forked);
        until("the last is sent", || {
            number = client.send_request(b"last");
            number.is_ok()
        });
        assert_eq!(number.unwrap(), sent + 1);
        assert_eq!(reader.join().unwrap(), sent + 1);
    });
}
