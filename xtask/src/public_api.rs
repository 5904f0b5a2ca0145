//! What each published crate shows, one item a line, in `public-api.txt` beside its manifest: a change of the
//! surface is seen in the change that makes it.

use std::collections::BTreeSet;
use std::env;
use std::fs;
use std::os::unix::process::CommandExt as _;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode};

use public_api::Builder;

/// The crates, and where they are. rustls-axon shows what rustls does.
const CRATES: [(&str, &str); 6] = [
    ("etsi_qkd014", "etsi-qkd014"),
    ("axon_envelope", "axon-envelope"),
    ("axon_tls", "axon-tls"),
    ("axon_shm", "axon-transport/shm"),
    ("axon_transport", "axon-transport"),
    ("axon_daemon", "axon-transport/daemon"),
];
const LISTING: &str = "public-api.txt";
/// Set where cargo calls this program for rustdoc.
const AS_RUSTDOC: &str = "XTASK_AS_RUSTDOC";
/// The format of rustdoc's JSON that is read here, which changes with the compiler.
const FORMAT: u64 = 57;

/// Compares the listings with the code, or writes them.
///
/// # Errors
/// The lines that are new or gone, by crate.
pub(crate) fn check(root: &Path, write: bool) -> Result<String, String> {
    let json = document(root)?;
    let mut wrong = Vec::new();
    for (name, folder) in CRATES {
        let file = json.join(format!("{name}.json"));
        if let Some(other) = other_format(&file)? {
            return Ok(format!(
                "skipped: the public interfaces, since this compiler's rustdoc writes format {other} and {FORMAT} \
                 is read here"
            ));
        }
        let api = Builder::from_rustdoc_json(&file)
            .omit_blanket_impls(true)
            .omit_auto_trait_impls(true)
            .omit_auto_derived_impls(true)
            .build()
            .map_err(|e| format!("{}: {e}", file.display()))?;
        let now: String = api.items().map(|item| format!("{item}\n")).collect();
        let listing = root.join(folder).join(LISTING);
        if write {
            fs::write(&listing, now).map_err(|e| format!("{}: {e}", listing.display()))?;
        } else {
            let then = fs::read_to_string(&listing).unwrap_or_default();
            wrong.extend(differences(name, &then, &now));
        }
    }
    if write {
        Ok(format!("{LISTING} of {} crates is written", CRATES.len()))
    } else if wrong.is_empty() {
        Ok(format!("the interfaces of {} crates are as {LISTING} says", CRATES.len()))
    } else {
        wrong.push(
            "if that is meant, write it down: cargo xtask public-api --write, and tell of it in the CHANGELOG"
                .to_owned(),
        );
        Err(wrong.join("\n"))
    }
}

fn differences(name: &str, then: &str, now: &str) -> Vec<String> {
    let [then, now] = [then, now].map(|text| text.lines().collect::<BTreeSet<_>>());
    let line = |sign: char| move |line: &&str| format!("{name}: {sign} {line}");
    let gone = then.difference(&now).map(line('-'));
    gone.chain(now.difference(&then).map(line('+'))).collect()
}

/// Has rustdoc describe the workspace's libraries in JSON; where the files are.
fn document(root: &Path) -> Result<PathBuf, String> {
    let target = env::var_os("CARGO_TARGET_DIR").map_or_else(|| root.join("target"), Into::into);
    let itself = env::current_exe().map_err(|e| format!("where this program is: {e}"))?;
    let target: PathBuf = root.join(target);
    let status = Command::new(env::var_os("CARGO").unwrap_or_else(|| "cargo".into()))
        .current_dir(root)
        // The same as for the pages, so that nothing is compiled again.
        .args(["doc", "--quiet", "--locked", "--workspace", "--no-deps", "--all-features"])
        .env("RUSTDOC", itself)
        .env(AS_RUSTDOC, "1")
        .env_remove("RUSTDOCFLAGS")
        .status()
        .map_err(|e| format!("cargo doc: {e}"))?;
    if !status.success() {
        return Err(format!("cargo doc: {status}"));
    }
    Ok(target.join("doc"))
}

fn other_format(file: &Path) -> Result<Option<u64>, String> {
    let text = fs::read_to_string(file).map_err(|e| format!("{}: {e}", file.display()))?;
    let json: serde_json::Value =
        serde_json::from_str(&text).map_err(|e| format!("{}: {e}", file.display()))?;
    let format = json["format_version"].as_u64().unwrap_or_default();
    Ok((format != FORMAT).then_some(format))
}

/// Where cargo called this program for rustdoc: becomes rustdoc, and has it write JSON. A stable rustdoc does
/// so if it is told to take itself for a nightly one; nothing that is compiled is told so.
pub(crate) fn rustdoc() -> Option<ExitCode> {
    env::var_os(AS_RUSTDOC)?;
    let mut rustdoc = Command::new("rustdoc");
    rustdoc.args(env::args_os().skip(1)).env("RUSTC_BOOTSTRAP", "1");
    if env::args_os().any(|argument| argument == "--crate-name") {
        rustdoc.args(["-Zunstable-options", "--output-format=json"]);
    }
    let error = rustdoc.exec();
    eprintln!("error: rustdoc: {error}");
    Some(ExitCode::FAILURE)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_that_came_and_went_are_told_apart() {
        let told = differences(
            "a",
            "pub fn a::old()\npub fn a::kept()\n",
            "pub fn a::kept()\npub fn a::new()\n",
        );
        assert_eq!(told, ["a: - pub fn a::old()", "a: + pub fn a::new()"]);
        assert!(differences("a", "pub mod a\n", "pub mod a\n").is_empty());
    }
}
