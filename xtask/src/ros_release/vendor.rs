//! The crates of the registry, as far as a build on Linux needs them.

use std::collections::BTreeSet;
use std::fs;
use std::path::Path;
use std::process::Command;

use serde_json::Value;

use super::files::{read, size, write};
use super::graph::{self, Crate, PLATFORMS, ROOTS};
use super::{lock, manifest, prune};
use crate::rustls_axon::cargo;

/// Summary of the vendored crates.
#[derive(Debug)]
pub(super) struct Vendored {
    /// Those that are compiled on one of the platforms.
    pub(super) compiled: Vec<Crate>,
    /// How many stand-ins there are for others that the lock file names.
    pub(super) stand_ins: usize,
    /// Bytes before anything was left out, and now.
    pub(super) bytes: (u64, u64),
}

/// Puts the crates that `workspace` needs into its folder `vendor`, and makes cargo use them.
pub(super) fn vendor(workspace: &Path, is_offline: bool) -> Result<Vendored, String> {
    let lock_file = workspace.join("Cargo.lock");
    let committed = read(&lock_file)?;
    // Without --locked: cargo drops what the members do not need, and keeps the versions of the rest.
    let described = metadata(workspace, is_offline)?;
    lock::check(&read(&lock_file)?, &committed)?;
    let mut trees = Vec::new();
    for platform in PLATFORMS {
        trees.push(tree(workspace, platform, is_offline)?);
    }
    let compiled = graph::compiled(&trees, &described)?;

    let folder = workspace.join("vendor");
    let mut command = cargo_in(workspace, is_offline);
    // Each folder with its version: which crate has the plain name depends on the others.
    command.args(["vendor", "--quiet", "--locked", "--versioned-dirs", "vendor"]);
    run(&mut command, "vendor")?;
    let before = size(&folder)?;

    for (name, version) in lock::registry(&read(&lock_file)?)? {
        let of_crate = folder.join(format!("{name}-{version}"));
        if compiled.iter().any(|one| one.name == name && one.version == version) {
            prune::crate_folder(&name, &of_crate)?;
        } else {
            let manifest = of_crate.join("Cargo.toml");
            let manifest = manifest::stub(&read(&manifest)?)
                .map_err(|why| format!("{}: {why}", manifest.display()))?;
            prune::stand_in(&of_crate, &manifest)?;
        }
    }
    write(&workspace.join(".cargo/config.toml"), CONFIG)?;
    // Stand-ins have no dependencies, so that more of the lock file goes.
    metadata(workspace, true)?;
    let text = read(&lock_file)?;
    lock::check(&text, &committed)?;
    let stand_ins = drop_unlocked(&folder, &text)? - compiled.len();
    Ok(Vendored { compiled, stand_ins, bytes: (before, size(&folder)?) })
}

/// Cargo's configuration: sources come from `vendor/` alone.
const CONFIG: &str = "[source.crates-io]\nreplace-with = \"vendored-sources\"\n\n\
    [source.vendored-sources]\ndirectory = \"vendor\"\n\n[net]\noffline = true\n";

/// Removes the folders of crates that the lock file does not name any more; returns the number of the others.
fn drop_unlocked(folder: &Path, lock_file: &str) -> Result<usize, String> {
    let locked = lock::registry(lock_file)?;
    let locked: BTreeSet<String> =
        locked.into_iter().map(|(name, version)| format!("{name}-{version}")).collect();
    let failed = |err| format!("{}: {err}", folder.display());
    for entry in fs::read_dir(folder).map_err(failed)? {
        let entry = entry.map_err(failed)?;
        if !locked.contains(entry.file_name().to_string_lossy().as_ref()) {
            fs::remove_dir_all(entry.path()).map_err(failed)?;
        }
    }
    Ok(locked.len())
}

fn metadata(workspace: &Path, is_offline: bool) -> Result<Value, String> {
    let mut command = cargo_in(workspace, is_offline);
    command.args(["metadata", "--quiet", "--format-version", "1"]);
    let said = run(&mut command, "metadata")?;
    serde_json::from_str(&said)
        .map_err(|err| format!("cannot read what cargo metadata says: {err}"))
}

/// What `cargo build` of the C library and the daemon compiles for a platform, a crate a line. What runs during a
/// build is that of this machine, and the same on the others.
fn tree(workspace: &Path, platform: &str, is_offline: bool) -> Result<String, String> {
    let mut command = cargo_in(workspace, is_offline);
    command.args(["tree", "--quiet", "--locked", "--edges", "normal,build", "--prefix", "none"]);
    command.args(["--format", "{p}", "--target", platform]);
    for root in ROOTS {
        command.args(["--package", root]);
    }
    run(&mut command, "tree")
}

/// A cargo that has nothing of the xtask's own surroundings.
fn cargo_in(workspace: &Path, is_offline: bool) -> Command {
    let mut command = Command::new(cargo());
    command.current_dir(workspace).env_remove("CARGO_TARGET_DIR");
    if is_offline {
        command.env("CARGO_NET_OFFLINE", "true");
    }
    command
}

fn run(command: &mut Command, name: &str) -> Result<String, String> {
    let output = command.output().map_err(|err| format!("cannot run cargo {name}: {err}"))?;
    if !output.status.success() {
        return Err(format!(
            "cargo {name} fails: {}\nThe crates of Cargo.lock have to be in cargo's cache, or in reach: \
             run `cargo fetch --locked` with a network first",
            String::from_utf8_lossy(&output.stderr).trim_end()
        ));
    }
    Ok(String::from_utf8_lossy(&output.stdout).into_owned())
}
