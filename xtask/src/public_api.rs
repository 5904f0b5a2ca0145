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
/// The format of rustdoc's JSON that this program reads: that of Rust 1.95. CI checks the listings with that toolchain.
const FORMAT: u64 = 57;

/// What `cargo xtask public-api` does with the listings.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Mode {
    /// Compares them with the code. Skips the comparison if this compiler's rustdoc writes another format.
    Check,
    /// Compares them with the code. Fails if this compiler's rustdoc writes another format.
    Strict,
    /// Writes them.
    Write,
}

/// Compares the listings with the code, or writes them.
///
/// # Errors
/// The lines that are new or gone, by crate; or, but for [`Mode::Check`], that rustdoc's format is not [`FORMAT`].
pub(crate) fn check(root: &Path, mode: Mode) -> Result<String, String> {
    let json = document(root)?;
    let mut wrong = Vec::new();
    for (name, folder) in CRATES {
        let file = json.join(format!("{name}.json"));
        if let Some(other) = other_format(&file)? {
            return unreadable(other, mode);
        }
        let api = Builder::from_rustdoc_json(&file)
            .omit_blanket_impls(true)
            .omit_auto_trait_impls(true)
            .omit_auto_derived_impls(true)
            .build()
            .map_err(|e| format!("{}: {e}", file.display()))?;
        let now: String = api.items().map(|item| format!("{item}\n")).collect();
        let listing = root.join(folder).join(LISTING);
        if mode == Mode::Write {
            fs::write(&listing, now).map_err(|e| format!("{}: {e}", listing.display()))?;
        } else {
            let then = fs::read_to_string(&listing).unwrap_or_default();
            wrong.extend(differences(name, &then, &now));
        }
    }
    if mode == Mode::Write {
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

fn unreadable(format: u64, mode: Mode) -> Result<String, String> {
    let reason =
        format!("this compiler's rustdoc writes format {format}, and xtask reads format {FORMAT}");
    match mode {
        Mode::Check => Ok(format!("skipped: the public interfaces: {reason}")),
        Mode::Strict | Mode::Write => Err(reason),
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
    fn another_rustdoc_format_is_skipped_in_a_plain_check_only() {
        assert!(unreadable(FORMAT + 1, Mode::Check).unwrap().starts_with("skipped: "));
        for mode in [Mode::Strict, Mode::Write] {
            let error = unreadable(FORMAT + 1, mode).unwrap_err();
            assert!(error.contains(&format!("format {}", FORMAT + 1)), "{error}");
        }
    }

    #[test]
    fn differences_mark_removed_and_added_lines() {
        let told = differences(
            "a",
            "pub fn a::old()\npub fn a::kept()\n",
            "pub fn a::kept()\npub fn a::new()\n",
        );
        assert_eq!(told, ["a: - pub fn a::old()", "a: + pub fn a::new()"]);
        assert!(differences("a", "pub mod a\n", "pub mod a\n").is_empty());
    }
}
