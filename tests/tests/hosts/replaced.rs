//! The last writer of a route leaves, and another one comes at the same time: nothing of the new one is lost.

use std::{
    sync::atomic::{AtomicBool, Ordering},
    thread,
    time::Duration,
};

use axon_transport::{EndpointSpec, Session, qos::Qos};

use super::{
    mode::{Kmes, classic},
    pair::{Host, Plan},
    process::PATIENCE,
};

const ROUNDS: u64 = 60;

/// In each way in which two hosts may be set up.
fn in_all(test: impl Fn([Host; 2])) {
    test(Plan::new([classic(&[]), classic(&[])]).start());
    let kmes = Kmes::start();
    let more = [("AXON_QKD_KEY_MODE", "messages10")];
    test(Plan::new([0, 1].map(|host| kmes.settings(host, &more))).start());
}

/// Has an endpoint come in each round at the moment at which the one before it leaves. The pauses differ, so that the
/// graph is at various points of its way.
fn in_turn<E>(host: &Host, mut come: impl FnMut(&Session, u64) -> E) {
    let sessions = [host.session("one"), host.session("other")];
    let mut before = None;
    for round in 0..ROUNDS {
        thread::sleep(Duration::from_millis(round % 12 * 5));
        drop(before.take());
        before = Some(come(&sessions[round as usize % 2], round));
    }
}

#[test]
fn call_of_a_new_client_is_served_though_the_last_other_client_left() {
    in_all(|[a, b]| {
        let spec = || EndpointSpec::new("/echo", "test/Echo", Qos::keep_all());
        let there = a.session("server");
        let server = there.create_server(spec()).unwrap();
        let is_over = AtomicBool::new(false);
        thread::scope(|scope| {
            scope.spawn(|| {
                let mut bytes = Vec::new();
                while !is_over.load(Ordering::Relaxed) {
                    let wait = Some(Duration::from_millis(100));
                    if let Ok(request) = server.recv_request(&mut bytes, wait) {
                        server.send_response(request.publisher, request.sequence, &bytes).unwrap();
                    }
                }
            });
            in_turn(&b, |session, round| {
                let client = session.create_client(spec()).unwrap();
                assert!(client.wait_available(PATIENCE), "round {round}");
                let number = client.send_request(&round.to_be_bytes()).unwrap();
                let mut response = Vec::new();
                let info = client.recv_response(&mut response, Some(PATIENCE));
                let info = info.unwrap_or_else(|error| panic!("round {round}: {error}"));
                assert_eq!((info.sequence, &response[..]), (number, &round.to_be_bytes()[..]));
                client
            });
            is_over.store(true, Ordering::Relaxed);
        });
    });
}

#[test]
fn sample_of_a_new_publisher_arrives_though_the_last_other_publisher_left() {
    in_all(|[a, b]| {
        let spec = || EndpointSpec::new("/topic", "test/Bytes", Qos::keep_all());
        let there = a.session("subscription");
        let subscription = there.create_subscription(spec()).unwrap();
        in_turn(&b, |session, round| {
            let publisher = session.create_publisher(spec()).unwrap();
            assert!(publisher.wait_matched(1, PATIENCE), "round {round}");
            publisher.publish(&round.to_be_bytes()).unwrap();
            let mut bytes = Vec::new();
            let info = subscription.recv(&mut bytes, Some(PATIENCE));
            info.unwrap_or_else(|error| panic!("round {round}: {error}"));
            assert_eq!(bytes[..], round.to_be_bytes());
            publisher
        });
        assert_eq!(subscription.lost(), 0);
    });
}
