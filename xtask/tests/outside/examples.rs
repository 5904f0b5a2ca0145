//! The examples and changelogs of the published crates.

use std::collections::BTreeSet;
use std::fs;
use std::process::Command;

use serde_json::Value;

use crate::PUBLISHED;
use crate::project::cargo;
use crate::support::{run, workspace};

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
    let build = ["build", "--workspace", "--examples", "--message-format=json"];
    let messages = run(&mut cargo(workspace(), &build)).stdout;
    let mut ran = BTreeSet::new();
    for message in String::from_utf8_lossy(&messages).lines() {
        let message: Value = serde_json::from_str(message).expect("cargo prints JSON");
        let Some(program) = message["executable"].as_str() else { continue };
        if message["target"]["kind"][0] != "example" {
            continue;
        }
        run(&mut Command::new(program));
        let manifest = message["manifest_path"].as_str().expect("a manifest");
        let its = |(_, dir): &&(&str, &str)| {
            workspace().join(dir).join("Cargo.toml") == std::path::Path::new(manifest)
        };
        ran.extend(PUBLISHED.iter().find(its).map(|(name, _)| *name));
    }
    let libraries = PUBLISHED.map(|(name, _)| name).into_iter().filter(|name| *name != "axon-cli");
    assert_eq!(ran, libraries.collect(), "crates whose examples ran");
}
