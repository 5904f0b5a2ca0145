//! Chores of `third_party/rustls-axon`: its patches, digests and packaged form.
//!
//! What a patched tree is made of is decided in that crate's `build/`, which is used here as it is.

use std::env;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::atomic::{AtomicUsize, Ordering};

#[path = "../../third_party/rustls-axon/build/patch.rs"]
mod patch;
#[path = "../../third_party/rustls-axon/build/tree.rs"]
mod tree;
#[path = "../../third_party/rustls-axon/build/upstream.rs"]
mod upstream;

mod packaged;
mod rebase;

pub(crate) use packaged::write_packaged_form;
pub(crate) use rebase::walk;
pub(crate) use rebase::{Options as Rebase, rebase};

/// The author of the commits that stand for patches.
const AUTHOR: [&str; 4] = ["-c", "user.name=AXON", "-c", "user.email=axon@localhost"];

/// Writes `patched.sha256`, for the release that `upstream.sha256` has.
pub(crate) fn digests() -> Result<String, String> {
    let made = tree::assemble(&upstream_src(&crate_dir())?, &crate_dir())?;
    let pinned = upstream::pinned_version(&crate_dir())?;
    let path = crate_dir().join("patched.sha256");
    fs::write(&path, patched_digests(&made, &pinned))
        .map_err(|err| format!("cannot write {}: {err}", path.display()))?;
    Ok(format!("digests of {} patched files written", made.len()))
}

fn upstream_digests(released: &tree::Tree, version: &str) -> String {
    tree::digests(released, &format!("rustls {version}"))
}

fn patched_digests(made: &tree::Tree, version: &str) -> String {
    tree::digests(made, &format!("rustls {version}, patched"))
}

/// Makes `dir` a git repository: rustls's source first, then a commit for each patch. With a
/// `version`, the branch of that name has its source, for the patches to be rebased on.
pub(crate) fn checkout(dir: &Path, version: Option<&str>) -> Result<String, String> {
    if dir.exists() {
        return Err(format!("{} exists: name a new directory", dir.display()));
    }
    let pinned = upstream::pinned_version(&crate_dir())?;
    let mut files = tree::read_dir(&upstream_src(&crate_dir())?)?;
    tree::check(&files, &crate_dir().join("upstream.sha256"))?;
    let newer = match version {
        Some(version) => Some((version, tree::read_dir(&rebase::fetch(&crate_dir(), version)?)?)),
        None => None,
    };
    tree::write(&files, &dir.join("src"))?;
    git(dir, &["init", "--quiet"])?;
    commit(dir, &format!("rustls {pinned}{RELEASED}"))?;
    git(dir, &["tag", &pinned])?;

    let patches = tree::read_patches(&crate_dir())?;
    for (name, text) in &patches {
        patch::apply(&mut files, text).map_err(|why| format!("patches/{name}: {why}"))?;
        tree::write(&files, &dir.join("src"))?;
        let message = text.split("\ndiff --git ").next().unwrap_or_default();
        commit(dir, message.trim_end())?;
    }
    let done = format!("{}: {} commits on rustls {pinned}", dir.display(), patches.len());
    let Some((version, newer)) = newer else { return Ok(done) };

    git(dir, &["branch", "patches"])?;
    git(dir, &["checkout", "--quiet", "-b", version, &pinned])?;
    tree::write(&newer, &dir.join("src"))?;
    commit(dir, &format!("rustls {version}{RELEASED}"))?;
    git(dir, &["checkout", "--quiet", "patches"])?;
    Ok(format!("{done}; move them there with `git rebase --onto {version} {pinned} patches`"))
}

/// How the subjects of commits end that are rustls's source and not a patch.
const RELEASED: &str = ", as released";

/// Writes the commits in `dir` to `patches/`, and the digests.
pub(crate) fn export(dir: &Path) -> Result<String, String> {
    let exported = patches_in(dir)?;
    let mut released = tree::read_dir(&upstream_src(&crate_dir())?)?;
    tree::change(&mut released, &exported, &tree::read_added(&crate_dir())?)?;
    tree::write(&exported, &crate_dir().join("patches"))?;
    digests()
}

/// The commits in `dir` on top of rustls's source, as patches.
fn patches_in(dir: &Path) -> Result<tree::Tree, String> {
    if !git(dir, &["status", "--porcelain"])?.is_empty() {
        return Err(format!("{} has changes that are not committed", dir.display()));
    }
    let subjects = git(dir, &["log", "--reverse", "--format=%H %s", "HEAD"])?;
    let subjects: Vec<&str> = subjects.lines().collect();
    let released = subjects
        .iter()
        .rposition(|subject| subject.ends_with(RELEASED))
        .ok_or_else(|| format!("{} is not from `rustls-checkout`", dir.display()))?;

    let mut patches = tree::Tree::new();
    for (number, line) in (1..).zip(&subjects[released + 1..]) {
        let commit = line.split(' ').next().unwrap_or_default();
        let subject = git(dir, &["log", "-1", "--format=%f", commit])?.to_lowercase();
        let message = git(dir, &["log", "-1", "--format=%B", commit])?;
        let parent = format!("{commit}~");
        let diff = git(dir, &["diff", "--no-renames", "--histogram", "-U3", &parent, commit])?;
        let diff: Vec<&str> = diff.lines().filter(|line| !line.starts_with("index ")).collect();
        patches.insert(
            format!("{number:04}-{}.patch", subject.trim()),
            format!("{}\n\n{}\n", message.trim_end(), diff.join("\n")),
        );
    }
    Ok(patches)
}

fn commit(dir: &Path, message: &str) -> Result<(), String> {
    git(dir, &["add", "--all"])?;
    git(dir, &[&AUTHOR[..], &["commit", "--quiet", "--message", message]].concat()).map(drop)
}

pub(crate) fn git(dir: &Path, args: &[&str]) -> Result<String, String> {
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

pub(crate) fn workspace() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("xtask is in the root")
}

fn crate_dir() -> PathBuf {
    workspace().join(CRATE)
}

/// Where the crate is in the workspace.
const CRATE: &str = "third_party/rustls-axon";

pub(crate) fn cargo() -> PathBuf {
    env::var_os("CARGO").map_or_else(|| PathBuf::from("cargo"), PathBuf::from)
}

fn upstream_src(crate_dir: &Path) -> Result<PathBuf, String> {
    let scratch = Scratch::new("source")?;
    upstream::locate(&cargo(), crate_dir, &host()?, &scratch.0)
}

fn host() -> Result<String, String> {
    let rustc = Command::new("rustc")
        .arg("-vV")
        .output()
        .map_err(|err| format!("cannot run rustc: {err}"))?;
    let about = String::from_utf8_lossy(&rustc.stdout).into_owned();
    let host = about.lines().find_map(|line| line.strip_prefix("host: "));
    host.map(str::to_owned).ok_or_else(|| "rustc -vV does not name its host".into())
}

/// A new directory that goes away again.
struct Scratch(PathBuf);

impl Scratch {
    fn new(purpose: &str) -> Result<Self, String> {
        static NEXT: AtomicUsize = AtomicUsize::new(0);
        let (process, number) = (std::process::id(), NEXT.fetch_add(1, Ordering::Relaxed));
        let dir = env::temp_dir().join(format!("axon-xtask-{purpose}-{process}-{number}"));
        fs::create_dir(&dir).map_err(|err| format!("cannot create {}: {err}", dir.display()))?;
        Ok(Self(dir))
    }
}

impl Drop for Scratch {
    fn drop(&mut self) {
        let _ = fs::remove_dir_all(&self.0);
    }
}
