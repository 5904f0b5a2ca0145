//! KMEs that give the two hosts different keys under one key_ID.

use std::time::Duration;

use axon_tests::Sizes;
use etsi_qkd014::sim::{Fault, FaultPlan, Method};

use super::{
    mode::{Kmes, SAE},
    pair::{Host, Plan},
    process::until,
};

const SOME: u64 = 300;

fn hosts(kmes: &Kmes) -> [Host; 2] {
    let more = [("AXON_QKD_KEY_MODE", "messages10")];
    Plan::new([0, 1].map(|host| kmes.settings(host, &more))).start()
}

/// Returns a counter of a host's keys towards the other SAE.
fn counter(host: &Host, peer: &str, direction: &str, name: &str) -> u64 {
    host.status().keys["peers"][peer][direction][name].as_u64().unwrap_or_default()
}

#[test]
fn a_failed_proof_retires_that_key_on_both_hosts_and_nothing_else() {
    let kmes = Kmes::start();
    let [a, b] = hosts(&kmes);
    let mut there = b.subscribe(Sizes::Small);
    let mut publisher = a.publish(Sizes::Small, 1, None);
    there.wait_taken(SOME);
    let since = [&a, &b].map(|host| host.link().since);
    let retired = counter(&b, SAE[0], "receiving", "retired");

    kmes.plan(1, FaultPlan::new(Fault::WrongKey).times(1).on(Method::DecKeys));
    until("the wrong key is noticed", || counter(&a, SAE[1], "sending", "disagreed") == 1);
    let now = publisher.published();
    there.wait_taken(now + SOME);
    assert!(counter(&b, SAE[0], "receiving", "retired") > retired);

    let sent = publisher.stop();
    there.wait_taken(sent);
    let tally = there.tally();
    assert_eq!((tally.taken, tally.missing, tally.lost), (sent, 0, 0), "{tally:?}");
    for (host, since) in [&a, &b].into_iter().zip(since) {
        assert_eq!(host.link().since, since, "the link stood");
        assert!(host.status().refusals.is_empty(), "{:?}", host.status().refusals);
    }
    assert_eq!(counter(&a, SAE[1], "sending", "disagreed"), 1);
    let url = kmes.url(0);
    a.wait_log(&["WARN", "disagree", "key_ID", SAE[0], SAE[1], &url]);
    for node in [publisher, there] {
        node.finish();
    }
}

/// The first key of every answer by name that host B gets is wrong.
#[test]
fn kmes_that_disagree_about_the_first_keys_cost_few_of_them() {
    let kmes = Kmes::start();
    kmes.plan(1, FaultPlan::new(Fault::WrongKey).on(Method::DecKeys));
    let [a, b] = hosts(&kmes);
    let named = |host: &Host, own: usize| {
        host.log_lines(&["WARN", "KMEs disagree", SAE[own], &kmes.url(own)]) > 0
    };
    until("a host names the KMEs", || named(&a, 0) || named(&b, 1));
    let before = kmes.calls();
    let start = [&a, &b].map(|host| host.status().uptime);
    until("ten seconds pass", || a.status().uptime >= start[0] + Duration::from_secs(10));
    // Eight for each dial, which are ever further apart, and the status of two pools.
    let calls = kmes.calls() - before;
    assert!(calls <= 60, "{calls} calls in ten seconds");
    kmes.clear_faults();
    a.link();
    b.link();
}
