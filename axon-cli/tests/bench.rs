//! `axon bench shm`: what it writes is complete and well-formed. No figure is looked at: other
//! tests run at the same time.

#![forbid(unsafe_code)]

mod common;

use std::{
    fs,
    io::Write as _,
    process::Stdio,
    thread::{self, available_parallelism},
};

use common::{Running, Stderr, axon, eventually};
use serde_json::Value;

/// One for each way that AXON has with a sample: in its descriptor, copied, in place.
const SIZES: [u64; 3] = [64, 4096, 16_384];
const KINDS: [(&str, &str); 6] = [
    ("poll", "copy"),
    ("poll", "fill"),
    ("poll", "touch"),
    ("event", "touch"),
    ("event_one_cpu", "touch"),
    ("event", "copy"),
];

/// Returns whether there are two CPUs: two processes cannot poll for each other on one.
fn has_two_cpus() -> bool {
    let enough = available_parallelism().is_ok_and(|cpus| cpus.get() > 1);
    if !enough {
        // Past the harness, which would show it only beside a failure.
        let _ = writeln!(std::io::stderr(), "skipped: it takes two CPUs");
    }
    enough
}

fn rows(document: &Value, part: &str) -> Vec<Value> {
    document[part].as_array().unwrap_or_else(|| panic!("{part} is a list")).clone()
}

/// Checks all percentiles of the best round and of all together, which must be in order, and the number of
/// measurements.
fn check_times(times: &Value) {
    assert!(times["median_of_p50_ns"].is_f64(), "{times}");
    assert!(times["cpu_ns_a_message"].as_f64() > Some(0.0), "{times}");
    assert_eq!(times["rounds"], 3, "{times}");
    let percents = [0.0, 1.0, 5.0, 10.0, 25.0, 50.0, 75.0, 90.0, 95.0, 99.0, 99.9, 99.99, 100.0];
    for part in ["best_round", "all_rounds"] {
        let part = &times[part];
        assert!(part["count"].as_u64() > Some(0) && part["mean_ns"].is_f64(), "{times}");
        let at = |percent: &f64| {
            let value = part["percentiles_ns"][format!("p{percent}")].as_f64();
            value.unwrap_or_else(|| panic!("p{percent} is missing: {times}"))
        };
        assert!(percents.iter().map(at).is_sorted(), "{times}");
        assert_eq!(part["percentiles_ns"].as_object().map(|all| all.len()), Some(percents.len()));
    }
    let [best, all] = ["best_round", "all_rounds"].map(|part| times[part]["count"].as_u64());
    assert!(best <= all, "{times}");
}

fn check_ratio(ratio: &Value) -> f64 {
    let [best, median] = ["of_best_rounds", "median_of_rounds"].map(|name| ratio[name].as_f64());
    assert!(median.is_some_and(f64::is_finite), "{ratio}");
    best.filter(|best| best.is_finite()).unwrap_or_else(|| panic!("{ratio}"))
}

fn check_ratio_median(ratio: &Value) -> f64 {
    check_ratio(ratio);
    ratio["median_of_rounds"].as_f64().expect("was looked at")
}

fn check_budget(row: &Value, ratio: f64, at_most: Option<f64>) {
    match at_most {
        None => assert_eq!(row["budget"], Value::Null, "{row}"),
        Some(at_most) => {
            assert_eq!(row["budget"]["at_most"], at_most, "{row}");
            assert_eq!(row["budget"]["met"], ratio <= at_most, "{row}");
        }
    }
}

#[test]
fn a_quick_run_writes_every_figure_there_is() {
    if !has_two_cpus() {
        return;
    }
    let dir = tempfile::tempdir().expect("temporary directory");
    let out = dir.path().join("made/for/it");
    let sizes = SIZES.map(|size| size.to_string()).join(",");
    let output = axon([])
        .args(["bench", "shm", "--quick", "--sizes", &sizes, "--out"])
        .arg(&out)
        .output()
        .expect("it runs");
    let text = String::from_utf8(output.stdout).expect("text");
    assert!(output.status.success(), "{text}\n{}", Stderr::of(&output.stderr));

    let document = fs::read(out.join("shm.json")).expect("a file");
    let document: Value = serde_json::from_slice(&document).expect("JSON");
    assert_eq!(document["version"], env!("CARGO_PKG_VERSION"));
    assert_eq!(document["quick"], true);
    let machine = &document["machine"];
    for known in ["host", "kernel", "architecture", "cpu"] {
        assert!(machine[known].as_str().is_some_and(|text| !text.is_empty()), "{known}: {machine}");
    }
    assert!(machine["pinned"][0] != machine["pinned"][1] && machine["clock_ns"].is_f64());

    let latency = rows(&document, "latency");
    let expected: Vec<_> = KINDS.iter().flat_map(|kind| SIZES.map(|size| (*kind, size))).collect();
    assert_eq!(latency.len(), expected.len());
    for (row, ((wake, motion), size)) in latency.iter().zip(expected) {
        assert_eq!((&row["wake"], &row["motion"]), (&wake.into(), &motion.into()));
        assert_eq!((&row["bytes"], &row["window"]), (&size.into(), &1.into()));
        check_times(&row["raw"]);
        check_times(&row["axon"]);
        let at_most = match (wake, motion, size) {
            ("poll", "copy", 64) => Some(1.3),
            ("poll", "copy", 16_384) => Some(1.05),
            ("poll", "touch", _) => Some(2.5),
            ("event" | "event_one_cpu", "touch", _) => Some(1.1),
            _ => None,
        };
        check_budget(row, check_ratio(&row["ratio"]), at_most);
    }

    let streams = rows(&document, "throughput");
    assert_eq!(streams.len(), 3 * SIZES.len());
    for row in &streams {
        assert!(row["window"].as_u64() > Some(1), "{row}");
        check_times(&row["raw"]);
        check_times(&row["axon"]);
        check_ratio(&row["ratio"]);
    }

    let paced = rows(&document, "paced");
    let expected: Vec<_> =
        [100.0, 1000.0].iter().flat_map(|hz| SIZES.map(|size| (*hz, size))).collect();
    assert_eq!(paced.len(), expected.len());
    for (row, (hz, size)) in paced.iter().zip(expected) {
        assert_eq!((&row["hz"], &row["bytes"]), (&hz.into(), &size.into()));
        ["epoll", "futex", "axon"].iter().for_each(|of| check_times(&row[of]));
        check_ratio(&row["ratio_to_futex"]);
        check_budget(row, check_ratio_median(&row["ratio_to_epoll"]), Some(1.1));
    }

    let publish = rows(&document, "publish");
    let expected: Vec<_> = SIZES
        .iter()
        .flat_map(|size| [false, true].map(|woken| (*size, woken)))
        .flat_map(|(size, woken)| [1, 4, 16].map(|readers| (size, woken, readers)))
        .collect();
    assert_eq!(publish.len(), expected.len());
    for (row, (size, woken, readers)) in publish.iter().zip(expected) {
        assert_eq!((&row["bytes"], &row["woken"]), (&size.into(), &woken.into()));
        assert_eq!(row["readers"], readers);
        for of in [&row["raw"], &row["axon"]] {
            check_times(&of["call"]);
            check_times(&of["read"]);
        }
        check_ratio(&row["ratio_to_raw"]);
        check_ratio(&row["raw_ratio_to_one"]);
        // The budget leaves wake-ups aside.
        let at_most = (!woken && readers == 16).then_some(1.3);
        check_budget(row, check_ratio_median(&row["ratio_to_one"]), at_most);
    }

    // The tables have as many rows as there are loads, and no row without its title.
    assert_eq!(text.matches("\nLatency, ").count(), KINDS.len(), "{text}");
    assert_eq!(text.matches("\nThroughput, ").count(), 3, "{text}");
    assert!(
        text.matches("\nA publish to processes").count() == 2 && text.contains("good for nothing"),
        "{text}"
    );
    for size in ["64 B", "4 KiB", "16 KiB"] {
        let lines = text.lines().filter(|line| line.trim_start().starts_with(size)).count();
        // Two paces, and three numbers of readers twice.
        assert_eq!(lines, KINDS.len() + 3 + 2 + 6, "{size}: {text}");
    }

    let svg = fs::read_to_string(out.join("shm.svg")).expect("a file");
    assert!(svg.starts_with("<svg ") && svg.trim_end().ends_with("</svg>"));
    assert_eq!(svg.matches("<polyline").count(), 2 * (KINDS.len() + 3) + 4);
    assert!(!svg.contains("NaN") && !svg.contains("inf"), "{svg}");
}

#[test]
fn it_ends_when_its_other_process_does() {
    if !has_two_cpus() {
        return;
    }
    let dir = tempfile::tempdir().expect("temporary directory");
    let mut command = axon([]);
    command.args(["bench", "shm", "--sizes", "8", "--out"]).arg(dir.path());
    command.stdin(Stdio::null());
    let mut running = Running::start(command);
    let pid = running.0.id();
    let mut other = None;
    eventually("there is another process", || {
        let children = fs::read_to_string(format!("/proc/{pid}/task/{pid}/children"));
        let first = children.ok().and_then(|list| list.split(' ').next()?.parse().ok());
        other = first.and_then(rustix::process::Pid::from_raw);
        other.is_some()
    });
    // In the middle of the first round, or before it.
    thread::sleep(std::time::Duration::from_millis(50));
    rustix::process::kill_process(other.expect("found"), rustix::process::Signal::KILL)
        .expect("it was there");
    eventually("it ends", || running.0.try_wait().expect("its status").is_some());
    let output = running.finish();
    let why = Stderr::of(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{why}");
    assert!(why.contains("ended"), "{why}");
    assert!(!dir.path().join("shm.json").exists());
}

#[test]
fn a_size_that_cannot_be_measured_is_refused() {
    for wrong in ["7", "1k", "8,,9", "67108865"] {
        let output = axon([]).args(["bench", "shm", "--sizes", wrong]).output().expect("it runs");
        assert_eq!(output.status.code(), Some(2), "{wrong}");
        assert!(Stderr::of(&output.stderr).contains("number of bytes"), "{wrong}");
    }
}

#[test]
fn a_quick_run_of_sessions_compares_them_with_bare_shared_memory() {
    if !has_two_cpus() {
        return;
    }
    let dir = tempfile::tempdir().expect("temporary directory");
    let output = axon([])
        .args(["bench", "session", "--quick", "--sizes", "64,8192", "--out"])
        .arg(dir.path())
        .output()
        .expect("it runs");
    let text = String::from_utf8(output.stdout).expect("text");
    assert!(output.status.success(), "{text}\n{}", Stderr::of(&output.stderr));
    assert!(text.contains("session") && text.contains("CPU: bare"), "{text}");
    let document = fs::read(dir.path().join("session.json")).expect("a file");
    let document: Value = serde_json::from_slice(&document).expect("JSON");
    let latency = rows(&document, "latency");
    assert_eq!(latency.len(), 4 * 2);
    let check_judged = |judged: &Value, at_most: f64| {
        let ratio = judged["ratio"].as_f64().expect("a ratio");
        let (said, met) = (&judged["at_most"], &judged["met"]);
        assert_eq!((said, met), (&at_most.into(), &(ratio <= at_most).into()));
    };
    for row in &latency {
        check_times(&row["bare"]);
        check_times(&row["session"]);
        check_judged(&row["session_to_bare"], 1.3);
        let service = (&row["service_one_way"], &row["service_round_trip_to_session"]);
        // Data that is made and read in place has no service row beside it, because a service copies.
        if row["motion"] == "copy" {
            check_times(service.0);
            check_judged(service.1, 2.5);
        } else {
            assert_eq!(service, (&Value::Null, &Value::Null), "{row}");
        }
    }
    assert_eq!(text.matches("by session").count(), 2, "{text}");
}

#[test]
fn a_quick_run_between_two_hosts_has_every_mode_and_size() {
    if !has_two_cpus() {
        return;
    }
    let dir = tempfile::tempdir().expect("temporary directory");
    let output = axon([])
        .args(["bench", "net", "--quick", "--modes", "classic,messages10"])
        .args(["--sizes", "64,65536", "--out"])
        .arg(dir.path())
        .output()
        .expect("it runs");
    let text = String::from_utf8(output.stdout).expect("text");
    assert!(output.status.success(), "{text}\n{}", Stderr::of(&output.stderr));
    assert!(text.contains("QUIC qkd/messages10") && text.contains("KEEP_LAST"), "{text}");
    let document = fs::read(dir.path().join("net.json")).expect("a file");
    let document: Value = serde_json::from_slice(&document).expect("JSON");
    let modes = rows(&document, "modes");
    let names: Vec<_> = modes.iter().map(|mode| &mode["mode"]).collect();
    assert_eq!(names, ["classic", "messages10"]);
    for mode in &modes {
        let sizes = |part: &str| rows(mode, part).iter().map(|row| row["bytes"].clone()).collect();
        let (latency, streams): (Vec<_>, Vec<_>) = (sizes("latency"), sizes("streams"));
        assert_eq!(
            (latency, streams),
            (vec![64.into(), 65_536.into()], vec![64.into(), 65_536.into()])
        );
        for row in rows(mode, "latency") {
            check_times(&row["bare"]);
            check_times(&row["axon"]);
        }
        let paced = rows(mode, "paced");
        let loads: Vec<_> = paced.iter().map(|row| (&row["pace_ns"], &row["bytes"])).collect();
        // A longer message than one packet holds has no pace.
        let size = Value::from(64);
        let paces = [10_000_000, 1_000_000].map(Value::from);
        assert_eq!(loads, paces.iter().map(|pace| (pace, &size)).collect::<Vec<_>>());
        for row in paced {
            for times in ["wake_up", "bare", "axon"] {
                check_times(&row[times]);
            }
        }
        for row in rows(mode, "streams") {
            let of = |what: &str, count: &str| row[what][count].as_u64().expect("a number");
            for waits in ["bare", "keep_all"] {
                assert_eq!(of(waits, "sent"), of(waits, "taken"), "{waits} loses nothing: {row}");
            }
            assert!((1..=of("keep_last", "sent")).contains(&of("keep_last", "taken")), "{row}");
        }
    }
}
