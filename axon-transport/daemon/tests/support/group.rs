//! A control group with little memory, if one can be created.

use std::{
    fs,
    path::{Path, PathBuf},
};

/// A control group. Dropping it removes it; it must be empty by then.
pub(crate) struct Group(PathBuf);

impl Group {
    /// Creates a group whose processes may have `bytes` of memory. Returns the reason if that is
    /// not possible.
    pub(crate) fn new(bytes: u64) -> Result<Self, String> {
        let name = format!("axon-test-{}", std::process::id());
        let of = |root: &str, limit: &str| {
            let group = Path::new(root).join(&name);
            fs::create_dir(&group).map_err(|e| format!("{}: {e}", group.display()))?;
            let made = Self(group);
            fs::write(made.0.join(limit), bytes.to_string())
                .map_err(|e| format!("{}: {e}", made.0.join(limit).display()))?;
            Ok(made)
        };
        if Path::new("/sys/fs/cgroup/cgroup.controllers").exists() {
            of("/sys/fs/cgroup", "memory.max")
        } else {
            of("/sys/fs/cgroup/memory", "memory.limit_in_bytes")
        }
    }

    /// Returns its directory.
    pub(crate) fn path(&self) -> &Path {
        &self.0
    }
}

impl Drop for Group {
    fn drop(&mut self) {
        let _ = fs::remove_dir(&self.0);
    }
}

/// Moves the calling process to the group with this directory.
pub(crate) fn join(group: &Path) -> std::io::Result<()> {
    fs::write(group.join("cgroup.procs"), std::process::id().to_string())
}
