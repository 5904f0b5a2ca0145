//! Runs the test suite many times, for tests that fail seldom.

use std::collections::BTreeMap;
use std::env;
use std::fs::{self, File};
use std::io;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitStatus, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal, kill_process_group};
use serde_json::Value;

type Result<T> = std::result::Result<T, String>;

/// A test program that takes longer than this hangs.
const PATIENCE: Duration = Duration::from_secs(30 * 60);

/// How often, and beside what.
pub(crate) struct Repeat<'a> {
    /// Runs of the whole suite.
    pub(crate) times: u32,
    /// Threads that keep a processor busy meanwhile.
    pub(crate) busy: u32,
    /// Test programs to run: those whose name contains one of the texts. Empty: all.
    pub(crate) only: Vec<&'a str>,
}

/// A test program that cargo built.
struct Program {
    name: String,
    executable: PathBuf,
    manifest: PathBuf,
}

/// A failure of a test, or of a program outside its tests.
struct Failures {
    runs: Vec<u32>,
    log: PathBuf,
}

/// Builds the suite once, runs it `times` times, and reports each test that failed in any run.
///
/// Documentation tests are left out: they are built anew by each run and fail always or never.
///
/// # Errors
/// The suite cannot be built, or a test failed.
pub(crate) fn repeat(options: &Repeat<'_>) -> Result<String> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("xtask is in the repository");
    let programs: Vec<Program> = build(root)?
        .into_iter()
        .filter(|p| options.only.is_empty() || options.only.iter().any(|o| p.name.contains(o)))
        .collect();
    if programs.is_empty() {
        return Err("no test program has such a name".to_owned());
    }
    let target = env::var_os("CARGO_TARGET_DIR").map_or_else(|| root.join("target"), PathBuf::from);
    let logs = target.join("repeat");
    fs::create_dir_all(&logs).map_err(|e| format!("{}: {e}", logs.display()))?;

    let stop = AtomicBool::new(false);
    let mut failed: BTreeMap<String, Failures> = BTreeMap::new();
    thread::scope(|scope| {
        for _ in 0..options.busy {
            // Relaxed: the flag guards no other memory.
            scope.spawn(|| {
                while !stop.load(Ordering::Relaxed) {
                    std::hint::spin_loop();
                }
            });
        }
        let result = run_all(options.times, &programs, &logs, &mut failed);
        stop.store(true, Ordering::Relaxed);
        result
    })?;

    let (times, count) = (options.times, programs.len());
    if failed.is_empty() {
        return Ok(format!("{times} runs of {count} test programs: no test failed"));
    }
    let rows = failed.iter().map(|(test, Failures { runs, log })| {
        let runs = runs.iter().map(u32::to_string).collect::<Vec<_>>().join(", ");
        format!("\n  {test}\n    failed in run {runs}; output of the first: {}", log.display())
    });
    Err(format!("{times} runs of {count} test programs, failed:{}", rows.collect::<String>()))
}

fn run_all(
    times: u32,
    programs: &[Program],
    logs: &Path,
    failed: &mut BTreeMap<String, Failures>,
) -> Result<()> {
    for run in 1..=times {
        let since = Instant::now();
        let mut count = 0;
        for program in programs {
            let log = logs.join(format!("{}-run{run}.log", program.name));
            let status = run_one(program, &log).map_err(|e| format!("{}: {e}", program.name))?;
            if status.is_some_and(|status| status.success()) {
                let _ = fs::remove_file(&log);
                continue;
            }
            let mut tests = failed_tests(&fs::read_to_string(&log).unwrap_or_default());
            if tests.is_empty() {
                tests.push(status.map_or_else(|| "(hangs)".to_owned(), |s| format!("({s})")));
            }
            count += tests.len();
            for test in tests {
                println!("run {run}: {} {test} failed", program.name);
                let entry = failed.entry(format!("{} {test}", program.name));
                let fresh = || Failures { runs: Vec::new(), log: log.clone() };
                entry.or_insert_with(fresh).runs.push(run);
            }
        }
        println!("run {run} of {times}: {} s, {count} failed", since.elapsed().as_secs());
    }
    Ok(())
}

/// Runs a test program as cargo does, its output to `log`. `None`: it hung and was killed, with the
/// processes that it had started.
fn run_one(program: &Program, log: &Path) -> io::Result<Option<ExitStatus>> {
    let out = File::create(log)?;
    let package = program.manifest.parent().expect("a manifest is in a folder");
    let mut command = Command::new(&program.executable);
    command
        .current_dir(package)
        .env("CARGO_MANIFEST_DIR", package)
        .stdin(Stdio::null())
        .stderr(out.try_clone()?)
        .stdout(out);
    let since = Instant::now();
    finish(&mut command, || since.elapsed() >= PATIENCE)
}

/// Runs a program to its end in a process group of its own, or kills that group when it `is_late`.
fn finish(
    command: &mut Command,
    mut is_late: impl FnMut() -> bool,
) -> io::Result<Option<ExitStatus>> {
    let mut child = command.process_group(0).spawn()?;
    while !is_late() {
        if let Some(status) = child.try_wait()? {
            return Ok(Some(status));
        }
        thread::sleep(Duration::from_millis(50));
    }
    // It was not waited for, so its number is still that of its group.
    kill_process_group(Pid::from_child(&child), Signal::KILL)?;
    child.wait()?;
    Ok(None)
}

/// The tests that a run's output calls failed.
fn failed_tests(output: &str) -> Vec<String> {
    let name =
        |line: &str| Some(line.strip_prefix("test ")?.strip_suffix(" ... FAILED")?.to_owned());
    output.lines().filter_map(name).collect()
}

/// Builds all test programs of the workspace.
fn build(root: &Path) -> Result<Vec<Program>> {
    let output = Command::new(env::var_os("CARGO").unwrap_or_else(|| "cargo".into()))
        .current_dir(root)
        .args(["test", "--workspace", "--no-run", "--message-format=json-render-diagnostics"])
        .stderr(Stdio::inherit())
        .output()
        .map_err(|e| format!("cargo test --no-run: {e}"))?;
    if !output.status.success() {
        return Err(format!("cargo test --no-run: {}", output.status));
    }
    programs(&String::from_utf8_lossy(&output.stdout))
}

/// The test programs that cargo's messages name.
fn programs(messages: &str) -> Result<Vec<Program>> {
    let mut programs = Vec::new();
    for line in messages.lines().filter(|line| line.starts_with('{')) {
        let message: Value = serde_json::from_str(line).map_err(|e| format!("cargo: {e}"))?;
        let test = message["profile"]["test"] == true;
        let (Some(executable), true) = (message["executable"].as_str(), test) else { continue };
        let text = |value: &Value| value.as_str().unwrap_or_default().to_owned();
        let manifest = PathBuf::from(text(&message["manifest_path"]));
        let package = manifest.parent().and_then(Path::file_name).unwrap_or_default();
        let target = text(&message["target"]["name"]);
        let name = format!("{}-{target}", package.to_string_lossy());
        programs.push(Program { name, executable: executable.into(), manifest });
    }
    Ok(programs)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn failed_tests_are_found_in_a_programs_output() {
        let output =
            "running 3 tests\ntest a::b ... ok\ntest a::c ... FAILED\ntest d ... ignored\n";
        assert_eq!(failed_tests(output), ["a::c"]);
        assert!(failed_tests("").is_empty());
    }

    #[test]
    fn only_programs_of_tests_are_run() {
        let messages = r#"{"reason":"compiler-artifact","manifest_path":"/r/a/Cargo.toml","target":{"name":"hosts"},"profile":{"test":true},"executable":"/r/t/hosts-1"}
{"reason":"compiler-artifact","manifest_path":"/r/a/Cargo.toml","target":{"name":"axon"},"profile":{"test":false},"executable":"/r/t/axon"}
{"reason":"compiler-artifact","manifest_path":"/r/a/Cargo.toml","target":{"name":"lib"},"profile":{"test":true},"executable":null}
{"reason":"build-finished","success":true}"#;
        let found = programs(messages).unwrap();
        assert_eq!(found.len(), 1);
        assert_eq!(
            (found[0].name.as_str(), found[0].executable.to_str()),
            ("a-hosts", Some("/r/t/hosts-1"))
        );
    }

    #[test]
    fn failing_program_is_reported_with_its_log() {
        let dir = tempfile::tempdir().unwrap();
        let program = Program {
            name: "p".to_owned(),
            executable: "/bin/false".into(),
            manifest: dir.path().join("Cargo.toml"),
        };
        let mut failed = BTreeMap::new();
        run_all(2, &[program], dir.path(), &mut failed).unwrap();
        let (test, failures) = failed.first_key_value().unwrap();
        assert_eq!(test, "p (exit status: 1)");
        assert_eq!(failures.runs, [1, 2]);
        assert!(failures.log.exists());
    }

    /// What a test started would keep a processor, a port or a lock for as long as it lives.
    #[test]
    fn timed_out_program_is_killed_with_its_children() {
        let dir = tempfile::tempdir().unwrap();
        let note = dir.path().join("pid");
        let mut command = Command::new("sh");
        command.arg("-c").arg("sleep 3600 & echo $! >new && mv new pid && wait");
        command.current_dir(dir.path()).stdin(Stdio::null());
        // It is late once it has started the other one.
        assert!(finish(&mut command, || note.exists()).unwrap().is_none());
        let pid = fs::read_to_string(note).unwrap();
        let stat = Path::new("/proc").join(pid.trim()).join("stat");
        let lives = || {
            let stat = fs::read_to_string(&stat).unwrap_or_default();
            stat.rsplit_once(") ").is_some_and(|(_, rest)| !rest.starts_with(['Z', 'X']))
        };
        for _ in 0..600 {
            if !lives() {
                return;
            }
            thread::sleep(Duration::from_millis(100));
        }
        let pid = Pid::from_raw(pid.trim().parse().unwrap()).unwrap();
        let _ = rustix::process::kill_process(pid, Signal::KILL);
        panic!("what the program started lives on");
    }
}
