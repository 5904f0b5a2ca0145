//! The packages of the published crates, and projects outside of the workspace that depend on them.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::LazyLock;

use crate::PUBLISHED;
use crate::support::{profiles, reached, run, target, unpack, workspace};

fn scratch() -> PathBuf {
    Path::new(env!("CARGO_TARGET_TMPDIR")).join("outside")
}

/// Cargo in a directory, with the target directory of the workspace. What else it would inherit is of
/// this workspace.
pub(crate) fn cargo(dir: &Path, args: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO"));
    command.args(args).current_dir(dir).env("CARGO_TARGET_DIR", target());
    command
}

/// The directory of each unpacked package, in the order of [`PUBLISHED`]. Made once, as a release
/// makes them.
static PACKAGES: LazyLock<Vec<PathBuf>> = LazyLock::new(|| {
    let _ = fs::remove_dir_all(scratch());
    let out = scratch().join("out");
    fs::create_dir_all(&out).expect("a directory");
    let mut package = Command::new(env!("CARGO_BIN_EXE_xtask"));
    package.args(["package", "--allow-dirty", "--no-verify", "--offline"]);
    run(package.arg("--target-dir").arg(&out));

    let packed = |name: &str| {
        let is_it = |file: &PathBuf| {
            let stem = file.file_stem().and_then(|stem| stem.to_str()).unwrap_or_default();
            let version = stem.strip_prefix(name).and_then(|rest| rest.strip_prefix('-'));
            file.extension().is_some_and(|end| end == "crate")
                && version.is_some_and(|version| version.starts_with(|c: char| c.is_ascii_digit()))
        };
        let mut files = fs::read_dir(out.join("package")).expect("it was just made").flatten();
        files.find_map(|entry| Some(entry.path()).filter(is_it)).expect(name)
    };
    let unpacked = PUBLISHED.iter().map(|(name, _)| {
        let dir = unpack(&packed(name), &scratch());
        // Otherwise cargo looks for a workspace in the directories above, and finds this one.
        let manifest = dir.join("Cargo.toml");
        let text = fs::read_to_string(&manifest).expect("a manifest") + "\n[workspace]\n";
        fs::write(&manifest, text).expect("a manifest");
        dir
    });
    unpacked.collect()
});

/// The directory of a package.
pub(crate) fn package(name: &str) -> &'static Path {
    let at = PUBLISHED.iter().position(|(one, _)| *one == name);
    &PACKAGES[at.unwrap_or_else(|| panic!("{name} is not published"))]
}

/// Has the packages find each other where a registry would have them.
pub(crate) fn patch() -> String {
    let lines = PUBLISHED.iter().map(|(name, _)| format!("{name}.path = {:?}\n", package(name)));
    format!("[patch.crates-io]\n{}", lines.collect::<String>())
}

/// A project outside of the workspace.
pub(crate) struct Project {
    pub(crate) dir: PathBuf,
}

impl Project {
    /// An empty project. It has the workspace's `Cargo.lock` and profiles, so that what was built for
    /// the workspace is not built again.
    pub(crate) fn new(name: &str) -> Self {
        // Unpacked first, which empties the directory that this one is in.
        let patch = patch();
        let dir = scratch().join("projects").join(name);
        let _ = fs::remove_dir_all(&dir);
        fs::create_dir_all(dir.join("src/bin")).expect("a directory");
        let own = format!("[package]\nname = {name:?}\nversion = \"0.0.0\"\nedition = \"2024\"\n");
        let text = format!("{own}[workspace]\n{patch}{}", profiles());
        fs::write(dir.join("Cargo.toml"), text).expect("a manifest");
        fs::copy(workspace().join("Cargo.lock"), dir.join("Cargo.lock")).expect("a lock file");
        let project = Self { dir };
        project.write("src/lib.rs", "");
        project
    }

    pub(crate) fn write(&self, file: &str, text: &str) {
        fs::write(self.dir.join(file), text).expect(file);
    }

    pub(crate) fn cargo(&self, args: &[&str]) -> Command {
        cargo(&self.dir, args)
    }

    /// Runs `cargo add` with these arguments. A crate of ours is taken from its package: until it is
    /// published, a registry does not have it. `cargo add` takes one path at a time, so each crate of
    /// ours has a command of its own.
    ///
    /// `None` without a registry, and says so.
    pub(crate) fn add(&self, args: &[&str]) -> Option<()> {
        let is_ours = |arg: &&str| PUBLISHED.iter().any(|(name, _)| name == arg);
        let (ours, rest): (Vec<&str>, Vec<&str>) = args.iter().copied().partition(is_ours);
        for name in &ours {
            reached(self.cargo(&["add", "--path"]).arg(package(name)).args(&rest))?;
        }
        if ours.is_empty() { reached(self.cargo(&["add"]).args(&rest)) } else { Some(()) }
    }
}
