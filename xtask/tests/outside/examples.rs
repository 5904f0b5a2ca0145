//! The examples and changelogs of the published crates.

use std::collections::BTreeSet;
use std::fs;
use std::io::Read;
use std::path::Path;
use std::process::Stdio;

use serde_json::Value;

use crate::PUBLISHED;
use crate::project::cargo;
use crate::support::{Kept, run, target, with_daemon, workspace};

/// Each crate for programs in Rust has one; axon-cli is itself a program.
#[test]
fn each_library_has_an_example() {
    for (name, dir) in PUBLISHED.iter().filter(|(name, _)| *name != "axon-cli") {
        let examples = fs::read_dir(workspace().join(dir).join("examples")).into_iter().flatten();
        let programs = examples.flatten().filter(|e| e.path().extension() == Some("rs".as_ref()));
        assert_ne!(programs.count(), 0, "{name} has no example");
    }
}

/// docs/release.md says that each has one.
#[test]
fn each_crate_has_a_changelog() {
    for (name, dir) in PUBLISHED {
        let text = fs::read_to_string(workspace().join(dir).join("CHANGELOG.md")).expect(name);
        assert!(text.starts_with("# Changelog\n"), "{name}");
        let headings: Vec<_> = text.lines().filter(|line| line.starts_with('#')).skip(1).collect();
        assert_eq!(headings.first(), Some(&"## [Unreleased]"), "{name}");
        let kinds = ["Added", "Changed", "Deprecated", "Removed", "Fixed", "Security"];
        let is_known = |line: &&&str| {
            line.strip_prefix("### ").map_or(line.starts_with("## ["), |kind| kinds.contains(&kind))
        };
        assert_eq!(headings.iter().find(|line| !is_known(line)), None, "{name}");
    }
}

/// Builds them with the workspace's features, as `cargo test --workspace` has done before.
#[test]
#[ignore = "builds all examples of the workspace"]
fn each_example_runs() {
    let daemon = ["--bin", "axon_daemon"];
    let mut build =
        cargo(workspace(), &["build", "--workspace", "--examples", "--message-format=json"]);
    let messages = run(build.args(daemon)).stdout;
    let mut ran = BTreeSet::new();
    for message in String::from_utf8_lossy(&messages).lines() {
        let message: Value = serde_json::from_str(message).expect("cargo prints JSON");
        let Some(program) = message["executable"].as_str().map(Path::new) else { continue };
        if message["target"]["kind"][0] != "example" {
            continue;
        }
        let manifest = message["manifest_path"].as_str().expect("a manifest");
        let its = |(_, dir): &&(&str, &str)| {
            workspace().join(dir).join("Cargo.toml") == Path::new(manifest)
        };
        let of = PUBLISHED.iter().find(its).map(|(name, _)| *name);
        if program.ends_with("two_hosts") {
            a_talker_is_heard_on_another_host(program);
        } else {
            let place = tempfile::tempdir().expect("a directory");
            let mut example = with_daemon(program, place.path());
            // The others have no daemon, or are their own.
            if of == Some("axon-transport") {
                example.env("AXON_DAEMON_PATH", target().join("debug/axon_daemon"));
            }
            run(&mut example);
        }
        ran.extend(of);
    }
    let libraries = PUBLISHED.map(|(name, _)| name).into_iter().filter(|name| *name != "axon-cli");
    assert_eq!(ran, libraries.collect(), "crates whose examples ran");
}

/// The example whose two halves are for two hosts. Two addresses of this one stand for them.
fn a_talker_is_heard_on_another_host(program: &Path) {
    let places = [(); 2].map(|()| tempfile::tempdir().expect("a directory"));
    let part = |part: &str, here: usize| {
        let addresses = ["127.0.0.1", "127.0.0.2"];
        let mut command = with_daemon(program, places[here].path());
        command.arg(part).env_remove("ROS_AUTOMATIC_DISCOVERY_RANGE");
        command.env("AXON_DAEMON_PATH", target().join("debug/axon_daemon"));
        command.env("AXON_BIND_ADDRS", addresses[here]);
        command.env("AXON_DAEMON_PEERS", addresses[1 - here]);
        command
    };
    let mut listen = part("listen", 0);
    let mut listener = Kept(listen.stdout(Stdio::piped()).spawn().expect("it starts"));
    let said = run(&mut part("talk", 1)).stdout;
    assert_eq!(String::from_utf8_lossy(&said), "said 3\n");
    let mut heard = String::new();
    let mut output = listener.0.stdout.take().expect("a pipe");
    output.read_to_string(&mut heard).expect("text");
    assert_eq!(heard, "heard hello 1\nheard hello 2\nheard hello 3\n");
    assert!(listener.0.wait().expect("it ends").success());
}
