//! What hundreds of keys leave behind in the memory of the daemons that used them.
//!
//! Searched for: each KME key, raw, as base64, and in the forms in which SHA-256 and HMAC handle it;
//! what HKDF extracts from it for the PSK, the READY proof and the envelope; the PSK, the secrets of TLS
//! that depend on nothing else, and the key of the READY proof. The envelope's AEAD key depends on an exporter of the connection, which this test
//! does not know: `tests/tests/residue` searches for it, and `tests/tests/tls_memory` for the secrets
//! of TLS.

use std::{
    collections::BTreeSet,
    thread,
    time::{Duration, Instant},
};

use axon_tests::{
    Sizes,
    memory::{Find, Needles, Stopped},
    unexpected,
};

use super::{
    mode::{Kmes, SAE},
    pair::{Host, Plan},
    process::{Node, PATIENCE, until},
};

/// Ten messages a key.
const MESSAGES: u64 = 3_000;

fn length_prefixed(names: [&[u8]; 4]) -> Vec<u8> {
    let mut info = Vec::new();
    for name in names {
        info.extend_from_slice(&(name.len() as u16).to_be_bytes());
        info.extend_from_slice(name);
    }
    info
}

/// Each key drawn so far, and all that a daemon derives of one without a secret of the connection.
fn needles(kmes: &Kmes) -> (usize, Needles) {
    let mut needles = Needles::default();
    let drawn = kmes.drawn();
    for (number, (key_id, key)) in drawn.iter().enumerate() {
        needles.add_key(number, key);
        needles.add_derived("READY key", number, None, key, &[b"axon ready"]);
        // The AEAD key depends on the connection; what it is expanded from does not.
        needles.add_extracted(number, Some(b"AXQKD001"), key);
        for [client, server] in [SAE, [SAE[1], SAE[0]]] {
            let names = [key_id.as_str(), client, server, "SHA256"].map(str::as_bytes);
            let salt = b"AXON-QKD-TLS13-EXTERNAL-PSK-v1";
            let info = length_prefixed(names);
            let psk = needles.add_derived("PSK", number, Some(salt), key, &[&info]);
            needles.add_tls_secrets(number, &psk);
        }
    }
    (drawn.len(), needles)
}

/// Messages that were sealed under keys which are no more.
fn retired(host: &Host) -> u64 {
    let keys = host.status().keys;
    let peers = keys["peers"].as_object().unwrap();
    peers.values().map(|peer| peer["sending"]["retired"].as_u64().unwrap()).sum()
}

/// Keys that wait for their use are in locked memory alone, and nothing else is anywhere.
fn is_allowed(find: &Find) -> bool {
    find.guarded && find.secret.kind == "KME key"
}

/// Searches the daemons and applications until nothing is left of `spent()` keys but what locked memory
/// holds of the others.
fn wait_erased(kmes: &Kmes, hosts: &[Host; 2], applications: [&Node; 2], spent: impl Fn() -> u64) {
    let deadline = Instant::now() + PATIENCE;
    loop {
        let pids = hosts.each_ref().map(|host| host.status().pid);
        let spent = spent();
        // Both, or the one that runs on would find the other silent.
        let stopped = pids.map(|pid| Stopped::new(pid).unwrap());
        let applications = applications.map(|node| Stopped::new(node.pid()).unwrap());
        let (drawn, needles) = needles(kmes);
        let (mut wrong, mut on_stacks) = (0, 0);
        let mut held = BTreeSet::new();
        for (name, process) in ["host A", "host B"].into_iter().zip(&stopped) {
            let found = process.search(&needles).unwrap();
            wrong += unexpected(name, &found, is_allowed);
            on_stacks += found.iter().filter(|find| find.on_stack).count();
            held.extend(found.iter().filter(|f| is_allowed(f)).map(|find| find.secret.number));
        }
        for process in &applications {
            let found = process.search(&needles).unwrap();
            wrong += unexpected("an application", &found, |_| false);
            on_stacks += found.iter().filter(|find| find.on_stack).count();
        }
        drop((stopped, applications));
        eprintln!("{drawn} keys were drawn, {spent} are spent, {} are held", held.len());
        // Nothing ever erases a stack but the work that used it, at once.
        assert_eq!(on_stacks, 0, "parts of secrets are left on stacks");
        // An answer of the KME stays in its connection's buffers until that is closed as idle.
        if spent > 0 && wrong == 0 && held.len() as u64 <= drawn as u64 - spent {
            break;
        }
        assert!(Instant::now() < deadline, "{wrong} parts of secrets are left behind");
        thread::sleep(Duration::from_secs(2));
    }
}

pub(crate) fn may_search() -> bool {
    let root = rustix::process::geteuid().is_root();
    if !root {
        eprintln!("skipped: only root may read the memory of a process that is not dumpable");
    }
    root
}

#[test]
fn in_messages10_keys_are_in_locked_memory_alone_and_spent_ones_nowhere() {
    if !may_search() {
        return;
    }
    let kmes = Kmes::start();
    let mode = [("AXON_QKD_KEY_MODE", "messages10")];
    let hosts = Plan::new([kmes.settings(0, &mode), kmes.settings(1, &mode)]).start();
    let [a, b] = &hosts;
    let mut there = b.subscribe(Sizes::Small);
    let mut publisher = a.publish(Sizes::Small, 1, Some(MESSAGES));
    publisher.wait_sent();
    there.wait_taken(MESSAGES);
    // The status is a little behind.
    wait_erased(&kmes, &hosts, [&publisher, &there], || {
        let spent = hosts.iter().map(retired).sum();
        if spent >= MESSAGES / 10 - 1 { spent } else { 0 }
    });
    for node in [publisher, there] {
        node.finish();
    }
}

/// Links are renewed under new keys while samples flow: the key of each of them is spent.
fn in_session(kex: &str) {
    if !may_search() {
        return;
    }
    let kmes = Kmes::start();
    let mode = [
        ("AXON_QKD_KEY_MODE", "session"),
        ("AXON_QKD_KEX", kex),
        // A KME's connection is closed as idle after four seconds.
        ("AXON_QKD_SESSION_MAX_AGE", "20"),
    ];
    let hosts = Plan::new([0, 1].map(|host| kmes.settings(host, &mode))).start();
    let [a, b] = &hosts;
    let mut there = b.subscribe(Sizes::Small);
    let mut publisher = a.publish(Sizes::Small, 1, None);
    there.wait_taken(1);
    let mut links = BTreeSet::new();
    until("there was a third link", || {
        links.extend(b.status().links.first().map(|link| link.since));
        links.len() >= 3
    });
    wait_erased(&kmes, &hosts, [&publisher, &there], || links.len() as u64);
    let sent = publisher.stop();
    there.wait_taken(sent);
    for node in [publisher, there] {
        node.finish();
    }
}

#[test]
fn in_session_with_psk_ke_spent_keys_and_what_was_derived_of_them_are_nowhere() {
    in_session("psk_ke");
}

#[test]
fn in_session_with_psk_dhe_ke_spent_keys_and_what_was_derived_of_them_are_nowhere() {
    in_session("psk_dhe_ke");
}
