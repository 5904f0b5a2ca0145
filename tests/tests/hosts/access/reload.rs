//! Log levels and peers are read again beside the rules.

use std::net::{Ipv4Addr, UdpSocket};

use axon_daemon::internal::shared_group;

use super::*;

/// Prepares two hosts that list no peers. A host that is not listed is not found. The settings of the first are in its
/// `axon.toml`.
fn unlisted() -> [Host; 2] {
    let plan = Plan { listed: false, ..Plan::new([classic(&[]), classic(&[])]) };
    let mut hosts = plan.prepare();
    for host in &mut hosts {
        host.set("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST");
    }
    hosts[0].unset("AXON_DAEMON_PEERS");
    hosts[0].unset("AXON_LOG");
    hosts
}

/// Writes `axon.toml` of a host, and makes its daemon read it. Returns the changed settings.
fn rewrite(host: &Host, toml: &str) -> Vec<String> {
    fs::write(host.dir.path().join("axon.toml"), toml).unwrap();
    let report = daemon_reload_at(&DaemonLocation::from(&host.config())).unwrap();
    assert_eq!(report.error, None);
    report.changed
}

#[test]
fn log_levels_follow_the_settings() {
    let [mut a, _] = unlisted();
    fs::write(a.dir.path().join("axon.toml"), "log = \"warn\"").unwrap();
    a.start();
    let uses = || {
        let session = a.session("user");
        let _publisher = publisher(&session, "/logged");
        a.status();
    };
    uses();
    assert_eq!(a.log_lines(&["DEBUG"]) + a.log_lines(&["INFO"]), 0);
    assert_eq!(rewrite(&a, "log = \"axon_daemon=debug\""), ["AXON_LOG"]);
    a.wait_log(&["INFO", "the settings were read again", "AXON_LOG"]);
    until("debug lines come", || {
        uses();
        a.log_lines(&["DEBUG"]) > 0
    });
    assert_eq!(rewrite(&a, "log = \"error\""), ["AXON_LOG"]);
    let before = a.log_bytes();
    (0..10).for_each(|_| uses());
    assert_eq!(a.log_bytes(), before, "nothing below an error");
    // A level that there is not changes nothing, and is named.
    let place = DaemonLocation::from(&a.config());
    fs::write(a.dir.path().join("axon.toml"), "log = \"axon_daemon=loud\"").unwrap();
    let error = daemon_reload_at(&place).unwrap().error.expect("why not");
    assert!(error.contains("log") && error.contains("loud"), "{error}");
    fs::write(a.dir.path().join("axon.toml"), "log = \"error\"").unwrap();
}

#[test]
fn a_peer_that_is_listed_with_its_port_while_the_daemon_runs_is_linked() {
    links_once_listed(|b| format!("{}:{}", b.address, b.status().port.unwrap()));
}

#[test]
fn a_peer_that_is_listed_without_a_port_while_the_daemon_runs_is_linked() {
    links_once_listed(|b| b.address.to_string());
}

fn links_once_listed(name_of: impl Fn(&Host) -> String) {
    let plan = Plan { listed: false, ..Plan::new([classic(&[]), classic(&[])]) };
    let [mut a, mut b] = plan.prepare();
    // This socket does not share its port, so the daemons find each other only by their lists.
    let group = shared_group(a.domain());
    let _alone = UdpSocket::bind((Ipv4Addr::UNSPECIFIED, group.port())).unwrap();
    a.unset("AXON_DAEMON_PEERS");
    for host in [&mut a, &mut b] {
        host.start();
        host.wait_log(&["cannot open the shared discovery port"]);
    }
    let subscription = subscription(&b.session("b"), "/listed");
    let publisher = publisher(&a.session("a"), "/listed");
    assert!(a.status().links.is_empty());
    let listing = format!("daemon_peers = [\"{}\"]\n", name_of(&b));
    assert_eq!(rewrite(&a, &listing), ["AXON_DAEMON_PEERS"]);
    assert!(publisher.wait_matched(1, PATIENCE) && subscription.wait_matched(1, PATIENCE));
    until("the link is in the status", || a.status().links.len() == 1);
    // A link that stands stays.
    assert_eq!(rewrite(&a, ""), ["AXON_DAEMON_PEERS"]);
    publisher.publish(b"still linked").unwrap();
    assert!(subscription.recv(&mut Vec::new(), Some(PATIENCE)).is_ok());
}
