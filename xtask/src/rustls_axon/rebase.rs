//! Moving `third_party/rustls-axon` to another release of rustls.
//!
//! Everything is found out first: the release as cargo has it, whether every patch applies, and
//! what rustls's own tests say. Files are written last, and are all put back if one step of that
//! fails.

use std::path::{Path, PathBuf};

use super::tree::{self, Tree};
use super::{CRATE, Scratch, cargo, host, patches_in, upstream, upstream_src, workspace};

mod fit;
mod pin;
mod review;
mod suite;
pub(crate) use suite::walk;
#[cfg(test)]
mod tests;

/// What to do.
pub(crate) struct Options<'a> {
    /// The release to move to.
    pub(crate) version: &'a str,
    /// A checkout whose commits are the patches, instead of `patches/`.
    pub(crate) from: Option<&'a Path>,
    /// A checkout of rustls's repository, whose tests are run.
    pub(crate) suite: Option<&'a Path>,
    /// Writes nothing.
    pub(crate) dry_run: bool,
}

impl<'a> Options<'a> {
    pub(crate) fn new(version: &'a str) -> Self {
        Self { version, from: None, suite: None, dry_run: false }
    }
}

/// Moves the pin of this workspace.
pub(crate) fn rebase(options: &Options<'_>) -> Result<String, String> {
    rebase_in(workspace(), options)
}

fn rebase_in(root: &Path, options: &Options<'_>) -> Result<String, String> {
    let version = options.version;
    admit(version)?;

    let crate_dir = root.join(CRATE);
    let pinned = upstream::pinned_version(&crate_dir)?;
    let old_src = upstream_src(&crate_dir)?;
    let old = tree::read_dir(&old_src)?;
    tree::check(&old, &crate_dir.join("upstream.sha256"))?;
    let new_src = fetch(&crate_dir, version)?;
    let new = tree::read_dir(&new_src)?;

    let patches = match options.from {
        Some(dir) => patches_in(dir)?,
        None => tree::read_patches(&crate_dir)?,
    };
    let added = tree::read_added(&crate_dir)?;
    let changed = apply(&new, &patches, &added).map_err(|list| unfit(&list, &pinned, version))?;
    let made = tree::adapt(changed.clone())?;

    let mut report = format!(
        "rustls {version}: {} files, all {} patches apply strictly, {} files added",
        new.len(),
        patches.len(),
        added.len()
    );
    if let Some(repository) = options.suite {
        report += "\n\n";
        report += &suite::compare(repository, version, &new, &changed)?;
    }
    if version != pinned {
        report += "\n\n";
        report += &review::list((&pinned, &old_src), (version, &new_src), &patches)?;
    }

    let mut edits = pin::Edits::new(root);
    pin::plan(&mut edits, (&pinned, version), &new, &made, &patches)?;
    if edits.is_empty() {
        return Ok(format!("{report}\n\nnothing to change: this is the pinned release"));
    }
    let names = edits.names().join("\n  ");
    if options.dry_run {
        return Ok(format!("{report}\n\ndry run, nothing was changed; this would be:\n  {names}"));
    }

    let written = edits.write()?;
    pin::update_locks(root, version)?;
    // as the build script is going to see it
    let seen = tree::assemble(&upstream_src(&crate_dir)?, &crate_dir)?;
    tree::check(&seen, &crate_dir.join("patched.sha256"))?;
    written.keep();
    Ok(format!("{report}\n\nchanged, with the lock files:\n  {names}"))
}

/// The `src` directory of the release, which cargo downloads and verifies if it has to.
pub(super) fn fetch(crate_dir: &Path, version: &str) -> Result<PathBuf, String> {
    let scratch = Scratch::new("release")?;
    let exactly = format!("={version}");
    let (found, src) = upstream::find(&cargo(), crate_dir, &host()?, &scratch.0, &exactly, &[])
        .map_err(|why| format!("rustls {version} cannot be had: {why}"))?;
    if found != version {
        return Err(format!("cargo has rustls {found} for {exactly}"));
    }
    Ok(src)
}

/// Refuses what the patches must never be moved to.
fn admit(version: &str) -> Result<(), String> {
    let release = version.strip_prefix("0.23.").filter(|release| {
        release.bytes().all(|byte| byte.is_ascii_digit())
            && (*release == "0" || !release.starts_with('0'))
    });
    let Some(Ok(release)) = release.map(str::parse::<u32>) else {
        return Err(format!(
            "{version} is not a release of rustls 0.23, which is the line that the patches and \
             rustls-axon's API are of"
        ));
    };
    if (13..=44).contains(&release) {
        return Err(format!(
            "rustls {version} has the vulnerability RUSTSEC-2026-0285, as all from 0.23.13 to \
             0.23.44"
        ));
    }
    Ok(())
}

/// The released tree with patches and added files, or everything that hinders it.
fn apply(released: &Tree, patches: &Tree, added: &Tree) -> Result<Tree, Vec<String>> {
    let mut changed = released.clone();
    // the strict applier decides; the rest finds what does not fit, for the maintainer who resolves it
    let Err(why) = tree::change(&mut changed, patches, added) else { return Ok(changed) };

    let mut list = Vec::new();
    let mut as_far_as_it_goes = released.clone();
    for (name, text) in patches {
        list.extend(fit::misfits(&mut as_far_as_it_goes, name, text));
    }
    for path in added.keys().filter(|path| released.contains_key(*path)) {
        list.push(format!("added/src/{path}: rustls has a file of that name"));
    }
    if list.is_empty() {
        list.push(why);
    }
    Err(list)
}

fn unfit(list: &[String], pinned: &str, version: &str) -> String {
    format!(
        "the patches do not apply to rustls {version}, so nothing was changed:\n  {}\n\
         To resolve them:\n  \
         cargo xtask rustls-checkout DIR {version}\n  \
         in DIR: git rebase --onto {version} {pinned} patches\n  \
         cargo xtask rebase {version} --from DIR",
        list.join("\n  ")
    )
}
