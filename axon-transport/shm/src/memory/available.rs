//! The number of bytes of memory that this process may still allocate: the minimum of the remaining memory of the
//! host and of the process's control groups.
//!
//! A process that exceeds a control group's limit is killed and gets no error, so rings check before they grow.

use std::{fs::File, io::Read as _, path::Path};

use crate::error::ShmError;

/// Bytes that are left free for other processes.
const RESERVE: u64 = 8 << 20;

/// Checks that `needed` bytes can be allocated without exhausting the memory of the host or the control group.
pub(crate) fn check(needed: u64) -> Result<(), ShmError> {
    let enough = needed.saturating_add(RESERVE);
    match at_most(enough) {
        Some(available) if available < enough => Err(ShmError::NoMemory { needed, available }),
        _ => Ok(()),
    }
}

#[cfg(test)]
thread_local! {
    /// The available memory that a test makes this thread believe in.
    pub(crate) static PRETENDED: std::cell::Cell<Option<u64>> = const { std::cell::Cell::new(None) };
}

/// Returns the bytes available to this process; `None` if the system does not tell.
pub(crate) fn bytes() -> Option<u64> {
    at_most(u64::MAX)
}

/// Like [`bytes`], but the result may be too low if it is at least `enough`.
fn at_most(enough: u64) -> Option<u64> {
    #[cfg(test)]
    if let Some(pretended) = PRETENDED.get() {
        return Some(pretended);
    }
    available_in(Path::new("/proc"), Path::new("/sys/fs/cgroup"), enough)
}

fn available_in(proc: &Path, cgroup: &Path, enough: u64) -> Option<u64> {
    let mut text = String::with_capacity(4096);
    let host = read(&proc.join("meminfo"), &mut text)
        .and_then(|text| field(text, "MemAvailable:"))
        .map(|kib| kib.saturating_mul(1024));
    let mut groups = String::with_capacity(1024);
    read(&proc.join("self/cgroup"), &mut groups);
    groups
        .lines()
        .filter_map(|line| {
            let mut parts = line.splitn(3, ':');
            let (_, controllers, path) = (parts.next()?, parts.next()?, parts.next()?);
            let path = path.trim_start_matches('/');
            if controllers.is_empty() {
                lowest(cgroup, path, &V2, enough, &mut text)
            } else if controllers.split(',').any(|c| c == "memory") {
                lowest(&cgroup.join("memory"), path, &V1, enough, &mut text)
            } else {
                None
            }
        })
        .chain(host)
        .min()
}

struct MemoryFiles {
    limit: &'static str,
    usage: &'static str,
    reclaimable: &'static str,
}

const V2: MemoryFiles =
    MemoryFiles { limit: "memory.max", usage: "memory.current", reclaimable: "inactive_file " };
const V1: MemoryFiles = MemoryFiles {
    limit: "memory.limit_in_bytes",
    usage: "memory.usage_in_bytes",
    reclaimable: "total_inactive_file ",
};

/// Returns the least memory left to a group and its ancestors by their limits.
fn lowest(
    root: &Path,
    group: &str,
    files: &MemoryFiles,
    enough: u64,
    text: &mut String,
) -> Option<u64> {
    let groups = Path::new(group).ancestors();
    groups.filter_map(|group| room(&root.join(group), files, enough, text)).min()
}

fn room(directory: &Path, files: &MemoryFiles, enough: u64, text: &mut String) -> Option<u64> {
    let mut number = |name| read(&directory.join(name), text)?.trim_ascii().parse::<u64>().ok();
    // A group without a limit says "max", which does not parse as a number.
    let limit = number(files.limit)?;
    let usage = number(files.usage)?;
    let left = limit.saturating_sub(usage);
    if left >= enough {
        // Reading memory.stat makes the kernel add up the counters of all processors.
        return Some(left);
    }
    let reclaimable = read(&directory.join("memory.stat"), text)
        .and_then(|text| field(text, files.reclaimable))
        .unwrap_or(0);
    Some(limit.saturating_sub(usage.saturating_sub(reclaimable)))
}

/// Reads a file of the kernel, whose length is not known beforehand, into `text`.
fn read<'a>(path: &Path, text: &'a mut String) -> Option<&'a str> {
    text.clear();
    File::open(path).ok()?.read_to_string(text).ok()?;
    Some(text)
}

/// Returns the number after `name` at the start of a line.
fn field(text: &str, name: &str) -> Option<u64> {
    let starts_line = |at: usize| at == 0 || text.as_bytes()[at - 1] == b'\n';
    let (at, _) = text.match_indices(name).find(|(at, _)| starts_line(*at))?;
    text[at + name.len()..].split_ascii_whitespace().next()?.parse().ok()
}

#[cfg(test)]
mod tests {
    use std::fs;

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
        assert_eq!(available_in(&proc, &cgroup, u64::MAX), None);

        write(&proc, "meminfo", "MemTotal: 9000 kB\nMemAvailable:   4000 kB\n");
        write(&proc, "self/cgroup", "9:name=systemd:/\n4:cpu,memory:/x\n0::/a/b\ngarbage\n");
        assert_eq!(available_in(&proc, &cgroup, u64::MAX), Some(4_096_000));

        write(&cgroup, "a/b/memory.max", "max\n");
        write(&cgroup, "a/b/memory.current", "1\n");
        write(&cgroup, "a/memory.max", "1000000\n");
        write(&cgroup, "a/memory.current", "400000\n");
        write(&cgroup, "a/memory.stat", "anon 5\ninactive_file 100000\n");
        assert_eq!(available_in(&proc, &cgroup, u64::MAX), Some(700_000));
        assert_eq!(available_in(&proc, &cgroup, 600_001), Some(700_000));
        assert_eq!(
            available_in(&proc, &cgroup, 600_000),
            Some(600_000),
            "enough without the cache"
        );

        write(&cgroup, "memory/x/memory.limit_in_bytes", "500000\n");
        write(&cgroup, "memory/x/memory.usage_in_bytes", "600000\n");
        assert_eq!(available_in(&proc, &cgroup, u64::MAX), Some(0));
    }

    #[test]
    fn a_field_is_the_whole_word_that_a_line_begins_with() {
        let text = "total_inactive_file 1\ninactive_file 2\ninactive_file 3\nlast 4";
        assert_eq!(field(text, "inactive_file "), Some(2));
        assert_eq!(field(text, "total_inactive_file "), Some(1));
        assert_eq!(field(text, "last "), Some(4));
        for absent in ["file ", "total ", "1", "other ", "last 4"] {
            assert_eq!(field(text, absent), None, "{absent}");
        }
    }

    #[test]
    fn this_host_tells() {
        assert!(bytes().is_some_and(|bytes| bytes > 0));
        assert!(matches!(check(u64::MAX), Err(ShmError::NoMemory { .. })));
    }
}
