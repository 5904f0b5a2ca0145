//! What a person has to look at between two releases.

use std::path::Path;

use super::super::{commit, git};
use super::{Scratch, Tree, tree};

/// What a connection on an external PSK must not use, or goes through. A new line that names one of
/// them may be a new way around the patches.
const WATCHED: [&str; 10] = [
    "key_log",
    "resumption",
    "session_storage",
    "ticket",
    "early_data",
    "verifier",
    "kx_groups",
    "ClientExtensions",
    "ExpectFinished",
    "ExpectTraffic",
];

/// Where the handshake is. The rest cannot get around it.
const HANDSHAKE: [&str; 8] = [
    "client/",
    "server/",
    "tls13/",
    "common_state.rs",
    "conn.rs",
    "quic.rs",
    "builder.rs",
    "msgs/",
];

const QUESTIONS: &str = "\
to look at:
  the release notes and advisories from the old release on
  every change in a file that a patch touches, and the lines above
  each new extension of a ClientHello: does it ask for a certificate or a ticket?
  dependencies, features and rust-version in rustls's Cargo.toml against those of rustls-axon
  the diff of patches/, and rustls-axon's CHANGELOG
  rustls's own tests, without and with the patches (--suite)
  cargo test -p rustls-axon -p axon-tls --all-features, with OpenSSL and GnuTLS installed
  cargo xtask package rustls-axon";

/// Upstream's changes, those in files that patches touch first.
pub(super) fn list(
    (old, old_src): (&str, &Path),
    (new, new_src): (&str, &Path),
    patches: &Tree,
) -> Result<String, String> {
    let scratch = Scratch::new("review")?;
    let dir = &scratch.0;
    git(dir, &["init", "--quiet"])?;
    for (version, src) in [(old, old_src), (new, new_src)] {
        tree::write(&tree::read_dir(src)?, &dir.join("src"))?;
        // the manifest as its author wrote it, which a package has under this name
        let manifest = src.with_file_name("Cargo.toml.orig");
        std::fs::copy(&manifest, dir.join("Cargo.toml"))
            .map_err(|err| format!("cannot copy {}: {err}", manifest.display()))?;
        commit(dir, version)?;
    }

    let (mut touched, mut others) = (Vec::new(), Vec::new());
    let numbers = git(dir, &["diff", "--no-renames", "--numstat", "HEAD~", "HEAD"])?;
    for line in numbers.lines() {
        let [added, removed, path] = line.split('\t').collect::<Vec<_>>()[..] else { continue };
        let header = format!("\ndiff --git a/{path} ");
        let by: Vec<&str> = patches
            .iter()
            .filter(|(_, text)| text.contains(&header))
            .map(|(name, _)| name.split('-').next().unwrap_or(name))
            .collect();
        let line = format!("  {path}  +{added} -{removed}");
        match &by[..] {
            [] => others.push(line),
            by => touched.push(format!("{line}  patches {}", by.join(", "))),
        }
    }

    let mut watched = Vec::new();
    let diff = git(dir, &["diff", "--no-renames", "-U0", "HEAD~", "HEAD"])?;
    let (mut path, mut number) = ("", 0_usize);
    for line in diff.lines() {
        if let Some(name) = line.strip_prefix("+++ b/") {
            path = name;
        } else if let Some((_, to)) = line.strip_prefix("@@ ").and_then(|at| at.split_once('+')) {
            number = to.split([',', ' ']).next().and_then(|at| at.parse().ok()).unwrap_or(0);
        } else if let Some(text) = line.strip_prefix('+') {
            let file = path.strip_prefix("src/").unwrap_or_default();
            if HANDSHAKE.iter().any(|start| file.starts_with(start))
                && !file.contains("test")
                && !text.trim_start().starts_with("//")
                && WATCHED.iter().any(|word| text.contains(word))
            {
                watched.push(format!("  {path}:{number}: {}", text.trim()));
            }
            number += 1;
        }
    }

    let mut review = format!("review list, rustls {old} to {new}");
    for (heading, lines) in [
        ("changed files that patches touch (lines added, removed):", touched),
        ("other changed files:", others),
        ("new lines that name what such a connection must not use, or goes through:", watched),
    ] {
        let none = vec!["  none".to_owned()];
        let lines = if lines.is_empty() { none } else { lines };
        review += &format!("\n{heading}\n{}", lines.join("\n"));
    }
    Ok(format!("{review}\n{QUESTIONS}"))
}
