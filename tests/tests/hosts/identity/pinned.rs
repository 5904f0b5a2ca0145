//! Pinned keys: rotation without a restart, removal, and strangers.

use std::{
    fs,
    path::{Path, PathBuf},
};

use axon_tests::Sizes;
use axon_tls::identity::{Auth, KeyAlgorithm, SigningKey, SpkiDigest, Trust, TrustFile};

use super::super::{
    mode::pinned,
    pair::{Host, Plan, write_key},
    process::until,
    stranger::{Claim, Stranger},
};

const EACH_OTHER: [[bool; 2]; 2] = [[false, true], [true, false]];

fn trust_of(dir: &Path, host: usize) -> PathBuf {
    dir.join(format!("host-{host}.trust"))
}

/// Returns the line of a trust file for the key in a file.
fn line(name: &str, key: &Path) -> String {
    let key = SigningKey::from_pem(&fs::read_to_string(key).unwrap()).unwrap();
    format!("{name} {}\n", key.spki_digest())
}

/// Creates another key in `dir`, not yet in use.
fn new_key(dir: &Path) -> PathBuf {
    let path = dir.join("new.key");
    let pem = SigningKey::generate_pem_with(KeyAlgorithm::Ed25519).unwrap();
    write_key(&path, &pem);
    path
}

/// Replaces the file by a rename, as a careful administrator does.
fn replace(path: &Path, content: &str) {
    let new = path.with_extension("new");
    fs::write(&new, content).unwrap();
    fs::rename(new, path).unwrap();
}

fn wait_key(host: &Host, key: &str) {
    until("a link under the key", || {
        let links = host.status().links;
        links.iter().any(|l| l.state == "connected" && l.authenticated_as.contains(key))
    });
}

fn digest(line: &str) -> String {
    let digest: SpkiDigest = line.split_whitespace().nth(1).unwrap().parse().unwrap();
    digest.to_string()
}

#[test]
fn a_key_is_changed_while_both_daemons_run() {
    let dir = tempfile::tempdir().unwrap();
    let [a, b] = Plan::new(pinned(dir.path(), EACH_OTHER)).start();
    let (trust, key) = (trust_of(dir.path(), 0), dir.path().join("host-1.key"));
    let (old, new) = (line("host-1", &key), new_key(dir.path()));
    let new_line = line("host-1", &new);
    wait_key(&a, &digest(&old));
    let mut publisher = b.publish(Sizes::Small, 1, None);

    // The second pin; processes that start on this host from now on read the new file.
    replace(&trust, &(old.clone() + &new_line));
    let mut subscriber = a.subscribe(Sizes::Small);
    subscriber.wait_taken(50);
    // The key is swapped; the link stands under the old one.
    fs::rename(&new, &key).unwrap();
    b.wait_log(&["were read again"]);
    let on = publisher.published();
    subscriber.wait_taken(on + 50);
    assert!(a.link().authenticated_as.contains(&digest(&old)));
    // The first pin goes: the link does too, and comes again under the new key.
    replace(&trust, &new_line);
    wait_key(&a, &digest(&new_line));
    let on = publisher.published();
    subscriber.wait_taken(on + 50);
    a.wait_refusal("why the first link ended", |text| text.contains("no longer pinned"));
    assert!(a.is_first_daemon() && b.is_first_daemon());
}

#[test]
fn a_host_that_comes_back_with_another_key_of_its_name_is_itself() {
    let dir = tempfile::tempdir().unwrap();
    let [a, mut b] = Plan::new(pinned(dir.path(), EACH_OTHER)).start();
    let (trust, key) = (trust_of(dir.path(), 0), dir.path().join("host-1.key"));
    let (old, new) = (line("host-1", &key), new_key(dir.path()));
    let new_line = line("host-1", &new);
    replace(&trust, &(old + &new_line));
    a.link();
    let mut subscriber = a.subscribe(Sizes::Small);
    let mut publisher = b.publish(Sizes::Small, 1, None);
    subscriber.wait_taken(50);
    // The session on B starts another daemon when this one is gone.
    fs::rename(&new, &key).unwrap();
    b.kill_daemon();
    wait_key(&a, &digest(&new_line));
    let on = publisher.published();
    subscriber.wait_taken(on + 50);
    assert!(a.is_first_daemon());
}

#[test]
fn a_pin_that_is_removed_ends_the_link_and_the_next_dial() {
    let dir = tempfile::tempdir().unwrap();
    let hosts = Plan::new(pinned(dir.path(), EACH_OTHER)).start();
    let trust = trust_of(dir.path(), 0);
    let before = fs::read_to_string(&trust).unwrap();
    hosts.iter().for_each(|host| drop(host.link()));

    fs::write(&trust, "# nobody\n").unwrap();
    until("the link ends", || hosts.iter().all(|host| host.status().links.is_empty()));
    for host in &hosts {
        host.wait_refusal("why the link ended", |text| text.contains("no longer pinned"));
        host.wait_refusal("the next dial", |text| text.contains("trusted"));
        host.wait_log(&["link refused", "trusted"]);
    }
    assert!(hosts.iter().all(|host| host.status().links.is_empty()));
    fs::write(&trust, before).unwrap();
    for (number, host) in hosts.iter().enumerate() {
        // Rules about the name apply again.
        assert_eq!(host.link().party, format!("host-{}", 1 - number));
        assert!(host.is_first_daemon());
    }
}

#[test]
fn expired_pin_ends_the_link_and_the_next_dial_with_its_date() {
    let dir = tempfile::tempdir().unwrap();
    let hosts = Plan::new(pinned(dir.path(), EACH_OTHER)).start();
    let trust = trust_of(dir.path(), 0);
    let before = fs::read_to_string(&trust).unwrap();
    hosts.iter().for_each(|host| drop(host.link()));

    let dated = |line: &str| format!("{} 2024-02-29\n", line.trim_end());
    fs::write(&trust, before.lines().map(dated).collect::<String>()).unwrap();
    let [a, _b] = &hosts;
    a.wait_refusal("why the link ended", |text| text.contains("its last day is 2024-02-29 (UTC)"));
    a.wait_refusal("the next dial", |text| text.contains("in the trust file is 2024-02-29 (UTC)"));
    fs::write(&trust, before).unwrap();
    hosts.iter().for_each(|host| drop(host.link()));
}

#[test]
fn a_missing_trust_file_keeps_linked_peers_and_admits_no_new_peer() {
    let dir = tempfile::tempdir().unwrap();
    let [a, mut b] = Plan::new(pinned(dir.path(), EACH_OTHER)).start();
    let (trust, away) = (trust_of(dir.path(), 0), dir.path().join("away"));
    a.link();
    fs::rename(&trust, &away).unwrap();
    a.wait_log(&["no new link is accepted", "AXON_CLASSIC_TRUST", trust.to_str().unwrap()]);
    // Settings that name a file that is gone are no settings, so A cannot be asked meanwhile.
    assert_eq!(b.status().links.len(), 1, "nothing says that B was removed");
    b.kill_daemon();
    b.start();
    a.wait_log(&["peer refused", "AXON_CLASSIC_TRUST"]);
    b.wait_refusal("that nobody is let in", |text| text.contains("its log says more"));
    assert!(b.status().links.is_empty());
    fs::rename(&away, &trust).unwrap();
    a.link();
    b.link();
}

#[test]
fn strangers_get_no_link_and_pinned_peers_cannot_take_another_identity() {
    let dir = tempfile::tempdir().unwrap();
    let settings = pinned(dir.path(), EACH_OTHER);
    let camera = new_key(dir.path());
    let trust = trust_of(dir.path(), 0);
    let both = fs::read_to_string(&trust).unwrap() + &line("camera", &camera);
    fs::write(&trust, both).unwrap();
    let [a, b] = Plan::new(settings).start();
    let daemon = a.link().peer;
    // The owner's trust does not matter here, so it trusts any peer.
    let anybody = Trust::new(TrustFile::parse(&line("a", &dir.path().join("host-0.key"))).unwrap());
    let as_owner = |key: SigningKey| Auth::Pinned { key, trust: anybody.clone() };
    let stranger = Stranger::new();

    let nobody = as_owner(SigningKey::generate().unwrap());
    let why = stranger.dial(&a, &nobody, &Claim::pinned("host-1")).expect_err("no pin");
    assert!(why.contains("by peer"), "{why}");
    a.wait_refusal("A says so", |text| text.contains("trusted") && text.contains("unknown_ca"));
    let revealed = Auth::None(SigningKey::generate().unwrap());
    stranger.dial(&a, &revealed, &Claim::pinned("host-1")).expect_err("an ephemeral key");

    let camera = as_owner(SigningKey::from_pem(&fs::read_to_string(&camera).unwrap()).unwrap());
    // The id of another daemon is taken, for every peer that asks for it.
    let claim = Claim { daemon: super::daemon_id(&daemon), ..Claim::pinned("host-1") };
    let why = stranger.dial(&a, &camera, &claim).expect_err("B's id");
    assert!(why.contains("that of another host"), "{why}");
    // Under an id of its own the peer has the name of its pin, even if it states another one.
    let link = stranger.dial(&a, &camera, &Claim::pinned("host-1")).expect("a pinned key");
    until("A knows it by its pin", || {
        let links = a.status().links;
        links.iter().any(|l| l.host == "camera" && l.authenticated_as.starts_with("camera ("))
    });
    let links = a.status().links;
    assert_eq!(links.iter().filter(|l| l.host == "host-1").count(), 1, "{links:?}");
    stranger.leave(&link);
    b.link();
}
