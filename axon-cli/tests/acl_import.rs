//! `axon acl import` as a user runs it, on the document of the page and on files that are none.

#![forbid(unsafe_code)]

mod common;

use std::{fs, path::Path, process::Output};

use common::axon;

const PAGE: &str = include_str!("../../docs/access-control.md");

fn run(arguments: &[&str]) -> Output {
    axon([]).args(arguments).output().expect("runs")
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8(bytes.to_vec()).expect("text")
}

fn written(dir: &Path, name: &str, bytes: impl AsRef<[u8]>) -> String {
    let path = dir.join(name);
    fs::write(&path, bytes).expect("writable");
    path.to_str().expect("UTF-8").to_owned()
}

/// Returns the first block of a language behind a heading of the page.
fn block(language: &str) -> &'static str {
    let section = PAGE.split("## From SROS2's permissions").nth(1).expect("the section");
    let rest = section.split(&format!("```{language}\n")).nth(1).expect("a block");
    rest.split("```").next().expect("its end")
}

#[test]
fn the_page_s_document_becomes_the_page_s_rules_and_they_can_be_used() {
    let dir = tempfile::tempdir().expect("directory");
    let file = written(dir.path(), "permissions.xml", block("xml"));
    let output = run(&["acl", "import", &file, "--peer", "base"]);
    let (out, said) = (text(&output.stdout), text(&output.stderr));
    assert!(output.status.success(), "{said}");
    assert!(out.ends_with(&format!("\n\n{}", block("toml"))), "{out}");
    for part in [
        "allows more: line 4: \"CN=/station/driver\" is an enclave's identity",
        "allows more: line 5: valid from 2026-01-01T00:00:00 to 2036-01-01T00:00:00",
        "allows more: line 14: for domains 0",
        "allows less: line 10: for domains 0",
        "signature (permissions.p7s) was not verified",
    ] {
        assert!(said.contains(part), "{part}: {said}");
        assert!(out.contains(part), "it is a comment as well: {part}: {out}");
    }
    let rules = written(dir.path(), "access.toml", &out);
    for (what, name, status) in [
        ("--publish", "/robot/cmd_vel", 0),
        ("--publish", "/robot/brake", 1),
        ("--publish", "/robot", 1),
        ("--call", "/robot/set_mode", 0),
        ("--subscribe", "/odom", 1),
    ] {
        let output = run(&["acl", "check", &rules, "--peer", "base", what, name]);
        assert_eq!(output.status.code(), Some(status), "{what} {name}: {}", text(&output.stdout));
    }
}

#[test]
fn a_file_or_a_name_that_cannot_be_used_writes_no_rules() {
    let dir = tempfile::tempdir().expect("directory");
    let good = written(dir.path(), "permissions.xml", block("xml"));
    let large = written(dir.path(), "large.xml", vec![b' '; 10 << 20]);
    let binary = written(dir.path(), "binary.xml", [0xff, 0xfe, 0x00]);
    let other = written(dir.path(), "other.xml", "<html/>");
    let missing = dir.path().join("missing.xml").display().to_string();
    for (file, peer, status, why) in [
        (&large, "base", 1, "larger than 1048576 bytes"),
        (&binary, "base", 1, "not UTF-8"),
        (&other, "base", 1, "its first element is <html>"),
        (&missing, "base", 1, "No such file"),
        (&good, "uid:x", 2, "peer \"uid:x\""),
        (&good, "", 2, "--peer"),
        (&good, " base", 2, "--peer"),
    ] {
        let output = run(&["acl", "import", file, "--peer", peer]);
        let said = text(&output.stderr);
        let expected = (Some(status), "");
        assert_eq!((output.status.code(), &*text(&output.stdout)), expected, "{peer}: {said}");
        assert!(said.contains(why), "{why}: {said}");
    }
    let output = run(&["acl", "import", &good, "--peer", "base", "--enclave", "/other"]);
    assert_eq!(output.status.code(), Some(1));
    assert!(text(&output.stderr).contains("it has \"/station/driver\""));
}

#[test]
fn help_shows_examples_on_lines_of_a_page() {
    let help = text(&run(&["acl", "import", "--help"]).stdout);
    assert!(help.contains("Examples:") && help.contains("Exit status:"), "{help}");
    assert!(help.lines().all(|line| line.chars().count() <= 100), "{help}");
}
