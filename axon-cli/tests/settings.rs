//! A bad setting ends every command with status 2 and one line that names the variable. `axon status` alone
//! looks for a daemon all the same: see `status.rs`.

#![forbid(unsafe_code)]

mod common;

use common::{LOG, Stderr, axon};

const COMMANDS: [&[&str]; 5] =
    [&["demo"], &["play", LOG], &["echo", "/scan"], &["trust", "list"], &["daemon"]];

/// `axon trust` works before a host is set up, because it is part of the setup.
#[test]
fn trust_keygen_and_scan_work_under_invalid_settings() {
    let dir = tempfile::tempdir().expect("temporary directory");
    let key = dir.path().join("host.key");
    let key = key.to_str().expect("UTF-8");
    for settings in [
        ("AXON_QKD_TYPO", "x"),
        ("AXON_SECURITY_MODE", "qkd"),
        ("AXON_CLASSIC_KEY", "/nowhere/key"),
    ] {
        let made = axon([settings]).args(["trust", "keygen", key]).output().expect("runs");
        assert!(made.status.success(), "{settings:?}: {}", Stderr::of(&made.stderr));
        std::fs::remove_file(key).expect("made");
        let scan = ["trust", "scan", "127.0.0.1:9", "--timeout", "1"];
        let looked = axon([settings]).args(scan).output().expect("runs");
        assert_eq!(looked.status.code(), Some(1), "{settings:?}: nobody is there");
    }
}

fn assert_refused(args: &[&str], settings: &[(&str, &str)], variable: &str) {
    let dir = tempfile::tempdir().expect("temporary directory");
    let path = dir.path().to_str().expect("UTF-8");
    let mut command = axon(settings.iter().copied());
    let output = command.env("AXON_RUNTIME_DIR", path).args(args).output().expect("runs");
    assert!(str::from_utf8(&output.stderr).is_ok(), "UTF-8");
    let stderr = Stderr::of(&output.stderr);
    assert_eq!(output.status.code(), Some(2), "{args:?} under {settings:?}: {stderr}");
    assert_eq!(stderr.lines().count(), 1, "{args:?} under {settings:?}: {stderr:?}");
    assert!(stderr.contains(variable), "{args:?} under {settings:?}: {stderr}");
    assert_eq!(output.stdout, b"", "{args:?} under {settings:?}");
    let left = std::fs::read_dir(dir.path()).expect("directory").count();
    assert_eq!(left, 0, "{args:?} under {settings:?}: something was made before validation");
}

#[test]
fn obsolete_and_unknown_variables_are_refused_by_every_command() {
    for args in COMMANDS {
        for name in [
            "AXON_SECURITY_PROFILE",
            "AXON_ENCRYPTION_MODE",
            "AXON_ENCRYPTION_KEY",
            "AXON_QKD_TYPO",
        ] {
            assert_refused(args, &[(name, "x")], name);
        }
    }
}

#[test]
fn an_obsolete_key_is_not_repeated() {
    let mut command = axon([("AXON_ENCRYPTION_KEY", "hunter2hunter2")]);
    let output = command.arg("status").output().expect("runs");
    assert!(!Stderr::of(&output.stderr).contains("hunter2"));
}

#[test]
fn bad_values_and_half_given_settings_name_the_variable() {
    for (settings, variable) in [
        (&[("AXON_SECURITY_MODE", "none")][..], "AXON_SECURITY_MODE"),
        (&[("AXON_SECURITY_MODE", "")], "AXON_SECURITY_MODE"),
        (&[("AXON_QUIC_CIPHER", "aes-128-gcm")], "AXON_QUIC_CIPHER"),
        (&[("AXON_SECURITY_MODE", "qkd")], "AXON_"),
        (&[("AXON_BIND_ADDRS", "nowhere")], "AXON_BIND_ADDRS"),
        (&[("AXON_LOG", "info=\nwarn=nonsense")], "AXON_LOG"),
        (&[("ROS_DOMAIN_ID", "-1")], "ROS_DOMAIN_ID"),
        (&[("AXON_DAEMON", "maybe")], "AXON_DAEMON"),
        (&[("AXON_CLASSIC_AUTH", "pinned")], "AXON_CLASSIC_KEY"),
        (&[("AXON_CLASSIC_AUTH", "ca")], "AXON_CLASSIC_CA"),
        (&[("AXON_CLASSIC_TRUST", "/nowhere/trust")], "AXON_CLASSIC_"),
    ] {
        assert_refused(&["echo", "/scan"], settings, variable);
        assert_refused(&["trust", "list"], settings, variable);
    }
}

#[test]
fn a_wrong_argument_has_status_2_too() {
    for args in [&["play"][..], &["play", LOG, "--rate", "nan"], &["echo"], &["dance"]] {
        assert_eq!(axon([]).args(args).output().expect("runs").status.code(), Some(2), "{args:?}");
    }
}

#[test]
fn a_standard_error_that_takes_nothing_changes_no_status() {
    let full = || std::fs::OpenOptions::new().write(true).open("/dev/full").expect("Linux has it");
    // The directory has no daemon, even if one runs on this host.
    let dir = tempfile::tempdir().expect("temporary directory");
    let mut setting = axon([("AXON_QKD_TYPO", "x")]);
    setting.env("AXON_RUNTIME_DIR", dir.path());
    assert_eq!(setting.arg("status").stderr(full()).status().expect("runs").code(), Some(2));
    let mut missing = axon([]);
    let file = ["play", "/nowhere/log.mcap"];
    assert_eq!(missing.args(file).stderr(full()).status().expect("runs").code(), Some(1));
}
