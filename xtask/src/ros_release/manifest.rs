//! The manifests of the source package: without tests, examples and benchmarks, and of crates that are left out.

use std::collections::BTreeSet;

use toml::{Table, Value};

/// The workspace's manifest with these members alone.
pub(super) fn workspace(text: &str, members: &[&str]) -> Result<String, String> {
    let is_kept = |section: &str| {
        !section.starts_with("workspace.metadata") && !section.starts_with("profile.dev")
    };
    let text = sections(text, is_kept);
    let (start, end) = list(&text, "members")?;
    let members: String = members.iter().map(|member| format!("    \"{member}\",\n")).collect();
    let mut made = format!("{}[\n{members}]{}", &text[..start], &text[end..]);
    let (start, end) = list(&made, "exclude")?;
    // It stands in a line of its own, and the folders are not there.
    made.replace_range(start - "exclude = ".len()..=end, "");
    Ok(made)
}

/// A crate's manifest without what only its tests, examples and benchmarks need.
pub(super) fn member(text: &str) -> String {
    sections(text, |section| {
        !section.ends_with("dev-dependencies")
            && !section.contains("dev-dependencies.")
            && !matches!(section, "example" | "test" | "bench")
    })
}

/// The text without the sections whose names `is_kept` refuses. Comments above a section go with it.
fn sections(text: &str, is_kept: impl Fn(&str) -> bool) -> String {
    let (mut made, mut keeps) = (String::new(), true);
    // Comments and empty lines, until it is known what they belong to.
    let mut pending = String::new();
    for line in text.split_inclusive('\n') {
        let bare = line.trim();
        if bare.is_empty() || bare.starts_with('#') {
            pending.push_str(line);
            continue;
        }
        // An array in a list of settings begins with a bracket too, but not in the first column.
        if line.starts_with('[') {
            keeps = is_kept(bare.trim_matches(['[', ']']));
        }
        if keeps {
            made.push_str(&pending);
            made.push_str(line);
        }
        pending.clear();
    }
    made
}

/// Where the value of a list begins and ends.
fn list(text: &str, key: &str) -> Result<(usize, usize), String> {
    let start = text
        .find(&format!("\n{key} = ["))
        .map(|at| at + key.len() + " = ".len() + 1)
        .ok_or_else(|| format!("the workspace's Cargo.toml has no list `{key}`"))?;
    let length = text[start..].find(']').ok_or_else(|| format!("the list `{key}` has no end"))?;
    Ok((start, start + length + 1))
}

/// The manifest of a crate that stands in for one that is left out: same name, version and features, and no
/// dependencies. Cargo resolves the lock file for all platforms, so it asks for each crate that is named.
pub(super) fn stub(text: &str) -> Result<String, String> {
    let manifest: Table = text.parse().map_err(|err| format!("{err}"))?;
    let package = manifest.get("package").and_then(Value::as_table).ok_or("no [package]")?;
    let field = |name: &str| package.get(name).and_then(Value::as_str);
    let name = field("name").ok_or("no name")?;
    let version = field("version").ok_or("no version")?;
    let mut made = format!(
        "# A stand-in: rmw_axon needs no source of this crate on Linux.\n[package]\nname = \"{name}\"\n\
         version = \"{version}\"\nedition = \"2021\"\n"
    );
    made.push_str("\n[lib]\npath = \"src/lib.rs\"\n\n[features]\n");
    for feature in features(&manifest) {
        made.push_str(&format!("\"{feature}\" = []\n"));
    }
    Ok(made)
}

/// The names that others may ask for: features, and optional dependencies.
fn features(manifest: &Table) -> BTreeSet<String> {
    let table = |value: &Value, name: &str| value.get(name).and_then(Value::as_table).cloned();
    let root = Value::Table(manifest.clone());
    let mut names: BTreeSet<String> =
        table(&root, "features").unwrap_or_default().keys().cloned().collect();
    let targets = table(&root, "target").unwrap_or_default();
    for part in targets.values().chain([&root]) {
        for kind in ["dependencies", "build-dependencies"] {
            let dependencies = table(part, kind).unwrap_or_default();
            let optional = dependencies.iter().filter(|(_, dependency)| {
                dependency.get("optional").and_then(Value::as_bool).unwrap_or_default()
            });
            names.extend(optional.map(|(name, _)| name.clone()));
        }
    }
    names
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn members_are_those_that_are_needed() {
        let text = "[workspace]\nresolver = \"3\"\nmembers = [\n    \"a\",\n    \"b\",\n]\n\
            exclude = [\"c\"]\n\n# For colcon.\n[workspace.metadata.colcon]\nx = 1\n\n\
            [workspace.package]\nversion = \"1.0.0\"\n\n[profile.dev.package.\"*\"]\nopt-level = 1\n\n\
            [profile.release]\ndebug = false\n";
        let expected = "[workspace]\nresolver = \"3\"\nmembers = [\n    \"b\",\n]\n\n\
            [workspace.package]\nversion = \"1.0.0\"\n\n[profile.release]\ndebug = false\n";
        assert_eq!(workspace(text, &["b"]).unwrap(), expected);
        assert!(workspace("[package]\n", &["b"]).is_err());
    }

    #[test]
    fn members_lose_sections_that_only_tests_need() {
        let text = "[package]\nname = \"a\"\n\n[dependencies]\nb = \"1\"\n\n[dev-dependencies]\n\
            # Why.\nc = \"1\"\n\n[target.'cfg(unix)'.dev-dependencies]\nd = \"1\"\n\n[[test]]\nname = \"t\"\n\n\
            # The daemon.\n[[bin]]\nname = \"a\"\npath = \"src/a.rs\"\n";
        let expected = "[package]\nname = \"a\"\n\n[dependencies]\nb = \"1\"\n\n\
            # The daemon.\n[[bin]]\nname = \"a\"\npath = \"src/a.rs\"\n";
        assert_eq!(member(text), expected);
    }

    #[test]
    fn stand_in_has_the_names_that_others_ask_for_and_no_dependencies() {
        let text = "[package]\nname = \"a\"\nversion = \"1.2.3+x\"\nbuild = \"b.rs\"\n\
            [features]\ndefault = [\"std\"]\nstd = [\"dep:c\"]\n[dependencies.b]\nversion = \"1\"\noptional = true\n\
            [target.'cfg(windows)'.dependencies.c]\nversion = \"1\"\noptional = true\n[dependencies.d]\nversion = \"1\"\n";
        let made: Table = stub(text).unwrap().parse().unwrap();
        let package = made["package"].as_table().unwrap();
        assert_eq!(package["version"].as_str(), Some("1.2.3+x"));
        assert!(!package.contains_key("build"));
        let features: Vec<_> = made["features"].as_table().unwrap().keys().collect();
        assert_eq!(features, ["b", "c", "default", "std"]);
        assert!(!made.contains_key("dependencies") && !made.contains_key("target"));
        assert!(stub("[lib]\n").is_err());
    }
}
