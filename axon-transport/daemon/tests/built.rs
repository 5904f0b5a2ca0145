//! A configuration that a program builds: it applies to the session and to the daemon that the session starts, and the
//! environment does not change it.

#[allow(dead_code, reason = "these tests start their daemons by sessions")]
#[path = "support/mod.rs"]
mod support;

use std::{fs, path::PathBuf};

use axon_transport::{
    Session, SessionError, SessionOptions,
    config::{Config, ConfigBuilder, DaemonPolicy, QuicCipher},
};
use support::{Host, say, wait_for_the_end};

/// Variables that contradict the built configuration, or are wrong, obsolete, foreign or misspelt.
const HOSTILE: &[(&str, &str)] = &[
    ("AXON_SECURITY_MODE", "qkd"),
    ("AXON_QUIC_CIPHER", "rot13"),
    ("AXON_CLASSIC_KEY", "/nowhere/key"),
    ("AXON_QKD_PEERS", "*"),
    ("AXON_ENCRYPTION_KEY", "hunter2"),
    ("AXON_QKD_TYPO", "x"),
    ("AXON_SOMEBODY_ELSES", "x"),
    ("AXON_STRICT_ENV", "1"),
    ("AXON_CONFIG", "/nowhere/axon.toml"),
    ("AXON_DAEMON", "off"),
    ("AXON_DAEMON_PATH", "/nowhere/axon_daemon"),
    ("AXON_RUNTIME_DIR", "relative"),
    ("AXON_LOG", "loud"),
    ("AXON_LINK_GRACE_S", "never"),
    ("AXON_MAX_MESSAGE_MB", "0"),
    ("ROS_DOMAIN_ID", "nonsense"),
    ("ROS_AUTOMATIC_DISCOVERY_RANGE", "EVERYWHERE"),
    ("ROS_LOCALHOST_ONLY", "1"),
    ("XDG_RUNTIME_DIR", "/nowhere"),
];

/// Returns a copy of the daemon, beside an `axon.toml` that must not be read.
fn program(host: &Host) -> PathBuf {
    let program = host.dir.path().join("axon_daemon");
    if !program.exists() {
        fs::copy(env!("CARGO_BIN_EXE_axon_daemon"), &program).unwrap();
        fs::write(program.with_file_name("axon.toml"), "this is no TOML").unwrap();
    }
    program
}

fn shown(config: &Config) -> String {
    format!("{config:?}")
}

/// The code of the children of the tests. It does nothing in a run of the tests themselves.
#[test]
fn child() {
    let Ok(part) = std::env::var("PLAY") else { return };
    let get = |name: &str| std::env::var(name).unwrap();
    let builder = match part.as_str() {
        "built" => {
            Config::from_env().unwrap_err();
            say(shown(&Config::default()));
            Config::builder()
                .domain(5)
                .runtime_dir(get("TEST_RUN"))
                .daemon_path(get("TEST_DAEMON"))
                .bind_addrs(["127.0.0.1".parse().unwrap()])
                .quic_cipher(QuicCipher::Aes256Gcm)
                .max_message_mb(7)
                .log("debug")
                .link_grace(std::time::Duration::ZERO)
        }
        "on top" => ConfigBuilder::from_env().domain(6).link_grace(std::time::Duration::ZERO),
        _ => unreachable!(),
    };
    let config = builder.build().unwrap();
    say(shown(&config));
    let session = Session::open(&config, SessionOptions::new(&*part)).unwrap();
    say(session.status_json().unwrap());
    wait_for_the_end();
}

fn status(json: &str) -> axon_transport::status::Status {
    serde_json::from_str(json).unwrap()
}

/// Waits for the end of a daemon that the test knows only by its pid.
fn until_it_ends(pid: u32) {
    support::until("the daemon ends", || !fs::exists(format!("/proc/{pid}/exe")).unwrap());
}

#[test]
fn environment_variables_influence_neither_a_built_config_nor_its_daemon() {
    let host = Host::new();
    let run = host.dir.path().join("run");
    let mut command = host.command(std::env::current_exe().unwrap());
    for (name, _) in &host.env {
        command.env_remove(name);
    }
    command.env("TEST_RUN", &run).env("TEST_DAEMON", program(&host));
    command.envs(HOSTILE.iter().copied());
    let mut player = host.play_in(command, "built");

    // The same as in a process without these variables, such as this one.
    assert_eq!(player.hear(), shown(&Config::default()));
    let built = player.hear();
    assert!(built.contains("domain: 5") && built.contains("Aes256Gcm"), "{built}");
    let status = status(&player.hear());
    assert_eq!((status.domain, status.mode.as_str()), (5, "classic"));
    assert_eq!(status.cipher, "aes-256-gcm");
    assert_eq!(status.runtime_dir.as_deref(), run.to_str());
    assert_eq!(fs::read_link(format!("/proc/{}/exe", status.pid)).unwrap(), program(&host));
    let log = fs::read_to_string(run.join("axon-5.log")).unwrap();
    assert!(log.contains("DEBUG"), "its log is at the level that was built: {log}");

    // A session with other settings meets that daemon, which refuses it as usual.
    let other = Config::builder().domain(5).runtime_dir(&run).daemon(DaemonPolicy::Require);
    let other = Session::open(&other.build().unwrap(), SessionOptions::new("other")).unwrap_err();
    let SessionError::Mismatch { variable, .. } = &other else { panic!("{other}") };
    assert_eq!(variable, "AXON_QUIC_CIPHER");

    player.finish();
    // It ends after the grace time that was built.
    until_it_ends(status.pid);
}

#[test]
fn builder_settings_over_the_environment_reach_the_daemon() {
    let host = Host::new().with("AXON_QUIC_CIPHER", "aes-256-gcm").with("ROS_DOMAIN_ID", "wrong");
    let mut player = host.play("on top");
    let built = player.hear();
    assert!(built.contains("domain: 6") && built.contains("Aes256Gcm"), "{built}");
    let status = status(&player.hear());
    assert_eq!((status.domain, status.cipher.as_str()), (6, "aes-256-gcm"));
    player.finish();
    until_it_ends(status.pid);
}
