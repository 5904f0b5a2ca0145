//! The crates that a build on Linux compiles, with licence, authors and Rust version.

use std::collections::BTreeSet;

use serde_json::Value;

/// The platforms of the source package.
pub(super) const PLATFORMS: [&str; 2] = ["x86_64-unknown-linux-gnu", "aarch64-unknown-linux-gnu"];

/// The packages that a build names: the C library and the daemon.
pub(super) const ROOTS: [&str; 2] = ["rmw-axon-core", "axon-daemon"];

/// A crate of the registry that is compiled.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct Crate {
    pub(super) name: String,
    pub(super) version: String,
    /// An SPDX expression; empty where the manifest has none.
    pub(super) licence: String,
    pub(super) authors: Vec<String>,
    pub(super) rust_version: Option<String>,
}

/// The crates of the registry that `trees` name, which are what `cargo tree` prints for the platforms. `metadata` is
/// that of the workspace: it has more, since it does not tell which features a build enables.
pub(super) fn compiled(trees: &[String], metadata: &Value) -> Result<Vec<Crate>, String> {
    let named: BTreeSet<(&str, &str)> =
        trees.iter().flat_map(|tree| tree.lines()).filter_map(named).collect();
    for root in ROOTS {
        if !named.iter().any(|(name, _)| *name == root) {
            return Err(format!("cargo tree does not show {root}"));
        }
    }
    let mut crates = Vec::new();
    for package in list(metadata, "packages")? {
        let is_ours = package.get("source").is_none_or(Value::is_null);
        if !is_ours && named.contains(&(text(package, "name")?, text(package, "version")?)) {
            crates.push(described(package)?);
        }
    }
    crates.sort();
    Ok(crates)
}

/// Name and version in a line such as `serde_derive v1.0.1 (proc-macro)`.
fn named(line: &str) -> Option<(&str, &str)> {
    let mut words = line.split_whitespace();
    Some((words.next()?, words.next()?.strip_prefix('v')?))
}

fn described(package: &Value) -> Result<Crate, String> {
    let optional = |name: &str| package.get(name).and_then(Value::as_str).map(str::to_owned);
    let authors = package.get("authors").and_then(Value::as_array);
    Ok(Crate {
        name: text(package, "name")?.to_owned(),
        version: text(package, "version")?.to_owned(),
        licence: optional("license").unwrap_or_default(),
        authors: authors
            .into_iter()
            .flatten()
            .filter_map(Value::as_str)
            .map(str::to_owned)
            .collect(),
        rust_version: optional("rust_version"),
    })
}

/// The oldest Rust that compiles all of them, and one that needs it, if it is newer than `stated`.
pub(super) fn newer_rust<'a>(crates: &'a [Crate], stated: &str) -> Option<(&'a str, &'a str)> {
    let newest = crates
        .iter()
        .filter_map(|one| Some((one.rust_version.as_deref()?, one.name.as_str())))
        .max_by_key(|(version, _)| numbers(version))?;
    (numbers(newest.0) > numbers(stated)).then_some(newest)
}

fn numbers(version: &str) -> Vec<u32> {
    let mut numbers: Vec<u32> = version.split('.').map(|part| part.parse().unwrap_or(0)).collect();
    numbers.resize(3, 0);
    numbers
}

fn list<'a>(value: &'a Value, name: &str) -> Result<&'a Vec<Value>, String> {
    value
        .get(name)
        .and_then(Value::as_array)
        .ok_or_else(|| format!("cargo metadata has no `{name}`"))
}

fn text<'a>(value: &'a Value, name: &str) -> Result<&'a str, String> {
    value.get(name).and_then(Value::as_str).ok_or_else(|| format!("cargo metadata has no `{name}`"))
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn package(name: &str, source: Option<&str>, rust: Option<&str>) -> Value {
        json!({ "id": format!("{name}#1.0.0"), "name": name, "version": "1.0.0", "source": source,
            "license": "MIT", "authors": ["A <a@b>"], "rust_version": rust })
    }

    fn metadata() -> Value {
        let registry = Some("registry");
        json!({ "packages": [
            package("rmw-axon-core", None, None),
            package("axon-daemon", None, None),
            package("linked", registry, Some("1.71")),
            package("for-build", registry, Some("1.100.1")),
            package("for-tests", registry, Some("1.200")),
        ] })
    }

    fn trees() -> [String; 2] {
        let ours = "axon-daemon v1.0.0 (/a/b)\nrmw-axon-core v1.0.0 (/a/c)\n";
        [
            format!("{ours}linked v1.0.0\nlinked v1.0.0 (*)\n\n"),
            format!("{ours}for-build v1.0.0 (proc-macro)\nfor-tests v2.0.0\n"),
        ]
    }

    #[test]
    fn crates_of_all_platforms_are_compiled_and_those_of_tests_are_not() {
        let crates = compiled(&trees(), &metadata()).unwrap();
        let names: Vec<_> = crates.iter().map(|one| one.name.as_str()).collect();
        assert_eq!(names, ["for-build", "linked"]);
        assert_eq!(crates[1].licence, "MIT");
        assert!(
            compiled(&["linked v1.0.0\n".into()], &metadata())
                .unwrap_err()
                .contains("rmw-axon-core")
        );
    }

    #[test]
    fn crate_that_needs_a_newer_rust_is_found() {
        let crates = compiled(&trees(), &metadata()).unwrap();
        assert_eq!(newer_rust(&crates, "1.88"), Some(("1.100.1", "for-build")));
        assert_eq!(newer_rust(&crates, "1.101"), None);
        assert_eq!(newer_rust(&crates, "1.100.1"), None);
    }
}
