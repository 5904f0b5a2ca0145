//! Chores of `third_party/rustls-axon`: its patches, digests and packaged tree.
//!
//! What a patched tree is made of is decided in that crate's `build/`, which is used here as it is.

use std::env;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

#[path = "../../third_party/rustls-axon/build/patch.rs"]
mod patch;
#[path = "../../third_party/rustls-axon/build/tree.rs"]
mod tree;
#[path = "../../third_party/rustls-axon/build/upstream.rs"]
mod upstream;

/// The author of the commits that stand for patches.
const AUTHOR: [&str; 4] = ["-c", "user.name=AXON", "-c", "user.email=axon@localhost"];

/// Makes `patched/`, checked against the committed digests.
pub(crate) fn patched_tree() -> Result<String, String> {
    let upstream = upstream_src()?;
    let made = tree::assemble(&upstream, &crate_dir())?;
    tree::check(&made, &crate_dir().join("patched.sha256"))?;
    let out = crate_dir().join("patched");
    tree::write(&made, &out.join("src"))?;

    // what is shipped is a derived work, so rustls's licences and copyright notices go with it
    for licence in ["LICENSE-APACHE", "LICENSE-ISC", "LICENSE-MIT"] {
        let from = upstream.with_file_name(licence);
        fs::copy(&from, out.join(licence))
            .map_err(|err| format!("cannot copy {}: {err}", from.display()))?;
    }
    Ok(format!("{}: {} files", out.display(), made.len()))
}

/// Writes both lists of digests. `upstream.sha256` only changes when the pin was moved.
pub(crate) fn digests() -> Result<String, String> {
    let pinned = upstream::pinned_version(&crate_dir())?;
    let write = |name: &str, list: String| {
        let path = crate_dir().join(name);
        fs::write(&path, list).map_err(|err| format!("cannot write {}: {err}", path.display()))
    };

    let upstream = upstream_src()?;
    let heading = format!("rustls {pinned}");
    write("upstream.sha256", tree::digests(&tree::read_dir(&upstream)?, &heading))?;
    let made = tree::assemble(&upstream, &crate_dir())?;
    write("patched.sha256", tree::digests(&made, &format!("{heading}, patched")))?;
    Ok(format!("digests of {} patched files written", made.len()))
}

/// Makes `dir` a git repository: rustls's source first, then a commit for each patch.
pub(crate) fn checkout(dir: &Path) -> Result<String, String> {
    if dir.exists() {
        return Err(format!("{} exists: name a new directory", dir.display()));
    }
    let mut files = tree::read_dir(&upstream_src()?)?;
    tree::check(&files, &crate_dir().join("upstream.sha256"))?;
    tree::write(&files, &dir.join("src"))?;
    git(dir, &["init", "--quiet"])?;
    commit(dir, "rustls, as released")?;

    let patches = tree::read_dir(&crate_dir().join("patches"))?;
    for (name, text) in &patches {
        patch::apply(&mut files, text).map_err(|why| format!("patches/{name}: {why}"))?;
        tree::write(&files, &dir.join("src"))?;
        let message = text.split("\ndiff --git ").next().unwrap_or_default();
        commit(dir, message.trim_end())?;
    }
    Ok(format!("{}: {} commits on top of rustls's source", dir.display(), patches.len()))
}

/// Writes every commit in `dir` but the first to `patches/`, and the digests.
pub(crate) fn export(dir: &Path) -> Result<String, String> {
    if !git(dir, &["status", "--porcelain"])?.is_empty() {
        return Err(format!("{} has changes that are not committed", dir.display()));
    }
    let patches = crate_dir().join("patches");
    fs::remove_dir_all(&patches)
        .and_then(|()| fs::create_dir_all(&patches))
        .map_err(|err| format!("cannot empty {}: {err}", patches.display()))?;

    let commits = git(dir, &["rev-list", "--reverse", "HEAD"])?;
    for (number, commit) in commits.lines().enumerate().skip(1) {
        let subject = git(dir, &["log", "-1", "--format=%f", commit])?.to_lowercase();
        let message = git(dir, &["log", "-1", "--format=%B", commit])?;
        let parent = format!("{commit}~");
        let diff = git(dir, &["diff", "--no-renames", "--histogram", "-U3", &parent, commit])?;
        let diff: Vec<&str> = diff.lines().filter(|line| !line.starts_with("index ")).collect();

        let path = patches.join(format!("{number:04}-{}.patch", subject.trim()));
        fs::write(&path, format!("{}\n\n{}\n", message.trim_end(), diff.join("\n")))
            .map_err(|err| format!("cannot write {}: {err}", path.display()))?;
    }
    digests()
}

fn commit(dir: &Path, message: &str) -> Result<(), String> {
    git(dir, &["add", "--all"])?;
    git(dir, &[&AUTHOR[..], &["commit", "--quiet", "--message", message]].concat()).map(drop)
}

fn git(dir: &Path, args: &[&str]) -> Result<String, String> {
    let output = Command::new("git")
        .args(args)
        .current_dir(dir)
        .output()
        .map_err(|err| format!("cannot run git: {err}"))?;
    if !output.status.success() {
        let stderr = String::from_utf8_lossy(&output.stderr);
        return Err(format!("git {}: {}", args.join(" "), stderr.trim_end()));
    }
    Ok(String::from_utf8_lossy(&output.stdout).into_owned())
}

fn crate_dir() -> PathBuf {
    let workspace = Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("xtask is in the root");
    workspace.join("third_party/rustls-axon")
}

fn upstream_src() -> Result<PathBuf, String> {
    let cargo = env::var_os("CARGO").map_or_else(|| PathBuf::from("cargo"), PathBuf::from);
    let rustc = Command::new("rustc")
        .arg("-vV")
        .output()
        .map_err(|err| format!("cannot run rustc: {err}"))?;
    let about = String::from_utf8_lossy(&rustc.stdout).into_owned();
    let host = about
        .lines()
        .find_map(|line| line.strip_prefix("host: "))
        .ok_or("rustc -vV does not name its host")?;
    let scratch = env::temp_dir().join(format!("axon-xtask-{}", std::process::id()));
    let located = upstream::locate(&cargo, &crate_dir(), host, &scratch);
    let _ = fs::remove_dir_all(&scratch);
    located
}
