//! A daemon killed in the middle of a stream.

use std::fs;

use axon_tests::{Sizes, Tally};
use axon_transport::status::Status;
use rustix::process::Signal;

use super::{
    mode::{Kmes, Settings, classic},
    pair::{self, Host, Plan},
    process::{Node, until},
};

/// Enough to be in the middle of the stream.
const SOME: u64 = 200;

impl Host {
    /// Returns whether no daemon runs.
    pub(crate) fn has_no_daemon(&self) -> bool {
        self.try_status().is_none()
    }

    /// Kills the host's daemon without a warning, and returns its last status.
    pub(crate) fn kill_daemon(&mut self) -> Status {
        let status = self.status();
        pair::kill(status.pid);
        if let Some(daemon) = self.daemon.take() {
            assert_eq!(daemon.0.id(), status.pid);
        }
        status
    }
}

/// Kills the daemon of host `victim` while samples flow from A to A and B.
fn kill(settings: [Settings; 2], victim: usize, kmes: Option<&Kmes>) {
    kill_while(|host| host.publish(Sizes::Small, 2, None), settings, victim, kmes);
}

fn kill_while(
    publish: impl Fn(&Host) -> Node,
    settings: [Settings; 2],
    victim: usize,
    kmes: Option<&Kmes>,
) {
    let mut hosts = Plan { grace_s: 5, ..Plan::new(settings) }.start();
    let mut there = hosts[1].subscribe(Sizes::Small);
    let mut here = hosts[0].subscribe(Sizes::Small);
    let mut publisher = publish(&hosts[0]);
    there.wait_taken(SOME);
    let old = [0, 1].map(|host| hosts[host].link());
    let keys = kmes.map(Kmes::keys);

    let killed = hosts[victim].kill_daemon();
    until("another daemon takes over", || hosts[victim].status().daemon != killed.daemon);
    // On the other host the new link shows by the peer's new name.
    let next = hosts[victim].status();
    until("a link to the new daemon, and none to the old one", || {
        let links = hosts[1 - victim].status().links;
        links.len() == 1 && links[0].peer == next.daemon
    });
    assert_eq!(hosts[victim].link().peer, old[victim].peer, "the same peer");
    let now = publisher.published();
    there.wait_taken(now + SOME);
    if let (Some(before), Some(kmes)) = (keys, kmes) {
        let after = kmes.keys();
        assert!(after.0 >= before.0 + 2 && after.1 >= before.1 + 2, "{before:?}, {after:?}");
    }

    let sent = publisher.stop();
    here.wait_taken(sent);
    there.wait_taken(sent);
    assert_eq!(here.tally(), Tally { taken: sent, first: 1, last: sent, ..Tally::default() });
    let remote = there.tally();
    assert_eq!((remote.repeated, remote.corrupt, remote.first), (0, 0, 1), "{remote:?}");
    assert_eq!(remote.taken + remote.missing, sent, "{remote:?}");
    // The samples that were in flight when the link broke count as lost.
    until("the losses are reported", || there.tally().lost == remote.missing);
    for node in [publisher, here, there] {
        node.finish();
    }

    // No session needs the daemons any more. The one that a session started ends by itself; the other gets a signal.
    // Neither leaves anything behind that disturbs its successor.
    pair::signal(hosts[1 - victim].status().pid, Signal::TERM);
    for host in &hosts {
        until("the daemon ends", || host.has_no_daemon());
        let run = host.dir.path().join("run");
        until("the socket is gone", || {
            let names = fs::read_dir(&run).unwrap().map(|e| e.unwrap().file_name());
            names.into_iter().all(|name| !name.to_str().unwrap().ends_with(".sock"))
        });
    }
    for pid in [killed.pid, next.pid] {
        until("the process has ended", || !runs(pid));
    }
}

fn runs(pid: u32) -> bool {
    // One that ended may wait for its parent to take notice.
    fs::read_to_string(format!("/proc/{pid}/stat")).is_ok_and(|stat| !stat.contains(") Z "))
}

#[test]
fn of_the_publisher_in_classic() {
    kill([classic(&[]), classic(&[])], 0, None);
}

#[test]
fn of_the_subscriber_in_classic() {
    kill([classic(&[]), classic(&[])], 1, None);
}

/// The link is cut in the middle of data that is written together.
#[test]
fn in_the_middle_of_a_flood() {
    let flood = |host: &Host| host.flood(Sizes::Small, 2);
    kill_while(flood, [classic(&[]), classic(&[])], 1, None);
}

fn kill_qkd(victim: usize, key_mode: &str) {
    let kmes = Kmes::start();
    let more = [("AXON_QKD_KEY_MODE", key_mode)];
    kill([0, 1].map(|host| kmes.settings(host, &more)), victim, Some(&kmes));
}

#[test]
fn of_the_publisher_in_qkd_session() {
    kill_qkd(0, "session");
}

#[test]
fn of_the_subscriber_in_qkd_session() {
    kill_qkd(1, "session");
}

#[test]
fn of_the_publisher_in_messages10() {
    kill_qkd(0, "messages10");
}

#[test]
fn of_the_subscriber_in_messages10() {
    kill_qkd(1, "messages10");
}
