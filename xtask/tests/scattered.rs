//! Structs whose methods are in several files: `docs/architecture.md` names each, and no other.

mod support;

use std::{
    collections::{BTreeMap, BTreeSet},
    fs,
};

use support::{rust_sources, workspace};

const CRATES: [&str; 3] =
    ["axon-transport/src", "axon-transport/daemon/src", "axon-transport/shm/src"];
/// Lines of methods from which on a struct has to be in the table.
const LINES: usize = 100;

/// The lines of each inherent `impl` of a file without its tests, by the name of the type. The sources are formatted:
/// an `impl` ends with the first line that is a brace alone.
fn impls(source: &str) -> Vec<(String, usize)> {
    let product = source.split("\nmod tests {").next().unwrap_or_default();
    let mut found = Vec::new();
    let mut lines = product.lines();
    while let Some(line) = lines.next() {
        let Some(rest) = line.strip_prefix("impl") else { continue };
        // Generic parameters, with bounds that may have brackets of their own.
        let rest = rest.trim_start();
        let rest = rest.strip_prefix('<').map_or(rest, |rest| {
            let mut depth = 1;
            let end = rest.find(|c| {
                depth += i32::from(c == '<') - i32::from(c == '>');
                depth == 0
            });
            end.map_or("", |end| rest[end + 1..].trim_start())
        });
        if rest.contains(" for ") || !rest.ends_with('{') {
            continue;
        }
        let name: String = rest.chars().take_while(|c| c.is_alphanumeric() || *c == '_').collect();
        let length = lines.by_ref().take_while(|line| *line != "}").count();
        found.push((name, length));
    }
    found
}

/// The structs of a crate with more than [`LINES`] of methods in several files.
fn scattered(of: &str) -> BTreeSet<String> {
    // Tests and the simulator are left out.
    let files = rust_sources(&workspace().join(of), &["tests", "tests.rs", "sim"]);
    let mut all: BTreeMap<String, Vec<usize>> = BTreeMap::new();
    for file in files {
        let source = fs::read_to_string(file).expect("a source");
        let mut here: BTreeMap<String, usize> = BTreeMap::new();
        for (name, lines) in impls(&source) {
            *here.entry(name).or_default() += lines;
        }
        for (name, lines) in here {
            all.entry(name).or_default().push(lines);
        }
    }
    all.retain(|_, files| files.len() > 1 && files.iter().sum::<usize>() > LINES);
    all.into_keys().collect()
}

/// The names in the first cells of the table.
fn named(page: &str) -> BTreeSet<String> {
    let (_, rest) = page.split_once("\n| struct | its parts |").expect("the table");
    let rows = rest.lines().skip(2).take_while(|line| line.starts_with('|'));
    let cells = rows.filter_map(|row| row.split('|').nth(1));
    // Behind the names stands the folder, in brackets.
    let names = cells.filter_map(|cell| cell.split('(').next());
    names.flat_map(|names| names.split('`').skip(1).step_by(2)).map(str::to_owned).collect()
}

#[test]
fn structs_with_methods_in_several_files_are_in_the_table_and_no_others() {
    let page = fs::read_to_string(workspace().join("docs/architecture.md")).expect("the page");
    let found: BTreeSet<String> = CRATES.iter().flat_map(|of| scattered(of)).collect();
    assert_eq!(found, named(&page));
}

#[test]
fn an_impl_of_a_trait_is_none_of_the_struct() {
    let source = "impl<T: Into<u8>> A<T> {\n    a\n    b\n}\n\nimpl Drop for A {\n    c\n}\nmod tests {\nimpl B {\n}\n}\n";
    assert_eq!(impls(source), [("A".to_owned(), 2)]);
    assert!(impls("struct A;\n").is_empty());
}
