//! The archive of the source package: the same bytes for the same commit.

use std::path::Path;
use std::process::Command;

/// Packs `name`, a folder in `parent`, without `debian/`. `seconds` since 1970 become the time of all files.
pub(super) fn pack(parent: &Path, name: &str, to: &Path, seconds: &str) -> Result<u64, String> {
    let mut command = Command::new("tar");
    command
        .current_dir(parent)
        .args([
            "--create",
            "--format=gnu",
            "--sort=name",
            "--owner=0",
            "--group=0",
            "--numeric-owner",
        ])
        .arg("--mode=u+rw,go=rX")
        .arg(format!("--mtime=@{seconds}"))
        .arg(format!("--exclude={name}/debian"))
        .args(["--use-compress-program", "gzip -9n", "--file"])
        .arg(to)
        .arg(name);
    let output = command.output().map_err(|err| format!("cannot run tar: {err}"))?;
    if !output.status.success() {
        return Err(format!("tar fails: {}", String::from_utf8_lossy(&output.stderr).trim_end()));
    }
    let about = to.metadata().map_err(|err| format!("{}: {err}", to.display()))?;
    Ok(about.len())
}

/// A number of bytes, for people.
pub(super) fn megabytes(bytes: u64) -> String {
    let tenths = (bytes + 50_000) / 100_000;
    format!("{}.{} MB", tenths / 10, tenths % 10)
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    #[test]
    fn archive_depends_on_the_files_alone_and_has_no_debian() {
        let pack_one = |first: &str, second: &str| {
            let folder = tempfile::tempdir().unwrap();
            for name in [first, second, "debian/control"] {
                super::super::files::write(&folder.path().join("p").join(name), name).unwrap();
            }
            let to = folder.path().join("p.tar.gz");
            let size = pack(folder.path(), "p", &to, "1000").unwrap();
            let bytes = fs::read(&to).unwrap();
            assert_eq!(bytes.len() as u64, size);
            let listed = Command::new("tar").arg("-tf").arg(&to).output().unwrap().stdout;
            assert_eq!(String::from_utf8_lossy(&listed), "p/\np/a\np/b/\np/b/c\n");
            bytes
        };
        assert_eq!(pack_one("a", "b/c"), pack_one("b/c", "a"));
    }

    #[test]
    fn sizes_are_rounded() {
        assert_eq!(megabytes(12_340_000), "12.3 MB");
        assert_eq!(megabytes(49_999), "0.0 MB");
    }
}
