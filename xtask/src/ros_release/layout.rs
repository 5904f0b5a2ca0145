//! Where each file of the repository goes in the source package.
//!
//! `rmw_axon/` becomes the root, as bloom wants a package. The crates go to `axon/`, a workspace of their own.

use std::fs;
use std::path::Path;

/// The folder of the crates, in the source package.
pub(super) const CORE: &str = "axon";

/// The crates that `librmw_axon.so` and `axon_daemon` are built from, where the repository has them.
pub(super) const CRATES: [&str; 8] = [
    "etsi-qkd014",
    "axon-envelope",
    "axon-tls",
    "rmw_axon/core",
    "third_party/rustls-axon",
    "axon-transport/shm",
    "axon-transport",
    "axon-transport/daemon",
];

/// Returns the path in the source package, or `None` for a file that is not part of it.
pub(super) fn destination(path: &str) -> Option<String> {
    let core = || Some(format!("{CORE}/{path}"));
    if matches!(path, "Cargo.toml" | "Cargo.lock") {
        return core();
    }
    if matches!(path, "LICENSE-MIT" | "LICENSE-APACHE") {
        return Some(path.to_owned());
    }
    if let Some((folder, within)) = of_crate(path) {
        let (first, _) = within.split_once('/').unwrap_or((within, ""));
        // rustls-axon's packaged form is made from the rest of its folder.
        let is_source = matches!(first, "Cargo.toml" | "README.md" | "src" | "include");
        return if is_source || folder == "third_party/rustls-axon" { core() } else { None };
    }
    let within = path.strip_prefix("rmw_axon/")?;
    let (first, _) = within.split_once('/').unwrap_or((within, ""));
    match first {
        // Simulated keys belong in no binary package, and their simulator needs more crates.
        "qkd" | "fuzz" => None,
        // It is for a checkout: tests/ros/test_core builds it.
        "test" if within.starts_with("test/core/") => None,
        _ => Some(within.to_owned()),
    }
}

/// The crate that a file belongs to, by the longest path, and the file's path in it.
fn of_crate(path: &str) -> Option<(&'static str, &str)> {
    let within = |folder: &'static str| {
        path.strip_prefix(folder)
            .and_then(|rest| rest.strip_prefix('/'))
            .map(|within| (folder, within))
    };
    CRATES.into_iter().filter_map(within).max_by_key(|(folder, _)| folder.len())
}

/// Copies the files of the source package from `root` to `to`.
pub(super) fn copy(root: &Path, files: &[String], to: &Path) -> Result<(), String> {
    for name in files {
        let Some(destination) = destination(name) else { continue };
        let (from, to) = (root.join(name), to.join(destination));
        // A tracked file may have been removed.
        if !from.is_file() {
            continue;
        }
        to.parent()
            .map_or(Ok(()), fs::create_dir_all)
            .and_then(|()| fs::copy(&from, &to).map(drop))
            .map_err(|err| format!("cannot copy {} to {}: {err}", from.display(), to.display()))?;
    }
    Ok(())
}

/// The README with links to the repository's pages in place of those to folders that are not in the package.
pub(super) fn readme(text: &str, repository: &str) -> String {
    text.replace("](../", &format!("]({repository}/blob/main/"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rmw_axon_is_the_root_and_crates_are_below_axon() {
        for (path, expected) in [
            ("rmw_axon/package.xml", "package.xml"),
            ("rmw_axon/src/cdr/plan.cpp", "src/cdr/plan.cpp"),
            ("rmw_axon/test/cargo.cmake", "test/cargo.cmake"),
            ("rmw_axon/core/Cargo.toml", "axon/rmw_axon/core/Cargo.toml"),
            ("Cargo.lock", "axon/Cargo.lock"),
            ("LICENSE-MIT", "LICENSE-MIT"),
            ("axon-transport/include/axon.h", "axon/axon-transport/include/axon.h"),
            ("axon-transport/daemon/src/lib.rs", "axon/axon-transport/daemon/src/lib.rs"),
            (
                "third_party/rustls-axon/patches/0001-a.patch",
                "axon/third_party/rustls-axon/patches/0001-a.patch",
            ),
        ] {
            assert_eq!(destination(path).as_deref(), Some(expected), "{path}");
        }
    }

    #[test]
    fn tests_tools_and_documents_stay_out() {
        for path in [
            "docs/architecture.md",
            "axon-cli/src/main.rs",
            "axon-transport/tests/topics.rs",
            "axon-transport/daemon/tests/kill.rs",
            "axon-tls/benches/handshake.rs",
            "axon-tls/COLCON_IGNORE",
            "rmw_axon/qkd/make-profile",
            "rmw_axon/fuzz/decode.cpp",
            "rmw_axon/test/core/CMakeLists.txt",
            "xtask/Cargo.toml",
        ] {
            assert_eq!(destination(path), None, "{path}");
        }
    }

    #[test]
    fn links_lead_to_the_repository() {
        let text = "[one](../docs/a.md#b) and [two](#here)";
        assert_eq!(
            readme(text, "https://host/axon"),
            "[one](https://host/axon/blob/main/docs/a.md#b) and [two](#here)"
        );
    }
}
