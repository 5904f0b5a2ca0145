//! What `--help` says: each command's purpose, examples, exit statuses.

#![forbid(unsafe_code)]

use std::process::Command;

fn help(args: &[&str]) -> String {
    let output =
        Command::new(env!("CARGO_BIN_EXE_axon")).args(args).arg("--help").output().expect("runs");
    assert!(output.status.success(), "{args:?}");
    String::from_utf8(output.stdout).expect("text")
}

#[test]
fn the_first_page_names_every_command_and_the_exit_statuses() {
    let text = help(&[]);
    for part in ["demo", "play", "echo", "status", "daemon", "Exit status:", "AXON_SECURITY_MODE"] {
        assert!(text.contains(part), "{part:?} is missing in:\n{text}");
    }
    assert!(!text.contains("demo-player"), "what the demo starts is not for people:\n{text}");
}

#[test]
fn each_command_says_what_it_does_and_shows_an_example() {
    for command in ["demo", "play", "echo", "status", "daemon"] {
        let text = help(&[command]);
        assert!(text.contains("Examples:") && text.contains(&format!("axon {command}")), "{text}");
    }
    for status in ["demo", "status"] {
        assert!(help(&[status]).contains("Exit status:"), "{status}");
    }
}

#[test]
fn no_line_is_wider_than_a_page() {
    for command in [&[][..], &["demo"], &["play"], &["echo"], &["status"], &["daemon"]] {
        for line in help(command).lines() {
            assert!(line.chars().count() <= 100, "{command:?}: {line}");
        }
    }
}
