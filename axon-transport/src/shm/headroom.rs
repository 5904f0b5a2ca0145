//! How much memory this process may still take.
//!
//! Exceeding a control group's limit gets a process killed rather than an error, so rings ask
//! before they grow.

use std::{
    fs,
    path::{Path, PathBuf},
};

use super::ShmError;

/// Left free for everybody else.
const RESERVE: u64 = 8 << 20;

/// Whether `needed` bytes more can be taken without starving the host or the control group.
pub(super) fn check(needed: u64) -> Result<(), ShmError> {
    match available() {
        Some(available) if available < needed.saturating_add(RESERVE) => {
            Err(ShmError::NoMemory { needed, available })
        }
        _ => Ok(()),
    }
}

#[cfg(test)]
thread_local! {
    /// What a test has this thread believe to be available.
    pub(super) static PRETENDED: std::cell::Cell<Option<u64>> = const { std::cell::Cell::new(None) };
}

/// Bytes available to this process, or `None` where the system does not tell.
pub(super) fn available() -> Option<u64> {
    #[cfg(test)]
    if let Some(pretended) = PRETENDED.get() {
        return Some(pretended);
    }
    available_in(Path::new("/proc"), Path::new("/sys/fs/cgroup"))
}

fn available_in(proc: &Path, cgroup: &Path) -> Option<u64> {
    let host = fs::read_to_string(proc.join("meminfo"))
        .ok()
        .and_then(|text| field(&text, "MemAvailable:"))
        .map(|kib| kib.saturating_mul(1024));
    let groups = fs::read_to_string(proc.join("self/cgroup")).unwrap_or_default();
    groups
        .lines()
        .filter_map(|line| {
            let mut parts = line.splitn(3, ':');
            let (_, controllers, path) = (parts.next()?, parts.next()?, parts.next()?);
            let path = path.trim_start_matches('/');
            if controllers.is_empty() {
                lowest(cgroup, path, &V2)
            } else if controllers.split(',').any(|c| c == "memory") {
                lowest(&cgroup.join("memory"), path, &V1)
            } else {
                None
            }
        })
        .chain(host)
        .min()
}

struct Files {
    limit: &'static str,
    usage: &'static str,
    reclaimable: &'static str,
}

const V2: Files =
    Files { limit: "memory.max", usage: "memory.current", reclaimable: "inactive_file" };
const V1: Files = Files {
    limit: "memory.limit_in_bytes",
    usage: "memory.usage_in_bytes",
    reclaimable: "total_inactive_file",
};

/// The tightest of the limits of a group and its ancestors.
fn lowest(root: &Path, group: &str, files: &Files) -> Option<u64> {
    let mut directory: PathBuf = root.join(group);
    let mut lowest = None;
    loop {
        lowest = lowest.into_iter().chain(room(&directory, files)).min();
        if directory == root || !directory.pop() || !directory.starts_with(root) {
            return lowest;
        }
    }
}

fn room(directory: &Path, files: &Files) -> Option<u64> {
    let number = |name| fs::read_to_string(directory.join(name)).ok()?.trim().parse::<u64>().ok();
    // A group without a limit says "max", which is no number.
    let limit = number(files.limit)?;
    let usage = number(files.usage)?;
    let reclaimable = fs::read_to_string(directory.join("memory.stat"))
        .ok()
        .and_then(|text| field(&text, files.reclaimable))
        .unwrap_or(0);
    Some(limit.saturating_sub(usage.saturating_sub(reclaimable)))
}

/// The number after `name` at the start of a line.
fn field(text: &str, name: &str) -> Option<u64> {
    text.lines().find_map(|line| {
        let mut words = line.split_whitespace();
        (words.next()? == name).then(|| words.next()?.parse().ok())?
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn write(root: &Path, path: &str, text: &str) {
        let path = root.join(path);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(path, text).unwrap();
    }

    #[test]
    fn the_tightest_limit_of_host_and_groups_holds() {
        let directory = tempfile::tempdir().unwrap();
        let root = directory.path();
        let (proc, cgroup) = (root.join("proc"), root.join("cgroup"));
        assert_eq!(available_in(&proc, &cgroup), None);

        write(&proc, "meminfo", "MemTotal: 9000 kB\nMemAvailable:   4000 kB\n");
        write(&proc, "self/cgroup", "9:name=systemd:/\n4:cpu,memory:/x\n0::/a/b\ngarbage\n");
        assert_eq!(available_in(&proc, &cgroup), Some(4_096_000));

        write(&cgroup, "a/b/memory.max", "max\n");
        write(&cgroup, "a/b/memory.current", "1\n");
        write(&cgroup, "a/memory.max", "1000000\n");
        write(&cgroup, "a/memory.current", "400000\n");
        write(&cgroup, "a/memory.stat", "anon 5\ninactive_file 100000\n");
        assert_eq!(available_in(&proc, &cgroup), Some(700_000));

        write(&cgroup, "memory/x/memory.limit_in_bytes", "500000\n");
        write(&cgroup, "memory/x/memory.usage_in_bytes", "600000\n");
        assert_eq!(available_in(&proc, &cgroup), Some(0));
    }

    #[test]
    fn this_host_tells() {
        assert!(available().is_some_and(|bytes| bytes > 0));
        assert!(matches!(check(u64::MAX), Err(ShmError::NoMemory { .. })));
    }
}
