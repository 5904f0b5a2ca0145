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
const PROBED: [&str; 1] = ["the link does not answer: probing its path"];
const DIALLED: [&str; 1] = ["the link is silent though its path works: dialling a successor"];

pub(crate) fn wired(settings: [Settings; 2]) -> ([Host; 2], Wire) {
    let [mut a, mut b] = Plan { wired: true, ..Plan::new(settings) }.prepare();
    b.start();
    let wire = b.wire();
    a.start();
    ([a, b], wire)
}

/// Tests that samples flow again after a wire was cut for eight seconds. The link is then in one of QUIC's pauses, as
/// on a path whose congestion window is full.
fn flows_again(settings: [Settings; 2]) {
    let (hosts, wire) = wired(settings);
    let mut there = hosts[1].subscribe(Sizes::Mixed);
    let mut publisher = hosts[0].flood(Sizes::Mixed, 1);
    there.wait_taken(publisher.published() + SOME);
    wire.cut();
    sleep(Duration::from_secs(8));
    let before = there.tally().taken;
    wire.mend_for_newcomers();
    let back = std::time::Instant::now();
    until("samples flow again", || there.tally().taken > before);
    eprintln!("samples flow {:?} after the path is back", back.elapsed());
    let dialled = hosts.each_ref().map(|host| host.log_lines(&DIALLED));
    assert_ne!(dialled, [0, 0], "QUIC's own pause is not waited for");
    there.wait_taken(publisher.published() + SOME);
    let sent = publisher.stop();
    there.wait_taken(sent);
    assert_eq!(there.tally().lost, 0);
    for host in &hosts {
        host.link();
    }
}

#[test]
fn in_classic_a_link_flows_again_soon_after_its_path_is_back() {
    flows_again([classic(&[]), classic(&[])]);
}

#[test]
fn in_session_a_link_flows_again_soon_after_its_path_is_back() {
    let kmes = Kmes::start();
    let settings = [0, 1].map(|host| kmes.settings(host, &[("AXON_QKD_KEY_MODE", "session")]));
    flows_again(settings);
}

#[test]
fn in_messages10_a_link_flows_again_soon_after_its_path_is_back() {
    let kmes = Kmes::start();
    flows_again([0, 1].map(|host| kmes.settings(host, &[("AXON_QKD_KEY_MODE", "messages10")])));
}

/// A daemon may have data to send during a cut, for example a larger window. It then notices the cut, and rightly dials
/// a successor. Such a cut proves nothing about the rule, so the test repeats it.
#[test]
fn an_unnoticed_cut_creates_no_second_link() {
    let (hosts, wire) = wired([classic(&[]), classic(&[])]);
    let mut there = hosts[1].subscribe(Sizes::Small);
    let mut publisher = hosts[0].publish(Sizes::Small, 1, Some(SOME));
    there.wait_taken(publisher.wait_sent());
    let lines = |parts| hosts.each_ref().map(|host| host.log_lines(parts));
    for _ in 0..5 {
        let (probed, dialled) = (lines(&PROBED), lines(&DIALLED));
        let link = hosts[0].link();
        // An acknowledgement that is late is no silence.
        sleep(Duration::from_millis(500));
        wire.cut();
        sleep(Duration::from_secs(3));
        wire.mend();
        sleep(Duration::from_secs(2));
        if lines(&PROBED) == probed {
            assert_eq!(lines(&DIALLED), dialled);
            assert_eq!(hosts[0].link().since, link.since);
            return;
        }
    }
    panic!("each of five cuts was noticed, though no samples were published");
}

#[test]
fn an_outage_that_outlasts_the_graph_takes_nothing() {
    let (hosts, wire) = wired([classic(&[]), classic(&[])]);
    let mut there = hosts[1].subscribe(Sizes::Small);
    let mut publisher = hosts[0].flood(Sizes::Small, 1);
    there.wait_taken(publisher.published() + SOME);
    wire.cut();
    let gone = |host: &Host| host.status().links.is_empty();
    until("each host takes the other for gone", || hosts.iter().all(gone));
    wire.mend();
    until("they are back", || hosts.iter().all(|host| !gone(host)));
    there.wait_taken(publisher.published() + SOME);
    let sent = publisher.stop();
    there.wait_taken(sent);
    let tally = there.tally();
    assert_eq!((tally.taken, tally.lost), (sent, 0), "{tally:?}");
}
