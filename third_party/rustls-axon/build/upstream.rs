//! Finding the source of the rustls release that the patches are for.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use serde_json::Value;

/// The `src` directory of the rustls that the workspace's lock file has.
///
/// Asks cargo, offline: rustls is a build dependency, so by now cargo has it on this machine, from
/// a registry or from a vendored copy.
pub(crate) fn locate(
    cargo: &Path,
    crate_dir: &Path,
    host: &str,
    scratch: &Path,
) -> Result<PathBuf, String> {
    let pinned = pinned_version(crate_dir)?;
    // as in the build dependency in `Cargo.toml`
    let range = format!(">={pinned}, <0.24");
    let (found, src) =
        find(cargo, crate_dir, host, scratch, &range, &["--offline"]).map_err(|why| {
            // the lock file of the project being built need not have the version that ours has
            format!(
                "{why}\nIf cargo does not have rustls {pinned} yet, this gets it: \
                 cargo fetch --locked --manifest-path {}",
                crate_dir.join("Cargo.toml").display()
            )
        })?;
    check_version(&found, &pinned)?;
    Ok(src)
}

/// Version and `src` directory of the rustls that cargo picks for `range`, which is the one in the
/// workspace's lock file if that is in it.
///
/// Cargo is asked about a package in `scratch` that depends on rustls and nothing else, because a
/// question about this workspace has no answer before the last optional dependency of its last
/// member was downloaded.
pub(crate) fn find(
    cargo: &Path,
    crate_dir: &Path,
    host: &str,
    scratch: &Path,
    range: &str,
    options: &[&str],
) -> Result<(String, PathBuf), String> {
    let workspace =
        run(cargo, crate_dir, &["locate-project", "--workspace", "--message-format=plain"])?;
    let lock = Path::new(workspace.trim_end()).with_file_name("Cargo.lock");

    let manifest = scratch.join("Cargo.toml");
    let write = |path: &Path, text: &str| {
        fs::write(path, text).map_err(|err| format!("cannot write {}: {err}", path.display()))
    };
    fs::create_dir_all(scratch.join("src"))
        .map_err(|err| format!("cannot create {}: {err}", scratch.display()))?;
    write(&scratch.join("src/lib.rs"), "")?;
    write(
        &manifest,
        &format!(
            "[package]\nname = \"where-is-rustls\"\nversion = \"0.0.0\"\nedition = \"2021\"\n\
             [dependencies]\nrustls = {{ version = \"{range}\", default-features = false }}\n\
             [workspace]\n"
        ),
    )?;
    if lock.exists() {
        fs::copy(&lock, scratch.join("Cargo.lock"))
            .map_err(|err| format!("cannot copy {}: {err}", lock.display()))?;
    }

    let manifest_arg = format!("--manifest-path={}", manifest.display());
    let ask = ["metadata", "--format-version=1", "--filter-platform", host, &manifest_arg];
    let metadata = run(cargo, crate_dir, &[&ask, options].concat())?;
    let metadata: Value = serde_json::from_str(&metadata)
        .map_err(|err| format!("cannot read the output of cargo metadata: {err}"))?;
    rustls_in(&metadata).ok_or_else(|| "cargo metadata does not list rustls".into())
}

/// The version named in the first line of `upstream.sha256`: the only one the patches are for.
pub(crate) fn pinned_version(crate_dir: &Path) -> Result<String, String> {
    let path = crate_dir.join("upstream.sha256");
    let text = fs::read_to_string(&path)
        .map_err(|err| format!("cannot read {}: {err}", path.display()))?;
    text.lines()
        .next()
        .and_then(|line| line.strip_prefix("# rustls "))
        .map(str::to_owned)
        .ok_or_else(|| format!("{}: the first line must be `# rustls VERSION`", path.display()))
}

pub(crate) fn check_version(found: &str, pinned: &str) -> Result<(), String> {
    if found == pinned {
        return Ok(());
    }
    Err(format!(
        "rustls-axon is made from rustls {pinned}, and Cargo.lock has rustls {found}.\n\
         Its patches are not known to be right for any other version.\n\
         To build with the pinned one: cargo update -p rustls@{found} --precise {pinned}\n\
         To move to a newer one: cargo xtask rebase {found}, and see docs/rustls-axon.md"
    ))
}

/// Version and `src` directory of the only rustls that `metadata` lists.
fn rustls_in(metadata: &Value) -> Option<(String, PathBuf)> {
    let packages = metadata["packages"].as_array()?;
    let rustls = packages.iter().find(|package| package["name"] == "rustls")?;
    let manifest = Path::new(rustls["manifest_path"].as_str()?);
    Some((rustls["version"].as_str()?.to_owned(), manifest.parent()?.join("src")))
}

/// Runs cargo where this crate's configuration of registries and vendored sources applies.
fn run(cargo: &Path, crate_dir: &Path, args: &[&str]) -> Result<String, String> {
    let output = Command::new(cargo)
        .args(args)
        .current_dir(crate_dir)
        .output()
        .map_err(|err| format!("cannot run {}: {err}", cargo.display()))?;
    let stderr = String::from_utf8_lossy(&output.stderr);
    if !output.status.success() {
        return Err(format!(
            "cargo {} failed, so rustls's source is not found:\n{stderr}",
            args[0]
        ));
    }
    String::from_utf8(output.stdout).map_err(|err| format!("cargo {}: {err}", args[0]))
}
