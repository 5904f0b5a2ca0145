//! Imports between the rooms of this crate run down only, so that none of them is in a circle.

use std::{fs, path::Path};

/// Which floor each room is on. A room may import from lower floors, and from itself.
const FLOORS: [(&str, usize); 9] = [
    ("os", 0),
    ("memory", 1),
    ("ring", 2),
    ("alloc", 3),
    ("wake", 3),
    ("session", 4),
    ("writer", 5),
    ("reader", 5),
    ("direct", 6),
];
/// What is below all rooms, and imports from none.
const BOTTOM: [&str; 5] = ["error", "ids", "limits", "qos", "sync"];
/// More files than that are more than one room.
const MOST: usize = 15;

fn floor(room: &str) -> Option<usize> {
    FLOORS.iter().find(|(name, _)| *name == room).map(|(_, floor)| *floor)
}

/// A file's code without comments, and without its tests, which may import from anywhere.
fn code(file: &Path) -> String {
    let text = fs::read_to_string(file).expect("a source file");
    let code = text.split("#[cfg(test)]\nmod ").next().unwrap_or_default();
    let lines = code.lines().map(|line| line.split("//").next().unwrap_or_default());
    lines.collect::<Vec<_>>().join("\n")
}

/// The first names of the paths in `{a::b, c::{d, e}}`.
fn heads(list: &str) -> Vec<String> {
    let (mut depth, mut heads, mut item) = (0, Vec::new(), String::new());
    for c in list.chars() {
        match c {
            '{' => depth += 1,
            '}' => depth -= 1,
            ',' if depth == 1 => heads.push(std::mem::take(&mut item)),
            _ if depth > 0 => item.push(c),
            _ => {}
        }
        if depth == 0 {
            break;
        }
    }
    heads.push(item);
    heads.iter().map(|item| item.trim().split(':').next().unwrap_or_default().into()).collect()
}

/// What a file imports, by the first name of each path in the crate.
fn imports(code: &str) -> Vec<String> {
    let paths = code.split("crate::").skip(1);
    let of = |path: &str| {
        if path.starts_with('{') {
            return heads(path);
        }
        let end = path.find(|c: char| !c.is_alphanumeric() && c != '_').unwrap_or(path.len());
        vec![path[..end].to_owned()]
    };
    paths.flat_map(of).filter(|name| !name.is_empty()).collect()
}

/// The source files of a room, or of a file that is one by itself.
fn files(room: &str) -> Vec<std::path::PathBuf> {
    let source = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    let file = source.join(room).with_extension("rs");
    if file.exists() {
        return vec![file];
    }
    let entries = fs::read_dir(source.join(room)).expect(room);
    entries.map(|entry| entry.expect(room).path()).collect()
}

#[test]
fn each_room_imports_from_lower_floors_only() {
    for (room, own) in FLOORS {
        for file in files(room) {
            if file.file_stem() == Some("tests".as_ref()) {
                continue;
            }
            let code = code(&file);
            assert!(!code.contains("super::super"), "{}: by its full path, please", file.display());
            for name in imports(&code) {
                let lower = floor(&name).is_some_and(|floor| floor < own);
                let allowed = lower || name == room || BOTTOM.contains(&name.as_str());
                assert!(allowed, "{}: imports from {name}", file.display());
            }
        }
    }
}

#[test]
fn what_is_below_all_rooms_imports_from_none() {
    for name in BOTTOM {
        for file in files(name) {
            let imports = imports(&code(&file));
            let strange = imports.iter().find(|import| !BOTTOM.contains(&import.as_str()));
            assert_eq!(strange, None, "{}", file.display());
        }
    }
}

#[test]
fn no_room_has_more_files_than_one_can_look_over() {
    for (room, _) in FLOORS {
        let count = files(room).len();
        assert!((1..=MOST).contains(&count), "{room}: {count} files");
    }
}

#[test]
fn each_folder_is_a_room() {
    let source = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    for entry in fs::read_dir(source).expect("the sources").map(|entry| entry.expect("an entry")) {
        let name = entry.path().file_stem().expect("a name").to_string_lossy().into_owned();
        let known = floor(&name).is_some() || BOTTOM.contains(&name.as_str());
        assert!(known || ["lib", "tests"].contains(&name.as_str()), "{name} is on no floor");
    }
}

#[test]
fn imports_are_read_as_the_compiler_reads_them() {
    let code =
        "use crate::{\n    a::{b, c},\n    d::e,\n    f,\n};\nuse crate::g::h;\nlet i = crate::j;";
    assert_eq!(imports(code), ["a", "d", "f", "g", "j"]);
}
