//! Tests `axon acl check` beside running daemons: the answers of a peer, and rules that the daemon has not read yet.

#![forbid(unsafe_code)]

mod common;

use std::{
    fs,
    path::{Path, PathBuf},
    process::Output,
};

use axon_transport::{EndpointSpec, qos::Qos};
use common::{Host, Running, eventually};

/// A host with its own rules, and its daemon.
struct Ruled {
    host: Host,
    rules: PathBuf,
    _daemon: Running,
}

impl Ruled {
    fn start(host: Host, dir: &Path, name: &str, rules: &str) -> Self {
        let file = dir.join(name);
        fs::write(&file, rules).expect("writable");
        let mut command = host.axon(&["daemon"]);
        command.env("AXON_ACCESS_FILE", &file);
        let daemon = Running::start(command);
        host.wait_daemon();
        Self { host, rules: file, _daemon: daemon }
    }

    fn run(&self, arguments: &[&str]) -> Output {
        let mut command = self.host.axon(arguments);
        command.env("AXON_ACCESS_FILE", &self.rules).output().expect("runs")
    }

    /// Returns standard output and standard error of `axon acl check` about the only peer.
    fn check(&self, what: &str, name: &str) -> (String, String) {
        let status = self.host.status().expect("a status");
        let peer = status["links"][0]["party"].as_str().expect("a party").to_owned();
        let output = self.run(&["acl", "check", "--peer", &peer, what, name]);
        let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
        (text(&output.stdout), text(&output.stderr))
    }
}

#[test]
fn acl_check_reports_peer_denials_and_a_rules_file_not_yet_reloaded() {
    let dir = tempfile::tempdir().expect("directory");
    let [robot, base] = Host::pair();
    let robot =
        Ruled::start(robot, dir.path(), "robot.toml", "[[deny]]\npeer = \"*\"\ncall = \"/x\"\n");
    let denies = "[[deny]]\npeer = \"*\"\npublish = \"/odom\"\n";
    let base = Ruled::start(base, dir.path(), "base.toml", denies);
    let session = robot.host.session("robot");
    let spec = |topic| EndpointSpec::new(topic, "test/Bytes", Qos::default());
    let _odom = session.create_publisher(spec("/odom")).expect("a publisher");
    let _scan = session.create_publisher(spec("/scan")).expect("a publisher");
    eventually("the base station says what it denies", || {
        let status = robot.host.status().expect("a status");
        !status["links"][0]["denied"]["publish /odom (ours)"].is_null()
    });
    // This host's rules know the peer by its address: it proves no name.
    let (out, said) = robot.check("--subscribe", "/odom");
    assert!(out.contains("denied by line 3 of base.toml"), "{out}{said}");
    let (out, said) = robot.check("--subscribe", "/scan");
    assert!(out.contains("allowed: no rule in base.toml denies this"), "{out}{said}");
    assert_eq!(said, "", "the file is in force");
    // The peer answers for what no endpoint uses, and for services.
    let (out, said) = robot.check("--subscribe", "/nobody");
    assert!(out.contains("allowed: no rule in base.toml denies this"), "{out}{said}");
    let (out, said) = base.check("--serve", "/x");
    assert!(out.contains("denied by line 3 of robot.toml"), "{out}{said}");
    assert!(base.check("--publish", "/odom").0.contains("denied by line 3 of base.toml"));

    // The file is changed, and the daemon has not read it.
    fs::write(&robot.rules, "[[deny]]\npeer = \"*\"\nsubscribe = \"/scan\"\n").expect("writable");
    let (out, said) = robot.check("--subscribe", "/scan");
    assert!(out.contains("denied by line 3 of robot.toml"), "{out}");
    assert!(said.contains("other rules in force") && said.contains("axon reload"), "{said}");
    let output = robot.run(&["reload"]);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    assert_eq!(robot.check("--subscribe", "/scan").1, "");
    let shown = String::from_utf8_lossy(&robot.run(&["status"]).stdout).into_owned();
    let line = shown.lines().find(|line| line.trim_start().starts_with("access rules"));
    let line = line.expect("a line").to_owned();
    assert!(line.contains("robot.toml, digest "), "{line}");
}
