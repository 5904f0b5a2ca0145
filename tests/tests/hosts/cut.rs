//! A path that is cut for seconds and comes back.

use std::{thread::sleep, time::Duration};

use axon_tests::Sizes;

use super::{
    mode::{Kmes, Settings, classic},
    pair::{Host, Plan},
    process::until,
    wire::Wire,
};

const SOME: u64 = 300;
const DIALLED: [&str; 1] = ["the link is silent though its path works: dialling a successor"];

fn wired(settings: [Settings; 2]) -> ([Host; 2], Wire) {
    let [mut a, mut b] = Plan { wired: true, ..Plan::new(settings) }.prepare();
    b.start();
    let wire = b.wire();
    a.start();
    ([a, b], wire)
}

/// Samples flow both ways through a wire that is cut for eight seconds, and more than QUIC lets be under
/// way at once: then it sends nothing but probes of its own, ever more seldom.
fn flows_again(settings: [Settings; 2]) -> [usize; 2] {
    let (hosts, wire) = wired(settings);
    let mut nodes = [0, 1].map(|host| {
        let there = hosts[1 - host].subscribe(Sizes::Mixed);
        (hosts[host].flood(Sizes::Mixed, 1), there)
    });
    for (publisher, there) in &mut nodes {
        there.wait_taken(publisher.published() + SOME);
    }
    wire.cut(true);
    sleep(Duration::from_secs(8));
    let before = nodes.each_mut().map(|(_, there)| there.tally().taken);
    wire.cut(false);
    let back = std::time::Instant::now();
    for ((_, there), before) in nodes.iter_mut().zip(before) {
        until("samples flow again", || there.tally().taken > before);
    }
    eprintln!("samples flow both ways {:?} after the path is back", back.elapsed());
    let dialled = hosts.each_ref().map(|host| host.log_lines(&DIALLED));
    for (publisher, there) in &mut nodes {
        there.wait_taken(publisher.published() + SOME);
        let sent = publisher.stop();
        there.wait_taken(sent);
        assert_eq!(there.tally().lost, 0);
    }
    hosts.each_ref().map(Host::link);
    dialled
}

#[test]
fn in_classic_a_link_flows_again_soon_after_its_path_is_back() {
    let dialled = flows_again([classic(&[]), classic(&[])]);
    assert_ne!(dialled, [0, 0], "QUIC's own pause is not waited for");
}

#[test]
fn in_session_a_link_flows_again_soon_after_its_path_is_back() {
    let kmes = Kmes::start();
    let settings = [0, 1].map(|host| kmes.settings(host, &[("AXON_QKD_KEY_MODE", "session")]));
    assert_ne!(flows_again(settings), [0, 0], "QUIC's own pause is not waited for");
}

#[test]
fn in_messages10_a_link_flows_again_soon_after_its_path_is_back() {
    let kmes = Kmes::start();
    // The pace of its keys may leave QUIC room for more.
    flows_again([0, 1].map(|host| kmes.settings(host, &[("AXON_QKD_KEY_MODE", "messages10")])));
}

#[test]
fn a_cut_that_nobody_notices_makes_no_second_link() {
    let (hosts, wire) = wired([classic(&[]), classic(&[])]);
    let mut there = hosts[1].subscribe(Sizes::Small);
    let mut publisher = hosts[0].publish(Sizes::Small, 1, Some(SOME));
    there.wait_taken(publisher.wait_sent());
    let link = hosts[0].link();
    // What is acknowledged late is not to be taken for silence.
    sleep(Duration::from_millis(500));
    wire.cut(true);
    sleep(Duration::from_secs(3));
    wire.cut(false);
    sleep(Duration::from_secs(2));
    assert_eq!(hosts.each_ref().map(|host| host.log_lines(&DIALLED)), [0, 0]);
    assert_eq!(hosts[0].link().since_unix_ms, link.since_unix_ms);
}
