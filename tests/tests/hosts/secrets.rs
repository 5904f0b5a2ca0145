//! Tests what hundreds of keys leave in the memory of the daemons that used them.
//!
//! The tests search for each KME key, raw, as base64, and in the forms in which SHA-256 and HMAC handle it. They search
//! for the keys that HKDF extracts from it for the PSK, the READY proof and the envelope, for the PSK, for the secrets
//! of TLS that depend on nothing else, and for the key of the READY proof. For each connection in `psk_ke`, whose
//! handshake is [`recorded`](super::recorded), they search for all secrets of TLS, the keys of QUIC's packets and
//! headers, and the daemon's exported secrets. They also search for the AEAD key of each KME key in both directions,
//! with its key of GHASH and the masks of its tags, whose nonces are read from the recorded packets. The module `dhe`
//! searches for the secrets of a connection in `psk_dhe_ke`.

use std::{
    cell::RefCell,
    collections::BTreeSet,
    thread,
    time::{Duration, Instant},
};

use axon_tests::{
    Sizes,
    memory::{Find, Needles, Stopped},
    unexpected,
};
use axon_tls::Cipher;
use rustix::process::Signal;

use super::{
    cut::wired,
    mode::{Kmes, SAE},
    pair::{Host, signal},
    process::{Node, PATIENCE, until},
    recorded::{self, IN_USE, Nonces, USED_UP},
    wire::Wire,
};

/// Duration of the message flow between two searches.
const FLOW: Duration = Duration::from_millis(500);

fn length_prefixed(names: &[&[u8]]) -> Vec<u8> {
    let mut info = Vec::new();
    for name in names {
        info.extend_from_slice(&(name.len() as u16).to_be_bytes());
        info.extend_from_slice(name);
    }
    info
}

/// Two hosts with a wire between them.
struct Hosts {
    hosts: [Host; 2],
    wire: Wire,
    kmes: Kmes,
    /// Whether the recorded handshakes reveal the secrets of connections.
    recorded: bool,
    /// The nonces of the envelopes in the recorded packets, and whether there are any.
    nonces: RefCell<Nonces>,
    reads_nonces: bool,
}

/// The objects of a search.
struct Sought {
    needles: Needles,
    /// Keys that were drawn so far.
    drawn: usize,
    /// Keys whose nonces are known.
    with_nonces: usize,
    /// Connections that were established so far, and that were recorded.
    connections: usize,
    /// The numbers of the spent keys.
    spent: BTreeSet<usize>,
}

/// The findings, permitted or not.
#[derive(Default)]
struct Found {
    wrong: usize,
    /// Permitted findings that are text of the KME's answers, and the maximum number of keys of which one daemon has
    /// such text.
    texts: usize,
    keys_in_text: usize,
    on_stacks: usize,
    /// KME keys that wait for their use, or that the cipher of envelopes has.
    held: BTreeSet<usize>,
    /// Connections of which there are secrets.
    connections: BTreeSet<usize>,
    /// Number of processes that have the cipher of envelopes, and number of those that have secrets of connections.
    with_ciphers: usize,
    with_connections: usize,
    /// Findings of connections, or of the ciphers of their envelopes.
    of_connections: Vec<Find>,
}

const AEAD: &str = "AEAD key";
const GHASH: &str = "GHASH key";
/// A mask is needed only while an envelope is sealed or opened.
const MASK: &str = "tag mask";
const TEXT: &str = "KME key, base64";
/// Maximum number of keys whose text one daemon has while messages flow: the keys of the last answers of each
/// connection to the KME. A daemon has up to eight connections.
const KEYS_IN_TEXT: usize = 32;

/// Returns whether a finding is permitted. Keys that wait for their use are only in locked memory. Ciphers and the
/// secrets of a connection are in use.
fn is_allowed(find: &Find) -> bool {
    match find.secret.kind {
        "KME key" => find.guarded,
        AEAD | GHASH | IN_USE => !find.on_stack,
        _ => false,
    }
}

impl Hosts {
    fn start(settings: &[(&'static str, &str)], recorded: bool) -> Self {
        let kmes = Kmes::start();
        let (hosts, wire) = wired([0, 1].map(|host| kmes.settings(host, settings)));
        let reads_nonces = settings.contains(&("AXON_QKD_KEY_MODE", "messages10"));
        if reads_nonces {
            wire.remember_data();
        }
        Self { hosts, wire, kmes, recorded, nonces: RefCell::default(), reads_nonces }
    }

    /// Returns each key drawn so far, all secrets that a daemon derives from one, and the secrets of the recorded
    /// connections.
    fn sought(&self) -> Sought {
        let mut needles = Needles::default();
        let drawn = self.kmes.drawn();
        let connections = match self.recorded {
            true => recorded::connections(&self.wire, Cipher::default(), &drawn, None),
            false => Vec::new(),
        };
        for (number, connection) in connections.iter().enumerate() {
            connection.add_to(&mut needles, number);
        }
        let mut nonces = self.nonces.borrow_mut();
        nonces.read(&self.wire, Cipher::default(), &connections);
        let mut with_nonces = 0;
        for (number, (key_id, key)) in drawn.iter().enumerate() {
            let prefix = nonces.prefix(key_id);
            with_nonces += usize::from(prefix.is_some());
            needles.add_key(number, key);
            needles.add_derived("READY key", number, None, key, &[b"axon ready"]);
            needles.add_extracted(number, Some(b"AXQKD001"), key);
            for [first, second] in [SAE, [SAE[1], SAE[0]]] {
                let names = [key_id.as_str(), first, second, "SHA256"].map(str::as_bytes);
                let salt = b"AXON-QKD-TLS13-EXTERNAL-PSK-v1";
                let info = length_prefixed(&names);
                let psk = needles.add_derived("PSK", number, Some(salt), key, &[&info]);
                needles.add_tls_secrets(number, &psk);
                for connection in &connections {
                    let fields = [b"seal", names[0], names[1], names[2], &connection.context];
                    let info = length_prefixed(&fields);
                    let aead = needles.add_derived(AEAD, number, Some(b"AXQKD001"), key, &[&info]);
                    needles.add_ghash_key(GHASH, number, &aead);
                    if let Some(prefix) = prefix {
                        needles.add_tag_masks(MASK, number, &aead, prefix);
                    }
                }
            }
        }
        let is_spent = |key_id: &String| connections.iter().any(|c| c.key_id == *key_id);
        let spent = (0..drawn.len()).filter(|number| is_spent(&drawn[*number].0)).collect();
        Sought { needles, drawn: drawn.len(), with_nonces, connections: connections.len(), spent }
    }

    /// Searches the daemons of these hosts, and these applications, in which there must be no finding.
    fn search(&self, hosts: &[Host], applications: &[&Node]) -> (Sought, Found) {
        let pids: Vec<u32> = hosts.iter().map(|host| host.status().pid).collect();
        // All, or the one that runs on would find the other silent.
        let stopped: Vec<_> = pids.iter().map(|pid| Stopped::new(*pid).unwrap()).collect();
        let applications = applications.iter().map(|node| Stopped::new(node.pid()).unwrap());
        let applications: Vec<_> = applications.collect();
        let sought = self.sought();
        let mut all = Found::default();
        let is_of_connection = |find: &Find| match find.secret.kind {
            "PSK" => sought.spent.contains(&find.secret.number),
            kind => [IN_USE, USED_UP, AEAD, GHASH, MASK].contains(&kind),
        };
        for process in &stopped {
            let found = process.search(&sought.needles).unwrap();
            all.wrong += unexpected("a daemon", &found, is_allowed);
            all.of_connections.extend(found.iter().filter(|find| is_of_connection(find)).cloned());
            let texts = || found.iter().filter(|find| find.secret.kind == TEXT);
            let keys: BTreeSet<_> = texts().map(|find| find.secret.number).collect();
            all.texts += texts().count();
            all.keys_in_text = all.keys_in_text.max(keys.len());
            all.on_stacks += found.iter().filter(|find| find.on_stack).count();
            let of = |kinds: &[&str]| -> BTreeSet<usize> {
                let allowed = found.iter().filter(|find| is_allowed(find));
                allowed
                    .map(|find| find.secret)
                    .filter(|s| kinds.contains(&s.kind))
                    .map(|s| s.number)
                    .collect()
            };
            all.held.extend(of(&["KME key", AEAD, GHASH]));
            all.with_ciphers += usize::from(!of(&[AEAD]).is_empty());
            let connections = of(&[IN_USE]);
            all.with_connections += usize::from(!connections.is_empty());
            all.connections.extend(connections);
        }
        for process in &applications {
            let found = process.search(&sought.needles).unwrap();
            all.wrong += unexpected("an application", &found, |_| false);
            all.on_stacks += found.iter().filter(|find| find.on_stack).count();
        }
        (sought, all)
    }

    /// Searches while messages flow, until only secrets in use are found. A process that is stopped in the middle of a
    /// derivation has its input on the stack. Text of the KME's answers disappears only when new answers come. Neither
    /// occurs in each search, or lasts for long.
    fn wait_clean(&self, applications: [&Node; 2]) {
        let deadline = Instant::now() + PATIENCE;
        loop {
            thread::sleep(FLOW);
            let (Sought { drawn, connections, with_nonces, .. }, found) =
                self.search(&self.hosts, &applications);
            let (wrong, on_stacks) = (found.wrong - found.texts, found.on_stacks);
            let in_use = (found.with_connections, found.with_ciphers);
            eprintln!(
                "{drawn} keys were drawn, of {with_nonces} nonces were read, {connections} connections were \
                 recorded: {in_use:?}"
            );
            assert!(
                found.keys_in_text <= KEYS_IN_TEXT,
                "the text of {} keys of {drawn} is left",
                found.keys_in_text
            );
            let are_many = drawn > 2 * KEYS_IN_TEXT && with_nonces > 0;
            if (wrong, on_stacks, in_use) == (0, 0, (2, 2)) && are_many {
                break;
            }
            let left = (wrong, on_stacks, in_use);
            assert!(Instant::now() < deadline, "while messages flow: {left:?}");
        }
    }

    /// Searches until nothing is left of the `spent()` spent keys and of ended connections. Locked memory may hold the
    /// other keys, and secrets of the current connection may remain.
    fn wait_erased(&self, applications: [&Node; 2], spent: impl Fn() -> u64) {
        let deadline = Instant::now() + PATIENCE;
        loop {
            let spent = spent();
            let (Sought { drawn, connections, with_nonces, .. }, found) =
                self.search(&self.hosts, &applications);
            let (held, stand) = (found.held.len(), found.connections.len());
            eprintln!(
                "{drawn} keys were drawn, {spent} are spent, {held} are held; {connections} connections were \
                 recorded, {stand} are held; of {with_nonces} keys nonces were read"
            );
            // Only the work that used a stack erases it, at once.
            assert_eq!(found.on_stacks, 0, "parts of secrets are left on stacks");
            // An answer of the KME stays in its connection's buffers until that is closed as idle.
            // Or the masks of their tags were not searched for.
            let are_read = !self.reads_nonces || 2 * with_nonces as u64 >= spent;
            if spent > 0
                && are_read
                && found.wrong == 0
                && held as u64 <= drawn as u64 - spent
                && stand <= 1
            {
                // Or the search finds nothing.
                assert!(!self.recorded || found.with_connections == 2);
                break;
            }
            assert!(Instant::now() < deadline, "{} parts of secrets are left behind", found.wrong);
            thread::sleep(Duration::from_secs(2));
        }
    }

    /// Ends one of the daemons, and searches the other until nothing is left of any connection, nor of the ciphers of its
    /// envelopes.
    fn wait_ended(mut self, ends: usize) {
        let mut daemon = self.hosts[ends].daemon.take().unwrap();
        signal(daemon.0.id(), Signal::TERM);
        daemon.0.wait().unwrap();
        let deadline = Instant::now() + PATIENCE;
        loop {
            let stays = &self.hosts[1 - ends..2 - ends];
            let (_, found) = self.search(stays, &[]);
            assert_eq!(found.on_stacks, 0, "parts of secrets are left on stacks");
            let left = unexpected("of links that ended", &found.of_connections, |_| false);
            if left == 0 {
                break;
            }
            assert!(Instant::now() < deadline, "{left} parts of secrets of links that ended");
            thread::sleep(Duration::from_secs(2));
        }
    }
}

/// Returns the number of messages that were sealed under keys which are gone.
fn retired(host: &Host) -> u64 {
    let keys = host.status().keys;
    let peers = keys["peers"].as_object().unwrap();
    peers.values().map(|peer| peer["sending"]["retired"].as_u64().unwrap()).sum()
}

pub(crate) fn may_search() -> bool {
    let root = rustix::process::geteuid().is_root();
    if !root {
        eprintln!("skipped: only root may read the memory of a process that is not dumpable");
    }
    root
}

/// Tests `messages10`. At the end the daemon of host `ends` ends.
fn in_messages10(ends: usize) {
    if !may_search() {
        return;
    }
    let all = Hosts::start(&[("AXON_QKD_KEY_MODE", "messages10")], true);
    let [a, b] = &all.hosts;
    let mut there = b.subscribe(Sizes::Small);
    let mut publisher = a.publish(Sizes::Small, 1, None);
    there.wait_taken(1);
    all.wait_clean([&publisher, &there]);
    let sent = publisher.stop();
    there.wait_taken(sent);
    // The status is a little behind.
    all.wait_erased([&publisher, &there], || {
        let spent = all.hosts.iter().map(retired).sum();
        if spent >= sent / 10 - 1 { spent } else { 0 }
    });
    for node in [publisher, there] {
        node.finish();
    }
    all.wait_ended(ends);
}

#[test]
fn in_messages10_keys_are_in_locked_memory_or_in_use_and_spent_ones_nowhere() {
    in_messages10(0);
}

#[test]
fn in_messages10_ciphers_of_a_link_that_ended_are_nowhere_at_its_sender() {
    in_messages10(1);
}

/// Tests `session`: links are renewed under new keys while samples flow, and each link spends its key.
fn in_session(kex: &str) {
    if !may_search() {
        return;
    }
    let settings = [
        ("AXON_QKD_KEY_MODE", "session"),
        ("AXON_QKD_KEX", kex),
        // A KME's connection is closed as idle after four seconds.
        ("AXON_QKD_SESSION_MAX_AGE", "20"),
    ];
    let all = Hosts::start(&settings, kex == "psk_ke");
    let [a, b] = &all.hosts;
    let mut there = b.subscribe(Sizes::Small);
    let mut publisher = a.publish(Sizes::Small, 1, None);
    there.wait_taken(1);
    let mut links = BTreeSet::new();
    until("there was a third link", || {
        links.extend(b.status().links.first().map(|link| link.since));
        links.len() >= 3
    });
    all.wait_erased([&publisher, &there], || links.len() as u64);
    let sent = publisher.stop();
    there.wait_taken(sent);
    for node in [publisher, there] {
        node.finish();
    }
    all.wait_ended(0);
}

#[test]
fn in_session_with_psk_ke_spent_and_derived_keys_are_erased() {
    in_session("psk_ke");
}

#[test]
fn in_session_with_psk_dhe_ke_spent_and_derived_keys_are_erased() {
    in_session("psk_dhe_ke");
}
