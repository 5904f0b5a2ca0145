//! Ledgers across processes: a full disk, a second process, a crash in between.

#![cfg(unix)]

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::Duration;

use etsi_qkd014::KeyPool;
use etsi_qkd014::pool::{Ledger, LedgerError};
use etsi_qkd014::sim::Network;
use tokio::time::Instant;

/// Names the ledger to a child process. Without it the tests of children do nothing.
const PATH: &str = "POOL_LEDGER_CHILD";

fn child_path() -> Option<PathBuf> {
    std::env::var_os(PATH).map(PathBuf::from)
}

/// Returns a command that runs one test of this test binary, after the shell commands in `prelude`.
fn child(test: &str, ledger: &Path, prelude: &str) -> Command {
    let mut command = Command::new("sh");
    command
        .args(["-c", &format!("{prelude} exec \"$0\" --exact --nocapture {test}")])
        .arg(std::env::current_exe().unwrap())
        .env(PATH, ledger);
    command
}

fn passed(mut command: Command) {
    let output = command.output().unwrap();
    let shown = String::from_utf8_lossy(&output.stdout);
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success() && shown.contains("1 passed"), "{shown}\n{errors}");
}

fn record(ledger: &Ledger, from: usize, number: usize) -> Result<Vec<bool>, LedgerError> {
    ledger.record((from..from + number).map(|n| n.to_string()))
}

/// No file may grow beyond 1,024 bytes, and the signal that would say so is ignored. (`ulimit -f`
/// counts in 512 bytes, some shells in 1,024; both are tight enough.)
const SMALL_DISK: &str = "trap '' XFSZ; ulimit -f 1;";

#[test]
fn a_full_disk_records_nothing_in_part_and_works_on_when_there_is_room() {
    let dir = tempfile::tempdir().unwrap();
    passed(child("child_with_a_full_disk", &dir.path().join("ledger"), SMALL_DISK));
}

#[test]
fn child_with_a_full_disk() {
    let Some(path) = child_path() else { return };
    let ledger = Ledger::file(&path).unwrap();
    assert_eq!(record(&ledger, 0, 8).unwrap(), [true; 8]);
    let error = record(&ledger, 8, 40).unwrap_err();
    assert!(matches!(error, LedgerError::Write { .. }), "{error}");
    assert_eq!(std::fs::metadata(&path).unwrap().len(), 32 + 8 * 32, "no part of it stays");
    // Fewer fit, and those of the failed batch count as new: they were not given to anybody.
    assert_eq!(record(&ledger, 8, 4).unwrap(), [true; 4]);
    assert_eq!(record(&ledger, 0, 12).unwrap(), [false; 12]);
    drop(ledger);
    let again = Ledger::file(&path).unwrap();
    assert_eq!((again.len(), record(&again, 0, 12).unwrap()), (12, vec![false; 12]));
}

#[test]
fn a_pool_with_a_full_disk_hands_out_only_recorded_keys() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("ledger");
    passed(child("child_pool_with_a_full_disk", &path, SMALL_DISK));
}

#[tokio::test]
async fn child_pool_with_a_full_disk() {
    let Some(path) = child_path() else { return };
    let network = network().await;
    let client = network.client_builder("sae-a").build().unwrap();
    let ledger = Ledger::file(&path).unwrap();
    let pool = KeyPool::builder(client, "sae-b").target(64).ledger(ledger.clone()).build().unwrap();
    let mut taken = Vec::new();
    while let Ok(key) = pool.take(Instant::now() + Duration::from_secs(3)).await {
        taken.push(key);
    }
    assert!(taken.len() <= 31 && !taken.is_empty(), "{}", taken.len());
    let failure = pool.last_failure().unwrap();
    assert!(failure.contains("could not be recorded"), "{failure}");
    let network_gave = network.kme("kme-a").unwrap().counters().keys_to_masters;
    assert!(network_gave > taken.len() as u64, "keys that came and could not be recorded");
    let ids = taken.iter().map(|key| key.key_id());
    assert!(ledger.record(ids).unwrap().iter().all(|is_new| !is_new));
}

async fn network() -> Network {
    Network::builder()
        .strict()
        .kme("kme-a", "127.0.0.1:0".parse().unwrap(), ["sae-a"])
        .kme("kme-b", "127.0.0.2:0".parse().unwrap(), ["sae-b"])
        .start()
        .await
        .unwrap()
}

#[test]
fn a_second_process_is_locked_out_until_the_first_lets_go() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("ledger");
    let ledger = Ledger::file(&path).unwrap();
    record(&ledger, 0, 3).unwrap();
    passed(child("child_that_is_locked_out", &path, ""));
    let clone = ledger.clone();
    drop(ledger);
    passed(child("child_that_is_locked_out", &path, ""));
    drop(clone);
    passed(child("child_that_goes_on", &path, ""));
    assert_eq!(
        record(&Ledger::file(&path).unwrap(), 0, 5).unwrap(),
        [false, false, false, false, true]
    );
}

#[test]
fn child_that_is_locked_out() {
    let Some(path) = child_path() else { return };
    let error = Ledger::file(&path).unwrap_err();
    assert!(matches!(error, LedgerError::Locked { .. }), "{error}");
}

#[test]
fn child_that_goes_on() {
    let Some(path) = child_path() else { return };
    let ledger = Ledger::file(&path).unwrap();
    assert_eq!(record(&ledger, 0, 4).unwrap(), [false, false, false, true]);
}

#[test]
fn the_ledger_of_a_killed_process_holds_all_reported_keys() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("ledger");
    let mut killed = child("child_that_is_killed", &path, "")
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let told = {
        use std::io::BufRead;
        let lines = std::io::BufReader::new(killed.stdout.take().unwrap()).lines();
        let mut told = lines.map_while(Result::ok).filter_map(|line| line.parse::<usize>().ok());
        let last = told.by_ref().take(200).last();
        killed.kill().unwrap();
        // Numbers that the child printed before it died count too.
        told.last().or(last).unwrap()
    };
    killed.wait().unwrap();
    let ledger = Ledger::file(&path).unwrap();
    assert!(ledger.len() > told, "{} records, {told} told", ledger.len());
    assert!(record(&ledger, 0, told + 1).unwrap().iter().all(|is_new| !is_new));
}

#[test]
fn child_that_is_killed() {
    let Some(path) = child_path() else { return };
    let ledger = Ledger::file(&path).unwrap();
    for n in 0..1_000_000 {
        assert_eq!(record(&ledger, n, 1).unwrap(), [true]);
        // Writes directly to the pipe, past the test harness's own buffer.
        use std::io::Write;
        writeln!(std::io::stdout(), "{n}").unwrap();
    }
}
