//! Measures how long many processes that start at once take until each knows all, and again after
//! the daemon was killed, and the messages and the processor time for that.

use std::{
    fs,
    sync::Arc,
    time::{Duration, Instant},
};

use super::{TOPICS, support};
use axon_transport::{
    EndpointSpec, Session, SessionOptions,
    config::{Config, OsFiles},
    graph::{GraphEntry, GraphView},
    ids::Gid,
    qos::{Durability, Qos},
    status::TrafficStatus,
};
use support::{Host, PATIENCE, Player, say, wait_for_the_end};

/// Time for which they are left alone.
const REST: Duration = Duration::from_secs(2);
/// Number of sessions of each process that has its own topics.
const SESSIONS: usize = 4;
/// The services of a ROS 2 node, by which other processes query its parameters.
const SERVICES: [&str; 7] = [
    "describe_parameters",
    "get_parameter_types",
    "get_parameters",
    "get_type_description",
    "list_parameters",
    "set_parameters",
    "set_parameters_atomically",
];
/// The node, its services, the endpoints of each ROS 2 node, and a topic of its own.
const OF_NODE: usize = 1 + SERVICES.len() + 3 + 2;

fn session() -> Session {
    let config = Config::resolve(std::env::vars_os(), None, &OsFiles).unwrap();
    Session::open(&config, SessionOptions::new("sizing")).unwrap()
}

/// Opens sessions with endpoints of their own topics; each must come to know `total` endpoints.
pub(super) fn play_sessions(total: usize) {
    let mut endpoints = Vec::new();
    let mut sessions = Vec::new();
    for _ in 0..SESSIONS {
        let session = session();
        for topic in 0..TOPICS {
            let name = format!("/of{}/topic{topic}", session.id());
            let spec = || EndpointSpec::new(&*name, "test/Bytes", Qos::default());
            let publisher = session.create_publisher(spec()).unwrap();
            endpoints.push((publisher, session.create_subscription(spec()).unwrap()));
        }
        sessions.push(session);
    }
    know_all(&sessions, total, || {});
}

/// Creates one node as ROS 2 does, in one of `processes` processes.
pub(super) fn play_node(processes: usize) {
    let session = session();
    let name = format!("node{}", std::process::id());
    let node = session.create_node(&name, "/", "/").unwrap();
    let spec =
        |topic: String, kind: &str, qos| EndpointSpec::new(topic, kind, qos).type_hash(vec![7; 32]);
    let deep = Qos::default().with_depth(1000);
    let latched = deep.with_durability(Durability::TransientLocal);
    let _log = node.create_publisher(spec("/rosout".into(), "rcl_interfaces/msg/Log", latched));
    let services: Vec<_> = SERVICES
        .map(|service| {
            let kind = format!("rcl_interfaces/srv/{service}");
            node.create_server(spec(format!("/{name}/{service}"), &kind, deep)).unwrap()
        })
        .into();
    let events = || spec("/parameter_events".into(), "rcl_interfaces/msg/ParameterEvent", deep);
    let sends = node.create_publisher(events()).unwrap();
    let hears = node.create_subscription(events()).unwrap();
    let own = || spec(format!("/{name}/topic"), "std_msgs/msg/String", Qos::default());
    let topic = (node.create_publisher(own()).unwrap(), node.create_subscription(own()).unwrap());
    know_all(std::slice::from_ref(&session), processes * OF_NODE, || {
        assert!(sends.wait_matched(processes, PATIENCE));
        assert!(hears.wait_matched(processes, PATIENCE));
    });
    drop((services, topic));
}

/// Reports when each session knows `total` endpoints and is `matched`, and when it does again with
/// another daemon.
fn know_all(sessions: &[Session], total: usize, matched: impl Fn()) {
    say("created");
    for session in sessions {
        assert!(session.wait_graph(PATIENCE, |graph| graph.endpoints.len() == total));
    }
    matched();
    let before: Vec<_> = sessions.iter().map(|s| (s.daemon(), s.graph())).collect();
    say("whole");
    for (session, (daemon, _)) in sessions.iter().zip(&before) {
        // Without polling, because the processes must be at rest.
        let another = || session.daemon().is_some_and(|now| Some(now) != *daemon);
        assert!(session.wait_graph(PATIENCE, |_| another()));
    }
    say("found");
    for (session, (_, before)) in sessions.iter().zip(&before) {
        // The new daemon reported each of them again.
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
    matched();
    say("whole again");
    wait_for_the_end();
}

/// Returns the processor time in seconds that the threads of a process have used.
fn processor(pid: u32) -> f64 {
    let tasks = fs::read_dir(format!("/proc/{pid}/task")).unwrap();
    let nanoseconds = tasks.map(|task| {
        // A thread that ends meanwhile has none.
        let path = task.unwrap().path().join("schedstat");
        let text = fs::read_to_string(path).unwrap_or_default();
        text.split(' ').next().and_then(|run| run.parse::<u64>().ok()).unwrap_or(0)
    });
    nanoseconds.sum::<u64>() as f64 / 1e9
}

fn processor_of_all(players: &[Player]) -> f64 {
    players.iter().map(|player| processor(player.pid())).sum()
}

/// Returns the private memory of a process in KiB.
fn private(pid: u32) -> u64 {
    let rollup = fs::read_to_string(format!("/proc/{pid}/smaps_rollup")).unwrap();
    let of = |name: &str| {
        let line = rollup.lines().find_map(|line| line.strip_prefix(name)).unwrap();
        line.trim().trim_end_matches(" kB").parse::<u64>().unwrap()
    };
    of("Private_Clean:") + of("Private_Dirty:")
}

/// Returns the number of descriptors of a process.
fn descriptors(pid: u32) -> usize {
    fs::read_dir(format!("/proc/{pid}/fd")).unwrap().count()
}

/// The cost until all knew all, and the resources and the load after that.
struct Whole {
    /// Time until all knew all.
    time: Duration,
    /// Processor time in seconds until then: of the daemon, and of the others.
    processor: [f64; 2],
    traffic: TrafficStatus,
    /// Private memory in KiB: of the daemon, and the largest of the others.
    memory: [u64; 2],
    /// Number of descriptors: of the daemon, and the largest of the others.
    descriptors: [usize; 2],
    /// Share of one processor while nothing happens: of the daemon, and of all others together.
    at_rest: [f64; 2],
}

impl Whole {
    /// Measures players that know all, `time` after the event that started it. `before` is the
    /// processor time of the others at that event.
    fn look(host: &Host, players: &[Player], time: Duration, before: f64) -> Self {
        let daemon = host.status().unwrap();
        let worked = || [processor(daemon.pid), processor_of_all(players)];
        let [of_daemon, of_all] = worked();
        let most = |of: fn(u32) -> u64| players.iter().map(|one| of(one.pid())).max().unwrap();
        let descriptors = [descriptors(daemon.pid), most(|pid| descriptors(pid) as u64) as usize];
        let memory = [private(daemon.pid), most(private)];
        std::thread::sleep(REST);
        let resting = worked();
        std::thread::sleep(REST);
        let rested = worked();
        let share = |of: usize| 100.0 * (rested[of] - resting[of]) / REST.as_secs_f64();
        Self {
            time,
            processor: [of_daemon, of_all - before],
            traffic: daemon.traffic,
            memory,
            descriptors,
            at_rest: [share(0), share(1)],
        }
    }
}

/// Prints a table of both.
fn print(start: &Whole, again: &Whole) {
    let row = |name: &str, of: &dyn Fn(&Whole) -> String| {
        println!("| {name:<38} | {:>9} | {:>9} |", of(start), of(again));
    };
    row("", &|whole| if std::ptr::eq(whole, start) { "start" } else { "kill" }.into());
    println!("| {:-<38} | {:->9} | {:->9} |", "", ":", ":");
    row("all know all after", &|whole| format!("{:.2} s", whole.time.as_secs_f64()));
    row("processor of the daemon until then", &|whole| format!("{:.2} s", whole.processor[0]));
    row("and of the others", &|whole| format!("{:.2} s", whole.processor[1]));
    row("packets to the daemon", &|whole| whole.traffic.packets_in.to_string());
    row("packets from it", &|whole| whole.traffic.packets_out.to_string());
    row("bytes from it", &|whole| format!("{:.1} MB", whole.traffic.bytes_out as f64 / 1e6));
    row("memory of a process, the most", &|whole| format!("{} KiB", whole.memory[1]));
    row("memory of the daemon", &|whole| format!("{} KiB", whole.memory[0]));
    row("descriptors of a process, the most", &|whole| whole.descriptors[1].to_string());
    row("descriptors of the daemon", &|whole| whole.descriptors[0].to_string());
    row("daemon at rest, of one processor", &|whole| format!("{:.2} %", whole.at_rest[0]));
    row("all others at rest", &|whole| format!("{:.2} %", whole.at_rest[1]));
}

/// Starts `processes` processes that play `part`, and kills the daemon once all know all.
fn measure(processes: usize, part: &str) {
    let host = Host::new().with("AXON_LOG", "warn");
    let mut daemon = host.daemon();
    let mut players: Vec<_> = (0..processes).map(|_| host.play(part)).collect();
    let all = |players: &mut [Player], what: &str| {
        players.iter_mut().for_each(|player| assert_eq!(player.hear(), what));
        Instant::now()
    };
    let begun = Instant::now();
    let created = all(&mut players, "created");
    let whole = all(&mut players, "whole");
    let start = Whole::look(&host, &players, whole - created, 0.0);
    let before = processor_of_all(&players);
    daemon.0.kill().unwrap();
    daemon.0.wait().unwrap();
    // One of them starts the next daemon.
    let killed = Instant::now();
    let found = all(&mut players, "found");
    let whole_again = all(&mut players, "whole again");
    let again = Whole::look(&host, &players, whole_again - killed, before);
    println!(
        "all was created after {:.2} s; after the kill a new daemon was found by all after {:.2} s",
        (created - begun).as_secs_f64(),
        (found - killed).as_secs_f64(),
    );
    print(&start, &again);
    players.into_iter().for_each(Player::finish);
}

#[test]
fn every_session_of_many_knows_all_endpoints() {
    if std::env::var("PLAY").is_ok() {
        return;
    }
    let processes = super::size(4);
    let total = processes * SESSIONS * 2 * TOPICS;
    println!("{processes} processes, {SESSIONS} sessions each, {total} endpoints in all:");
    measure(processes, &format!("sessions {total}"));
}

#[test]
fn every_node_of_many_knows_all_and_hears_from_all() {
    if std::env::var("PLAY").is_ok() {
        return;
    }
    let processes = super::size(6);
    println!(
        "{processes} processes of a ROS 2 node each, {} endpoints in all:",
        processes * OF_NODE
    );
    measure(processes, &format!("node {processes}"));
}
