//! Which files of a vendored crate are left out, and its checksums without them.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::Path;

use serde_json::{Map, Value};

use super::files::{below, read, remove, write};

/// Folders at the top of a crate that hold no source of a library.
const UNUSED: [&str; 3] = ["testdata", "fuzz", "ci"];

/// How the names of more such folders begin.
const UNUSED_STARTS: [&str; 4] = ["tests", "test-", "bench", "example"];

/// Parts of paths that are for other platforms or for tests alone, of crates where this is much.
const UNUSED_OF: [(&str, &[&str]); 3] = [
    (
        "aws-lc-sys",
        &[
            "aws-lc/generated-src/mac-",
            "aws-lc/generated-src/ios-",
            "aws-lc/generated-src/win-",
            "builder/prebuilt-nasm/",
            "src/*_apple_*",
            "src/*_windows_*",
            "src/*_android_*",
            "aws-lc/*_test.cc",
        ],
    ),
    ("libc", &["src/windows/", "src/fuchsia/", "src/wasi/", "src/unix/bsd/"]),
    (
        "linux-raw-sys",
        &["src/mips", "src/m68k/", "src/sparc", "src/hexagon/", "src/xtensa/", "src/csky/"],
    ),
];

/// True for a file that `cargo build` for Linux reads, or that says what the crate is and under which licence.
///
/// Git and debhelper leave files out by their names: `dh_clean` removes `*.orig`, and `.gitignore` and
/// `.gitattributes` of a crate would act in the repository that bloom makes. Cargo then misses a file of which it
/// has the checksum, so that they are left out before.
pub(super) fn is_kept(package: &str, path: &str) -> bool {
    let name = path.rsplit('/').next().unwrap_or(path);
    let is_hidden = path.split('/').any(|part| part.starts_with('.'));
    let is_cleaned = [".orig", ".rej", ".bak", "~"].iter().any(|end| name.ends_with(end))
        || matches!(name, "DEADJOE" | "TAGS")
        || name.starts_with('#');
    if is_hidden || is_cleaned || path == "Cargo.lock" {
        return false;
    }
    // A licence is kept wherever it stands.
    if super::copyright::is_licence(name) {
        return true;
    }
    if let Some((folder, _)) = path.split_once('/')
        && (UNUSED.contains(&folder) || UNUSED_STARTS.iter().any(|start| folder.starts_with(start)))
    {
        return false;
    }
    let unused = UNUSED_OF.iter().find(|(name, _)| *name == package).map_or(&[][..], |(_, of)| of);
    !unused.iter().any(|pattern| fits(path, pattern))
}

/// True if the path begins with the pattern. A pattern with a `*` has to fit as a whole: what comes before the first
/// one, what comes after the last, and in between what stands between two.
fn fits(path: &str, pattern: &str) -> bool {
    let Some((start, rest)) = pattern.split_once('*') else { return path.starts_with(pattern) };
    let Some(path) = path.strip_prefix(start) else { return false };
    match rest.rsplit_once('*') {
        Some((middle, end)) => path.ends_with(end) && path.contains(middle),
        None => path.ends_with(rest),
    }
}

/// Removes the files of a vendored crate that are not needed, from the folder and from its checksums.
pub(super) fn crate_folder(package: &str, folder: &Path) -> Result<(), String> {
    let files = below(folder)?;
    let mut kept: BTreeSet<String> =
        files.iter().filter(|path| is_kept(package, path)).cloned().collect();
    let sources: Vec<_> = kept.iter().filter(|path| path.ends_with(".rs")).cloned().collect();
    for source in &sources {
        kept.extend(included(source, &read(&folder.join(source))?));
    }
    for path in files.iter().filter(|path| *path != CHECKSUMS && !kept.contains(*path)) {
        remove(&folder.join(path))?;
    }
    let text = read(&folder.join(CHECKSUMS))?;
    let text = checksums(&text, |path| kept.contains(path))
        .map_err(|why| format!("{}/{CHECKSUMS}: {why}", folder.display()))?;
    write(&folder.join(CHECKSUMS), &text)?;
    remove_empty(folder).map(drop)
}

/// The files that a source includes, as the documentation of a crate may include its examples.
fn included(source: &str, text: &str) -> Vec<String> {
    let mut found = Vec::new();
    for line in text.lines().filter(|line| !line.trim_start().starts_with("//")) {
        for part in ["include!(\"", "include_str!(\"", "include_bytes!(\""] {
            let literals = line.split(part).skip(1).filter_map(|rest| rest.split('"').next());
            found.extend(literals.filter_map(|literal| resolved(source, literal)));
        }
    }
    found
}

/// A path that stands in a file, from the crate's folder. `None` for one that leads out of it.
fn resolved(source: &str, relative: &str) -> Option<String> {
    let mut parts: Vec<&str> = source.split('/').collect();
    parts.pop();
    for part in relative.split('/') {
        match part {
            "." => {}
            ".." => drop(parts.pop()?),
            name => parts.push(name),
        }
    }
    Some(parts.join("/"))
}

/// Replaces a vendored crate by its stand-in.
pub(super) fn stand_in(folder: &Path, manifest: &str) -> Result<(), String> {
    let checksums_of_all = read(&folder.join(CHECKSUMS))?;
    fs::remove_dir_all(folder)
        .and_then(|()| fs::create_dir_all(folder.join("src")))
        .map_err(|err| format!("cannot make {} anew: {err}", folder.display()))?;
    write(&folder.join("Cargo.toml"), manifest)?;
    write(&folder.join("src/lib.rs"), STAND_IN)?;
    let text = checksums(&checksums_of_all, |_| false)
        .map_err(|why| format!("{}/{CHECKSUMS}: {why}", folder.display()))?;
    write(&folder.join(CHECKSUMS), &text)
}

/// The source of a crate that is left out.
const STAND_IN: &str = "compile_error!(\n    \"the source package of rmw_axon does not have this crate: \
    it has what x86_64 and aarch64 Linux need. Build from a checkout of the repository instead\"\n);\n";

/// Cargo's file of the digests of a vendored crate.
pub(super) const CHECKSUMS: &str = ".cargo-checksum.json";

/// The checksums of the files that are kept. That of the whole package stays: the lock file has it.
fn checksums(text: &str, is_kept: impl Fn(&str) -> bool) -> Result<String, String> {
    let mut value: Map<String, Value> =
        serde_json::from_str(text).map_err(|err| format!("cannot be read: {err}"))?;
    let files = value.get_mut("files").and_then(Value::as_object_mut).ok_or("has no `files`")?;
    let kept: BTreeMap<String, Value> = files
        .iter()
        .filter(|(path, _)| is_kept(path))
        .map(|(p, v)| (p.clone(), v.clone()))
        .collect();
    *files = kept.into_iter().collect();
    Ok(Value::Object(value).to_string())
}

/// Removes folders without a file; returns true if `folder` is one.
fn remove_empty(folder: &Path) -> Result<bool, String> {
    let shown = |err| format!("{}: {err}", folder.display());
    let mut is_empty = true;
    for entry in fs::read_dir(folder).map_err(shown)? {
        let path = entry.map_err(shown)?.path();
        if path.is_dir() && remove_empty(&path)? {
            fs::remove_dir(&path).map_err(shown)?;
        } else {
            is_empty = false;
        }
    }
    Ok(is_empty)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sources_licences_and_readmes_are_kept() {
        for path in [
            "Cargo.toml",
            "src/lib.rs",
            "src/tests/mod.rs",
            "build.rs",
            "README.md",
            "LICENSE-MIT",
            "tests/data/COPYING",
            "cilk/a.c",
        ] {
            assert!(is_kept("any", path), "{path}");
        }
        assert!(is_kept("aws-lc-sys", "aws-lc/generated-src/linux-aarch64/crypto/a.S"));
        assert!(is_kept("aws-lc-sys", "src/x86_64_unknown_linux_gnu_crypto.rs"));
        assert!(is_kept("zstd-sys", "zstd/lib/common/mem.h"));
    }

    #[test]
    fn tests_other_platforms_and_files_that_tools_drop_are_left_out() {
        for path in [
            "tests/a.rs",
            "test-macros/src/lib.rs",
            "benches/a.rs",
            "ci/run.sh",
            "Cargo.lock",
            "Cargo.toml.orig",
            "src/a.rs~",
            ".gitignore",
            ".github/workflows/ci.yml",
            "src/.gitattributes",
        ] {
            assert!(!is_kept("any", path), "{path}");
        }
        for path in [
            "aws-lc/generated-src/win-x86_64/crypto/a.asm",
            "src/aarch64_apple_darwin_crypto.rs",
            "aws-lc/crypto/bio/bio_test.cc",
        ] {
            assert!(!is_kept("aws-lc-sys", path), "{path}");
            assert!(is_kept("any", path), "{path}");
        }
    }

    #[test]
    fn checksums_of_files_that_are_left_out_go_and_the_package_keeps_its_own() {
        let text = r#"{"files":{"tests/a.rs":"11","src/lib.rs":"22"},"package":"33"}"#;
        let kept = checksums(text, |path| is_kept("any", path)).unwrap();
        assert_eq!(kept, r#"{"files":{"src/lib.rs":"22"},"package":"33"}"#);
        assert!(checksums("{}", |_| true).is_err());
    }

    #[test]
    fn files_that_a_source_includes_are_found() {
        let text = "#![doc = include_str!(\"../../examples/css/parser.rs\")]\n\
            /// let bytes = include_bytes!(\"../tests/a.pem\");\n\
            include!(\"data.rs\"); include!(concat!(env!(\"OUT_DIR\"), \"/b.rs\"));\n\
            include_str!(\"../../../outside\")\n";
        assert_eq!(included("src/a/mod.rs", text), ["examples/css/parser.rs", "src/a/data.rs"]);
    }

    #[test]
    fn crate_folder_matches_its_checksums() {
        let folder = tempfile::tempdir().unwrap();
        for path in ["tests/data/large", "examples/a.rs", "Cargo.toml", "Cargo.toml.orig"] {
            write(&folder.path().join(path), "").unwrap();
        }
        let source = "#![doc = include_str!(\"../examples/a.rs\")]";
        write(&folder.path().join("src/lib.rs"), source).unwrap();
        let listed = r#"{"files":{"src/lib.rs":"1","tests/data/large":"2","Cargo.toml":"3",
            "examples/a.rs":"5"},"package":"4"}"#;
        fs::write(folder.path().join(CHECKSUMS), listed).unwrap();
        crate_folder("any", folder.path()).unwrap();
        assert_eq!(
            below(folder.path()).unwrap(),
            [CHECKSUMS, "Cargo.toml", "examples/a.rs", "src/lib.rs"]
        );
        assert!(!folder.path().join("tests").exists());
        let text = read(&folder.path().join(CHECKSUMS)).unwrap();
        assert_eq!(
            text,
            r#"{"files":{"Cargo.toml":"3","examples/a.rs":"5","src/lib.rs":"1"},"package":"4"}"#
        );
    }
}
