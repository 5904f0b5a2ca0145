//! What `--help` says: each command's purpose, examples, exit statuses.

#![forbid(unsafe_code)]

use std::process::Command;

const TRUST: [[&str; 2]; 3] = [["trust", "keygen"], ["trust", "scan"], ["trust", "list"]];

fn help(args: &[&str]) -> String {
    let output =
        Command::new(env!("CARGO_BIN_EXE_axon")).args(args).arg("--help").output().expect("runs");
    assert!(output.status.success(), "{args:?}");
    String::from_utf8(output.stdout).expect("text")
}

#[test]
fn the_first_page_names_every_command_and_the_exit_statuses() {
    let text = help(&[]);
    for part in [
        "demo",
        "play",
        "echo",
        "status",
        "trust",
        "daemon",
        "bench",
        "Exit status:",
        "AXON_SECURITY_MODE",
    ] {
        assert!(text.contains(part), "{part:?} is missing in:\n{text}");
    }
    for hidden in
        ["demo-player", "bench-answer", "bench-read", "bench-session-read", "bench-net-read"]
    {
        assert!(!text.contains(hidden), "what the tool starts is not for people:\n{text}");
    }
}

#[test]
fn each_command_says_what_it_does_and_shows_an_example() {
    for command in ["demo", "play", "echo", "status", "daemon", "bench"] {
        let text = help(&[command]);
        assert!(text.contains("Examples:") && text.contains(&format!("axon {command}")), "{text}");
    }
    for status in [&["demo"][..], &["status"], &["trust", "scan"]] {
        assert!(help(status).contains("Exit status:"), "{status:?}");
    }
}

#[test]
fn trust_says_how_two_hosts_come_to_know_each_other() {
    let text = help(&["trust"]);
    for part in
        ["axon trust keygen", "axon trust scan", "axon trust list", "AXON_CLASSIC_KEY", "_TRUST"]
    {
        assert!(text.contains(part), "{part:?} is missing in:\n{text}");
    }
    for command in TRUST {
        let text = help(&command);
        assert!(text.contains("Examples:") && text.contains(&command.join(" ")), "{text}");
    }
}

#[test]
fn no_line_is_wider_than_a_page() {
    let others: [&[&str]; 10] = [
        &[],
        &["demo"],
        &["play"],
        &["echo"],
        &["status"],
        &["trust"],
        &["daemon"],
        &["bench"],
        &["bench", "shm"],
        &["bench", "session"],
    ];
    for command in others.into_iter().chain(TRUST.iter().map(|command| &command[..])) {
        for line in help(command).lines() {
            assert!(line.chars().count() <= 100, "{command:?}: {line}");
        }
    }
}
