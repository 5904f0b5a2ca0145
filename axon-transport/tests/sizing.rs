//! What many processes of many endpoints take: each of these publishes on and subscribes to the same
//! ten topics, so each reads from each.
//!
//! And how long it takes until every session of many knows all endpoints of all, and again after the
//! daemon was killed.
//!
//! In the full size: `SIZING=50 cargo test --release -p axon-transport --test sizing -- --nocapture`
#![expect(clippy::print_stdout, reason = "what it prints is its result")]

#[allow(dead_code, reason = "what other tests need of it")]
mod support;

use std::{
    fs,
    os::unix::fs::MetadataExt as _,
    sync::Arc,
    time::{Duration, Instant},
};

use axon_transport::{
    config::{Config, OsFiles},
    daemon::status::TrafficStatus,
    graph::{GraphEntry, GraphView},
    ids::Gid,
    qos::Qos,
    session::{EndpointSpec, Session, SessionOptions},
};
use support::{Host, PATIENCE, say, until, wait_for_the_end};

/// Topics: a publisher and a subscription of each process for each.
const TOPICS: usize = 10;
/// How long they are left alone.
const REST: Duration = Duration::from_secs(2);
/// Processes of an ordinary run.
const FEW: usize = 8;

fn spec(topic: usize) -> EndpointSpec {
    EndpointSpec::new(format!("/topic{topic}"), "test/Bytes", Qos::default())
}

/// What a process holds, as the system counts it.
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

/// Not a test of its own: what each of the processes does.
#[test]
fn child() {
    let Ok(part) = std::env::var("PLAY") else { return };
    if let Some(total) = part.strip_prefix("graph ") {
        return know_all(total.parse().unwrap());
    }
    let processes: usize = part.parse().unwrap();
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
    let processes = std::env::var("SIZING").ok().map_or(FEW, |n| n.parse().unwrap());
    let host = Host::new().with("AXON_LOG", "warn");
    let daemon = host.daemon();
    let mut players: Vec<_> = (0..processes).map(|_| host.play(&processes.to_string())).collect();
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
    // What is always there, and a lane of 128 bytes for each publisher that a subscription reads
    // from, in pieces of 64 KiB.
    let lanes = TOPICS as u64 * processes * 128;
    assert!(committed <= processes * ((64 << 10) + lanes).next_multiple_of(64 << 10));
    players.into_iter().for_each(support::Player::finish);
}

/// Sessions of each process that is to know the whole graph.
const SESSIONS: usize = 4;

/// Sessions with endpoints of their own topics, which each shall know `total`.
fn know_all(total: usize) {
    let config = Config::resolve(std::env::vars_os(), None, &OsFiles).unwrap();
    let mut sessions = Vec::new();
    let mut endpoints = Vec::new();
    for _ in 0..SESSIONS {
        let session = Session::open(&config, SessionOptions::new("graph")).unwrap();
        for topic in 0..TOPICS {
            let name = format!("/of{}/topic{topic}", session.id());
            let spec = || EndpointSpec::new(&*name, "test/Bytes", Qos::default());
            let publisher = session.create_publisher(spec()).unwrap();
            endpoints.push((publisher, session.create_subscription(spec()).unwrap()));
        }
        sessions.push(session);
    }
    say("created");
    for session in &sessions {
        assert!(session.wait_graph(PATIENCE, |graph| graph.endpoints.len() == total));
    }
    let before: Vec<_> = sessions.iter().map(|s| (s.daemon(), s.graph())).collect();
    say("whole");
    for (session, (daemon, _)) in sessions.iter().zip(&before) {
        // Not by looking now and then: they are to be at rest.
        let another = || session.daemon().is_some_and(|now| Some(now) != *daemon);
        assert!(session.wait_graph(PATIENCE, |_| another()));
    }
    say("found");
    for (session, (_, before)) in sessions.iter().zip(&before) {
        // Each of them was told of by the new one.
        let anew = |(gid, entry): (&Gid, &GraphEntry)| {
            !before
                .endpoints
                .get(gid)
                .is_some_and(|old| Arc::ptr_eq(&old.endpoint, &entry.endpoint))
        };
        let whole =
            |graph: &GraphView| graph.endpoints.len() == total && graph.endpoints.iter().all(anew);
        assert!(session.wait_graph(PATIENCE, whole));
    }
    say("whole again");
    wait_for_the_end();
}

/// Seconds of the processor that a process has had.
fn processor(pid: u32) -> f64 {
    let stat = fs::read_to_string(format!("/proc/{pid}/stat")).unwrap();
    let (_, fields) = stat.rsplit_once(") ").unwrap();
    let ticks = |at: usize| fields.split(' ').nth(at).unwrap().parse::<f64>().unwrap();
    // User and system time, in hundredths of a second.
    (ticks(11) + ticks(12)) / 100.0
}

/// Memory of a process that it shares with no other, in KiB.
fn private(pid: u32) -> u64 {
    let rollup = fs::read_to_string(format!("/proc/{pid}/smaps_rollup")).unwrap();
    let of = |name: &str| {
        let line = rollup.lines().find_map(|line| line.strip_prefix(name)).unwrap();
        line.trim().trim_end_matches(" kB").parse::<u64>().unwrap()
    };
    of("Private_Clean:") + of("Private_Dirty:")
}

/// Prints what sessions and daemon said to each other.
fn print_traffic(when: &str, host: &Host) {
    let TrafficStatus { packets_in, packets_out, bytes_out } = host.status().unwrap().traffic;
    println!("  packets to the daemon, {when:<8} {packets_in:>8}");
    println!(
        "  from it                         {packets_out:>8}, {:.1} MB",
        bytes_out as f64 / 1e6
    );
}

#[test]
fn every_session_of_many_knows_all_endpoints() {
    if std::env::var("PLAY").is_ok() {
        return;
    }
    let processes = std::env::var("SIZING").ok().map_or(FEW / 2, |n| n.parse().unwrap());
    let total = processes * SESSIONS * 2 * TOPICS;
    let host = Host::new().with("AXON_LOG", "warn");
    let mut daemon = host.daemon();
    let part = format!("graph {total}");
    let mut players: Vec<_> = (0..processes).map(|_| host.play(&part)).collect();
    let all = |players: &mut [support::Player], what: &str| {
        players.iter_mut().for_each(|player| assert_eq!(player.hear(), what));
        Instant::now()
    };
    println!("{processes} processes, {SESSIONS} sessions each, {total} endpoints in all:");
    let begun = Instant::now();
    let created = all(&mut players, "created");
    let whole = all(&mut players, "whole");
    let busy = |players: &[support::Player]| -> f64 {
        players.iter().map(|player| processor(player.pid())).sum()
    };
    let start_up = (processor(daemon.0.id()), busy(&players));
    print_traffic("start", &host);
    let memory = players.iter().map(|player| private(player.pid())).max().unwrap();
    println!("  memory of its own, most      {memory:>8} KiB");
    println!("  of the daemon                {:>8} KiB", private(daemon.0.id()));
    std::thread::sleep(REST);
    let before = (processor(daemon.0.id()), busy(&players));
    std::thread::sleep(REST);
    let rest = (processor(daemon.0.id()) - before.0, busy(&players) - before.1);
    daemon.0.kill().unwrap();
    daemon.0.wait().unwrap();
    // One of them starts the next.
    let again = Instant::now();
    all(&mut players, "found");
    let found = Instant::now();
    let whole_again = all(&mut players, "whole again");
    print_traffic("again", &host);
    println!("  created                         {:>8.2} s", (created - begun).as_secs_f64());
    println!("  whole after the last creation   {:>8.2} s", (whole - created).as_secs_f64());
    println!("  processor, daemon and others    {:>8.2} s {:>8.2} s", start_up.0, start_up.1);
    let share = 100.0 / REST.as_secs_f64();
    println!(
        "  at rest                         {:>8.2} % {:>8.2} %",
        rest.0 * share,
        rest.1 * share
    );
    println!("  a new daemon found by all       {:>8.2} s", (found - again).as_secs_f64());
    println!("  and the graph whole             {:>8.2} s", (whole_again - again).as_secs_f64());
    let descriptors =
        fs::read_dir(format!("/proc/{}/fd", host.status().unwrap().pid)).unwrap().count();
    println!("  descriptors of the daemon       {descriptors:>8}");
    players.into_iter().for_each(support::Player::finish);
}
