//! rustls-axon as it is packaged: the patched source as the crate's own, with no script to build it.

use std::fs;
use std::path::Path;

use super::tree::{self, Tree};
use super::{CRATE, crate_dir, upstream_src};

/// What is in a package. The patches are there to be read: the source has them already.
const INCLUDE: &str = r#"include = [
    "/src/**/*.rs",
    "/examples/*.rs",
    "/patches/*.patch",
    "/upstream.sha256",
    "/README.md",
    "/CHANGELOG.md",
    "/LICENSE-*",
]
"#;

/// Turns the crate in `copy`, a copy of the workspace, into what is packaged. Its source is made from the
/// workspace that this program was built in, and checked against the committed digests.
pub(crate) fn write_packaged_form(copy: &Path) -> Result<(), String> {
    let upstream = upstream_src(&crate_dir())?;
    let mut source = tree::assemble(&upstream, &crate_dir())?;
    tree::check(&source, &crate_dir().join("patched.sha256"))?;

    let to = copy.join(CRATE);
    let read = |name: &str| {
        let path = to.join(name);
        fs::read_to_string(&path).map_err(|err| format!("cannot read {}: {err}", path.display()))
    };
    let lib = library(&read("src/lib.rs")?, &mut source)?;
    source.insert("lib.rs".into(), lib);
    let manifest = manifest(&read("Cargo.toml")?)?;
    tree::write(&source, &to.join("src"))?;
    fs::write(to.join("Cargo.toml"), manifest)
        .and_then(|()| fs::remove_file(to.join("build.rs")))
        .and_then(|()| fs::remove_dir_all(to.join("tests")))
        .map_err(|err| format!("cannot write the packaged form of rustls-axon: {err}"))?;

    // what is shipped is a derived work, so rustls's licences and copyright notices go with it
    for licence in ["LICENSE-APACHE", "LICENSE-ISC", "LICENSE-MIT"] {
        let from = upstream.with_file_name(licence);
        fs::copy(&from, to.join(licence))
            .map_err(|err| format!("cannot copy {}: {err}", from.display()))?;
    }
    Ok(())
}

/// The crate's `lib.rs` with the rest of rustls's in the place where a checkout includes it.
fn library(ours: &str, source: &mut Tree) -> Result<String, String> {
    const INCLUDED: &str = "include!(concat!(env!(\"RUSTLS_AXON_SRC\"), \"/lib_body.rs\"));\n";
    let body = source.remove("lib_body.rs").ok_or("the patched source has no lib_body.rs")?;
    replace(ours, "src/lib.rs", INCLUDED, &body)
}

/// The manifest without what only a checkout has.
fn manifest(checkout: &str) -> Result<String, String> {
    let name = "Cargo.toml";
    // with the comment that says why it is not the README
    let start = checkout.find("# What is packaged is not this directory").unwrap_or_default();
    let readme = "readme = \"made-by-cargo-xtask-package/README.md\"\n";
    let end = checkout.find(readme).unwrap_or_default() + readme.len();
    let manifest = replace(
        checkout,
        name,
        &format!("{}publish = false\n", checkout.get(start..end).unwrap_or(readme)),
        &format!("readme = \"README.md\"\n{INCLUDE}"),
    )?;
    let manifest = replace(&manifest, name, "build = \"build.rs\"\n", "")?;
    let (before, rest) = manifest
        .split_once("\n[build-dependencies]\n")
        .ok_or("Cargo.toml of rustls-axon has no [build-dependencies]")?;
    let (_, after) = rest.split_once("\n[").ok_or("nothing follows [build-dependencies]")?;
    Ok(format!("{before}\n[{after}"))
}

fn replace(text: &str, name: &str, part: &str, with: &str) -> Result<String, String> {
    match text.matches(part).count() {
        1 => Ok(text.replacen(part, with, 1)),
        count => Err(format!(
            "{name} of rustls-axon must have this once, and has it {count} times: {part}"
        )),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn packaged_manifest_has_no_build_script_and_no_build_dependencies() {
        let checkout = fs::read_to_string(crate_dir().join("Cargo.toml")).unwrap();
        let packaged = manifest(&checkout).unwrap();
        for part in ["build.rs", "[build-dependencies]", "publish", "made-by"] {
            assert!(checkout.contains(part) && !packaged.contains(part), "{part}");
        }
        for part in
            ["\n[dependencies]\n", "\n[dev-dependencies]\n", "\n[package.metadata.docs.rs]\n"]
        {
            assert!(packaged.contains(part), "{part}");
        }
        assert!(packaged.contains("readme = \"README.md\""));
        assert!(manifest(&packaged).is_err(), "it is not made twice");
    }
}
