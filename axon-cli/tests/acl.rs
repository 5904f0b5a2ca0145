//! `axon acl` and `axon reload` as a user runs them, and the page that describes them as it is typed.

#![forbid(unsafe_code)]

mod common;

use std::{fs, path::Path, process::Output};

use common::axon;

const PAGE: &str = include_str!("../../docs/access-control.md");

fn run(arguments: &[&str], settings: &[(&str, &str)]) -> Output {
    axon(settings.iter().copied()).args(arguments).output().expect("runs")
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8(bytes.to_vec()).expect("text")
}

fn written(dir: &Path, name: &str, rules: &str) -> String {
    let path = dir.join(name);
    fs::write(&path, rules).expect("writable");
    path.to_str().expect("UTF-8").to_owned()
}

/// Returns the blocks of a language in the page.
fn blocks<'a>(page: &'a str, language: &str) -> Vec<&'a str> {
    let begin = format!("```{language}\n");
    page.split(&begin).skip(1).filter_map(|rest| rest.split("```").next()).collect()
}

#[test]
fn the_page_s_rules_meet_its_expectations_and_its_commands_run_as_typed() {
    let dir = tempfile::tempdir().expect("directory");
    let rules = blocks(PAGE, "toml");
    assert!(!rules.is_empty());
    let file = written(dir.path(), "access.toml", rules[0]);
    let mut ran = 0;
    for line in blocks(PAGE, "sh").iter().flat_map(|block| block.lines()) {
        let Some(arguments) = line.strip_prefix("axon ") else { continue };
        let line = arguments.replace("/etc/axon/access.toml", &file);
        let output = run(&line.split(' ').collect::<Vec<_>>(), &[]);
        assert!(output.status.success(), "axon {line}: {}", text(&output.stderr));
        ran += 1;
    }
    assert_eq!(ran, 2, "the page has other commands than this test knows");
    let said = run(&["acl", "test", &file], &[]);
    assert_eq!(text(&said.stdout), "3 expectations, all met\n");
    let mut tested = 0;
    for rules in rules.iter().filter(|rules| rules.contains("[[expect]]")) {
        let file = written(dir.path(), "access.toml", rules);
        let said = run(&["acl", "test", &file], &[]);
        let met = format!("{} expectations, all met\n", rules.matches("[[expect]]").count());
        assert_eq!(text(&said.stdout), met, "{rules}{}", text(&said.stderr));
        tested += 1;
    }
    assert_eq!(tested, 4, "a whole file of the page is tried");
}

#[test]
fn check_names_the_limits_of_the_page_that_count() {
    let dir = tempfile::tempdir().expect("directory");
    let limits = blocks(PAGE, "toml").into_iter().find(|rules| rules.contains("[[limit]]"));
    let file = written(dir.path(), "access.toml", limits.expect("limits"));
    let shown = blocks(PAGE, "text").into_iter().find(|text| text.starts_with("limited: "));
    let check = |arguments: &[&str]| {
        let output = run(&[&["acl", "check", &*file, "--peer"], arguments].concat(), &[]);
        assert!(output.status.success(), "{}", text(&output.stderr));
        text(&output.stdout)
    };
    let base = check(&["base", "--subscribe", "/camera/left"]);
    assert!(base.contains(shown.expect("an example")), "{base}");
    assert!(
        base.ends_with(
            "limited: all packets to it: line 12 of access.toml: 2.5 MB/s\n\
             limited: all packets by wlan*: line 16 of access.toml: 3.75 MB/s\n"
        ),
        "{base}"
    );
    let guest = check(&["guest", "--publish", "/scan"]);
    let said =
        "limited: publish /scan: line 8 of access.toml: 500 kB/s, drop-oldest, all topics together";
    assert!(guest.contains(said), "{guest}");
    assert!(!check(&["base", "--publish", "/scan"]).contains("limited: publish"));
}

#[test]
fn check_says_which_line_decides_and_its_status_says_whether_it_may() {
    let dir = tempfile::tempdir().expect("directory");
    let rules = "[[allow]]\npeer = \"base\"\npublish = \"/cmd_vel\"\nact = \"/dock\"\n";
    let file = written(dir.path(), "access.toml", rules);
    for (arguments, status, said) in [
        (["--peer", "base", "--publish", "/cmd_vel"], 0, "allowed by line 3 of access.toml"),
        (
            ["--peer", "base", "--publish", "/scan"],
            1,
            "denied: no [[allow]] in access.toml permits this",
        ),
        (["--peer", "base", "--act", "/dock"], 0, "allowed by line 4 of access.toml"),
        (["--peer", "arm", "--call", "/reboot"], 0, "no rule in access.toml denies this"),
        (["--peer", "uid:x", "--see", "/n"], 2, "uid: and a number"),
        (["--peer", "local", "--see", "/n"], 2, "uid: and a number, for a user"),
    ] {
        let all: Vec<_> = ["acl", "check", &file].into_iter().chain(arguments).collect();
        let output = run(&all, &[]);
        let out = text(&output.stdout) + &text(&output.stderr);
        assert_eq!(output.status.code(), Some(status), "{arguments:?} {out}");
        assert!(out.contains(said), "{arguments:?} {out}");
    }
    let action = run(&["acl", "check", &file, "--peer", "base", "--act", "/dock"], &[]);
    assert_eq!(text(&action.stdout).matches("/dock/_action/").count(), 5);
    // Both, or neither, is no question.
    let twice = ["acl", "check", &file, "--peer", "a", "--call", "/a", "--see", "/a"];
    assert_eq!(run(&twice, &[]).status.code(), Some(2));
    assert_eq!(run(&["acl", "check", &file, "--peer", "a"], &[]).status.code(), Some(2));
}

#[test]
fn check_says_that_a_denial_of_see_takes_the_uses_that_no_allow_names() {
    let dir = tempfile::tempdir().expect("directory");
    let rules = "[[deny]]\npeer = [\"base\", \"guest\"]\nsee = \"/scan\"\n\
                 [[allow]]\npeer = \"base\"\nsubscribe = \"/scan\"\n";
    let file = written(dir.path(), "access.toml", rules);
    for (peer, what, status, said) in [
        ("base", "--subscribe", 0, "allowed by line 6 of access.toml"),
        ("base", "--see", 1, "denied by line 3 of access.toml"),
        ("base", "--publish", 1, "no [[allow]] in access.toml permits this"),
        ("guest", "--subscribe", 1, "denied by line 3 of access.toml"),
        ("guest", "--call", 1, "denied by line 3 of access.toml"),
        ("other", "--subscribe", 0, "no rule in access.toml denies this"),
    ] {
        let output = run(&["acl", "check", &file, "--peer", peer, what, "/scan"], &[]);
        let out = text(&output.stdout) + &text(&output.stderr);
        assert_eq!(output.status.code(), Some(status), "{peer} {what} {out}");
        assert!(out.contains(said), "{peer} {what} {out}");
    }
}

#[test]
fn check_takes_the_rules_that_the_settings_name_and_rules_beside_other_settings() {
    let dir = tempfile::tempdir().expect("directory");
    let rules = "quic_cipher = \"aes-256-gcm\"\n[[deny]]\npeer = \"*\"\ncall = \"/reboot\"\n";
    for name in ["axon.toml", "robot.toml"] {
        rules_among_settings(&dir, name, rules);
    }
    // A file of rules alone has no other key.
    let wrong = rules.replace("quic_cipher", "quic_cypher");
    let wrong = written(dir.path(), "wrong.toml", &wrong);
    let output = run(&["acl", "check", &wrong, "--peer", "uid:7", "--call", "/reboot"], &[]);
    assert_eq!(output.status.code(), Some(2));
    assert!(text(&output.stderr).contains("unknown key \"quic_cypher\""));
}

/// Tests the file as AXON_CONFIG names it, and as an argument.
fn rules_among_settings(dir: &tempfile::TempDir, name: &str, rules: &str) {
    let file = written(dir.path(), name, rules);
    let run_dir = dir.path().join("run");
    let settings =
        [("AXON_CONFIG", &*file), ("AXON_RUNTIME_DIR", run_dir.to_str().expect("UTF-8"))];
    let question = ["acl", "check", "--peer", "uid:7", "--call", "/reboot"];
    let output = run(&question, &settings);
    assert_eq!(output.status.code(), Some(1));
    let line = format!("denied by line 4 of {name}");
    assert!(text(&output.stdout).contains(&line), "{}", text(&output.stdout));
    for settings in [&[][..], &settings] {
        let named = ["acl", "check", &file, "--peer", "uid:7", "--call", "/reboot"];
        let output = run(&named, settings);
        let out = text(&output.stdout) + &text(&output.stderr);
        assert_eq!(output.status.code(), Some(1), "{out}");
        assert!(out.contains(&line), "{out}");
        let output = run(&["acl", "test", &file], settings);
        assert!(text(&output.stderr).contains("has no [[expect]]"), "{}", text(&output.stderr));
    }
}

#[test]
fn test_names_each_expectation_that_is_not_met() {
    let dir = tempfile::tempdir().expect("directory");
    let expect = |name: &str, allowed: bool| {
        format!("[[expect]]\npeer = \"guest\"\npublish = \"{name}\"\nallowed = {allowed}\n")
    };
    let rules = "[[deny]]\npeer = \"guest\"\npublish = \"/cmd_vel\"\n";
    let all = format!("{rules}{}{}", expect("/cmd_vel", true), expect("/other", true));
    let file = written(dir.path(), "access.toml", &all);
    let output = run(&["acl", "test", &file], &[]);
    let out = text(&output.stdout);
    assert_eq!(output.status.code(), Some(1), "{out}");
    assert!(out.contains("denied by line 3 of access.toml"), "{out}");
    assert!(out.contains("1 of 2 expectations not met") && !out.contains("/other"), "{out}");
    let none = written(dir.path(), "none.toml", rules);
    let output = run(&["acl", "test", &none], &[]);
    assert_eq!(output.status.code(), Some(1));
    assert!(text(&output.stderr).contains("has no [[expect]]"));
    let wrong = written(dir.path(), "wrong.toml", "[[allow]]\npeer = 7\n");
    let output = run(&["acl", "test", &wrong], &[]);
    assert_eq!(output.status.code(), Some(2));
    assert!(text(&output.stderr).contains("line 2, column 8 of wrong.toml"));
}

#[test]
fn reload_without_a_daemon_says_so_and_one_with_wrong_settings_keeps_its_own() {
    let dir = tempfile::tempdir().expect("directory");
    let file = written(dir.path(), "access.toml", "default = \"allow\"");
    let run_dir = dir.path().join("run");
    let settings = [
        ("AXON_ACCESS_FILE", &*file),
        ("AXON_RUNTIME_DIR", run_dir.to_str().expect("UTF-8")),
        ("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST"),
    ];
    let output = run(&["reload"], &settings);
    assert_eq!(output.status.code(), Some(1));
    assert!(text(&output.stderr).contains("no daemon"), "{}", text(&output.stderr));
    let mut daemon = axon(settings).arg("daemon").spawn().expect("runs");
    let stands = std::time::Instant::now();
    while !run(&["status"], &settings).status.success() {
        assert!(stands.elapsed().as_secs() < 60, "the daemon does not stand");
        std::thread::sleep(std::time::Duration::from_millis(50));
    }
    let said = |output: &Output| text(&output.stdout) + &text(&output.stderr);
    let output = run(&["reload"], &settings);
    assert_eq!(said(&output), "changed: nothing\n");
    fs::write(&file, "[[deny]]\npeer = \"*\"\ncall = \"/x\"\n").expect("writable");
    assert_eq!(said(&run(&["reload"], &settings)), "changed: access rules\n");
    fs::write(&file, "[[deny]]\npeer = \"*\"\ncall = \"x\"\n").expect("writable");
    let output = run(&["reload"], &settings);
    assert_eq!(output.status.code(), Some(2), "{}", said(&output));
    let line = said(&output);
    assert!(line.contains("nothing was changed") && line.contains("line 3, column 8"), "{line}");
    daemon.kill().expect("runs");
    daemon.wait().expect("ends");
}
