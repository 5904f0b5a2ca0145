//! Two paths between two hosts: a second link stands by, and takes over when the path of the first is cut.

use std::{
    thread::{self, sleep},
    time::{Duration, Instant},
};

use axon_transport::{EndpointSpec, qos::Qos};

use super::{
    mode::{Kmes, Settings, classic},
    pair::{Host, Plan},
    process::{PATIENCE, until},
    wire::Wire,
};

const TWO: (&str, &str) = ("AXON_LINK_PATHS", "2");
const SECOND: [&str; 1] = ["a second link stands by"];
const TAKES_OVER: [&str; 1] = ["the second link takes over"];

/// Starts two hosts with a wire for each path.
fn wired_twice(settings: [Settings; 2]) -> ([Host; 2], [Wire; 2]) {
    let [mut a, mut b] = Plan { wired: true, paths: 2, ..Plan::new(settings) }.prepare();
    b.start();
    let wires = [b.wire(), b.second_wire()];
    a.start();
    ([a, b], wires)
}

/// Returns the wire that carries the link in use.
fn in_use(host: &Host, wires: &[Wire; 2]) -> usize {
    let address = host.link().address;
    wires.iter().position(|wire| wire.address.to_string() == address).unwrap()
}

fn stands_by(host: &Host) -> bool {
    host.status().links.iter().any(|link| link.standby.is_some())
}

/// Returns the samples and calls that a host received over the second path first.
fn copies(host: &Host) -> u64 {
    host.link().copies_in
}

/// Publishes 100 samples a second of 1 KB while one path after the other is cut and comes back. Returns the samples that
/// came over the second path first.
fn outlasts_cuts_of_either_path(settings: [Settings; 2]) -> u64 {
    let (hosts, wires) = wired_twice(settings);
    let spec = || EndpointSpec::new("/paths", "test/Bytes", Qos::keep_all());
    let (here, there) = (hosts[0].session("publisher"), hosts[1].session("subscription"));
    let subscription = there.create_subscription(spec()).unwrap();
    let publisher = here.create_publisher(spec()).unwrap();
    assert!(publisher.wait_matched(1, PATIENCE) && subscription.wait_matched(1, PATIENCE));
    let (mut published, mut taken, mut bytes) = (0, 0, Vec::new());
    let mut longest = Duration::ZERO;
    for _ in 0..4 {
        until("a second link stands by", || hosts.iter().all(stands_by));
        let path = in_use(&hosts[0], &wires);
        wires[path].cut();
        let begun = Instant::now();
        let mut last = begun;
        while begun.elapsed() < Duration::from_secs(2) {
            publisher.publish(&[0x5a; 1000]).unwrap();
            published += 1;
            while let Some(info) = subscription.take(&mut bytes) {
                taken += 1;
                assert_eq!(info.sequence, taken, "in order, and once");
                longest = longest.max(last.elapsed());
                last = Instant::now();
            }
            sleep(Duration::from_millis(10));
        }
        until("the other path carries the link", || in_use(&hosts[0], &wires) != path);
        wires[path].mend();
    }
    while taken < published {
        let info = subscription.recv(&mut bytes, Some(PATIENCE)).unwrap();
        taken += 1;
        assert_eq!(info.sequence, taken, "in order, and once");
    }
    eprintln!("the longest time without a sample was {longest:?}");
    let switches: usize = hosts.iter().map(|host| host.log_lines(&TAKES_OVER)).sum();
    assert!(switches >= 4, "{switches} switches");
    assert!(hosts.iter().all(|host| host.log_lines(&SECOND) >= 4));
    for host in &hosts {
        assert_eq!(host.log_lines(&["link down"]), 0, "the link never ended");
    }
    copies(&hosts[1])
}

#[test]
fn in_classic_traffic_outlasts_cuts_of_either_path() {
    let copies = outlasts_cuts_of_either_path([classic(&[TWO]), classic(&[TWO])]);
    assert!(copies > 20, "{copies} samples came over the second path during the cuts");
}

#[test]
fn in_session_traffic_outlasts_cuts_of_either_path() {
    let kmes = Kmes::start();
    let more = [TWO, ("AXON_QKD_KEY_MODE", "session")];
    let copies = outlasts_cuts_of_either_path([0, 1].map(|host| kmes.settings(host, &more)));
    assert!(copies > 20, "{copies} samples came over the second path during the cuts");
}

#[test]
fn in_messages10_traffic_outlasts_cuts_of_either_path() {
    let kmes = Kmes::start();
    let more = [TWO, ("AXON_QKD_KEY_MODE", "messages10")];
    let copies = outlasts_cuts_of_either_path([0, 1].map(|host| kmes.settings(host, &more)));
    assert_eq!(copies, 0, "a copy would leave without an envelope");
}

/// Calls a service 100 times a second, with up to ten calls under way, while one path after the other is cut.
fn calls_outlast_cuts_of_either_path(settings: [Settings; 2]) {
    let (hosts, wires) = wired_twice(settings);
    let spec = || EndpointSpec::new("/echo", "test/Echo", Qos::keep_all());
    let (here, there) = (hosts[0].session("client"), hosts[1].session("server"));
    let server = there.create_server(spec()).unwrap();
    let client = here.create_client(spec()).unwrap();
    assert!(client.wait_available(PATIENCE));
    let answering = thread::spawn(move || {
        let (mut served, mut bytes) = (0, Vec::new());
        while let Ok(request) = server.recv_request(&mut bytes, Some(PATIENCE)) {
            served += 1;
            assert_eq!(request.sequence, served, "each call once, and in order");
            server.send_response(request.publisher, request.sequence, &bytes).unwrap();
            if bytes == b"last" {
                break;
            }
        }
        served
    });
    let (mut called, mut answered, mut bytes) = (0, 0, Vec::new());
    let take = |answered: &mut u64, bytes: &mut Vec<u8>| {
        while let Some(info) = client.take_response(bytes) {
            *answered += 1;
            assert_eq!(info.sequence, *answered, "each response once");
        }
    };
    for _ in 0..4 {
        until("a second link stands by", || hosts.iter().all(stands_by));
        let path = in_use(&hosts[0], &wires);
        wires[path].cut();
        let begun = Instant::now();
        while begun.elapsed() < Duration::from_secs(1) {
            if called < answered + 10 {
                called = client.send_request(b"call").unwrap();
            }
            sleep(Duration::from_millis(10));
            take(&mut answered, &mut bytes);
        }
        until("the other path carries the link", || in_use(&hosts[0], &wires) != path);
        wires[path].mend();
    }
    called = client.send_request(b"last").unwrap();
    assert_eq!(answering.join().unwrap(), called);
    until("all calls are answered", || {
        take(&mut answered, &mut bytes);
        answered == called
    });
    assert!(hosts.iter().all(|host| copies(host) > 0), "calls and responses cross both paths");
}

#[test]
fn in_classic_calls_cross_both_paths_and_none_is_served_twice() {
    calls_outlast_cuts_of_either_path([classic(&[TWO]), classic(&[TWO])]);
}

#[test]
fn in_session_calls_cross_both_paths_and_none_is_served_twice() {
    let kmes = Kmes::start();
    let more = [TWO, ("AXON_QKD_KEY_MODE", "session")];
    calls_outlast_cuts_of_either_path([0, 1].map(|host| kmes.settings(host, &more)));
}

#[test]
fn each_path_has_a_key_of_its_own() {
    let kmes = Kmes::start();
    let more = [TWO, ("AXON_QKD_KEY_MODE", "session")];
    let (hosts, _wires) = wired_twice([0, 1].map(|host| kmes.settings(host, &more)));
    until("a second link stands by", || hosts.iter().all(stands_by));
    let drawn = kmes.drawn();
    let mut keys: Vec<_> = drawn.iter().map(|(key_id, _)| key_id).collect();
    keys.sort_unstable();
    keys.dedup();
    assert!(keys.len() >= 2, "{} keys", keys.len());
}

#[test]
fn host_with_one_path_has_no_second_link() {
    let (hosts, _wires) = wired_twice([classic(&[TWO]), classic(&[])]);
    until("they are linked", || hosts.iter().all(|host| !host.status().links.is_empty()));
    // Longer than the search for a second path takes where both hosts look for one.
    sleep(Duration::from_secs(4));
    assert!(!hosts.iter().any(stands_by));
}
