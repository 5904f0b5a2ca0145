use std::{
    fs,
    os::unix::fs::PermissionsExt,
    path::{Path, PathBuf},
    time::{Duration, Instant, SystemTime},
};

use axon_tls::identity::{KeyAlgorithm, SigningKey, SpkiDigest, TrustFile};
use axon_transport::config::ClassicAuth;

use super::*;

/// The files of a pinned host, and the identity that watches them.
struct Host {
    dir: tempfile::TempDir,
    identity: Identity,
    now: Instant,
}

fn write(path: &Path, content: impl AsRef<[u8]>, mode: u32) {
    fs::write(path, content).unwrap();
    fs::set_permissions(path, fs::Permissions::from_mode(mode)).unwrap();
}

fn pin(byte: u8) -> SpkiDigest {
    SpkiDigest([byte; 32])
}

fn line(byte: u8) -> String {
    format!("arm-{byte} {}\n", pin(byte))
}

fn key() -> zeroize::Zeroizing<String> {
    SigningKey::generate_pem_with(KeyAlgorithm::Ed25519).unwrap()
}

fn config(dir: &Path) -> ClassicConfig {
    let mut config = ClassicConfig::new(ClassicAuth::Pinned);
    [config.key, config.trust] = ["key", "trust"].map(|name| Some(dir.join(name)));
    config
}

impl Host {
    fn new(trust: impl AsRef<[u8]>) -> Self {
        let dir = tempfile::tempdir().unwrap();
        write(&dir.path().join("key"), key().as_bytes(), 0o600);
        write(&dir.path().join("trust"), trust, 0o644);
        let identity = Identity::load(&config(dir.path()), "node").unwrap();
        Self { dir, identity, now: Instant::now() }
    }

    fn file(&self, name: &str) -> PathBuf {
        self.dir.path().join(name)
    }

    fn look(&mut self) -> bool {
        self.now += Duration::from_millis(250);
        self.identity.look(self.now)
    }

    /// Looks at the files four times, as often as in a second. Returns whether a look saw a change.
    fn second(&mut self) -> bool {
        (0..4).map(|_| self.look()).filter(|changed| *changed).count() > 0
    }

    fn trusts(&self, byte: u8) -> bool {
        let Auth::Pinned { trust, .. } = self.identity.auth() else { unreachable!() };
        trust.name_of(&pin(byte)).is_some()
    }

    fn key(&self) -> SpkiDigest {
        let Auth::Pinned { key, .. } = self.identity.auth() else { unreachable!() };
        key.spki_digest()
    }

    #[track_caller]
    fn closed_for(&self, said: &[&str]) {
        let why = self.identity.closed().expect("closed to new links");
        assert!(said.iter().all(|said| why.contains(said)), "{said:?}: {why}");
    }
}

#[test]
fn a_rewrite_of_the_same_size_and_time_is_seen() {
    let mut host = Host::new(line(1));
    let trust = host.file("trust");
    let written = fs::metadata(&trust).unwrap().modified().unwrap();
    assert!(!host.second() && host.trusts(1));
    fs::write(&trust, line(2)).unwrap();
    fs::File::options().append(true).open(&trust).unwrap().set_modified(written).unwrap();
    assert_eq!(fs::metadata(&trust).unwrap().modified().unwrap(), written);
    assert!(host.second());
    assert!(!host.trusts(1) && host.trusts(2));
}

#[test]
fn two_writes_in_one_moment_are_told_apart() {
    let mut host = Host::new(line(1));
    let trust = host.file("trust");
    let moment = SystemTime::UNIX_EPOCH + Duration::from_secs(1_000_000_000);
    for byte in 2..50 {
        // Two writes follow each other as fast as possible: they differ only in the content, and at most by one tick of
        // the clock.
        fs::write(&trust, line(byte % 9)).unwrap();
        host.look();
        fs::write(&trust, line(byte % 7)).unwrap();
        fs::File::options().append(true).open(&trust).unwrap().set_modified(moment).unwrap();
        host.look();
        // A look is a quarter of a second after the last one; a tick is a hundredth at most.
        std::thread::sleep(Duration::from_millis(12));
        host.second();
        assert!(host.trusts(byte % 7), "write {byte}");
    }
}

#[test]
fn another_file_in_its_place_is_seen() {
    let mut host = Host::new(line(1));
    let (trust, new) = (host.file("trust"), host.file("new"));
    let written = fs::metadata(&trust).unwrap().modified().unwrap();
    write(&new, line(2), 0o644);
    fs::File::options().append(true).open(&new).unwrap().set_modified(written).unwrap();
    fs::rename(&new, &trust).unwrap();
    assert!(host.second());
    assert!(!host.trusts(1) && host.trusts(2));
}

#[test]
fn a_missing_trust_file_admits_no_new_peer_and_keeps_known_peers() {
    let mut host = Host::new(line(1));
    fs::remove_file(host.file("trust")).unwrap();
    assert!(host.second());
    host.closed_for(&["AXON_CLASSIC_TRUST", host.file("trust").to_str().unwrap(), "No such file"]);
    assert!(host.trusts(1), "nothing says that this pin was removed");
    assert!(!host.second(), "said once");

    write(&host.file("trust"), line(2), 0o644);
    assert!(host.second());
    assert_eq!(host.identity.closed(), None);
    assert!(!host.trusts(1) && host.trusts(2));
}

#[test]
fn trust_file_errors_name_the_line() {
    let mut host = Host::new(line(1));
    let trust = host.file("trust");
    let garbage = [line(1), "arm-2 spki-sha256:AAAA\n".into()].concat();
    for (content, said) in [
        (garbage.as_bytes(), "line 2"),
        (b"\xff\xfe", "UTF-8"),
        (&[b'#'; TrustFile::MAX_LEN + 1], "larger than 1024 KiB"),
    ] {
        fs::write(&trust, content).unwrap();
        assert!(host.second());
        host.closed_for(&["AXON_CLASSIC_TRUST", said]);
        assert!(host.trusts(1));
        fs::write(&trust, line(1)).unwrap();
        assert!(host.second());
        assert_eq!(host.identity.closed(), None);
    }
    fs::write(&trust, "").unwrap();
    assert!(host.second());
    assert!(host.identity.closed().is_none() && !host.trusts(1), "an empty file trusts nobody");
}

#[test]
fn world_writable_and_irregular_trust_files_are_refused() {
    let mut host = Host::new(line(1));
    let trust = host.file("trust");
    write(&trust, line(2), 0o646);
    assert!(host.second());
    host.closed_for(&["everybody may write it"]);
    assert!(!host.trusts(2));

    fs::remove_file(&trust).unwrap();
    fs::create_dir(&trust).unwrap();
    host.second();
    host.closed_for(&["not a regular file"]);
    fs::remove_dir(&trust).unwrap();
    // Opening the file for reading would wait for a writer, for ever.
    let (cwd, mode) = (rustix::fs::CWD, rustix::fs::Mode::from_raw_mode(0o600));
    rustix::fs::mkfifoat(cwd, &trust, mode).unwrap();
    host.second();
    host.closed_for(&["not a regular file"]);
    fs::remove_file(&trust).unwrap();
    std::os::unix::fs::symlink("/dev/zero", &trust).unwrap();
    host.second();
    host.closed_for(&["not a regular file"]);
}

#[test]
fn a_file_is_not_read_while_it_is_written() {
    let mut host = Host::new(line(1) + &line(2));
    let trust = host.file("trust");
    // The file is truncated, then half written, then complete, with a look after each step.
    for part in ["", &line(2), &(line(2) + &line(3)), &(line(2) + &line(3) + &line(4))] {
        fs::write(&trust, part).unwrap();
        assert!(!host.look(), "{part:?}");
        assert!(host.trusts(1) && host.trusts(2) && !host.trusts(3), "{part:?}");
    }
    assert!(host.look());
    assert!(!host.trusts(1) && host.trusts(2) && host.trusts(4));
}

#[test]
fn a_trust_file_that_keeps_changing_closes_the_identity() {
    let mut host = Host::new(line(1));
    let trust = host.file("trust");
    let mut closed = None;
    for round in 0..40_usize {
        fs::write(&trust, "#".repeat(round)).unwrap();
        host.look();
        if host.identity.closed().is_some() {
            closed = Some(closed.unwrap_or(round));
        }
    }
    let closed = closed.expect("closed");
    assert!((15..25).contains(&closed), "after some 5 s: {closed}");
    host.closed_for(&["keep changing"]);
    fs::write(&trust, line(2)).unwrap();
    assert!(host.second());
    assert!(host.identity.closed().is_none() && host.trusts(2) && !host.trusts(1));
}

#[test]
fn another_key_is_taken_up_and_one_that_others_may_read_is_not() {
    let mut host = Host::new(line(1));
    let before = host.key();
    let pem = key();
    let after = SigningKey::from_pem(&pem).unwrap().spki_digest();
    write(&host.file("key"), pem.as_bytes(), 0o644);
    assert!(host.second());
    host.closed_for(&["AXON_CLASSIC_KEY", "0644", "chmod 600"]);
    assert_eq!(host.key(), before);
    write(&host.file("key"), pem.as_bytes(), 0o600);
    assert!(host.second());
    assert_eq!((host.key(), host.identity.closed()), (after, None));

    write(&host.file("key"), "hunter2", 0o600);
    assert!(host.second());
    host.closed_for(&["AXON_CLASSIC_KEY", "PRIVATE KEY"]);
    assert!(!host.identity.closed().unwrap().contains("hunter2"));
    write(&host.file("key"), [b'A'; (64 << 10) + 1], 0o600);
    assert!(host.second());
    host.closed_for(&["larger than 64 KiB"]);
}

#[test]
fn handshakes_under_way_know_the_new_pins() {
    let mut host = Host::new(line(1));
    let Auth::Pinned { trust, .. } = host.identity.auth() else { unreachable!() };
    fs::write(host.file("trust"), line(2)).unwrap();
    assert!(host.second());
    assert_eq!(trust.name_of(&pin(1)), None);
    assert_eq!(trust.name_of(&pin(2)).as_deref(), Some("arm-2"));
}

#[test]
fn a_file_that_cannot_be_used_at_the_start_is_named() {
    let dir = tempfile::tempdir().unwrap();
    let load = || Identity::load(&config(dir.path()), "node").err().map(|e| e.to_string());
    let says = |said: &str| {
        let error = load().expect("an error");
        assert!(error.contains(said), "{error}");
    };
    says("AXON_CLASSIC_KEY");
    write(&dir.path().join("key"), "no key", 0o600);
    says("AXON_CLASSIC_KEY");
    write(&dir.path().join("key"), key().as_bytes(), 0o600);
    says("AXON_CLASSIC_TRUST");
    write(&dir.path().join("trust"), "arm-2", 0o600);
    says("AXON_CLASSIC_TRUST");
    write(&dir.path().join("trust"), line(1), 0o600);
    assert_eq!(load(), None);
}

#[test]
fn without_files_there_is_nothing_to_look_at() {
    let identity = Identity::load(&ClassicConfig::new(ClassicAuth::None), "node").unwrap();
    assert!(!identity.has_files());
    assert!(!identity.look(Instant::now()));
}
