//! Packages for a registry, from a copy of the workspace in which rustls-axon has its patched source.

use std::env;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use super::rustls_axon::{self, cargo, git, workspace};

/// What is published, each crate after those it depends on.
pub(crate) const PUBLISHED: [&str; 8] = [
    "etsi-qkd014",
    "axon-envelope",
    "rustls-axon",
    "axon-tls",
    "axon-shm",
    "axon-transport",
    "axon-daemon",
    "axon-cli",
];

/// Which crates, and how.
#[derive(Debug, Default, PartialEq, Eq)]
pub(crate) struct Options<'a> {
    /// Empty for all of [`PUBLISHED`].
    crates: Vec<&'a str>,
    /// Packages changes that are not committed.
    allow_dirty: bool,
    /// The directory that gets `package/` and the copy; `target/` unless told otherwise.
    target_dir: Option<&'a Path>,
    /// For `cargo package`.
    passed_on: Vec<&'a str>,
}

impl<'a> Options<'a> {
    /// `None` for arguments that are not known.
    pub(crate) fn parse(mut args: &[&'a str]) -> Option<Self> {
        let mut options = Self::default();
        while let [first, rest @ ..] = args {
            args = rest;
            match (*first, rest) {
                ("--allow-dirty", _) => options.allow_dirty = true,
                ("--no-verify" | "--offline", _) => options.passed_on.push(*first),
                ("--target-dir", [dir, rest @ ..]) => {
                    options.target_dir = Some(Path::new(*dir));
                    args = rest;
                }
                (name, _) if PUBLISHED.contains(&name) => options.crates.push(name),
                _ => return None,
            }
        }
        Some(options)
    }
}

/// Makes the packages; says where they are, and how they are published.
pub(crate) fn package(options: &Options<'_>) -> Result<String, String> {
    let root = workspace();
    refuse_dirty(root, options.allow_dirty)?;
    let target = options.target_dir.map_or_else(|| root.join("target"), Path::to_owned);
    let target = std::path::absolute(&target)
        .map_err(|err| format!("cannot use {}: {err}", target.display()))?;
    let copy = target.join("package-tree");
    copy_workspace(root, &copy)?;
    rustls_axon::write_packaged_form(&copy)?;

    let crates: &[&str] = if options.crates.is_empty() { &PUBLISHED } else { &options.crates };
    forget_unpacked(crates);
    let manifest = copy.join("Cargo.toml");
    let mut command = Command::new(cargo());
    command.arg("package").arg("--manifest-path").arg(&manifest);
    command.arg("--target-dir").arg(&target).args(&options.passed_on);
    for name in crates {
        command.args(["--package", name]);
    }
    // What verifies the packages is thrown away. With debug information it takes gigabytes.
    command.env("CARGO_PROFILE_DEV_DEBUG", "0");
    let status = command
        .current_dir(&copy)
        .status()
        .map_err(|err| format!("cannot run cargo package: {err}"))?;
    if !status.success() {
        return Err("cargo package failed".into());
    }
    let packages = target.join("package");
    Ok(format!(
        "packages of {} are in {}\nto publish one: cargo publish --manifest-path {} --package NAME",
        crates.join(", "),
        packages.display(),
        manifest.display()
    ))
}

/// Fails where there are changes that are not committed, unless that is allowed. Returns true if there are any.
pub(crate) fn refuse_dirty(root: &Path, allow_dirty: bool) -> Result<bool, String> {
    let changed = git(root, &["status", "--porcelain"]).unwrap_or_default();
    if !allow_dirty && !changed.is_empty() {
        return Err(format!(
            "changes that are not committed would be packaged; commit them, or say --allow-dirty:\n{}",
            changed.trim_end()
        ));
    }
    Ok(!changed.is_empty())
}

/// The files of the workspace that git knows or would know, or without git all but build directories.
pub(crate) fn copied_files(root: &Path) -> Result<Vec<String>, String> {
    match git(root, &["ls-files", "-z", "--cached", "--others", "--exclude-standard"]) {
        Ok(list) => {
            Ok(list.split('\0').filter(|name| !name.is_empty()).map(str::to_owned).collect())
        }
        Err(_) => {
            let mut files = Vec::new();
            rustls_axon::walk(root, "", &mut files)?;
            Ok(files)
        }
    }
}

/// Makes `copy` hold these files.
fn copy_workspace(root: &Path, copy: &Path) -> Result<(), String> {
    let files = copied_files(root)?;
    if copy.exists() {
        fs::remove_dir_all(copy)
            .map_err(|err| format!("cannot remove {}: {err}", copy.display()))?;
    }
    // a tracked file may have been removed
    for name in files.iter().filter(|name| root.join(name).is_file()) {
        let (from, to) = (root.join(name), copy.join(name));
        to.parent()
            .map_or(Ok(()), fs::create_dir_all)
            .and_then(|()| fs::copy(&from, &to).map(drop))
            .map_err(|err| format!("cannot copy {}: {err}", from.display()))?;
    }
    Ok(())
}

/// Removes what cargo unpacked of earlier packages: it goes by the version alone, and would verify the
/// other packages against the sources of then.
fn forget_unpacked(crates: &[&str]) {
    let home = env::var_os("CARGO_HOME")
        .map(PathBuf::from)
        .or_else(|| env::var_os("HOME").map(|home| PathBuf::from(home).join(".cargo")));
    let Some(Ok(registries)) = home.map(|home| fs::read_dir(home.join("registry/src"))) else {
        return;
    };
    // a registry on this machine has no host in its name
    for registry in
        registries.flatten().filter(|dir| dir.file_name().to_string_lossy().starts_with('-'))
    {
        for unpacked in fs::read_dir(registry.path()).into_iter().flatten().flatten() {
            let name = unpacked.file_name().to_string_lossy().into_owned();
            let is_ours = |ours: &&str| {
                name.strip_prefix(*ours).and_then(|rest| rest.strip_prefix('-')).is_some_and(
                    |version| version.starts_with(|first: char| first.is_ascii_digit()),
                )
            };
            if crates.iter().any(is_ours) {
                let _ = fs::remove_dir_all(unpacked.path());
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn arguments_are_crates_and_known_options() {
        assert_eq!(Options::parse(&[]), Some(Options::default()));
        let options =
            Options::parse(&["rustls-axon", "--target-dir", "out", "--no-verify"]).unwrap();
        assert_eq!(options.crates, ["rustls-axon"]);
        assert_eq!(options.target_dir, Some(Path::new("out")));
        assert_eq!(options.passed_on, ["--no-verify"]);
        assert!(!options.allow_dirty);
        assert!(Options::parse(&["--allow-dirty"]).unwrap().allow_dirty);
        for wrong in [&["xtask"][..], &["--target-dir"], &["--list"], &["rustls"]] {
            assert_eq!(Options::parse(wrong), None);
        }
    }
}
