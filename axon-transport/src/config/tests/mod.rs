//! Accepted settings and their values.

use std::{
    collections::BTreeMap,
    ffi::OsString,
    io,
    os::unix::ffi::OsStringExt,
    path::{Path, PathBuf},
    time::Duration,
};

use proptest::prelude::*;

use super::*;

mod builder;
mod daemon_location;
mod refused;

/// A file system in memory, so that any bytes may name files in it.
#[derive(Default)]
struct Disk(BTreeMap<PathBuf, (u32, Vec<u8>)>);

impl Disk {
    fn new() -> Self {
        let mut disk = Self::default();
        for public in ["/f/ca.pem", "/f/cert.pem", "/f/trust", "/f/crl.pem"] {
            disk.put(public, 0o644, public);
        }
        disk.put("/f/key.pem", 0o600, "secret");
        disk.put("/f/open-key.pem", 0o640, "secret");
        disk.put("/f/anyone-writes", 0o666, "");
        disk.put("/f/daemon", 0o755, "");
        disk
    }

    fn put(&mut self, path: &str, mode: u32, text: &str) {
        self.0.insert(path.into(), (mode, text.into()));
    }

    fn find(&self, path: &Path) -> io::Result<&(u32, Vec<u8>)> {
        self.0.get(path).ok_or_else(|| io::ErrorKind::NotFound.into())
    }
}

impl Files for Disk {
    fn read(&self, path: &Path) -> io::Result<Vec<u8>> {
        Ok(self.find(path)?.1.clone())
    }

    fn facts(&self, path: &Path) -> io::Result<FileFacts> {
        if path == Path::new("/f") {
            return Ok(FileFacts { kind: FileKind::Directory, mode: 0o755 });
        }
        let mode = self.find(path)?.0;
        Ok(FileFacts { kind: FileKind::Regular, mode })
    }

    fn readable(&self, path: &Path) -> io::Result<()> {
        let (_, bytes) = self.find(path)?;
        assert_ne!(bytes, b"secret", "validation never opens a private key");
        Ok(())
    }

    fn current_dir(&self) -> io::Result<PathBuf> {
        Ok("/f".into())
    }
}

const QKD: &[(&str, &str)] = &[
    ("AXON_SECURITY_MODE", "qkd"),
    ("AXON_QKD_PEERS", "sae-b;sae-c"),
    ("AXON_KME_URL", "https://kme-a.example:8443/prefix"),
    ("AXON_KME_CA", "/f/ca.pem"),
    ("AXON_SAE_ID", "sae-a"),
    ("AXON_SAE_CERT", "/f/cert.pem"),
    ("AXON_SAE_KEY", "/f/key.pem"),
];
const PINNED: &[(&str, &str)] =
    &[("AXON_CLASSIC_KEY", "/f/key.pem"), ("AXON_CLASSIC_TRUST", "/f/trust")];
const CA: &[(&str, &str)] = &[
    ("AXON_CLASSIC_AUTH", "ca"),
    ("AXON_CLASSIC_KEY", "/f/key.pem"),
    ("AXON_CLASSIC_CA", "/f/ca.pem"),
    ("AXON_CLASSIC_CERT", "/f/cert.pem"),
];

fn pairs(env: &[(&str, &str)]) -> Vec<(OsString, OsString)> {
    env.iter().map(|(name, value)| (name.into(), value.into())).collect()
}

/// `base` with `change` on top of it; an empty name changes nothing.
fn resolve(base: &[(&str, &str)], change: &[(&str, &str)]) -> Result<Config, ConfigError> {
    let env: BTreeMap<_, _> = pairs(base).into_iter().chain(pairs(change)).collect();
    Config::resolve(env, None, &Disk::new())
}

fn with_file(env: &[(&str, &str)], toml: &str) -> Result<Config, ConfigError> {
    let mut disk = Disk::new();
    disk.put("/f/axon.toml", 0o644, toml);
    Config::resolve(pairs(env), Some(Path::new("/f/axon.toml")), &disk)
}

fn qkd(config: &Config) -> &QkdConfig {
    match &config.security {
        Security::Qkd(qkd) => qkd,
        Security::Classic(_) => panic!("classic"),
    }
}

fn classic(config: &Config) -> &ClassicConfig {
    match &config.security {
        Security::Classic(classic) => classic,
        Security::Qkd(_) => panic!("qkd"),
    }
}

#[test]
fn nothing_given_is_the_table_of_defaults() {
    let config = resolve(&[], &[]).unwrap();
    assert_eq!(classic(&config).auth, ClassicAuth::None);
    assert_eq!(config.cipher, QuicCipher::ChaCha20Poly1305);
    assert_eq!((config.domain, config.range), (0, DiscoveryRange::Subnet));
    assert_eq!(config.daemon, DaemonPolicy::Spawn);
    assert_eq!((config.runtime_dir.clone(), config.socket_in_runtime_dir), (None, false));
    assert!(config.bind_addrs.is_empty() && config.daemon_peers.is_empty());
    assert_eq!(config.ring_bytes, 64 << 20);
    assert_eq!((config.max_message, config.reliable_queue), (256 << 20, 256 << 20));
    assert!(!config.shm_copy && config.trusted_uids.is_empty());
    assert_eq!(config.log, "warn");
    assert_eq!(
        config.link,
        LinkConfig {
            grace: Duration::from_secs(10),
            stalled: Duration::from_secs(10),
            mtu: 1452,
            graph: 16 << 20,
            held: 2 << 30,
            poll: LinkPoll::Adaptive,
            qlog: None,
            congestion: Congestion::Auto,
            compression: LinkCompression::Auto,
            paths: 1,
        }
    );
    assert!(config.warnings().iter().any(|w| w.contains("not authenticated")));

    let config = resolve(QKD, &[]).unwrap();
    let qkd = qkd(&config);
    assert_eq!((qkd.key_mode, qkd.kex), (KeyMode::Messages10, QkdKex::PskKe));
    assert_eq!(qkd.session_max_age, Duration::from_secs(3600));
    assert_eq!(qkd.peers, QkdPeers::Listed(vec!["sae-b".into(), "sae-c".into()]));
    assert!(qkd.kme_id.is_none() && qkd.kme_quirks.is_empty());
    assert_eq!((qkd.kme_connect_timeout.as_secs(), qkd.kme_answer_timeout.as_secs()), (2, 3));

    assert_eq!(classic(&resolve(PINNED, &[]).unwrap()).auth, ClassicAuth::Pinned);
    let ca = resolve(CA, &[("AXON_CLASSIC_CRL", "crl.pem")]).unwrap();
    assert_eq!(classic(&ca).crl, Some("/f/crl.pem".into()), "relative to the current directory");
}

#[test]
fn every_setting_takes_effect() {
    let config = resolve(
        QKD,
        &[
            ("AXON_QKD_KEY_MODE", "session"),
            ("AXON_QKD_KEX", "psk_dhe_ke"),
            ("AXON_QKD_PEERS", "*"),
            ("AXON_QKD_SESSION_MAX_AGE", "86400"),
            ("AXON_QUIC_CIPHER", "aes-256-gcm"),
            ("AXON_KME_ID", "KME A"),
            ("AXON_KME_QUIRKS", "null-members,any-key-id"),
            ("AXON_KME_CONNECT_TIMEOUT", "4"),
            ("AXON_KME_ANSWER_TIMEOUT", "7"),
            ("AXON_DAEMON", "require"),
            ("AXON_DAEMON_PATH", "daemon"),
            ("AXON_RUNTIME_DIR", "/f/created/later"),
            ("AXON_BIND_ADDRS", "127.0.0.2; ::1"),
            ("AXON_DAEMON_PEERS", "robot-1;10.0.0.7:61400,fe80::1,[::1]:9,host_a.lan.:7"),
            ("AXON_ADVERTISE_ADDRS", "192.0.2.1"),
            ("AXON_RING_BUFFER_SIZE_MB", "1"),
            ("AXON_MAX_MESSAGE_MB", "4095"),
            ("AXON_RELIABLE_QUEUE_MB", "2"),
            ("AXON_SHM", "off"),
            ("AXON_SHM_COPY", "1"),
            ("AXON_TRUSTED_UIDS", "0;1000"),
            ("AXON_LOG", "info,axon_transport::link=trace"),
            ("ROS_DOMAIN_ID", "232"),
            ("ROS_STATIC_PEERS", "10.1.1.1;robot-2;"),
            ("XDG_RUNTIME_DIR", "/run/user/1"),
        ],
    )
    .unwrap();
    let of_qkd = qkd(&config);
    assert_eq!((of_qkd.key_mode, of_qkd.kex), (KeyMode::Session, QkdKex::PskDheKe));
    assert_eq!((&of_qkd.peers, of_qkd.session_max_age.as_secs()), (&QkdPeers::Any, 86_400));
    assert_eq!(of_qkd.kme_id.as_deref(), Some("KME A"));
    assert_eq!(of_qkd.kme_quirks, ["any-key-id", "null-members"]);
    assert_eq!((of_qkd.kme_connect_timeout.as_secs(), of_qkd.kme_answer_timeout.as_secs()), (4, 7));
    assert_eq!(config.cipher, QuicCipher::Aes256Gcm);
    assert_eq!(config.daemon, DaemonPolicy::Require);
    assert_eq!(config.daemon_path, Some("/f/daemon".into()));
    assert_eq!(config.runtime_dir, Some("/f/created/later".into()));
    assert!(config.socket_in_runtime_dir);
    assert_eq!(config.bind_addrs.len(), 2);
    let peer = |host: &str, port| PeerAddress { host: host.into(), port };
    assert_eq!(
        config.daemon_peers,
        [
            peer("robot-1", None),
            peer("10.0.0.7", Some(61400)),
            peer("fe80::1", None),
            peer("::1", Some(9)),
            peer("host_a.lan.", Some(7)),
        ]
    );
    assert_eq!(config.advertise_addrs.len(), 1);
    assert_eq!(config.ring_bytes, 1 << 20);
    assert_eq!((config.max_message, config.reliable_queue), (4095 << 20, 2 << 20));
    assert!(config.shm_copy);
    assert_eq!(config.trusted_uids, [0, 1000]);
    assert_eq!(config.log, "info,axon_transport::link=trace");
    assert_eq!((config.domain, config.static_peers.len()), (232, 2));
    assert!(config.warnings().iter().any(|w| w.contains("AXON_QKD_PEERS")));
}

#[test]
fn discovery_range_is_as_rcl_resolves_it() {
    let peers = ("ROS_STATIC_PEERS", "a;b");
    for (env, range, count) in [
        (vec![], DiscoveryRange::Subnet, 2),
        (vec![("ROS_AUTOMATIC_DISCOVERY_RANGE", "")], DiscoveryRange::Subnet, 2),
        (vec![("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")], DiscoveryRange::Localhost, 2),
        (vec![("ROS_AUTOMATIC_DISCOVERY_RANGE", "SYSTEM_DEFAULT")], DiscoveryRange::Subnet, 0),
        (vec![("ROS_AUTOMATIC_DISCOVERY_RANGE", "OFF")], DiscoveryRange::Off, 0),
        (
            vec![("ROS_AUTOMATIC_DISCOVERY_RANGE", "SUBNET"), ("ROS_LOCALHOST_ONLY", "1")],
            DiscoveryRange::Localhost,
            0,
        ),
    ] {
        let config = resolve(&[peers], &env).unwrap();
        assert_eq!((config.range, config.static_peers.len()), (range, count), "{env:?}");
    }
}

#[test]
fn the_environment_wins_over_the_file() {
    let file = "
        security_mode = 'qkd'
        qkd_peers = ['sae-b', 'sae-c']
        kme_url = 'https://kme'
        kme_ca = 'ca.pem'
        sae_id = 'sae-a'
        sae_cert = '/f/cert.pem'
        sae_key = 'key.pem'
        shm_copy = true
        ring_buffer_size_mb = 8
        daemon_peers = ['robot-1', '[::1]:9']
        trusted_uids = [7]
        [link]
        grace_s = 3
        stalled_s = 4
        mtu = 9000
        graph_mb = 4
        held_mb = 32
        poll = 'always'
        qlog = '/var/qlog'
        congestion = 'bbr'
        compression = 'never'
        paths = 2
    ";
    let config = with_file(&[], file).unwrap();
    assert_eq!(qkd(&config).peers.to_string(), "sae-b;sae-c");
    assert_eq!(qkd(&config).kme_ca, Path::new("/f/ca.pem"), "relative to the file");
    assert!(config.shm_copy);
    assert_eq!((config.ring_bytes, config.trusted_uids.len()), (8 << 20, 1));
    assert_eq!(config.daemon_peers.len(), 2);
    assert_eq!(
        config.link,
        LinkConfig {
            grace: Duration::from_secs(3),
            stalled: Duration::from_secs(4),
            mtu: 9000,
            graph: 4 << 20,
            held: 32 << 20,
            poll: LinkPoll::Always,
            qlog: Some("/var/qlog".into()),
            congestion: Congestion::Bbr,
            compression: LinkCompression::Never,
            paths: 2,
        }
    );

    let config =
        with_file(&[("AXON_RING_BUFFER_SIZE_MB", "9"), ("AXON_DAEMON_PEERS", "")], file).unwrap();
    assert_eq!((config.ring_bytes, config.daemon_peers.len()), (9 << 20, 0));

    // Turning the mode off by the environment leaves the file's material without effect.
    let error = with_file(&[("AXON_SECURITY_MODE", "classic")], file).unwrap_err();
    assert!(error.to_string().contains("in /f/axon.toml"), "{error}");
}

#[test]
fn the_section_of_qkd_counts_in_qkd_alone() {
    let section = "
        [qkd]
        qkd_peers = ['sae-b']
        qkd_key_mode = 'session'
        kme_url = 'https://kme'
        kme_ca = 'ca.pem'
        sae_id = 'sae-a'
        sae_cert = 'cert.pem'
        sae_key = 'key.pem'
    ";
    let file = format!("security_mode = 'qkd'\n{section}");
    let config = with_file(&[], &file).unwrap();
    assert_eq!(qkd(&config).sae_key, Path::new("/f/key.pem"), "relative to the file");
    assert_eq!(qkd(&config).key_mode, KeyMode::Session);
    let config = with_file(&[("AXON_QKD_KEY_MODE", "messages10")], &file).unwrap();
    assert_eq!(qkd(&config).key_mode, KeyMode::Messages10, "the environment wins");
    let config = with_file(&[("AXON_SECURITY_MODE", "classic")], &file).unwrap();
    assert_eq!(classic(&config).auth, ClassicAuth::None);
    let error =
        with_file(&[("AXON_SECURITY_MODE", "classic"), ("AXON_SAE_ID", "a")], &file).unwrap_err();
    assert_eq!(error.variable(), "AXON_SAE_ID", "what the environment says is never ignored");

    // The environment or the file must set the mode: the user who wrote the section expects it to apply.
    for section in [section, "[qkd]"] {
        let error = with_file(&[], section).unwrap_err();
        assert_eq!(error.variable(), "AXON_SECURITY_MODE");
        assert!(error.accepted().contains("security_mode"), "{error}");
    }
    classic(&with_file(&[("AXON_SECURITY_MODE", "classic")], section).unwrap());
    qkd(&with_file(&[("AXON_SECURITY_MODE", "qkd")], section).unwrap());
}

#[test]
fn real_files_are_judged_as_they_are() {
    use std::os::unix::fs::PermissionsExt;
    let dir = tempfile::tempdir().unwrap();
    let path = |name: &str| dir.path().join(name).into_os_string();
    let write = |name: &str, mode| {
        std::fs::write(path(name), name).unwrap();
        std::fs::set_permissions(path(name), std::fs::Permissions::from_mode(mode)).unwrap();
    };
    write("key", 0o600);
    write("trust", 0o644);
    let env = |key: &str| {
        [("AXON_CLASSIC_KEY".into(), path(key)), ("AXON_CLASSIC_TRUST".into(), path("trust"))]
    };
    let config = Config::resolve(env("key"), None, &OsFiles).unwrap();
    let before = security_settings(&config).unwrap();
    assert!(before.contains(&("AXON_CLASSIC_AUTH".into(), "pinned".into())));
    let digest = "sha256:";
    assert!(before.iter().any(|(name, v)| name == "AXON_CLASSIC_TRUST" && v.starts_with(digest)));
    assert!(!before.iter().any(|(name, _)| name == "AXON_CLASSIC_KEY"), "keys stay out");
    std::fs::write(path("trust"), "changed").unwrap();
    assert_ne!(security_settings(&config).unwrap(), before);
    std::fs::remove_file(path("trust")).unwrap();
    assert_eq!(security_settings(&config).unwrap_err().variable(), "AXON_CLASSIC_TRUST");

    write("trust", 0o644);
    std::fs::set_permissions(path("key"), std::fs::Permissions::from_mode(0o604)).unwrap();
    let error = Config::resolve(env("key"), None, &OsFiles).unwrap_err();
    assert!(error.to_string().contains("0604"), "{error}");

    // A pipe in a file's place neither hangs nor passes; no file is one that is empty.
    let config =
        |path: OsString| Config::resolve([("AXON_CONFIG".into(), path)], None, &OsFiles).map(drop);
    let fifo = dir.path().join("fifo");
    rustix::fs::mkfifoat(rustix::fs::CWD, &fifo, rustix::fs::Mode::RWXU).unwrap();
    assert!(config(fifo.into()).is_err());
    assert!(config("/dev/zero".into()).is_err());
    assert!(config("/dev/null".into()).is_ok());
}

#[test]
fn summaries_differ_exactly_where_settings_do() {
    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join("public.pem");
    std::fs::write(&file, "certificate").unwrap();
    let file = file.to_str().unwrap();
    let mut config = resolve(QKD, &[]).unwrap();
    if let Security::Qkd(qkd) = &mut config.security {
        qkd.kme_ca = file.into();
        qkd.sae_cert = file.into();
    }
    let settings = security_settings(&config).unwrap();
    for (name, _) in QKD.iter().filter(|(name, _)| *name != "AXON_SAE_KEY") {
        assert!(settings.iter().any(|(n, v)| n == name && !v.is_empty()), "{name}");
    }
    let mut other = config.clone();
    if let Security::Qkd(qkd) = &mut other.security {
        qkd.peers = QkdPeers::Listed(vec!["sae-c".into(), "sae-b".into()]);
        qkd.sae_key = "/elsewhere".into();
    }
    assert_eq!(security_settings(&other).unwrap(), settings, "order of peers is no difference");
    if let Security::Qkd(qkd) = &mut other.security {
        qkd.key_mode = KeyMode::Session;
    }
    let differ: Vec<_> = security_settings(&other)
        .unwrap()
        .into_iter()
        .zip(settings)
        .filter(|(a, b)| a != b)
        .map(|(a, _)| a.0)
        .collect();
    assert_eq!(differ, ["AXON_QKD_KEY_MODE"]);
}

fn names_and_noise() -> impl Strategy<Value = Vec<u8>> {
    let names = names::SETTINGS.iter().chain(names::LINK);
    let known = names.map(|name| name.as_bytes().to_vec()).collect::<Vec<_>>();
    prop_oneof![
        6 => proptest::sample::select(known),
        1 => proptest::sample::select(vec![&b"AXON_CONFIG"[..], b"ROS_DOMAIN_ID", b"ROS_STATIC_PEERS"])
            .prop_map(<[u8]>::to_vec),
        1 => proptest::collection::vec(any::<u8>(), 0..12),
    ]
}

fn values() -> impl Strategy<Value = Vec<u8>> {
    let good =
        ["qkd", "classic", "*", "sae-b", "/f/key.pem", "/f/ca.pem", "1", "ca", "pinned", "::1"];
    prop_oneof![
        2 => proptest::sample::select(good.map(|v| v.as_bytes().to_vec()).to_vec()),
        1 => proptest::collection::vec(any::<u8>(), 0..40),
        1 => "[ -~]{0,40}".prop_map(String::into_bytes),
    ]
}

proptest! {
    #[test]
    fn no_environment_makes_it_panic_or_say_two_lines(
        env in proptest::collection::vec((names_and_noise(), values()), 0..8),
        file in proptest::option::of("[a-z_\\[\\]='\"0-9\n ]{0,60}"),
    ) {
        let mut disk = Disk::new();
        // A setting may name the key as a file that is read, such as that of access rules.
        disk.put("/f/key.pem", 0o600, "no rules");
        if let Some(text) = &file {
            disk.put("/f/axon.toml", 0o644, text);
        }
        let env = env.into_iter().map(|(n, v)| (OsString::from_vec(n), OsString::from_vec(v)));
        if let Err(error) = Config::resolve(env, Some(Path::new("/f/axon.toml")), &disk) {
            prop_assert!(!error.to_string().contains(['\n', '\r', '\x1b']));
            prop_assert!(!error.variable().is_empty());
        }
    }
}

#[test]
fn the_first_entry_of_a_topic_counts() {
    let config = with_file(
        &[],
        r#"
        [[topic]]
        name = "/camera/front/**"
        priority = "high"

        [[topic]]
        name = "/camera/**"
        priority = "low"

        [[topic]]
        name = "/tf"
        max_hz = 12.5
        redundant = false
        "#,
    )
    .unwrap();
    let limits = ["/tf", "/scan"].map(|name| config.topic_limit(name).map(|l| l.to_string()));
    assert_eq!(limits, [Some("12.5 a second, drop-oldest".to_owned()), None]);
    for (name, priority) in [
        ("/camera/front/image", TopicPriority::High),
        ("/camera/rear/image", TopicPriority::Low),
        ("/tf", TopicPriority::Normal),
        ("/scan", TopicPriority::Normal),
    ] {
        assert_eq!(config.topic_priority(name), priority, "{name}");
        assert_eq!(config.topic_redundancy(name), name != "/tf", "{name}");
    }
}

/// A copy of a sample uses up a tenth of a KME key.
#[test]
fn messages10_sends_copies_only_where_a_topic_asks_for_them() {
    for (mode, default) in [("session", true), ("messages10", false)] {
        let rules = "
            [[topic]]
            name = '/yes'
            redundant = true

            [[topic]]
            name = '/no'
            redundant = false

            [[topic]]
            name = '/either'
            priority = 'high'
        ";
        let mut variables = QKD.to_vec();
        variables.push(("AXON_QKD_KEY_MODE", mode));
        let config = with_file(&variables, rules).unwrap();
        let expected = [("/yes", true), ("/no", false), ("/either", default), ("/other", default)];
        for (name, redundant) in expected {
            assert_eq!(config.topic_redundancy(name), redundant, "{mode}, {name}");
        }
    }
}
