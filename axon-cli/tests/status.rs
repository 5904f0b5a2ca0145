//! Tests `axon status` with wrong settings or files of this host: it reports each error as the daemon would, and still
//! shows the daemon if one runs.

#![forbid(unsafe_code)]

mod common;

use std::{fs, os::unix::fs::PermissionsExt as _, path::Path, process::Output};

use common::{Host, Running, eventually};

/// Writes a file of a test.
fn file(dir: &Path, name: &str, text: &str, mode: u32) -> String {
    let path = dir.join(name);
    fs::write(&path, text).expect("written");
    fs::set_permissions(&path, fs::Permissions::from_mode(mode)).expect("its owner");
    path.to_str().expect("UTF-8").to_owned()
}

const MISSING: &str = "/nowhere/ca.pem";

/// A certificate of a CA, in files.
struct Pki {
    ca: String,
    cert: String,
    key: String,
}

impl Pki {
    fn new(dir: &Path) -> Self {
        let ca_key = rcgen::KeyPair::generate().expect("a key");
        let mut params = rcgen::CertificateParams::default();
        params.is_ca = rcgen::IsCa::Ca(rcgen::BasicConstraints::Unconstrained);
        let ca = params.self_signed(&ca_key).expect("a CA").pem();
        let issuer = rcgen::Issuer::new(params, ca_key);
        let key = rcgen::KeyPair::generate().expect("a key");
        let params = rcgen::CertificateParams::new(["host-a".to_owned()]).expect("a name");
        let cert = params.signed_by(&key, &issuer).expect("a certificate").pem();
        Self {
            ca: file(dir, "ca.pem", &ca, 0o644),
            cert: file(dir, "host.pem", &cert, 0o644),
            key: file(dir, "host.key", &key.serialize_pem(), 0o600),
        }
    }

    /// Returns the settings of a host with this certificate, or with another CA or certificate.
    fn settings(&self, ca: &str, cert: &str) -> Vec<(&'static str, String)> {
        vec![
            ("AXON_CLASSIC_AUTH", "ca".to_owned()),
            ("AXON_CLASSIC_CA", ca.to_owned()),
            ("AXON_CLASSIC_CERT", cert.to_owned()),
            ("AXON_CLASSIC_KEY", self.key.clone()),
        ]
    }
}

/// Settings, the one that is wrong, and words that say how; and the exit status without a daemon.
type Case = (Vec<(&'static str, String)>, &'static str, &'static [&'static str], i32);

fn cases(dir: &Path) -> Vec<Case> {
    let key = axon_tls::identity::SigningKey::generate_pem().expect("a key");
    let good = file(dir, "good.key", &key, 0o600);
    let open = file(dir, "open.key", &key, 0o644);
    let wrong = file(dir, "wrong.key", "no key at all", 0o600);
    let encrypted =
        "-----BEGIN ENCRYPTED PRIVATE KEY-----\nAAAA\n-----END ENCRYPTED PRIVATE KEY-----\n";
    let encrypted = file(dir, "encrypted.key", encrypted, 0o600);
    let trust = file(dir, "trust", "", 0o644);
    let broken = file(dir, "broken-trust", "half a line", 0o644);
    let rules = file(dir, "broken-rules", "[[allow]]\npeer = 7\n", 0o644);
    let toml = file(dir, "broken.toml", "this is no TOML", 0o644);
    let certificate = file(dir, "junk.pem", "junk", 0o644);
    let classic = |key: &String, trust: &String| {
        vec![("AXON_CLASSIC_KEY", key.clone()), ("AXON_CLASSIC_TRUST", trust.clone())]
    };
    let pki = Pki::new(dir);
    let revoked = |crl: &str| {
        let mut settings = pki.settings(&pki.ca, &pki.cert);
        settings.push(("AXON_CLASSIC_CRL", crl.to_owned()));
        settings
    };
    let qkd = |ca: &str, key: &String| {
        vec![
            ("AXON_SECURITY_MODE", "qkd".to_owned()),
            ("AXON_QKD_PEERS", "sae-b".to_owned()),
            ("AXON_SAE_ID", "sae-a".to_owned()),
            ("AXON_KME_URL", "https://127.0.0.1:9".to_owned()),
            ("AXON_KME_CA", ca.to_owned()),
            ("AXON_SAE_CERT", certificate.clone()),
            ("AXON_SAE_KEY", key.clone()),
        ]
    };
    vec![
        (qkd(MISSING, &good), "AXON_KME_CA", &[MISSING, "exists"], 2),
        (qkd(&certificate, &open), "AXON_SAE_KEY", &["open.key", "0600"], 2),
        (qkd(&certificate, &good), "AXON_KME_CA", &["junk.pem"], 1),
        (qkd(&pki.ca, &good), "AXON_SAE_CERT", &["junk.pem"], 1),
        (classic(&open, &trust), "AXON_CLASSIC_KEY", &["open.key", "0600"], 2),
        (classic(&"/nowhere/key".to_owned(), &trust), "AXON_CLASSIC_KEY", &["/nowhere/key"], 2),
        (classic(&wrong, &trust), "AXON_CLASSIC_KEY", &["wrong.key", "PRIVATE KEY"], 1),
        (classic(&encrypted, &trust), "AXON_CLASSIC_KEY", &["encrypted.key", "is encrypted"], 1),
        (classic(&good, &broken), "AXON_CLASSIC_TRUST", &["broken-trust", "line 1"], 1),
        (pki.settings(&certificate, &pki.cert), "AXON_CLASSIC_CA", &["junk.pem"], 1),
        (pki.settings(MISSING, &pki.cert), "AXON_CLASSIC_CA", &[MISSING, "exists"], 2),
        (pki.settings(&pki.ca, &certificate), "AXON_CLASSIC_CERT", &["junk.pem"], 1),
        (pki.settings(&pki.ca, MISSING), "AXON_CLASSIC_CERT", &[MISSING, "exists"], 2),
        (revoked(&certificate), "AXON_CLASSIC_CRL", &["junk.pem"], 1),
        (revoked(MISSING), "AXON_CLASSIC_CRL", &[MISSING, "exists"], 2),
        (vec![("AXON_ACCESS_FILE", rules)], "AXON_ACCESS_FILE", &["broken-rules", "line 2"], 2),
        (vec![("AXON_ACCESS_FILE", MISSING.to_owned())], "AXON_ACCESS_FILE", &[MISSING], 2),
        (vec![("AXON_CONFIG", toml)], "AXON_CONFIG", &["broken.toml", "line 1"], 2),
        (vec![("AXON_CONFIG", "/nowhere/axon.toml".to_owned())], "AXON_CONFIG", &["/nowhere"], 2),
        (vec![("AXON_QKD_TYPO", "x".to_owned())], "AXON_QKD_TYPO", &[], 2),
    ]
}

fn status(host: &Host, settings: &[(&str, String)], args: &[&str]) -> Output {
    let mut command = host.axon(&[&["status"], args].concat());
    command.envs(settings.iter().map(|(name, value)| (name, value)));
    command.output().expect("runs")
}

#[track_caller]
fn said(output: &Output, variable: &str, words: &[&str]) -> String {
    let stderr = String::from_utf8(output.stderr.clone()).expect("text");
    let line = stderr.lines().find(|line| line.contains(variable));
    let line = line.unwrap_or_else(|| panic!("{variable}: {stderr}"));
    assert!(words.iter().all(|word| line.contains(word)), "{words:?}: {line}");
    stderr
}

#[test]
fn status_reports_wrong_settings_and_a_missing_daemon() {
    let dir = tempfile::tempdir().expect("temporary directory");
    let host = Host::new();
    for (settings, variable, words, code) in cases(dir.path()) {
        let output = status(&host, &settings, &[]);
        let stderr = said(&output, variable, words);
        let no_daemon = said(&output, "no daemon listens at", &["`axon daemon`", "`axon_daemon`"]);
        assert!(!no_daemon.contains("set AXON_DAEMON"), "it has no effect here: {no_daemon}");
        assert_eq!(stderr.lines().count(), 2, "{variable}: {stderr}");
        assert_eq!((output.status.code(), output.stdout.len()), (Some(code), 0), "{stderr}");
    }
    // The daemon's address depends on this setting.
    let output = status(&host, &[("ROS_DOMAIN_ID", "-1".to_owned())], &[]);
    let stderr = said(&output, "ROS_DOMAIN_ID", &["-1"]);
    assert_eq!((output.status.code(), stderr.lines().count()), (Some(2), 1), "{stderr}");
}

#[test]
fn a_variable_that_is_no_setting_is_named() {
    let host = Host::new();
    let _daemon = Running::start(host.axon(&["daemon"]));
    eventually("the daemon answers", || host.daemon().is_some());
    let output = status(&host, &[("AXON_EDITOR", "vi".to_owned())], &[]);
    let stderr = said(&output, "AXON_EDITOR", &["ignored", "AXON_STRICT_ENV"]);
    assert!(output.status.success(), "{stderr}");
    // A variable whose name concerns security does not count as foreign.
    for name in ["AXON_CERTIFICATE", "AXON_PINS", "AXON_ROBOT_IDENTITY"] {
        let output = status(&host, &[(name, "x".to_owned())], &[]);
        let stderr = said(&output, name, &["accepted"]);
        assert!(!stderr.contains("ignored"), "{stderr}");
    }
}

#[test]
fn status_shows_a_running_daemon_despite_invalid_local_settings() {
    let dir = tempfile::tempdir().expect("temporary directory");
    let host = Host::new();
    let _daemon = Running::start(host.axon(&["daemon"]));
    eventually("the daemon answers", || host.daemon().is_some());
    for (settings, variable, words, _) in cases(dir.path()) {
        let output = status(&host, &settings, &[]);
        let stderr = said(&output, variable, words);
        assert!(output.status.success(), "{variable}: {stderr}");
        assert_eq!(stderr.lines().count(), 1, "{variable}: {stderr}");
        let text = String::from_utf8(output.stdout).expect("text");
        assert!(text.starts_with("Daemon\n"), "{variable}: {text}");
        let output = status(&host, &settings, &["--json"]);
        let json: serde_json::Value = serde_json::from_slice(&output.stdout).expect("JSON alone");
        assert_eq!(json["pid"].as_i64().map(|pid| pid as i32), host.daemon(), "{variable}");
    }
}
