//! The files that name the pinned release.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use super::super::{patched_digests, upstream_digests};
use super::{CRATE, Tree, cargo};

/// The lock files that have rustls, and the manifests they belong to.
const LOCKS: [(&str, &str); 3] = [
    ("Cargo.lock", "Cargo.toml"),
    ("bench-peers/Cargo.lock", "bench-peers/Cargo.toml"),
    ("fuzz/Cargo.lock", "fuzz/Cargo.toml"),
];

/// What is going to be in which file; `None` for a file that goes away.
pub(super) struct Edits {
    root: PathBuf,
    files: BTreeMap<String, Option<String>>,
}

impl Edits {
    pub(super) fn new(root: &Path) -> Self {
        Self { root: root.to_owned(), files: BTreeMap::new() }
    }

    pub(super) fn is_empty(&self) -> bool {
        self.files.is_empty()
    }

    pub(super) fn names(&self) -> Vec<&str> {
        self.files.keys().map(String::as_str).collect()
    }

    /// What is going to be in a file that changes.
    #[cfg(test)]
    pub(super) fn text(&self, name: &str) -> Option<&str> {
        self.files.get(name)?.as_deref()
    }

    fn read(&self, name: &str) -> Result<String, String> {
        fs::read_to_string(self.root.join(name)).map_err(|err| format!("cannot read {name}: {err}"))
    }

    /// Files that are right already are no edit.
    fn set(&mut self, name: String, contents: String) {
        if fs::read(self.root.join(&name)).ok() != Some(contents.clone().into_bytes()) {
            self.files.insert(name, Some(contents));
        }
    }

    /// Replaces `from`, which has to be there exactly once: else the file is not what it was when
    /// this was written.
    pub(super) fn replace(&mut self, name: &str, from: &str, to: &str) -> Result<(), String> {
        let text = match self.files.get(name) {
            Some(Some(text)) => text.clone(),
            _ => self.read(name)?,
        };
        match text.matches(from).count() {
            1 => self.set(name.to_owned(), text.replacen(from, to, 1)),
            count => return Err(format!("{name} has `{}` {count} times, not once", from.trim())),
        }
        Ok(())
    }

    /// Writes all of them, to be kept or put back.
    pub(super) fn write(self) -> Result<Written, String> {
        let locks = LOCKS.iter().map(|(lock, _)| (*lock).to_owned());
        let mut before = Written { files: Vec::new(), keep: false };
        for name in self.files.keys().cloned().chain(locks) {
            let path = self.root.join(&name);
            let contents = fs::read(&path).ok();
            before.files.push((path, contents));
        }
        for (name, contents) in &self.files {
            let path = self.root.join(name);
            match contents {
                Some(contents) => fs::write(&path, contents),
                None => fs::remove_file(&path),
            }
            .map_err(|err| format!("cannot write {name}: {err}"))?;
        }
        Ok(before)
    }
}

/// Puts every file back when dropped, but after [`Written::keep()`].
pub(super) struct Written {
    files: Vec<(PathBuf, Option<Vec<u8>>)>,
    keep: bool,
}

impl Written {
    pub(super) fn keep(mut self) {
        self.keep = true;
    }
}

impl Drop for Written {
    fn drop(&mut self) {
        for (path, before) in self.files.iter().filter(|_| !self.keep) {
            let result = match before {
                Some(before) => fs::write(path, before),
                None if path.exists() => fs::remove_file(path),
                None => Ok(()),
            };
            if let Err(err) = result {
                eprintln!("cannot put {} back: {err}", path.display());
            }
        }
    }
}

/// All edits of a move from one release to another.
pub(super) fn plan(
    edits: &mut Edits,
    (pinned, version): (&str, &str),
    released: &Tree,
    made: &Tree,
    patches: &Tree,
) -> Result<(), String> {
    let path = |name: &str| format!("{CRATE}/{name}");
    edits.set(path("upstream.sha256"), upstream_digests(released, version));
    edits.set(path("patched.sha256"), patched_digests(made, version));
    let present = super::tree::read_dir(&edits.root.join(path("patches")))?;
    for name in present.keys().filter(|name| !patches.contains_key(*name)) {
        edits.files.insert(path(&format!("patches/{name}")), None);
    }
    for (name, text) in patches {
        edits.set(path(&format!("patches/{name}")), text.clone());
    }
    if pinned == version {
        return Ok(());
    }

    for (name, place) in [
        (path("Cargo.toml"), "+rustls.VERSION\"\n"),
        (path("Cargo.toml"), "\nrustls = { version = \">=VERSION, <0.24\""),
        (path("src/lib.rs"), "This is rustls VERSION with"),
        (path("src/lib.rs"), "https://docs.rs/rustls/VERSION\n"),
        (path("README.md"), "[rustls](https://docs.rs/rustls) VERSION with"),
        (path("README.md"), "+rustls.VERSION`"),
        (path("CHANGELOG.md"), "+rustls.VERSION`)."),
        ("docs/release.md".into(), "+rustls.VERSION`"),
        ("docs/rustls-axon.md".into(), "`third_party/rustls-axon` is rustls VERSION with"),
        ("docs/rustls-axon.md".into(), "+rustls.VERSION`"),
    ] {
        let with = |version: &str| place.replace("VERSION", version);
        edits.replace(&name, &with(pinned), &with(version))?;
    }
    Ok(())
}

/// Makes the lock files have `version`.
pub(super) fn update_locks(root: &Path, version: &str) -> Result<(), String> {
    for (lock, manifest) in LOCKS {
        let Ok(text) = fs::read_to_string(root.join(lock)) else { continue };
        let Some(locked) = locked(&text) else { continue };
        let package = format!("rustls@{locked}");
        let output = Command::new(cargo())
            .args(["update", "--quiet", "--package", &package, "--precise", version])
            .arg("--manifest-path")
            .arg(root.join(manifest))
            .current_dir(root)
            .output()
            .map_err(|err| format!("cannot run cargo: {err}"))?;
        if !output.status.success() {
            let why = String::from_utf8_lossy(&output.stderr);
            return Err(format!("{lock} cannot be moved, so nothing was changed:\n{why}"));
        }
    }
    Ok(())
}

/// The release of rustls 0.23 in a lock file.
fn locked(lock: &str) -> Option<&str> {
    lock.split("\nname = \"rustls\"\nversion = \"")
        .skip(1)
        .filter_map(|rest| rest.split('"').next())
        .find(|version| version.starts_with("0.23."))
}
