//! Excerpts of a long text (a log, or a compiler's output) for the message of a failed test: its end, and the first
//! warnings before that. The whole text is kept in a file.

use std::{fs, path::Path, thread};

/// Number of lines at the end that are shown.
const END: usize = 100;
/// Number of warnings and errors before these that are shown.
const WARNINGS: usize = 10;
/// Number of characters of a line that are shown.
const LINE: usize = 500;

/// Returns the excerpt of `text`, which is kept under `name`.
pub(crate) fn excerpt(name: &str, text: &str) -> String {
    let lines: Vec<&str> = text.lines().collect();
    let (before, end) = lines.split_at(lines.len().saturating_sub(END));
    let shown = |line: &&str| line.chars().take(LINE).collect::<String>();
    let end: Vec<_> = end.iter().map(shown).collect();
    if before.is_empty() && lines.iter().all(|line| line.chars().count() <= LINE) {
        return format!("--- {name}:\n{}", end.join("\n"));
    }
    let warns = |line: &&&str| {
        let words = ["WARN", "ERROR", "panicked"];
        line.starts_with("error") || words.iter().any(|word| line.contains(word))
    };
    let warnings: Vec<_> = before.iter().filter(warns).take(WARNINGS).map(shown).collect();
    let kept = match keep(name, text) {
        Ok(path) => format!("all {} lines are in {path}", lines.len()),
        Err(error) => format!("{} lines, which could not be kept: {error}", lines.len()),
    };
    let first = if warnings.is_empty() {
        String::new()
    } else {
        format!("the first warnings:\n{}\n", warnings.join("\n"))
    };
    format!("--- {name}: {kept}\n{first}the last {} lines:\n{}", end.len(), end.join("\n"))
}

/// Keeps a text under the running test's name. Replaces the text of an earlier run.
fn keep(name: &str, text: &str) -> std::io::Result<String> {
    let test = thread::current().name().unwrap_or("unnamed").replace("::", "-");
    let name = name.replace(|c: char| !c.is_alphanumeric(), "-");
    let path = Path::new(env!("CARGO_TARGET_TMPDIR")).join(format!("{test}-{name}.txt"));
    fs::write(&path, text)?;
    Ok(path.display().to_string())
}

#[test]
fn a_long_text_is_shown_in_part_and_kept_whole() {
    let mut text = String::from("first\nWARN this\n");
    for number in 0..5_000 {
        text += &format!("line {number} {}\n", "x".repeat(number));
    }
    let shown = excerpt("a log", &text);
    assert!(shown.lines().count() <= END + WARNINGS + 3);
    assert!(shown.lines().all(|line| line.chars().count() <= LINE));
    assert!(shown.contains("WARN this") && shown.contains("line 4999"), "{shown}");
    let path = shown.lines().next().unwrap().split_once(" are in ").unwrap().1;
    assert_eq!(fs::read_to_string(path).unwrap(), text);
    fs::remove_file(path).unwrap();
    assert_eq!(excerpt("short", "one\ntwo"), "--- short:\none\ntwo");
}
