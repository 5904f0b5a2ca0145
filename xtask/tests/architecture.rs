//! The table "Where to begin" of `docs/architecture.md` names files that exist.

mod support;

use std::fs;

use support::workspace;

const HEADING: &str = "\n## Where to begin\n";

/// The rows of the table, each with the paths that it names.
///
/// # Errors
/// The page has no such section, or the section no table.
fn rows(page: &str) -> Result<Vec<(&str, Vec<&str>)>, &'static str> {
    let (_, rest) = page.split_once(HEADING).ok_or("no section \"Where to begin\"")?;
    let section = rest.split_once("\n## ").map_or(rest, |(section, _)| section);
    let lines = section.lines().filter(|line| line.starts_with('|'));
    // Without the heading and the line below it.
    let rows: Vec<_> = lines.skip(2).map(row).collect();
    if rows.is_empty() { Err("no row below \"Where to begin\"") } else { Ok(rows) }
}

/// The task of a row, and what its other cells have in backquotes.
fn row(line: &str) -> (&str, Vec<&str>) {
    let mut cells = line.trim_matches('|').split('|');
    let task = cells.next().unwrap_or_default().trim();
    (task, cells.flat_map(|cell| cell.split('`').skip(1).step_by(2)).collect())
}

#[test]
fn each_path_of_where_to_begin_exists() {
    let page = fs::read_to_string(workspace().join("docs/architecture.md")).expect("the page");
    let rows = rows(&page).expect("the table");
    for (task, paths) in &rows {
        assert!(!paths.is_empty(), "{task}: names no path");
        for path in paths {
            assert!(workspace().join(path).exists(), "{task}: {path} does not exist");
        }
    }
    assert!(rows.len() >= 10, "{} tasks", rows.len());
}

#[test]
fn a_page_without_the_table_is_an_error() {
    assert!(rows("# Page\n\n## Processes\n").is_err());
    assert!(rows("# Page\n\n## Where to begin\n\n## Processes\n\n| a | b |\n").is_err());
    let empty = "# Page\n\n## Where to begin\n\n| task | file |\n| --- | --- |\n";
    assert!(rows(empty).is_err());
    let one = format!("{empty}| read `this` | `a/b.rs`, `c` |\n\n## Processes\n");
    assert_eq!(rows(&one), Ok(vec![("read `this`", vec!["a/b.rs", "c"])]));
}
