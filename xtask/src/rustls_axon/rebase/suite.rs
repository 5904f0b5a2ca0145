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

/// Why each failed test failed: its panic messages, without the place in the source.
pub(super) type Reasons = BTreeMap<String, BTreeSet<String>>;

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
    let missing = copy_tracked(repository, &copy)?;
    let src = copy.join("rustls/src");
    let run = |source: &Tree, which: &str| -> Result<(Outcomes, Reasons), String> {
        replace_sources(source, &src)?;
        outcomes(&copy, &scratch.0.join("target")).map_err(|why| {
            format!("rustls's tests, of {found}, on the {which} source of {version}: {why}")
        })
    };
    let (plain, plain_reasons) = run(released, "unpatched")?;
    let (patched, patched_reasons) = run(changed, "patched")?;

    let mut report = format!("rustls's own tests, of {found}, on the source of {version}:");
    for (name, outcomes) in [("unpatched", &plain), ("patched", &patched)] {
        let [passed, failed, ignored] = counts(outcomes);
        report += &format!("\n  {name:<9}  {passed} passed, {failed} failed, {ignored} ignored");
    }
    if found != version {
        report += &format!("\n  (the tests are not those of {version}: some may fail on both)");
    }
    if !missing.is_empty() {
        report += &format!("\n  the checkout lacks tracked files: {}", missing.join(", "));
    }
    report += &failures(&plain_reasons, &patched_reasons);
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

/// Lists each failed test with its reason, and with both reasons where the trees differ.
pub(super) fn failures(plain: &Reasons, patched: &Reasons) -> String {
    let names: BTreeSet<&String> = plain.keys().chain(patched.keys()).collect();
    let mut list = String::new();
    for name in names {
        let joined = |reasons: &Reasons| {
            let reasons = reasons.get(name)?;
            Some(reasons.iter().map(String::as_str).collect::<Vec<_>>().join("; "))
        };
        let reason = |reasons| joined(reasons).unwrap_or_else(|| "did not fail".into());
        let (plain, patched) = (reason(plain), reason(patched));
        list += &format!("\n  failed: {name}");
        if plain == patched {
            list += &format!("\n    {plain}");
        } else {
            list += &format!("\n    unpatched: {plain}\n    patched:   {patched}");
        }
    }
    list
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
/// Returns the tracked files that are missing: a test that reads one fails.
pub(super) fn copy_tracked(repository: &Path, to: &Path) -> Result<Vec<String>, String> {
    let tracked = git(repository, &["ls-files", "-z"]);
    let mut files: Vec<String> = Vec::new();
    match tracked {
        Ok(list) => {
            files.extend(list.split('\0').filter(|name| !name.is_empty()).map(str::to_owned));
        }
        Err(_) => walk(repository, "", &mut files)?,
    }
    let mut missing = Vec::new();
    for name in files {
        let from = repository.join(&name);
        // git also tracks links to directories
        if !from.is_file() {
            if from.symlink_metadata().is_err() {
                missing.push(name);
            }
            continue;
        }
        let to = to.join(&name);
        to.parent()
            .map_or(Ok(()), fs::create_dir_all)
            .and_then(|()| fs::copy(&from, &to).map(drop))
            .map_err(|err| format!("cannot copy {}: {err}", from.display()))?;
    }
    Ok(missing)
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

fn outcomes(repository: &Path, target: &Path) -> Result<(Outcomes, Reasons), String> {
    let output = Command::new(cargo())
        .args(TEST)
        .current_dir(repository)
        .env("CARGO_TARGET_DIR", target)
        .env("RUST_BACKTRACE", "0")
        .output()
        .map_err(|err| format!("cannot run cargo: {err}"))?;
    let stdout = String::from_utf8_lossy(&output.stdout);
    let stderr = String::from_utf8_lossy(&output.stderr);
    check_ran(&stdout, &stderr)?;
    Ok((parse(&stdout), reasons(&stdout)))
}

/// Refuses a run in which cargo ran no test, or in which a test program ended before its last test.
pub(super) fn check_ran(stdout: &str, stderr: &str) -> Result<(), String> {
    let started = stdout.lines().filter(|line| is_start(line)).count();
    let ended = stdout.lines().filter(|line| line.starts_with("test result: ")).count();
    if started > 0 && started == ended {
        return Ok(());
    }
    let lines: Vec<&str> = stderr.lines().collect();
    let last = lines[lines.len().saturating_sub(20)..].join("\n");
    if started > 0 {
        return Err(format!(
            "{} of {started} test programs ended before their last test:\n{last}",
            started - ended.min(started)
        ));
    }
    // The first errors name the cause. The last lines of a failed build only count the errors.
    let errors: Vec<&str> =
        lines.iter().copied().filter(|line| line.starts_with("error")).take(10).collect();
    if errors.iter().any(|error| error.starts_with("error[E")) {
        return Err(format!(
            "the tests do not compile:\n  {}\n\
             If an error is about an item of a dependency, Cargo.lock of the checkout is older than \
             the release: run `cargo update -p rustls-webpki -p aws-lc-rs` in the checkout.",
            errors.join("\n  ")
        ));
    }
    Err(format!("cargo ran no test:\n{last}"))
}

/// Tells whether `line` is what the harness prints first: `running 4 tests`.
fn is_start(line: &str) -> bool {
    line.strip_prefix("running ")
        .and_then(|line| line.strip_suffix(" tests").or_else(|| line.strip_suffix(" test")))
        .is_some_and(|count| count.parse::<usize>().is_ok())
}

/// Reads the panic messages that the test harness prints: `---- NAME stdout ----`, then what the
/// test wrote.
pub(super) fn reasons(output: &str) -> Reasons {
    let mut reasons = Reasons::new();
    let mut lines = output.lines().peekable();
    let mut test = None;
    while let Some(line) = lines.next() {
        if let Some(name) =
            line.strip_prefix("---- ").and_then(|line| line.strip_suffix(" stdout ----"))
        {
            let name = unplaced(name);
            reasons.entry(name.clone()).or_default();
            test = Some(name);
        } else if line.starts_with("test result: ") {
            test = None;
        } else if let Some(test) = &test
            && line.starts_with("thread '")
            && line.contains(" panicked at ")
        {
            let mut message = Vec::new();
            while let Some(line) =
                lines.next_if(|line| !line.is_empty() && !line.starts_with("note: "))
            {
                message.push(line.trim());
            }
            reasons.entry(test.clone()).or_default().insert(message.join(" "));
        }
    }
    reasons
}

/// The name of a test, without the line of a documentation test: patches move it.
fn unplaced(name: &str) -> String {
    match name.split_once(" (line ").map(|(item, rest)| (item, rest.split_once(')'))) {
        Some((item, Some((_, how)))) => format!("{item}{how}"),
        _ => name.to_owned(),
    }
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
        let seen = outcomes.entry(unplaced(name)).or_default();
        *seen.entry(outcome.to_owned()).or_default() += 1;
    }
    outcomes
}

pub(super) fn counts(outcomes: &Outcomes) -> [usize; 3] {
    ["ok", "FAILED", "ignored"]
        .map(|outcome| outcomes.values().filter_map(|seen| seen.get(outcome)).sum())
}
