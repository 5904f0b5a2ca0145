//! Tests the crates that an application links with a crate, by its normal dependencies.

use std::{collections::BTreeSet, path::Path, process::Command};

/// The crates that `package` brings, with its default features.
fn brought(package: &str) -> BTreeSet<String> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap();
    let output = Command::new(env!("CARGO"))
        .current_dir(root)
        .args(["tree", "--offline", "--locked", "--edges", "normal", "--prefix", "none"])
        .args(["--format", "{lib}", "--package", package])
        .output()
        .unwrap();
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    assert!(output.status.success(), "{}", text(&output.stderr));
    let crates: BTreeSet<_> = text(&output.stdout).lines().map(str::to_owned).collect();
    assert!(crates.contains(&package.replace('-', "_")), "{crates:?}");
    crates
}

/// Returns the dependencies that these rules forbid.
fn forbidden(package: &str, names: &[&str]) -> Vec<String> {
    let is_forbidden = |brought: &String| names.iter().any(|name| brought.starts_with(name));
    brought(package).into_iter().filter(is_forbidden).collect()
}

#[test]
fn an_application_links_no_quic_no_tls_no_http_and_no_async_runtime() {
    let names = [
        "quinn",
        "rustls",
        "axon_tls",
        "aws_lc",
        "ring",
        "openssl",
        "http",
        "hyper",
        "h2",
        "reqwest",
        "etsi_qkd014",
        "axon_envelope",
        "axon_daemon",
        "tokio",
        "async_io",
        "smol",
    ];
    assert_eq!(forbidden("axon-transport", &names), [""; 0]);
    // The test can fail.
    assert!(forbidden("axon-daemon", &names).len() > 10);
}

#[test]
fn shared_memory_knows_no_session_and_no_daemon() {
    assert_eq!(forbidden("axon-shm", &["axon_transport", "axon_daemon", "ed25519"]), [""; 0]);
}
