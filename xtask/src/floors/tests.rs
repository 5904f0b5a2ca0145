//! Tests what is said of crates with wrong imports, crowded folders and circles.

use super::*;

const PAGE: &str = "\
Text.

<!-- floors: src -->

| rooms | what |
| --- | --- |
| `roof` | highest |
| `left`, `right` | beside each other |
| `ground` | lowest |

More text with `roof`.
";

/// A crate with these files, and what is wrong with it.
fn wrong(files: &[(&str, &str)]) -> String {
    let dir = tempfile::tempdir().expect("a directory");
    let put = |name: &str, text: &str| {
        let path = dir.path().join(name);
        fs::create_dir_all(path.parent().expect("a folder")).expect("a folder");
        fs::write(path, text).expect("a file");
    };
    put("docs/architecture.md", PAGE);
    for room in ["roof", "left", "right", "ground"] {
        put(&format!("src/{room}.rs"), "");
    }
    put("src/lib.rs", "mod roof; mod left; mod right; mod ground; pub use roof::Top;");
    for (name, text) in files {
        put(&format!("src/{name}"), text);
    }
    check(dir.path()).err().unwrap_or_default()
}

#[test]
fn imports_from_below_are_allowed() {
    let text = "use crate::{ground::{Stone, Sand as S}, left::*}; fn f() { crate::right::f() }";
    assert_eq!(wrong(&[("roof.rs", text)]), "");
}

#[test]
fn imports_from_above_beside_and_the_root_are_named() {
    let cases = [
        ("left.rs", "use crate::roof::Top;", "`left` imports crate::roof::Top from above it"),
        ("left.rs", "use crate::right::Hand;", "`left` imports crate::right::Hand from beside it"),
        ("left.rs", "use crate::Top;", "`left` imports crate::Top from the root"),
        ("left.rs", "use super::roof::Top;", "crate::roof::Top from above"),
        ("left/inner.rs", "use super::super::roof::Top;", "crate::roof::Top from above"),
        ("left.rs", "mod inner { use super::super::roof::Top; }", "crate::roof::Top from above"),
        ("left.rs", "fn f() -> crate::roof::Top { loop {} }", "crate::roof::Top from above"),
        ("ground.rs", "fn f() { print!(\"{}\", crate::left::f(1)) }", "crate::left::f from above"),
        ("ground.rs", "impl crate::left::Hand for () {}", "crate::left::Hand from above"),
    ];
    for (file, text, said) in cases {
        let found = wrong(&[(file, text)]);
        assert!(found.contains(said) && found.contains(file), "{text}: {found}");
    }
}

#[test]
fn own_files_and_tests_may_import_any_module() {
    let text = "mod inner; use inner::A; use self::inner::B;
            #[cfg(test)] mod tests;
            #[cfg(test)] mod checks { use crate::roof::Top; }
            #[cfg(test)] use crate::roof::Top;
            pub(in crate::left) fn f() {}
            made! { pub(crate) fn g() {} }";
    let inner = "use super::C; use crate::left::D;";
    let files = [
        ("left.rs", text),
        ("left/inner.rs", inner),
        ("left/tests/all.rs", "use crate::roof::Top;"),
    ];
    assert_eq!(wrong(&files), "");
}

#[test]
fn a_folder_with_too_many_files_is_named() {
    let names: Vec<String> = (0..=MOST_FILES).map(|n| format!("left/part{n}.rs")).collect();
    let mut files: Vec<(&str, &str)> = names.iter().map(|name| (name.as_str(), "")).collect();
    assert!(wrong(&files).contains("left: 16 files, more than one room"), "{}", wrong(&files));
    files.pop();
    assert_eq!(wrong(&files), "");
}

#[test]
fn re_exports_of_other_crates_are_no_rooms() {
    let root = "mod roof; mod left; mod right; mod ground; pub use other as named;
            pub use other::{ids, deep::Stone as Rock}; pub use roof::Top;";
    let text = "use crate::{ids::Gid, Rock, named::f};";
    assert_eq!(wrong(&[("lib.rs", root), ("ground.rs", text)]), "");
    assert!(wrong(&[("lib.rs", root), ("ground.rs", "use crate::Top;")]).contains("from the root"));
}

#[test]
fn a_folder_may_be_called_crowded_as_long_as_it_is() {
    let page = PAGE.replace("src -->", "src; crowded: left -->");
    let names: Vec<String> = (0..=MOST_FILES).map(|n| format!("left/part{n}.rs")).collect();
    let mut files: Vec<(&str, &str)> = names.iter().map(|name| (name.as_str(), "")).collect();
    files.push(("../docs/architecture.md", &page));
    assert_eq!(wrong(&files), "");
    files.remove(0);
    assert!(wrong(&files).contains("left: docs/architecture.md calls it crowded"));
}

#[test]
fn a_room_without_a_floor_is_named() {
    let found = wrong(&[("attic.rs", "use crate::roof::Top;")]);
    assert!(found.contains("`attic` is on no floor"), "{found}");
    let found = wrong(&[("attic.rs", ""), ("roof.rs", "use crate::attic::Box;")]);
    assert!(found.contains("`attic` is on no floor"), "{found}");
}

/// The same page, with a table of the room `left`.
fn page_with_large_room() -> String {
    format!(
        "{PAGE}\n<!-- floors: src/left -->\n\n| rooms | what |\n| --- | --- |\n| `upper` | |\n| `lower.rs` | |\n"
    )
}

#[test]
fn imports_inside_a_large_room_run_down_by_its_own_table() {
    let page = page_with_large_room();
    let good = [
        ("../docs/architecture.md", page.as_str()),
        ("left/mod.rs", "mod upper; mod lower; pub use upper::Top;"),
        ("left/upper/mod.rs", "use crate::{ground::Stone, left::{Top, lower::Deep}};"),
        ("left/lower.rs", "use crate::ground::Stone;"),
        ("roof.rs", "use crate::left::Top;"),
    ];
    assert_eq!(wrong(&good), "");
    let cases = [
        ("use crate::left::upper::Top;", "`lower` imports crate::left::upper::Top from above it"),
        ("use super::upper::Top;", "`lower` imports crate::left::upper::Top from above it"),
        ("use super::Top;", "`lower` imports crate::left::Top from the root"),
        ("use crate::roof::Top;", "`left` imports crate::roof::Top from above it"),
    ];
    for (text, said) in cases {
        let mut files = good;
        files[3].1 = text;
        let found = wrong(&files);
        assert!(found.contains(said) && found.contains("left/lower.rs"), "{text}: {found}");
    }
}

#[test]
fn a_folder_of_a_large_room_without_a_floor_is_named() {
    let page = page_with_large_room();
    let files = [
        ("../docs/architecture.md", page.as_str()),
        ("left/mod.rs", "mod upper; mod attic;"),
        ("left/upper.rs", ""),
        ("left/attic.rs", "use super::upper::Top;"),
    ];
    let found = wrong(&files);
    assert!(found.contains("src/left: `attic` is on no floor"), "{found}");
}
