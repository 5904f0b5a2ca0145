//! The lock file of the source package has nothing that the repository's does not have.

use std::collections::BTreeMap;

use toml::{Table, Value};

/// A crate's name and version; its checksum, where it is from the registry.
type Locked = BTreeMap<(String, String), Option<String>>;

/// The crates of the registry that a lock file has.
pub(super) fn registry(text: &str) -> Result<Vec<(String, String)>, String> {
    let locked = locked(text)?;
    Ok(locked.into_iter().filter(|(_, sum)| sum.is_some()).map(|(name, _)| name).collect())
}

/// Fails unless each crate of `made` is in `committed`, with the same version and checksum.
pub(super) fn check(made: &str, committed: &str) -> Result<(), String> {
    let committed = locked(committed)?;
    for ((name, version), checksum) in locked(made)? {
        match committed.get(&(name.clone(), version.clone())) {
            Some(known) if *known == checksum => {}
            Some(_) => {
                return Err(format!("{name} {version} has another checksum than Cargo.lock says"));
            }
            None => {
                return Err(format!(
                    "cargo resolved {name} {version}, which Cargo.lock does not have. \
                     Run `cargo check --workspace` and commit Cargo.lock"
                ));
            }
        }
    }
    Ok(())
}

fn locked(text: &str) -> Result<Locked, String> {
    let lock: Table = text.parse().map_err(|err| format!("cannot read Cargo.lock: {err}"))?;
    let packages =
        lock.get("package").and_then(Value::as_array).ok_or("Cargo.lock has no packages")?;
    let field =
        |package: &Value, name: &str| package.get(name).and_then(Value::as_str).map(str::to_owned);
    packages
        .iter()
        .map(|package| {
            let name = field(package, "name").ok_or("a package without name")?;
            let version = field(package, "version").ok_or("a package without version")?;
            Ok(((name, version), field(package, "checksum")))
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn lock(packages: &[(&str, &str, &str)]) -> String {
        let one = |(name, version, sum): &(&str, &str, &str)| {
            let sum =
                if sum.is_empty() { String::new() } else { format!("checksum = \"{sum}\"\n") };
            format!("[[package]]\nname = \"{name}\"\nversion = \"{version}\"\n{sum}\n")
        };
        packages.iter().map(one).collect()
    }

    #[test]
    fn lock_file_of_the_package_is_part_of_the_committed_one() {
        let committed = lock(&[("a", "1.0.0", "11"), ("b", "2.0.0", "22"), ("ours", "0.1.0", "")]);
        check(&lock(&[("b", "2.0.0", "22"), ("ours", "0.1.0", "")]), &committed).unwrap();
        for (made, part) in [
            (("b", "2.0.1", "22"), "does not have"),
            (("b", "2.0.0", "23"), "another checksum"),
            (("c", "1.0.0", "11"), "does not have"),
        ] {
            assert!(check(&lock(&[made]), &committed).unwrap_err().contains(part));
        }
        assert_eq!(registry(&committed).unwrap().len(), 2);
    }
}
