//! Tests the dependencies that the features of axon-tls add.

mod support;

use std::process::Command;

use support::{run, workspace};

/// The packages that axon-tls is compiled with, each as `name vVERSION`.
fn dependencies(features: &str) -> Vec<String> {
    let mut tree = Command::new(env!("CARGO"));
    tree.args(["tree", "--package", "axon-tls", "--edges", "normal", "--prefix", "none"]);
    tree.args(["--offline", "--no-default-features", "--features", features]);
    let output = run(tree.current_dir(workspace()));
    String::from_utf8_lossy(&output.stdout).lines().map(str::to_owned).collect()
}

#[test]
fn each_axon_tls_feature_adds_only_its_own_dependencies() {
    let has = |features, name: &str| {
        dependencies(features).iter().any(|line| line.starts_with(&format!("{name} v")))
    };
    for features in ["", "quic", "tokio", "quic,tokio"] {
        assert!(has(features, "rustls-axon"), "{features}");
        assert!(!has(features, "rustls"), "{features}: stock rustls is for `hybrid` alone");
    }
    assert!(has("hybrid", "rustls"));
    for (name, feature) in [("quinn", "quic"), ("tokio", "tokio")] {
        assert!(!has("hybrid", name) && has(feature, name), "{name}");
    }
}
