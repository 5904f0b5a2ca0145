//! The source package of `rmw_axon`, which bloom and the ROS build farm take: it builds without a network.
//!
//! [`layout`] says which file goes where, [`manifest`] makes the crates' manifests smaller, [`vendor`] and [`prune`]
//! bring the registry's crates, [`changelog`], [`package_xml`], [`debian`] and [`copyright`] make the files for packagers.

mod archive;
mod changelog;
mod copyright;
mod debian;
mod files;
mod graph;
mod layout;
mod lock;
mod manifest;
mod package_xml;
mod prune;
mod vendor;

use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};

use super::package::{self, copied_files};
use super::rustls_axon::{self, git, workspace};
use files::{change, read, write};

/// The arguments of the command.
#[derive(Debug, Default, PartialEq, Eq)]
pub(crate) struct Options<'a> {
    /// `target/ros-release` unless told otherwise.
    dir: Option<&'a Path>,
    /// With `debian/` for this distribution of ROS.
    rosdistro: Option<&'a str>,
    suite: Option<&'a str>,
    rust_package: Option<&'a str>,
    allow_dirty: bool,
    is_offline: bool,
}

impl<'a> Options<'a> {
    /// `None` for arguments that are not known.
    pub(crate) fn parse(mut args: &[&'a str]) -> Option<Self> {
        let mut options = Self::default();
        while let [first, rest @ ..] = args {
            args = rest;
            let with_value = match *first {
                "--allow-dirty" => {
                    options.allow_dirty = true;
                    continue;
                }
                "--offline" => {
                    options.is_offline = true;
                    continue;
                }
                "--debian" => &mut options.rosdistro,
                "--suite" => &mut options.suite,
                "--rust-package" => &mut options.rust_package,
                dir if !dir.starts_with('-') && options.dir.is_none() => {
                    options.dir = Some(Path::new(dir));
                    continue;
                }
                _ => return None,
            };
            let [value, rest @ ..] = args else { return None };
            // They become parts of names.
            let is_name = |c: char| c.is_ascii_alphanumeric() || c == '.' || c == '-';
            if value.is_empty() || value.starts_with('-') || !value.chars().all(is_name) {
                return None;
            }
            *with_value = Some(value);
            args = rest;
        }
        let of_debian = options.suite.is_some() || options.rust_package.is_some();
        (options.rosdistro.is_some() || !of_debian).then_some(options)
    }
}

/// A file in a folder that this command made and may replace.
const MARKER: &str = ".made-by-xtask-ros-release";

/// Makes the source package; says what it has, how large it is, and what to do with it.
pub(crate) fn release(options: &Options<'_>) -> Result<String, String> {
    let root = workspace();
    let changed = package::refuse_dirty(root, options.allow_dirty)?;
    let suite = match (options.rosdistro, options.suite) {
        (None, _) => "",
        (Some(_), Some(suite)) => suite,
        (Some(rosdistro), None) => debian::suite(rosdistro).ok_or_else(|| {
            format!(
                "no suite is known for ROS {rosdistro}: name that of Ubuntu or Debian with --suite"
            )
        })?,
    };
    let commit = |format: &str| {
        let said = git(root, &["log", "-1", &format!("--format={format}")]).map_err(|why| {
            format!("the date of a release is that of its commit, and there is none: {why}")
        })?;
        Ok::<_, String>(said.trim().to_owned())
    };
    let (date, seconds) = (commit("%cs")?, commit("%ct")?);
    let package = package_xml::parse(&read(&root.join("rmw_axon/package.xml"))?)?;
    let rust = rust_version(&read(&root.join("Cargo.toml"))?)?;

    let dir = options.dir.map_or_else(|| root.join("target/ros-release"), Path::to_owned);
    let dir =
        std::path::absolute(&dir).map_err(|err| format!("cannot use {}: {err}", dir.display()))?;
    clear(&dir)?;
    let name = format!("{}-{}", package.name, package.version);
    let tree = dir.join(&name);
    let core = tree.join(layout::CORE);
    layout::copy(root, &copied_files(root)?, &tree)?;
    rustls_axon::write_packaged_form(&core)?;
    slim(&core)?;
    let vendored = vendor::vendor(&core, options.is_offline)?;
    if let Some((newer, by)) = graph::newer_rust(&vendored.compiled, &rust) {
        return Err(format!(
            "{by} needs Rust {newer}, and Cargo.toml says rust-version = \"{rust}\""
        ));
    }

    let legal = copyright::collect(&tree, &vendored.compiled, &package.name, &package.repository)?;
    write(&tree.join("NOTICES"), &legal.notices)?;
    change(&tree.join("README.md"), |text| Ok(layout::readme(text, &package.repository)))?;
    change(&tree.join("package.xml"), |text| package_xml::released(text, &legal.identifiers))?;
    let log = tree.join("CHANGELOG.rst");
    let (text, was_forthcoming) = changelog::released(&read(&log)?, &package.version, &date)?;
    write(&log, &text)?;

    let archive = match options.rosdistro {
        Some(rosdistro) => {
            let target = debian::Target {
                rosdistro,
                suite,
                rust: &rust,
                rust_package: options.rust_package,
            };
            let sections = changelog::sections(&text)?;
            for (file, text) in debian::files(&package, &sections, target) {
                write(&tree.join("debian").join(file), &text)?;
            }
            write(&tree.join("debian/copyright"), &legal.copyright)?;
            let rules = tree.join("debian/rules");
            fs::set_permissions(&rules, PermissionsExt::from_mode(0o755))
                .map_err(|err| format!("{}: {err}", rules.display()))?;
            format!("{}_{}.orig.tar.gz", debian::name(&package.name, rosdistro), package.version)
        }
        None => format!("{name}.tar.gz"),
    };
    let archive = dir.join(archive);
    let packed = archive::pack(&dir, &name, &archive, &seconds)?;

    let mut report = format!(
        "{}\n  {} crates for {}, {} stand-ins for others: {} of vendored sources, {} without what is not needed\n\
         {}\n  {}, without debian/\nneeds Rust {rust} or newer",
        tree.display(),
        vendored.compiled.len(),
        graph::PLATFORMS.join(" and "),
        vendored.stand_ins,
        archive::megabytes(vendored.bytes.0),
        archive::megabytes(vendored.bytes.1),
        archive.display(),
        archive::megabytes(packed),
    );
    if was_forthcoming {
        report += &format!(
            "\nCHANGELOG.rst has no section {}: Forthcoming was taken for it",
            package.version
        );
    }
    if changed {
        report += "\nNOT A RELEASE: changes that are not committed are in it";
    }
    if options.rosdistro.is_some() {
        report += &format!("\nto build it: cd {} && dpkg-buildpackage -us -uc -b", tree.display());
    }
    Ok(report)
}

/// Makes the manifests smaller, and keeps colcon away from the crates.
fn slim(core: &Path) -> Result<(), String> {
    change(&core.join("Cargo.toml"), |text| manifest::workspace(text, &layout::CRATES))?;
    for member in layout::CRATES {
        change(&core.join(member).join("Cargo.toml"), |text| Ok(manifest::member(text)))?;
    }
    let of_rustls = core.join("third_party/rustls-axon");
    for unused in ["examples", "build"] {
        let unused = of_rustls.join(unused);
        fs::remove_dir_all(&unused)
            .map_err(|err| format!("cannot remove {}: {err}", unused.display()))?;
    }
    write(&core.join("COLCON_IGNORE"), "")
}

/// Makes the folder an empty one. What somebody else put there is not removed.
fn clear(dir: &Path) -> Result<(), String> {
    let shown = |err| format!("{}: {err}", dir.display());
    let there: Vec<PathBuf> = match fs::read_dir(dir) {
        Ok(entries) => entries
            .map(|entry| entry.map(|entry| entry.path()))
            .collect::<Result<_, _>>()
            .map_err(shown)?,
        Err(_) if !dir.exists() => Vec::new(),
        Err(err) => return Err(shown(err)),
    };
    if !there.is_empty() && !dir.join(MARKER).exists() {
        return Err(format!(
            "{} has files that this command did not make: name another folder",
            dir.display()
        ));
    }
    // The marker stays, so that a run that is interrupted here is no hindrance.
    for path in there.into_iter().filter(|path| !path.ends_with(MARKER)) {
        let removed =
            if path.is_dir() { fs::remove_dir_all(&path) } else { fs::remove_file(&path) };
        removed.map_err(|err| format!("cannot remove {}: {err}", path.display()))?;
    }
    // A checkout in a workspace of colcon would have two packages of one name.
    write(&dir.join("COLCON_IGNORE"), "")?;
    write(&dir.join(MARKER), "")
}

/// The workspace's `rust-version`.
fn rust_version(manifest: &str) -> Result<String, String> {
    let manifest: toml::Table = manifest.parse().map_err(|err| format!("Cargo.toml: {err}"))?;
    let package = manifest.get("workspace").and_then(|workspace| workspace.get("package"));
    let version =
        package.and_then(|package| package.get("rust-version")).and_then(toml::Value::as_str);
    version.map(str::to_owned).ok_or_else(|| "Cargo.toml has no rust-version".into())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn arguments_are_a_folder_and_known_options() {
        assert_eq!(Options::parse(&[]), Some(Options::default()));
        let options =
            Options::parse(&["out", "--debian", "jazzy", "--suite", "bookworm", "--allow-dirty"])
                .unwrap();
        assert_eq!(options.dir, Some(Path::new("out")));
        assert_eq!((options.rosdistro, options.suite), (Some("jazzy"), Some("bookworm")));
        assert!(options.allow_dirty && !options.is_offline);
        for wrong in [
            &["a", "b"][..],
            &["--debian"],
            &["--debian", "../x"],
            &["--debian", "--offline"],
            &["--suite", "noble"],
            &["--sign"],
        ] {
            assert_eq!(Options::parse(wrong), None, "{wrong:?}");
        }
    }

    #[test]
    fn second_run_replaces_files_of_the_first_run_only() {
        let dir = tempfile::tempdir().unwrap();
        let out = dir.path().join("out");
        clear(&out).unwrap();
        write(&out.join("rmw_axon-0.1.0/a"), "").unwrap();
        clear(&out).unwrap();
        assert!(out.join(MARKER).exists() && !out.join("rmw_axon-0.1.0").exists());
        assert!(out.join("COLCON_IGNORE").exists());

        let theirs = dir.path().join("theirs");
        write(&theirs.join("thesis.tex"), "").unwrap();
        assert!(clear(&theirs).unwrap_err().contains("did not make"));
        assert!(theirs.join("thesis.tex").exists());
    }

    #[test]
    fn workspace_states_a_rust_version() {
        let manifest = read(&workspace().join("Cargo.toml")).unwrap();
        assert!(rust_version(&manifest).unwrap().starts_with("1."));
        assert!(rust_version("[workspace]\n").is_err());
    }
}
