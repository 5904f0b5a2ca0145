//! KMEs that give keys a second time, after both daemons were restarted.

use std::{fs, os::unix::fs::PermissionsExt};

use axon_tests::Sizes;

use super::{
    mode::{Kmes, SAE},
    pair::{Host, Plan},
    process::until,
};

const SOME: u64 = 100;

/// Lets samples flow from A to B, and ends both daemons.
fn use_keys(hosts: &mut [Host; 2]) {
    let mut there = hosts[1].subscribe(Sizes::Small);
    let mut publisher = hosts[0].publish(Sizes::Small, 1, Some(SOME));
    there.wait_taken(publisher.wait_sent());
    drop((publisher, there));
    for host in hosts.iter_mut() {
        host.kill_daemon();
    }
}

fn used_keys(host: &Host) -> std::path::PathBuf {
    host.dir.path().join(format!("run/used-keys-{}", host.domain()))
}

#[test]
fn keys_that_both_hosts_had_before_their_restart_are_refused_by_name() {
    let kmes = Kmes::start();
    kmes.note_state();
    let mut hosts = Plan::new([0, 1].map(|host| kmes.settings(host, &[]))).start();
    use_keys(&mut hosts);
    let before = hosts.each_ref().map(|host| fs::read(used_keys(host)).unwrap());
    for (host, bytes) in hosts.iter().zip(&before) {
        assert_eq!(fs::metadata(used_keys(host)).unwrap().permissions().mode() & 0o777, 0o600);
        assert!(bytes.len() > 32, "a header and key_IDs");
    }

    kmes.set_back();
    hosts.iter_mut().for_each(Host::start);
    // The host that dials first is the master of the first key.
    let named = |host: &Host| {
        let failure = host.status().keys["kme"]["last_failure"].as_str().map(str::to_owned);
        failure.is_some_and(|text| text.contains("again, which this host had before"))
    };
    until("a host names the key", || hosts.iter().any(named));
    let host = hosts.iter().position(named).unwrap();
    let (url, [own, peer]) = (kmes.url(host), [SAE[host], SAE[1 - host]]);
    hosts[host].wait_log(&["WARN", &url, "enc_keys", own, peer, "key_ID", "again"]);
    assert!(hosts.iter().all(|host| host.status().keys["used_keys"]["trouble"].is_null()));
}

#[test]
fn a_record_that_cannot_be_kept_is_said_and_shown_and_the_link_stands() {
    let kmes = Kmes::start();
    let mut hosts = Plan::new([0, 1].map(|host| kmes.settings(host, &[]))).start();
    use_keys(&mut hosts);
    let spoilt = "somebody else's file, and longer than the header of a ledger";
    fs::write(used_keys(&hosts[0]), spoilt).unwrap();
    hosts.iter_mut().for_each(Host::start);
    hosts[0].link();
    hosts[0].wait_log(&["WARN", "used-keys", "cannot be kept", "no ledger"]);
    let trouble = hosts[0].status().keys["used_keys"]["trouble"].clone();
    assert!(trouble.as_str().is_some_and(|why| why.contains("used-keys")), "{trouble}");
    assert!(hosts[1].status().keys["used_keys"]["trouble"].is_null());
    assert_eq!(fs::read_to_string(used_keys(&hosts[0])).unwrap(), spoilt, "left as it was");
}
