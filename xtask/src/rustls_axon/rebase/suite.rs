//! rustls's own tests, without and with the patches.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::Path;
use std::process::Command;

use super::super::git;
use super::{Scratch, Tree, cargo};

/// What is run. Features as upstream tests them, without FIPS.
const TEST: [&str; 5] =
    ["test", "--no-fail-fast", "--package=rustls", "--features=ring,brotli,zlib", "--color=never"];

/// How often each outcome (`ok`, `FAILED`, `ignored`) was seen of each test.
pub(super) type Outcomes = BTreeMap<String, BTreeMap<String, usize>>;

/// Runs the tests in a copy of `repository`, once with the released source and once with the
/// changed one. Another outcome of any test is an error.
///
/// Cargo may download what the tests need.
pub(super) fn compare(
    repository: &Path,
    version: &str,
    released: &Tree,
    changed: &Tree,
) -> Result<String, String> {
    let manifest = repository.join("rustls/Cargo.toml");
    let manifest = fs::read_to_string(&manifest)
        .map_err(|err| format!("cannot read {}: {err}", manifest.display()))?;
    let found = manifest
        .lines()
        .find_map(|line| line.strip_prefix("version = \"")?.strip_suffix('"'))
        .ok_or_else(|| format!("{} is not rustls's repository", repository.display()))?;

    let scratch = Scratch::new("suite")?;
    let copy = scratch.0.join("repository");
    copy_tracked(repository, &copy)?;
    let src = copy.join("rustls/src");
    let run = |source: &Tree| -> Result<Outcomes, String> {
        replace_sources(source, &src)?;
        outcomes(&copy, &scratch.0.join("target"))
    };
    let (plain, patched) = (run(released)?, run(changed)?);

    let mut report = format!("rustls's own tests, of {found}, on the source of {version}:");
    for (name, outcomes) in [("unpatched", &plain), ("patched", &patched)] {
        let [passed, failed, ignored] = counts(outcomes);
        report += &format!("\n  {name:<9}  {passed} passed, {failed} failed, {ignored} ignored");
    }
    if found != version {
        report += &format!("\n  (the tests are not those of {version}: some may fail on both)");
    }
    let names: BTreeSet<&String> = plain.keys().chain(patched.keys()).collect();
    let differ: Vec<&str> = names
        .into_iter()
        .filter(|name| plain.get(*name) != patched.get(*name))
        .map(String::as_str)
        .collect();
    if !differ.is_empty() {
        return Err(format!("{report}\n  not the same: {}", differ.join(", ")));
    }
    Ok(report + "\n  every test has the same outcome on both")
}

/// Makes `src` hold these Rust sources and no others. What tests read besides stays.
fn replace_sources(source: &Tree, src: &Path) -> Result<(), String> {
    let mut present = Vec::new();
    walk(src, "", &mut present)?;
    for name in present.iter().filter(|name| name.ends_with(".rs") && !source.contains_key(*name)) {
        fs::remove_file(src.join(name)).map_err(|err| format!("cannot remove {name}: {err}"))?;
    }
    for (name, contents) in source {
        let path = src.join(name);
        path.parent()
            .map_or(Ok(()), fs::create_dir_all)
            .and_then(|()| fs::write(&path, contents))
            .map_err(|err| format!("cannot write {}: {err}", path.display()))?;
    }
    Ok(())
}

/// Copies what `git` tracks in `repository`, or everything but `target/` where there is no git.
fn copy_tracked(repository: &Path, to: &Path) -> Result<(), String> {
    let tracked = git(repository, &["ls-files", "-z"]);
    let mut files: Vec<String> = Vec::new();
    match tracked {
        Ok(list) => {
            files.extend(list.split('\0').filter(|name| !name.is_empty()).map(str::to_owned));
        }
        Err(_) => walk(repository, "", &mut files)?,
    }
    // what is not a file (any more) is a link to a directory, or was removed
    for name in files.into_iter().filter(|name| repository.join(name).is_file()) {
        let (from, to) = (repository.join(&name), to.join(&name));
        to.parent()
            .map_or(Ok(()), fs::create_dir_all)
            .and_then(|()| fs::copy(&from, &to).map(drop))
            .map_err(|err| format!("cannot copy {}: {err}", from.display()))?;
    }
    Ok(())
}

/// The files below `root`, without build directories and git's own.
pub(crate) fn walk(root: &Path, below: &str, files: &mut Vec<String>) -> Result<(), String> {
    let failed = |err| format!("cannot read {}: {err}", root.join(below).display());
    for entry in fs::read_dir(root.join(below)).map_err(failed)? {
        let entry = entry.map_err(failed)?;
        let name = entry.file_name().to_string_lossy().into_owned();
        let path = if below.is_empty() { name.clone() } else { format!("{below}/{name}") };
        let kind = entry.file_type().map_err(failed)?;
        if kind.is_dir() && name != "target" && name != ".git" {
            walk(root, &path, files)?;
        } else if kind.is_file() {
            files.push(path);
        }
    }
    Ok(())
}

fn outcomes(repository: &Path, target: &Path) -> Result<Outcomes, String> {
    let output = Command::new(cargo())
        .args(TEST)
        .current_dir(repository)
        .env("CARGO_TARGET_DIR", target)
        .output()
        .map_err(|err| format!("cannot run cargo: {err}"))?;
    let outcomes = parse(&String::from_utf8_lossy(&output.stdout));
    if outcomes.is_empty() {
        let stderr = String::from_utf8_lossy(&output.stderr);
        let last: Vec<&str> = stderr.lines().rev().take(20).collect();
        let last: Vec<&str> = last.into_iter().rev().collect();
        return Err(format!("rustls's tests did not run:\n{}", last.join("\n")));
    }
    Ok(outcomes)
}

/// Reads what the test harness prints: `test NAME ... OUTCOME`.
pub(super) fn parse(output: &str) -> Outcomes {
    let mut outcomes = Outcomes::new();
    for line in output.lines() {
        let Some((name, outcome)) =
            line.strip_prefix("test ").and_then(|line| line.rsplit_once(" ... "))
        else {
            continue;
        };
        // an ignored test may say why
        let outcome = outcome.split(',').next().unwrap_or(outcome);
        // where a documentation test stands is not the same on both
        let name = match name.split_once(" (line ").map(|(item, rest)| (item, rest.split_once(')')))
        {
            Some((item, Some((_, how)))) => format!("{item}{how}"),
            _ => name.to_owned(),
        };
        let seen = outcomes.entry(name).or_default();
        *seen.entry(outcome.to_owned()).or_default() += 1;
    }
    outcomes
}

pub(super) fn counts(outcomes: &Outcomes) -> [usize; 3] {
    ["ok", "FAILED", "ignored"]
        .map(|outcome| outcomes.values().filter_map(|seen| seen.get(outcome)).sum())
}
