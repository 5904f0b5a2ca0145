//! Tests the output of `--help`: each command's purpose, examples, exit statuses.

#![forbid(unsafe_code)]

use std::process::Command;

const TRUST: [[&str; 2]; 3] = [["trust", "keygen"], ["trust", "scan"], ["trust", "list"]];
const ACL: [[&str; 2]; 4] =
    [["acl", "check"], ["acl", "test"], ["acl", "import"], ["acl", "learn"]];

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
        "acl",
        "reload",
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
fn the_help_of_commands_shows_examples_and_exit_status() {
    for command in ["demo", "play", "echo", "status", "reload", "daemon", "bench"] {
        let text = help(&[command]);
        assert!(text.contains("Examples:") && text.contains(&format!("axon {command}")), "{text}");
    }
    let acl = ACL.iter().map(|command| &command[..]);
    for status in
        [&["demo"][..], &["status"], &["reload"], &["trust", "scan"]].into_iter().chain(acl)
    {
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
fn acl_says_how_access_rules_are_written_tried_and_taken() {
    let text = help(&["acl"]);
    for part in [
        "[[allow]]",
        "axon acl check",
        "axon acl test",
        "axon acl import",
        "axon acl learn",
        "axon reload",
    ] {
        assert!(text.contains(part), "{part:?} is missing in:\n{text}");
    }
    for command in ACL {
        let text = help(&command);
        let example = format!("axon {}", command.join(" "));
        assert!(text.contains("Examples:") && text.contains(&example), "{text}");
    }
}

/// Returns each command that `--help` names, with its subcommands.
fn commands() -> Vec<String> {
    let below = |command: &[&str]| -> Vec<String> {
        let text = help(command);
        let Some((_, list)) = text.split_once("\nCommands:\n") else { return Vec::new() };
        let lines = list.lines().take_while(|line| !line.is_empty());
        let names = lines.filter(|line| !line.starts_with("   "));
        let names = names.filter_map(|line| line.split_whitespace().next());
        names.filter(|name| *name != "help").map(str::to_owned).collect()
    };
    let mut commands = Vec::new();
    for name in below(&[]) {
        let parts = below(&[&name]);
        let whole = parts.iter().map(|part| format!("{name} {part}"));
        commands.extend(whole);
        if parts.is_empty() {
            commands.push(name);
        }
    }
    commands
}

#[test]
fn the_pages_list_every_command() {
    let page = |name: &str| {
        let path = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join(name);
        std::fs::read_to_string(&path).unwrap_or_else(|error| panic!("{name}: {error}"))
    };
    let (table, first) = (page("README.md"), page("../README.md"));
    let changes = ["CHANGELOG.md", "../CHANGELOG.md"].map(|name| (name, page(name)));
    let all = commands();
    for command in ["demo", "reload", "trust list", "acl learn", "bench net"] {
        assert!(all.iter().any(|one| one == command), "{command}: {all:?}");
    }
    for command in all {
        assert!(table.contains(&format!("| `axon {command}")), "README.md: axon {command}");
        let words: Vec<&str> = command.split(' ').collect();
        let of_it = |text: &str| words.iter().all(|word| text.contains(word));
        assert!(first.lines().any(of_it), "../README.md: axon {command}");
        for (name, text) in &changes {
            assert!(text.split("\n- ").any(of_it), "{name}: axon {command}");
        }
    }
}

#[test]
fn no_line_is_wider_than_a_page() {
    let others: [&[&str]; 12] = [
        &[],
        &["demo"],
        &["play"],
        &["echo"],
        &["status"],
        &["trust"],
        &["acl"],
        &["reload"],
        &["daemon"],
        &["bench"],
        &["bench", "shm"],
        &["bench", "session"],
    ];
    let groups = TRUST.iter().chain(&ACL).map(|command| &command[..]);
    for command in others.into_iter().chain(groups) {
        for line in help(command).lines() {
            assert!(line.chars().count() <= 100, "{command:?}: {line}");
        }
    }
}
