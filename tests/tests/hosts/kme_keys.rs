//! Tests which secrets the TLS connection to a KME leaves in the memory of a daemon: traffic secrets, and keys of its
//! ciphers.
//!
//! The KMEs run in this process, and their TLS library reveals the secrets (`KeyLog`). While a connection stands its
//! secrets must be in memory: that they are found shows that the search works. They are on no stack. Once the
//! connection is closed as idle they are nowhere: neither in the heap, nor in freed heap, nor on stacks.

use std::{
    collections::BTreeSet,
    thread,
    time::{Duration, Instant},
};

use axon_tests::{
    Sizes,
    memory::{Find, Needles, Stopped},
};
use rustix::process::Signal;

use super::{
    link_memory::wait_until_nowhere,
    mode::Kmes,
    pair::{Host, Plan, signal},
    process::PATIENCE,
    secrets::may_search,
    traffic_keys::expand,
};

const MESSAGES: u64 = 1_000;
/// No call begins or ends for so long: the thread of the KME client waits.
const QUIET: Duration = Duration::from_millis(200);
/// Searches while a connection stands.
const SEARCHES: usize = 5;

/// Returns all secrets that TLS derives from those of all connections so far.
fn needles(kmes: &Kmes) -> Needles {
    let mut needles = Needles::default();
    for (number, (label, secret)) in kmes.tls_secrets().iter().enumerate() {
        let kinds = match label.as_str() {
            "CLIENT_HANDSHAKE_TRAFFIC_SECRET" | "SERVER_HANDSHAKE_TRAFFIC_SECRET" => {
                ["handshake traffic secret", "handshake key"]
            }
            "CLIENT_TRAFFIC_SECRET_0" | "SERVER_TRAFFIC_SECRET_0" => ["traffic secret", "key"],
            "EXPORTER_SECRET" => {
                needles.add("exporter secret", number, secret);
                continue;
            }
            other => panic!("{other} is none of TLS 1.3"),
        };
        needles.add(kinds[0], number, secret);
        needles.add(kinds[1], number, &expand(secret, "key", 32));
    }
    needles
}

/// Searches a daemon in a moment in which its KME client waits.
fn search(kmes: &Kmes, host: &Host) -> Vec<Find> {
    let pid = host.status().pid;
    let begin = Instant::now();
    let (stopped, needles) = loop {
        let calls = kmes.calls();
        thread::sleep(QUIET);
        let stopped = Stopped::new(pid).unwrap();
        let needles = needles(kmes);
        if kmes.calls() == calls {
            break (stopped, needles);
        }
        assert!(begin.elapsed() < PATIENCE, "calls without end");
    };
    let found = stopped.search(&needles).unwrap();
    let on_stacks: Vec<_> = found.iter().filter(|find| find.on_stack).collect();
    assert!(on_stacks.is_empty(), "parts of secrets on stacks: {on_stacks:?}");
    found
}

#[test]
fn secrets_of_the_kme_connection_are_erased() {
    if !may_search() {
        return;
    }
    let kmes = Kmes::start();
    let more = [("AXON_QKD_KEY_MODE", "messages10")];
    let hosts = Plan::new([0, 1].map(|host| kmes.settings(host, &more))).start();
    let mut there = hosts[1].subscribe(Sizes::Small);
    let mut publisher = hosts[0].publish(Sizes::Small, 1, None);
    let mut kinds = BTreeSet::new();
    for _ in 0..SEARCHES {
        let taken = there.tally().taken;
        there.wait_taken(taken + MESSAGES / SEARCHES as u64);
        // Without it there are calls without end.
        signal(publisher.pid(), Signal::STOP);
        for host in &hosts {
            kinds.extend(search(&kmes, host).iter().map(|find| find.secret.kind));
        }
        signal(publisher.pid(), Signal::CONT);
    }
    eprintln!("while connections stand, in live memory: {kinds:?}");
    assert!(kinds.contains("traffic secret"), "the search finds nothing: {kinds:?}");
    let sent = publisher.stop();
    there.wait_taken(sent);
    for host in &hosts {
        wait_until_nowhere("KME", || search(&kmes, host));
    }
    assert_eq!(there.tally().lost, 0);
}

#[test]
fn a_daemon_without_lockable_memory_warns_once_with_effect_and_remedy() {
    let kmes = Kmes::start();
    let [mut host, _other] = Plan::new([0, 1].map(|host| kmes.settings(host, &[]))).prepare();
    host.start_by("ulimit -l 0");
    let warned = || host.all_logs().matches("RLIMIT_MEMLOCK").count();
    let log = host.all_logs();
    assert_eq!(warned(), 1, "{log}");
    for part in ["mlock", "swap", "LimitMEMLOCK=", "ulimit -l"] {
        assert!(log.contains(part), "{part} is not in {log}");
    }
}
