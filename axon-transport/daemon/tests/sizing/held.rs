//! The resources that each process holds because of the others.

use std::{fs, os::unix::fs::MetadataExt as _};

use super::{TOPICS, support};
use axon_transport::{
    EndpointSpec, Session, SessionOptions,
    config::{Config, OsFiles},
    qos::Qos,
};
use support::{Host, PATIENCE, say, until, wait_for_the_end};

fn spec(topic: usize) -> EndpointSpec {
    EndpointSpec::new(format!("/topic{topic}"), "test/Bytes", Qos::default())
}

/// The resources of a process, as the system counts them.
#[derive(Debug, Default)]
struct Held {
    descriptors: u64,
    maps: u64,
    /// Bytes of memory that back its own segments.
    committed: u64,
    page_tables_kib: u64,
}

impl Held {
    fn here() -> Self {
        let entries = fs::read_dir("/proc/self/fd").unwrap().map(|entry| entry.unwrap().path());
        let mut held = Self::default();
        for path in entries {
            held.descriptors += 1;
            let target = fs::read_link(&path).unwrap_or_default();
            if target.to_string_lossy().starts_with("/memfd:axon-")
                && let Ok(file) = fs::metadata(&path)
            {
                held.committed += file.blocks() * 512;
            }
        }
        let maps = fs::read_to_string("/proc/self/maps").unwrap();
        held.maps = maps.lines().filter(|line| line.contains("/memfd:axon-")).count() as u64;
        let status = fs::read_to_string("/proc/self/status").unwrap();
        let tables = status.lines().find_map(|line| line.strip_prefix("VmPTE:")).unwrap();
        held.page_tables_kib = tables.trim().trim_end_matches(" kB").parse().unwrap();
        held
    }

    fn parse(line: &str) -> Self {
        let numbers: Vec<u64> = line.split(' ').map(|n| n.parse().unwrap()).collect();
        let [descriptors, maps, committed, page_tables_kib] = numbers[..] else { panic!("{line}") };
        Self { descriptors, maps, committed, page_tables_kib }
    }
}

impl std::fmt::Display for Held {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { descriptors, maps, committed, page_tables_kib } = self;
        write!(f, "{descriptors} {maps} {committed} {page_tables_kib}")
    }
}

/// The code of each of `processes` processes.
pub(super) fn play(processes: usize) {
    let config = Config::resolve(std::env::vars_os(), None, &OsFiles).unwrap();
    let session = Session::open(&config, SessionOptions::new("sizing")).unwrap();
    let publishers: Vec<_> =
        (0..TOPICS).map(|topic| session.create_publisher(spec(topic)).unwrap()).collect();
    let subscriptions: Vec<_> =
        (0..TOPICS).map(|topic| session.create_subscription(spec(topic)).unwrap()).collect();
    for subscription in &subscriptions {
        assert!(subscription.wait_matched(processes, PATIENCE));
    }
    for publisher in &publishers {
        assert!(publisher.wait_matched(processes, PATIENCE));
    }
    say("matched");
    let mut line = String::new();
    std::io::stdin().read_line(&mut line).unwrap();
    for publisher in &publishers {
        publisher.publish(&[7; 52]).unwrap();
    }
    let mut bytes = Vec::new();
    for subscription in &subscriptions {
        until("a sample of each", || {
            while subscription.take(&mut bytes).is_some() {}
            subscription.received() >= 1
        });
    }
    say(Held::here());
    wait_for_the_end();
}

#[test]
fn a_process_maps_each_other_process_once() {
    if std::env::var("PLAY").is_ok() {
        return;
    }
    let processes = super::size(8);
    let host = Host::new().with("AXON_LOG", "warn");
    let daemon = host.daemon();
    let mut players: Vec<_> =
        (0..processes).map(|_| host.play(&format!("held {processes}"))).collect();
    for player in &mut players {
        assert_eq!(player.hear(), "matched");
    }
    players.iter_mut().for_each(support::Player::go);
    let held: Vec<Held> = players.iter_mut().map(|player| Held::parse(&player.hear())).collect();

    let largest = |what: fn(&Held) -> u64| held.iter().map(what).max().unwrap();
    let committed: u64 = held.iter().map(|held| held.committed).sum();
    println!("{processes} processes of {} endpoints, each reads from each:", 2 * TOPICS);
    println!("  descriptors, most of a process  {:>8}", largest(|held| held.descriptors));
    println!("  maps of segments, most          {:>8}", largest(|held| held.maps));
    println!("  page tables, most            {:>8} KiB", largest(|held| held.page_tables_kib));
    println!("  committed in all             {:>8} KiB", committed >> 10);
    let descriptors = fs::read_dir(format!("/proc/{}/fd", daemon.0.id())).unwrap().count();
    println!("  descriptors of the daemon       {descriptors:>8}");

    let processes = processes as u64;
    // One map for each process, and two descriptors: its doorbell and its pidfd.
    assert_eq!(largest(|held| held.maps), processes);
    assert!(largest(|held| held.descriptors) <= 2 * processes + 24);
    // The memory that always exists, and a lane of 128 bytes for each publisher that a subscription
    // reads, in units of 64 KiB.
    let lanes = TOPICS as u64 * processes * 128;
    assert!(committed <= processes * ((64 << 10) + lanes).next_multiple_of(64 << 10));
    players.into_iter().for_each(support::Player::finish);
}
