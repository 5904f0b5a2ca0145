//! Refused settings and their error messages.

use std::os::unix::ffi::OsStringExt;

use super::*;

#[test]
fn obsolete_names_are_refused_first_and_their_values_stay_unsaid() {
    for name in ["AXON_SECURITY_PROFILE", "AXON_ENCRYPTION_MODE", "AXON_ENCRYPTION_KEY"] {
        for value in ["hunter2", ""] {
            let error = resolve(QKD, &[(name, value), ("AXON_AAA", "x")]).unwrap_err();
            assert_eq!(error.variable(), name);
            assert_eq!(error.read(), None);
            let line = error.to_string();
            assert!(!line.contains("hunter2"), "{line}");
            assert!(line.contains("AXON_SECURITY_MODE"), "says what takes its place: {line}");
        }
    }
    let error = with_file(&[], "encryption_key = \"hunter2\"").unwrap_err();
    assert_eq!(error.variable(), "AXON_ENCRYPTION_KEY");
    assert!(!error.to_string().contains("hunter2"));
}

#[test]
fn unknown_names_are_refused_with_the_nearest_known_one() {
    for (name, nearest) in [
        ("AXON_SECURITY_MOED", Some("AXON_SECURITY_MODE")),
        ("AXON_QKD_PEER", Some("AXON_QKD_PEERS")),
        ("AXON_KME_PASSWORD", None),
        ("AXON_CLASSIC_EVERYBODY", None),
        ("AXON_security_mode", None),
        ("AXON_STRICT_EMV", Some("AXON_STRICT_ENV")),
        ("AXON_MODE", None),
        ("AXON_TRUST", None),
        ("AXON_AUTH_MODE", None),
        ("AXON_CRL", None),
        ("AXON_KEY", None),
        ("AXON_CLASIC_TRUST_FILE", None),
        ("AXON_ENCRYPTION_KEYS", None),
        ("AXON_RMW_SECURTY_LEVEL", None),
    ] {
        let error = resolve(&[], &[(name, "hunter2")]).unwrap_err();
        assert_eq!(error.variable(), name);
        let line = error.to_string();
        assert!(!line.contains("hunter2"), "{line}");
        match nearest {
            Some(nearest) => assert!(line.contains(&format!("did you mean {nearest}?")), "{line}"),
            None => assert!(!line.contains("did you mean"), "{line}"),
        }
    }
    assert!(resolve(&[], &[("AXONX", "x"), ("axon_security_mode", "x")]).is_ok(), "not ours");
}

#[test]
fn foreign_names_are_ignored_with_a_warning_unless_the_environment_is_strict() {
    let foreign = [
        ("AXON_CI_JOB", "hunter2"),
        ("AXON_", "hunter2"),
        ("AXON_BENCH_SIZES", ""),
        ("AXON_FOO", ""),
    ];
    let config = resolve(&[], &foreign).unwrap();
    assert_eq!(config.unknown_variables, ["AXON_", "AXON_BENCH_SIZES", "AXON_CI_JOB", "AXON_FOO"]);
    let warnings = config.warnings().join("\n");
    assert!(warnings.contains("AXON_CI_JOB") && !warnings.contains("hunter2"), "{warnings}");
    let steering = resolve(&[], &[("AXON_X\n\u{1b}[2J", "x")]).unwrap().warnings().join(" ");
    assert!(steering.contains(r"AXON_X\n\u{1b}[2J"), "{steering}");
    assert!(resolve(&[], &[("AXON_STRICT_ENV", "0"), foreign[0]]).is_ok());
    for (name, value) in foreign {
        let error = resolve(&[], &[("AXON_STRICT_ENV", "1"), (name, value)]).unwrap_err();
        assert_eq!(error.variable(), name);
    }
    let error = resolve(&[], &[("AXON_STRICT_ENV", "yes")]).unwrap_err();
    assert_eq!((error.variable(), error.accepted()), ("AXON_STRICT_ENV", "0, 1"));
    let error = with_file(&[], "strict_env = 1").unwrap_err();
    assert_eq!(error.variable(), "AXON_STRICT_ENV");
    assert!(resolve(&[], &[]).unwrap().unknown_variables.is_empty());
}

#[test]
fn names_and_values_that_are_not_utf8_are_refused() {
    let bad = || OsString::from_vec(b"AXON_\xff".to_vec());
    let error = Config::resolve([(bad(), "x".into())], None, &Disk::new()).unwrap_err();
    assert!(error.variable().starts_with("AXON_"));
    for name in names::SETTINGS.iter().copied().chain(["AXON_CONFIG", "ROS_DOMAIN_ID"]) {
        let env = [(OsString::from(name), bad())];
        let error = Config::resolve(env, None, &Disk::new()).unwrap_err();
        assert_eq!(error.variable(), name);
        assert!(error.accepted().contains("UTF-8"));
    }
}

#[test]
fn empty_values_are_refused_but_for_lists_that_may_be_empty() {
    let may_be_empty =
        ["AXON_DAEMON_PEERS", "AXON_ADVERTISE_ADDRS", "AXON_TRUSTED_UIDS", "AXON_KME_QUIRKS"];
    for name in names::SETTINGS.iter().copied().chain(["AXON_CONFIG"]) {
        let base = if name.starts_with("AXON_CLASSIC") { CA } else { QKD };
        let result = resolve(base, &[(name, "")]);
        if may_be_empty.contains(&name) {
            assert!(result.is_ok(), "{name}");
        } else {
            assert_eq!(result.unwrap_err().variable(), name);
        }
    }
}

/// A base, a variable and values that it must not have in there.
type Refused = (&'static [(&'static str, &'static str)], &'static str, &'static [&'static str]);

#[test]
fn bad_values_are_refused_by_name() {
    let long = "x".repeat(64);
    let encoded = "/".repeat(27);
    let too_long: Vec<(&str, String)> = vec![
        ("AXON_SAE_ID", long.clone()),
        ("AXON_QKD_PEERS", long),
        ("AXON_SAE_ID", encoded),
        ("AXON_KME_ID", "x".repeat(129)),
        ("AXON_KME_URL", format!("https://a/{}", "x".repeat(2048))),
        ("AXON_RUNTIME_DIR", format!("/{}", "x".repeat(94))),
        ("AXON_DAEMON_PEERS", (0..65).map(|n| format!("h{n}")).collect::<Vec<_>>().join(";")),
        ("AXON_BIND_ADDRS", (0..17).map(|n| format!("10.0.0.{n}")).collect::<Vec<_>>().join(";")),
    ];
    for (name, value) in &too_long {
        assert_eq!(resolve(QKD, &[(name, value)]).unwrap_err().variable(), *name);
    }

    let table: &[Refused] = &[
        (&[], "AXON_SECURITY_MODE", &["QKD", "none", "classic ", "plaintext", "qkd;classic"]),
        (QKD, "AXON_QKD_KEY_MODE", &["messages", "message10", "Session", "session,messages10"]),
        (QKD, "AXON_QKD_KEX", &["psk", "psk-ke", "x25519"]),
        (
            QKD,
            "AXON_QKD_PEERS",
            &["sae-a", "sae-b;sae-a", "*;sae-b", "sae-b;", ";", "a b", "é", "**"],
        ),
        (
            QKD,
            "AXON_QKD_SESSION_MAX_AGE",
            &["0", "-1", "+5", "1h", "86401", "1e3", "99999999999999999999"],
        ),
        (QKD, "AXON_KME_CONNECT_TIMEOUT", &["0", "-1", "2s", "0.5", "4", "11"]),
        (QKD, "AXON_KME_ANSWER_TIMEOUT", &["0", "-1", "3s", "2.5", "11", "never"]),
        (&[], "AXON_QUIC_CIPHER", &["aes-128-gcm", "aes", "none", "CHACHA20"]),
        (&[], "AXON_CLASSIC_AUTH", &["tofu", "pin", "psk"]),
        (PINNED, "AXON_CLASSIC_KEY", &["/f/none", "/f", "/f/open-key.pem"]),
        (PINNED, "AXON_CLASSIC_TRUST", &["/f/none", "/f", "/f/anyone-writes"]),
        (CA, "AXON_CLASSIC_CA", &["/f/none", "/f"]),
        (CA, "AXON_CLASSIC_CERT", &["/f/none", "/f"]),
        (CA, "AXON_CLASSIC_CRL", &["/f/none", "/f"]),
        (
            QKD,
            "AXON_KME_URL",
            &[
                "http://kme",
                "kme",
                "https://",
                "https:///path",
                "https://a:0",
                "https://a:b",
                "https://u:hunter2@kme",
                "https://a/?q",
                "https://a/#f",
                "https://a b",
                "https://::1",
            ],
        ),
        (QKD, "AXON_KME_CA", &["/f/none", "/f"]),
        (QKD, "AXON_KME_ID", &["a\nb", "é"]),
        (
            QKD,
            "AXON_KME_QUIRKS",
            &["lenient", "any-key-id,", "any-key-id;lenient", "no-name-check"],
        ),
        (QKD, "AXON_SAE_ID", &["sae-b", "sae a", "*", "a;b", "a,b", "a\n", "é"]),
        (QKD, "AXON_SAE_CERT", &["/f/none", "/f", "/f/anyone-writes"]),
        (QKD, "AXON_SAE_KEY", &["/f/none", "/f", "/f/open-key.pem"]),
        (&[], "AXON_DAEMON", &["yes", "0", "Spawn"]),
        (&[], "AXON_DAEMON_PATH", &["/f/none", "/f", "/f/ca.pem"]),
        (&[], "AXON_RUNTIME_DIR", &["relative", "/f/ca.pem", "/a\0b"]),
        (&[], "AXON_BIND_ADDRS", &["0.0.0.0", "::", "eth0", "127.0.0.1:80", "239.1.1.1", " "]),
        (
            &[],
            "AXON_DAEMON_PEERS",
            &[
                "a b",
                "host:",
                "host:0",
                "host:65536",
                "host:+1",
                "[::1",
                "[::1]x",
                "10.0.0.256",
                "a..b",
                "x;;y",
            ],
        ),
        (&[], "AXON_ADVERTISE_ADDRS", &["::", "host", "1.1.1.1;1.1.1.2;1.1.1.3;1.1.1.4;1.1.1.5"]),
        (&[], "AXON_RING_BUFFER_SIZE_MB", &["0", "65537", "64M", "0x40", " 64"]),
        (&[], "AXON_MAX_MESSAGE_MB", &["0", "4096", "big"]),
        (&[], "AXON_RELIABLE_QUEUE_MB", &["0", "65537", "-1"]),
        (&[], "AXON_SHM", &["0", "no", "OFF"]),
        (&[], "AXON_SHM_COPY", &["2", "true", "yes"]),
        (&[], "AXON_TRUSTED_UIDS", &["root", "-1", "4294967296", "1;;2"]),
        (PINNED, "AXON_ACCESS_FILE", &["/f/none", "/f", "/f/anyone-writes", "/f/ca.pem"]),
        (&[], "AXON_LOG", &["loud", "axon=", "=info", "info,"]),
        (&[], "AXON_CONFIG", &["/f/none", "/f"]),
        (&[], "ROS_DOMAIN_ID", &["233", "-1", "x", "4294967296", " 1"]),
        (&[], "ROS_AUTOMATIC_DISCOVERY_RANGE", &["EVERYWHERE", "subnet"]),
        (&[], "ROS_STATIC_PEERS", &["host:80", "a b"]),
    ];
    for (base, name, values) in table {
        for value in *values {
            let error = resolve(base, &[(name, value)]).unwrap_err();
            // A peer that is this host's own SAE is the peers' defect, from whichever side it came.
            let own_peer = *name == "AXON_SAE_ID" && error.variable() == "AXON_QKD_PEERS";
            assert!(error.variable() == *name || own_peer, "{name}={value:?}: {error}");
            let line = error.to_string();
            assert!(!line.contains(['\n', '\r', '\0']), "{line:?}");
            assert!(!line.contains("hunter2"), "{line}");
        }
    }
    // Every setting is somewhere in the table.
    for name in names::SETTINGS {
        assert!(table.iter().any(|(_, tested, _)| tested == name), "{name} is untested");
    }
}

#[test]
fn a_mode_with_a_missing_setting_is_an_error() {
    for base in [QKD, PINNED, CA] {
        for (missing, _) in base {
            if ["AXON_SECURITY_MODE", "AXON_CLASSIC_AUTH"].contains(missing) {
                continue;
            }
            let rest: Vec<_> = base.iter().filter(|(name, _)| name != missing).copied().collect();
            let error = resolve(&rest, &[]).unwrap_err();
            assert_eq!(error.variable(), *missing);
            assert!(error.to_string().contains("not set"), "{error}");
        }
    }
}

#[test]
fn settings_of_another_mode_are_errors() {
    for (name, value) in QKD.iter().skip(1).chain(&[("AXON_QKD_KEX", "psk_ke")]) {
        let error = resolve(&[], &[(name, value)]).unwrap_err();
        assert_eq!(error.variable(), *name);
        assert!(error.accepted().contains("AXON_SECURITY_MODE=qkd"), "{error}");
    }
    for (name, value) in CA.iter().chain(PINNED) {
        assert_eq!(resolve(QKD, &[(name, value)]).unwrap_err().variable(), *name);
    }
    for (base, change, named) in [
        (PINNED, ("AXON_CLASSIC_AUTH", "none"), "AXON_CLASSIC_KEY"),
        (PINNED, ("AXON_CLASSIC_CA", "/f/ca.pem"), "AXON_CLASSIC_CA"),
        (CA, ("AXON_CLASSIC_TRUST", "/f/trust"), "AXON_CLASSIC_TRUST"),
        (CA, ("AXON_CLASSIC_AUTH", "pinned"), "AXON_CLASSIC_CA"),
        (&CA[..0], ("AXON_CLASSIC_CRL", "/f/crl.pem"), "AXON_CLASSIC_CRL"),
    ] {
        assert_eq!(resolve(base, &[change]).unwrap_err().variable(), named);
    }
}

#[test]
fn files_that_are_not_a_configuration_are_refused() {
    for (text, variable) in [
        ("security_mode = ", "AXON_CONFIG"),
        ("security_mode = 'qkd'\nsecurity_mode = 'qkd'", "AXON_CONFIG"),
        ("security_moed = 'qkd'", "AXON_SECURITY_MOED"),
        ("Security_Mode = 'qkd'", "AXON_SECURITY_MODE"),
        ("AXON_SECURITY_MODE = 'qkd'", "AXON_AXON_SECURITY_MODE"),
        ("config = '/f/other.toml'", "AXON_CONFIG"),
        ("security_mode = ['classic', { a = 1 }]", "AXON_SECURITY_MODE"),
        ("security_mode = 1.5", "AXON_SECURITY_MODE"),
        ("security_mode = true", "AXON_SECURITY_MODE"),
        ("daemon_peers = ['a;b']", "AXON_DAEMON_PEERS"),
        ("ring_buffer_size_mb = -1", "AXON_RING_BUFFER_SIZE_MB"),
        ("link = 3", "link"),
        ("qkd = 3", "qkd"),
        ("[qkd]\nsae_di = 'a'", "AXON_SAE_DI"),
        ("[qkd]\nsecurity_mode = 'qkd'", "AXON_SECURITY_MODE"),
        ("[qkd]\nclassic_key = 'key.pem'", "AXON_CLASSIC_KEY"),
        ("[qkd]\nsae_id = true", "AXON_SAE_ID"),
        ("sae_id = 'a'\n[qkd]\nsae_id = 'b'", "AXON_SAE_ID"),
        ("[link]\nmtu = 100", "link.mtu"),
        ("[link]\nmtu = '1500'", "link.mtu"),
        ("[link]\ngrace_s = -1", "link.grace_s"),
        ("[link]\ncongestion = 'reno'", "link.congestion"),
        ("[link]\ncongestion = 3", "link.congestion"),
        ("[link]\ncompression = 'zstd'", "link.compression"),
        ("[link]\ncompression = true", "link.compression"),
        ("[link]\nstalled_s = 0", "link.stalled_s"),
        ("[link]\nspeed = 1", "link.speed"),
        ("[link]\npoll = 'often'", "link.poll"),
        ("[link]\npoll = true", "link.poll"),
        ("[link]\nqlog = 'relative'", "link.qlog"),
        ("[link]\nqlog = 1", "link.qlog"),
        ("topic = 3", "topic"),
        ("topic = [3]", "topic"),
        ("[topic]\nname = '/a'", "topic"),
        ("[[topic]]", "topic.name"),
        ("[[topic]]\npriority = 'high'", "topic.name"),
        ("[[topic]]\nname = 'a'", "topic.name"),
        ("[[topic]]\nname = '/a**'", "topic.name"),
        ("[[topic]]\nname = ['/a']", "topic.name"),
        ("[[topic]]\nname = '/a'\npriority = 'highest'", "topic.priority"),
        ("[[topic]]\nname = '/a'\npriority = 1", "topic.priority"),
        ("[[topic]]\nname = '/a'\nmax = 1", "topic.max"),
        ("[[topic]]\nname = '/a'\nmax_hz = 0", "topic.max_hz"),
        ("[[topic]]\nname = '/a'\nmax_hz = '10'", "topic.max_hz"),
        ("[[topic]]\nname = '/a'\nmax_hz = inf", "topic.max_hz"),
        ("[[topic]]\nname = '/a'\nredundant = 1", "topic.redundant"),
        ("[[topic]]\nname = '/a'\nredundant = 'yes'", "topic.redundant"),
        ("[linc]\nmtu = 1500", "AXON_LINC"),
    ] {
        let error = with_file(&[], text).unwrap_err();
        assert_eq!(error.variable(), variable, "{text}: {error}");
        assert!(error.to_string().contains("/f/axon.toml"), "{error}");
        assert!(!error.to_string().contains('\n'), "{error}");
    }
    let mut disk = Disk::new();
    let path = Path::new("/f/axon.toml");
    assert!(Config::resolve([], Some(path), &disk).is_ok(), "a default file may be absent");
    disk.put("/f/axon.toml", 0o646, "");
    let error = Config::resolve([], Some(path), &disk).unwrap_err();
    assert!(error.accepted().contains("o-w"), "{error}");
    disk.0.insert(path.into(), (0o644, vec![0xff]));
    assert!(Config::resolve([], Some(path), &disk).is_err());
}

#[test]
fn rules_that_cannot_be_used_are_refused_with_their_place() {
    let mut disk = Disk::new();
    let base = "[[allow]]\npeer = \"base\"\npublish = \"/x\"";
    disk.put("/f/good.toml", 0o644, base);
    disk.put("/f/limit.toml", 0o644, "[[limit]]\npeer = \"base\"\nrate = 1");
    disk.put("/f/bad.toml", 0o644, "[[allow]]\npeer = \"base\"\npublish = \"x\"");
    disk.put("/f/axon.toml", 0o644, base);
    disk.put("/f/bad-axon.toml", 0o644, "[[deny]]\npeer = 3");
    disk.put("/f/no.toml", 0o644, "log = 'info'\nring_buffer_size_mb = = 8");
    disk.put("/f/address.toml", 0o644, "[[allow]]\npeer = [\"local\", \"address:10.*\", \"*\"]");
    let resolve = |env: &[(&str, &str)]| {
        let env = env.iter().map(|(name, value)| (name.into(), value.into()));
        Config::resolve(env, None, &disk).map_err(|error| error.to_string())
    };
    let pinned = |more: &[(&'static str, &'static str)]| resolve(&[PINNED, more].concat());
    let good = pinned(&[("AXON_ACCESS_FILE", "/f/good.toml")]).unwrap();
    assert_eq!(good.access_file.as_deref(), Some(Path::new("/f/good.toml")));
    assert_eq!(good.access.file(), Some("good.toml"));
    let limited = pinned(&[("AXON_ACCESS_FILE", "/f/limit.toml")]).unwrap();
    assert!(limited.access.is_empty() && limited.access.limits_anything());
    let both = [("AXON_ACCESS_FILE", "/f/good.toml"), ("AXON_CONFIG", "/f/limit.toml")];
    assert!(pinned(&both).unwrap_err().contains("rules in one place"));
    let unnamed = resolve(&[("AXON_ACCESS_FILE", "/f/limit.toml")]).unwrap_err();
    assert!(unnamed.contains("no host proves a name"), "{unnamed}");
    let inline = pinned(&[("AXON_CONFIG", "/f/axon.toml")]).unwrap();
    assert_eq!(inline.access_file.as_deref(), Some(Path::new("/f/axon.toml")));
    let error = pinned(&[("AXON_ACCESS_FILE", "/f/bad.toml")]).unwrap_err();
    assert!(
        error.starts_with("AXON_ACCESS_FILE (/f/bad.toml): line 3, column 11: publish"),
        "{error}"
    );
    let error = pinned(&[("AXON_CONFIG", "/f/bad-axon.toml")]).unwrap_err();
    assert!(error.starts_with("AXON_CONFIG (/f/bad-axon.toml): line 2, column 8: peer"), "{error}");
    let error = pinned(&[("AXON_CONFIG", "/f/no.toml")]).unwrap_err();
    assert!(error.contains("a file in TOML; line 2, column 23: "), "{error}");
    let both = pinned(&[("AXON_CONFIG", "/f/axon.toml"), ("AXON_ACCESS_FILE", "/f/good.toml")]);
    assert!(both.unwrap_err().contains("rules in one place"));
    // If no peer proves a name, a rule for a name would protect nothing.
    let error = resolve(&[("AXON_ACCESS_FILE", "/f/good.toml")]).unwrap_err();
    assert!(error.contains("\"base\"") && error.contains("AXON_CLASSIC_AUTH=none"), "{error}");
    resolve(&[("AXON_ACCESS_FILE", "/f/address.toml")]).unwrap();
    let error = pinned(&[("AXON_ACCESS_FILE", "/f/address.toml")]).unwrap_err();
    assert!(error.contains("\"address:10.*\""), "{error}");
}

#[test]
fn rules_of_the_host_apply_without_a_setting_and_fail_closed() {
    const RULES: &str = "[[allow]]\npeer = \"*\"\npublish = \"/x\"";
    let of_host = Path::new("/etc/axon/access.toml");
    let load = |env: &[(&str, &str)], mode, text: &str| {
        let mut disk = Disk::new();
        disk.put("/f/own.toml", 0o644, "[[deny]]\npeer = \"*\"\ncall = \"/own\"");
        disk.put("/f/axon.toml", 0o644, "[[deny]]\npeer = \"*\"\ncall = \"/inline\"");
        disk.put("/etc/axon/access.toml", mode, text);
        Config::resolve(pairs(env), None, &disk).unwrap().with_rules_of(of_host, &disk)
    };
    let obeyed = load(&[], 0o644, RULES).unwrap();
    assert_eq!(obeyed.access_file.as_deref(), Some(of_host));
    assert_eq!(obeyed.access.file(), Some("access.toml"));
    let own = load(&[("AXON_ACCESS_FILE", "/f/own.toml")], 0o644, RULES).unwrap();
    assert_eq!(own.access.file(), Some("own.toml"));
    let inline = load(&[("AXON_CONFIG", "/f/axon.toml")], 0o644, RULES).unwrap();
    assert_eq!(inline.access.file(), Some("axon.toml"));
    let none = load(&[("AXON_ACCESS_FILE", "/dev/null")], 0o644, RULES).unwrap();
    assert!(none.access.is_empty());
    assert_eq!(none.access_file.as_deref(), Some(Path::new("/dev/null")));
    let absent = Config::default().with_rules_of(of_host, &Disk::new()).unwrap();
    assert!(absent.access_file.is_none() && absent.access.is_empty());

    let refused = |mode, text| load(&[], mode, text).unwrap_err().to_string();
    for (mode, text, why) in [
        (0o644, "", "line 1"),
        (0o644, "[[alow]]", "unknown key"),
        (0o644, "[[allow]]\npeer = \"base\"\npublish = \"/x\"", "AXON_CLASSIC_AUTH=none"),
        (0o646, RULES, "chmod o-w"),
    ] {
        let error = refused(mode, text);
        assert!(error.contains("/etc/axon/access.toml") && error.contains(why), "{error}");
    }
    // The content of the file is unknown.
    let directory = Config::default().with_rules_of(Path::new("/f"), &Disk::new());
    assert!(directory.unwrap_err().to_string().contains("regular file"));
    let denied = Config::default().with_rules_of(of_host, &Unreadable).unwrap_err().to_string();
    assert!(denied.contains("permission denied"), "{denied}");
}

/// Files of which this user may know nothing.
struct Unreadable;

impl Files for Unreadable {
    fn read(&self, _: &Path) -> io::Result<Vec<u8>> {
        Err(io::ErrorKind::PermissionDenied.into())
    }

    fn facts(&self, _: &Path) -> io::Result<FileFacts> {
        Err(io::ErrorKind::PermissionDenied.into())
    }

    fn readable(&self, _: &Path) -> io::Result<()> {
        Err(io::ErrorKind::PermissionDenied.into())
    }

    fn current_dir(&self) -> io::Result<PathBuf> {
        Ok("/f".into())
    }
}
