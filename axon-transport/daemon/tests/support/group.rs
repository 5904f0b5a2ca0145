//! A control group with little memory, where one may be made.

use std::{
    fs,
    path::{Path, PathBuf},
};

/// Removed when dropped, by when it must be empty.
pub(crate) struct Group(PathBuf);

impl Group {
    /// A group whose processes may have `bytes` of memory; or why there can be none.
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

    /// Its directory.
    pub(crate) fn path(&self) -> &Path {
        &self.0
    }
}

impl Drop for Group {
    fn drop(&mut self) {
        let _ = fs::remove_dir(&self.0);
    }
}

/// Moves the calling process to the group of this directory.
pub(crate) fn join(group: &Path) -> std::io::Result<()> {
    fs::write(group.join("cgroup.procs"), std::process::id().to_string())
}
