//! What hundreds of keys leave behind in the memory of the daemons that used them.
//!
//! Searched for: each KME key, raw, as base64, and in the forms in which SHA-256 and HMAC handle it;
//! what HKDF extracts from it for the PSK, the READY proof and the envelope; the PSK and the key of
//! the READY proof. The envelope's AEAD key depends on an exporter of the connection, which this test
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
    process::PATIENCE,
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
            needles.add_derived("PSK", number, Some(salt), key, &[&length_prefixed(names)]);
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

#[test]
fn keys_are_in_locked_memory_alone_and_spent_ones_nowhere() {
    if !rustix::process::geteuid().is_root() {
        eprintln!("skipped: only root may read the memory of a process that is not dumpable");
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

    let deadline = Instant::now() + PATIENCE;
    loop {
        let pids = hosts.each_ref().map(|host| host.status().pid);
        let spent: u64 = hosts.iter().map(retired).sum();
        // Both, or the one that runs on would find the other silent.
        let stopped = pids.map(|pid| Stopped::new(pid).unwrap());
        let applications = [&publisher, &there].map(|node| Stopped::new(node.pid()).unwrap());
        let (drawn, needles) = needles(&kmes);
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
        // The status is a little behind. An answer of the KME stays in its connection's buffers until
        // that is closed as idle.
        let are_spent = spent >= MESSAGES / 10 - 1;
        if are_spent && wrong == 0 && !held.is_empty() && held.len() as u64 <= drawn as u64 - spent
        {
            break;
        }
        assert!(Instant::now() < deadline, "{wrong} parts of secrets are left behind");
        thread::sleep(Duration::from_secs(2));
    }
    for node in [publisher, there] {
        node.finish();
    }
}
