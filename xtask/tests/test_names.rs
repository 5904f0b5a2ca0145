//! Names of tests name the actor: a publisher, a peer, a key. Words that leave the actor out stand in none.

mod support;

use std::fs;

use support::{rust_sources, workspace};

/// Words that stand for an actor or a thing without naming it.
const VAGUE: [&str; 9] =
    ["who", "whom", "whoever", "what", "whatever", "nobody", "somebody", "anybody", "everybody"];

/// Returns the names of the tests of a source: functions with an attribute whose path ends in `test`.
fn test_names(source: &str) -> Vec<&str> {
    let mut names = Vec::new();
    let mut is_test = false;
    for line in source.lines().map(str::trim) {
        if let Some(attribute) = line.strip_prefix("#[") {
            let path = attribute.split(['(', ']']).next().unwrap_or_default();
            is_test |= path.rsplit("::").next() == Some("test");
        } else if let Some(function) = line.strip_prefix("async fn ").or(line.strip_prefix("fn ")) {
            if std::mem::take(&mut is_test) {
                names.extend(function.split(['(', '<']).next());
            }
        } else if !line.starts_with("//") {
            is_test = false;
        }
    }
    names
}

fn is_vague(name: &str) -> bool {
    name.split('_').any(|word| VAGUE.contains(&word))
}

#[test]
fn no_test_name_leaves_the_actor_out() {
    let files = rust_sources(workspace(), &["target", "patched"]);
    let mut count = 0;
    let mut vague = Vec::new();
    for file in files {
        let source = fs::read_to_string(&file).expect("a source");
        let names = test_names(&source);
        count += names.len();
        let named = names.into_iter().filter(|name| is_vague(name));
        vague.extend(named.map(|name| format!("{}: {name}", file.display())));
    }
    assert!(count > 2_000, "only {count} tests were found");
    assert!(vague.is_empty(), "these tests do not name the actor:\n{}", vague.join("\n"));
}

#[test]
fn tests_are_found_by_their_attribute() {
    let source = "#[test]\nfn a_peer_is_heard() {}\n#[tokio::test(flavor = \"x\")]\n// Why.\n\
        async fn what_comes() {}\nfn what_helps() {}\n#[derive(Debug)]\nstruct S;\nfn who() {}\n";
    assert_eq!(test_names(source), ["a_peer_is_heard", "what_comes"]);
    assert!(is_vague("what_comes") && !is_vague("a_peer_is_heard") && !is_vague("somewhat_late"));
}
