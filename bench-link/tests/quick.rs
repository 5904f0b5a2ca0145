//! The program itself, over a path that loses a fifth of the packets, for a second each.

#[path = "../../axon-transport/daemon/tests/support/excerpt.rs"]
mod excerpt;

use std::{
    fs,
    io::{BufRead, BufReader},
    process::{Command, Stdio},
};

use excerpt::excerpt;
use serde_json::Value;

/// The errors of the program if it may not create hosts.
const NOT_HERE: [&str; 3] = [
    "a network namespace cannot be made",
    "the device of a host cannot be made",
    "is iproute2 installed",
];

/// Returns the figures, or `None` if this machine cannot measure them.
fn figures(arguments: &[&str]) -> Option<Value> {
    let directory = tempfile::tempdir().unwrap();
    let file = directory.path().join("figures.json");
    let mut command = Command::new(env!("CARGO_BIN_EXE_axon-bench-link"));
    let output = command.args(arguments).arg("--json").arg(&file).output().unwrap();
    let said = String::from_utf8_lossy(&output.stderr);
    if let Some(why) = NOT_HERE.iter().find(|why| said.contains(**why)) {
        eprintln!("skipped: hosts in network namespaces, {why}");
        return None;
    }
    let shown = |name, bytes: &[u8]| excerpt(name, &String::from_utf8_lossy(bytes));
    let shown = || [shown("stderr", &output.stderr), shown("stdout", &output.stdout)].join("\n");
    assert!(output.status.success(), "{}", shown());
    Some(serde_json::from_str(&fs::read_to_string(file).unwrap()).unwrap())
}

/// A RELIABLE sample crosses a path that loses a fifth of all packets. How soon is not asserted.
#[test]
fn reliable_samples_arrive_over_a_lossy_path() {
    let arguments = ["losses", "--losses", "20", "--seconds", "1", "--mode", "classic,messages10"];
    let Some(all) = figures(&arguments) else { return };
    let [classic, messages10] =
        ["classic", "messages10"].map(|mode| all["figures"][mode]["losses"].as_array().unwrap());
    assert_eq!((classic.len(), messages10.len()), (7, 4), "TCP is measured once");
    for row in classic.iter().chain(messages10) {
        assert!(row["published"].as_u64().unwrap() > 10, "{row}");
        assert!(row["packets_lost"].as_u64().unwrap() > 0, "{row}");
        let arrived = row["arrived_percent"].as_f64().unwrap();
        match row["message"].as_str().unwrap() {
            "1 KB, RELIABLE" if row["carrier"] == "AXON" => assert_eq!(arrived, 100.0, "{row}"),
            // TCP guarantees nothing over this path.
            _ if row["carrier"] == "TCP" => {}
            // The path loses a fifth of lone packets.
            "1 KB, BEST_EFFORT" => assert!(arrived > 50.0, "{row}"),
            _ => assert!(arrived > 0.0, "{row}"),
        }
    }
}

#[test]
fn a_loss_that_is_no_share_is_refused() {
    let mut command = Command::new(env!("CARGO_BIN_EXE_axon-bench-link"));
    let output = command.args(["losses", "--losses", "100"]).output().unwrap();
    assert!(!output.status.success());
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(said.contains("from 0 to below 100"), "{}", excerpt("stderr", &said));
}

/// Processes and daemons are killed for some seconds; the program fails if a sample or a call is not accounted for.
#[test]
fn torture_accounts_for_every_sample() {
    let Some(all) = figures(&["torture", "--seconds", "8", "--seed", "3"]) else { return };
    let torture = &all["figures"]["classic"]["torture"];
    assert!(torture["faults"].as_object().is_some_and(|faults| !faults.is_empty()), "{torture}");
    let topics = torture["topics"].as_array().unwrap();
    assert_eq!(topics.len(), 4);
    for topic in topics {
        assert!(topic["published"].as_u64().unwrap() > 0, "{topic}");
        assert_eq!((&topic["repeated"], &topic["unaccounted"]), (&0.into(), &0.into()), "{topic}");
    }
}

/// A program that this one did not start enters the first host, and reaches the second one over the path.
#[test]
fn other_programs_enter_the_hosts_that_it_lends() {
    let mut command = Command::new(env!("CARGO_BIN_EXE_axon-bench-link"));
    command.args(["relay", "--losses", "0", "--round-trip", "2"]);
    command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped());
    let mut relay = command.spawn().unwrap();
    let mut output = BufReader::new(relay.stdout.take().unwrap());
    let mut line = String::new();
    output.read_line(&mut line).unwrap();
    if line.is_empty() {
        let said = String::from_utf8(relay.wait_with_output().unwrap().stderr).unwrap();
        assert!(NOT_HERE.iter().any(|why| said.contains(why)), "{said}");
        eprintln!("skipped: hosts in network namespaces, {said}");
        return;
    }
    let there: Value = serde_json::from_str(&line).unwrap();
    let mut enter = Command::new("nsenter");
    enter.arg(format!("--net={}", there["hosts"][0]["network"].as_str().unwrap()));
    if !nix::unistd::getuid().is_root() {
        enter.arg(format!("--user={}", there["user"].as_str().unwrap()));
        enter.arg("--preserve-credentials");
    }
    // The refusal has crossed the path, as had the request.
    let port = format!("/dev/tcp/{}/9", there["hosts"][1]["address"].as_str().unwrap());
    let refused = enter.args(["bash", "-c", &format!("exec 3<>{port}")]).output().unwrap();
    let said = String::from_utf8_lossy(&refused.stderr);
    assert!(said.contains("Connection refused"), "{said}");
    // The hosts end with its standard input; then it says what crossed.
    drop(relay.stdin.take());
    let mut last = String::new();
    output.read_line(&mut last).unwrap();
    let counters: Value = serde_json::from_str(&last).unwrap();
    let crossed = |from: usize| counters[from]["packets"].as_u64().unwrap();
    assert!(crossed(0) > 0 && crossed(1) > 0, "{counters}");
    assert!(relay.wait().unwrap().success());
}

#[test]
fn a_relay_of_several_losses_is_refused() {
    let mut command = Command::new(env!("CARGO_BIN_EXE_axon-bench-link"));
    let output = command.args(["relay", "--losses", "10,20"]).output().unwrap();
    assert!(!output.status.success());
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(said.contains("relay takes one loss"), "{}", excerpt("stderr", &said));
}
