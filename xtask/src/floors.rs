//! Keeps the arrows between the rooms of a crate: imports run down only.
//!
//! A room is a module at a crate's root. `docs/architecture.md` has a table for each crate whose rooms stand on
//! floors: one row a floor, the highest first. A room may import from the rooms below its own row, and from
//! its own files; not from above, not from a room beside it, and not from the crate's root, which is the top.
//! Tests may import what they like.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};

use proc_macro2::{TokenStream, TokenTree};
use syn::visit::{self, Visit};
use syn::{Attribute, Item, UsePath, UseRename, UseTree};

/// Stands before the table of a crate, with the folder of its sources, and after `; crowded:` the folders in it
/// that have too many files and are to be parted: a folder that no longer has too many may not stand there.
const MARK: &str = "<!-- floors: ";
const CROWDED: &str = "; crowded: ";
/// More files than that in a folder are more than one room.
const MOST_FILES: usize = 15;

/// Checks each crate that has a table; says how many imports were looked at.
///
/// # Errors
/// Each import that runs up, each room that no table has, and each folder with too many files.
pub(crate) fn check(root: &Path) -> Result<String, String> {
    let mut lines = Vec::new();
    let mut wrong = Vec::new();
    for House { folder, floors, crowded } in of_page(root)? {
        let mut sources = Vec::new();
        read(&root.join(&folder), &root.join(&folder), &mut sources)?;
        wrong.extend(judge_crowds(&root.join(&folder), &sources, &crowded));
        let imports = imports(sources);
        wrong.extend(judge(&folder, &floors, &imports));
        lines.push(format!(
            "{folder}: {} imports between {} rooms run down",
            imports.len(),
            floors.len()
        ));
    }
    if wrong.is_empty() { Ok(lines.join("\n")) } else { Err(wrong.join("\n")) }
}

/// The floor of each room, 0 the highest.
type Floors = BTreeMap<String, usize>;

/// What the page says of a crate.
pub(crate) struct House {
    /// Of its sources.
    pub(crate) folder: String,
    /// The rooms in the first column of the table.
    pub(crate) floors: Floors,
    /// Folders in it that may have too many files.
    crowded: BTreeSet<PathBuf>,
}

/// The crates of which the page has a table.
pub(crate) fn of_page(root: &Path) -> Result<Vec<House>, String> {
    let page = root.join("docs/architecture.md");
    let text = fs::read_to_string(&page).map_err(|e| format!("{}: {e}", page.display()))?;
    let houses = houses(&text)?;
    if houses.is_empty() {
        return Err(format!("{} has no table of floors", page.display()));
    }
    Ok(houses)
}

/// Which rooms of a crate import from which others.
pub(crate) fn arrows(root: &Path, house: &House) -> Result<BTreeSet<(String, String)>, String> {
    let folder = root.join(&house.folder);
    let mut sources = Vec::new();
    read(&folder, &folder, &mut sources)?;
    let imports = imports(sources).into_iter().filter(|import| !import.to.is_empty());
    Ok(imports.map(|import| (import.from, import.to)).collect())
}

fn houses(page: &str) -> Result<Vec<House>, String> {
    let mut found = Vec::new();
    for part in page.split(MARK).skip(1) {
        let (mark, rest) = part.split_once(" -->").ok_or("a mark of floors has no end")?;
        let (folder, crowded) = mark.split_once(CROWDED).unwrap_or((mark, ""));
        let crowded = crowded.split_whitespace().map(PathBuf::from).collect();
        let rows = rest
            .lines()
            .skip_while(|line| !line.starts_with('|'))
            .take_while(|l| l.starts_with('|'));
        let mut floors = Floors::new();
        // Without the heading and the line below it.
        for (floor, row) in rows.skip(2).enumerate() {
            let cell = row.split('|').nth(1).unwrap_or_default();
            for room in cell.split('`').skip(1).step_by(2) {
                if floors.insert(room.to_owned(), floor).is_some() {
                    return Err(format!("{folder}: `{room}` is on two floors"));
                }
            }
        }
        found.push(House { folder: folder.to_owned(), floors, crowded });
    }
    Ok(found)
}

/// An import of another room, or of the crate's root: then `to` is empty.
#[derive(Debug, PartialEq, Eq, PartialOrd, Ord)]
struct Import {
    from: String,
    file: PathBuf,
    to: String,
    what: String,
}

/// What is wrong with a crate's imports and its table.
fn judge(folder: &str, floors: &Floors, imports: &BTreeSet<Import>) -> Vec<String> {
    let mut wrong = Vec::new();
    let rooms: BTreeSet<&String> = imports.iter().map(|import| &import.from).collect();
    for room in rooms.iter().filter(|room| !floors.contains_key(**room)) {
        wrong.push(format!("{folder}: `{room}` is on no floor of docs/architecture.md"));
    }
    for import in imports {
        let Import { from, file, to, what } = import;
        let file = file.display();
        if to.is_empty() {
            wrong.push(format!("{file}: `{from}` imports {what} from the root, which is above it"));
            continue;
        }
        let (Some(own), Some(other)) = (floors.get(from), floors.get(to)) else {
            if !floors.contains_key(to) {
                wrong
                    .push(format!("{file}: {what}: `{to}` is on no floor of docs/architecture.md"));
            }
            continue;
        };
        if other < own {
            wrong.push(format!("{file}: `{from}` imports {what} from above it"));
        } else if other == own {
            wrong.push(format!("{file}: `{from}` imports {what} from beside it"));
        }
    }
    wrong
}

/// A file of a crate, with the path of its module.
struct Source {
    path: PathBuf,
    module: Vec<String>,
    file: syn::File,
}

/// The folders with more files than a newcomer can look over, and those that are said to have so many and
/// have not.
fn judge_crowds(root: &Path, sources: &[Source], crowded: &BTreeSet<PathBuf>) -> Vec<String> {
    let mut files: BTreeMap<&Path, usize> = BTreeMap::new();
    for folder in sources.iter().filter_map(|source| source.path.parent()) {
        *files.entry(folder).or_default() += 1;
    }
    files.retain(|_, count| *count > MOST_FILES);
    let is_said = |folder: &Path| crowded.iter().any(|of| root.join(of) == folder);
    let unsaid = files.iter().filter(|(folder, _)| !is_said(folder));
    let unsaid = unsaid
        .map(|(folder, count)| format!("{}: {count} files, more than one room", folder.display()));
    let empty = crowded.iter().map(|of| root.join(of)).filter(|of| !files.contains_key(&**of));
    let empty = empty.map(|of| format!("{}: docs/architecture.md calls it crowded", of.display()));
    unsaid.chain(empty).collect()
}

/// All imports between rooms, and from the root, of a crate.
fn imports(sources: Vec<Source>) -> BTreeSet<Import> {
    let rooms: BTreeSet<String> =
        sources.iter().filter_map(|s| s.module.first()).cloned().collect();
    let roots = sources.iter().filter(|source| source.module.is_empty());
    let foreign: BTreeSet<String> = roots.flat_map(|root| root.of_other_crates(&rooms)).collect();
    let tests: Vec<Vec<String>> = sources.iter().flat_map(Source::test_modules).collect();
    let mut found = BTreeSet::new();
    for Source { path, module, file } in sources {
        let Some(from) = module.first().cloned() else { continue };
        if tests.iter().any(|test| module.starts_with(test)) {
            continue;
        }
        let mut paths = Paths { module, found: Vec::new() };
        paths.visit_file(&file);
        for what in paths.found {
            if what.first().is_some_and(|first| foreign.contains(first)) {
                continue;
            }
            let to =
                what.first().filter(|first| rooms.contains(*first)).cloned().unwrap_or_default();
            if to != from {
                let what = format!("crate::{}", what.join("::"));
                found.insert(Import { from: from.clone(), file: path.clone(), to, what });
            }
        }
    }
    found
}

/// The names that a `use` brings.
fn names_of(tree: &UseTree, names: &mut Vec<String>) {
    match tree {
        UseTree::Path(path) => names_of(&path.tree, names),
        UseTree::Group(group) => group.items.iter().for_each(|tree| names_of(tree, names)),
        UseTree::Name(name) => names.push(name.ident.to_string()),
        UseTree::Rename(name) => names.push(name.rename.to_string()),
        UseTree::Glob(_) => {}
    }
}

/// Reads the files below `dir`, but for programs in `bin`.
fn read(folder: &Path, dir: &Path, sources: &mut Vec<Source>) -> Result<(), String> {
    let entries = fs::read_dir(dir).map_err(|e| format!("{}: {e}", dir.display()))?;
    for entry in entries {
        let path = entry.map_err(|e| format!("{}: {e}", dir.display()))?.path();
        let inside = path.strip_prefix(folder).expect("below it");
        if path.is_dir() {
            if inside != Path::new("bin") {
                read(folder, &path, sources)?;
            }
        } else if path.extension().is_some_and(|extension| extension == "rs") {
            let text = fs::read_to_string(&path).map_err(|e| format!("{}: {e}", path.display()))?;
            let file = syn::parse_file(&text).map_err(|e| format!("{}: {e}", path.display()))?;
            sources.push(Source { module: module_of(inside), file, path });
        }
    }
    Ok(())
}

impl Source {
    /// The names that this root hands out of other crates.
    fn of_other_crates(&self, rooms: &BTreeSet<String>) -> Vec<String> {
        let mut names = Vec::new();
        for item in &self.file.items {
            let Item::Use(item) = item else { continue };
            let (UseTree::Path(UsePath { ident, .. }) | UseTree::Rename(UseRename { ident, .. })) =
                &item.tree
            else {
                continue;
            };
            let first = ident.to_string();
            if !rooms.contains(&first) && !["crate", "self", "super"].contains(&&*first) {
                names_of(&item.tree, &mut names);
            }
        }
        names
    }

    /// The modules in files of their own that this one has for tests only.
    fn test_modules(&self) -> Vec<Vec<String>> {
        let is_test_file = |item: &Item| match item {
            Item::Mod(item) if item.content.is_none() && is_test(&item.attrs) => {
                Some(item.ident.to_string())
            }
            _ => None,
        };
        let names = self.file.items.iter().filter_map(is_test_file);
        names.map(|name| [&self.module[..], &[name]].concat()).collect()
    }
}

/// The path of the module in this file, from the crate's root, whose own is empty.
fn module_of(inside: &Path) -> Vec<String> {
    let mut module: Vec<String> =
        inside.with_extension("").iter().map(|part| part.to_string_lossy().into_owned()).collect();
    if module.last().is_some_and(|last| last == "mod") || module == ["lib"] || module == ["main"] {
        module.pop();
    }
    module
}

/// Collects the paths of a file that begin with `crate` or `super`, as paths from the root.
struct Paths {
    module: Vec<String>,
    found: Vec<Vec<String>>,
}

impl Paths {
    /// Notes a path by its parts, if it leaves this module.
    fn note(&mut self, parts: &[String]) {
        match parts.first().map(String::as_str) {
            // Alone it is that of `pub(crate)`, in a macro.
            Some("crate") if parts.len() > 1 => self.found.push(parts[1..].to_vec()),
            Some("super") => {
                let ups = parts.iter().take_while(|part| *part == "super").count();
                let above = &self.module[..self.module.len().saturating_sub(ups)];
                self.found.push(above.iter().chain(&parts[ups..]).cloned().collect());
            }
            _ => {}
        }
    }

    fn note_use(&mut self, before: &mut Vec<String>, tree: &UseTree) {
        match tree {
            UseTree::Path(path) => {
                before.push(path.ident.to_string());
                self.note_use(before, &path.tree);
                before.pop();
            }
            UseTree::Group(group) => {
                group.items.iter().for_each(|tree| self.note_use(before, tree))
            }
            UseTree::Name(name) => self.note(&[&before[..], &[name.ident.to_string()]].concat()),
            UseTree::Rename(name) => self.note(&[&before[..], &[name.ident.to_string()]].concat()),
            UseTree::Glob(_) => self.note(&[&before[..], &["*".to_owned()]].concat()),
        }
    }

    /// A macro's tokens are no syntax tree: `crate::` is looked for among them.
    fn note_tokens(&mut self, tokens: TokenStream) {
        let mut parts: Vec<String> = Vec::new();
        let mut colons = 0;
        for token in tokens {
            match token {
                TokenTree::Ident(ident) => {
                    if colons != 2 {
                        self.note(&std::mem::take(&mut parts));
                    }
                    parts.push(ident.to_string());
                    colons = 0;
                }
                TokenTree::Punct(punct) if punct.as_char() == ':' => colons += 1,
                other => {
                    self.note(&std::mem::take(&mut parts));
                    colons = 0;
                    if let TokenTree::Group(group) = other {
                        self.note_tokens(group.stream());
                    }
                }
            }
        }
        self.note(&parts);
    }
}

/// Whether this item is compiled for tests only.
fn is_test(attributes: &[Attribute]) -> bool {
    attributes.iter().any(|attribute| {
        attribute.path().is_ident("cfg")
            && attribute.parse_args::<syn::Path>().is_ok_and(|path| path.is_ident("test"))
    })
}

impl<'ast> Visit<'ast> for Paths {
    fn visit_item(&mut self, item: &'ast Item) {
        let attributes = match item {
            Item::Mod(item) => &item.attrs,
            Item::Use(item) => &item.attrs,
            Item::Fn(item) => &item.attrs,
            Item::Impl(item) => &item.attrs,
            _ => return visit::visit_item(self, item),
        };
        if is_test(attributes) {
            return;
        }
        match item {
            Item::Use(item) => self.note_use(&mut Vec::new(), &item.tree),
            Item::Mod(inner) => {
                self.module.push(inner.ident.to_string());
                visit::visit_item(self, item);
                self.module.pop();
            }
            _ => visit::visit_item(self, item),
        }
    }

    fn visit_path(&mut self, path: &'ast syn::Path) {
        let parts: Vec<String> = path.segments.iter().map(|part| part.ident.to_string()).collect();
        self.note(&parts);
        visit::visit_path(self, path);
    }

    fn visit_vis_restricted(&mut self, _: &'ast syn::VisRestricted) {
        // `pub(in crate::room)` imports nothing.
    }

    fn visit_macro(&mut self, found: &'ast syn::Macro) {
        self.note_tokens(found.tokens.clone());
        visit::visit_macro(self, found);
    }
}

#[cfg(test)]
mod tests {
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
            (
                "left.rs",
                "use crate::right::Hand;",
                "`left` imports crate::right::Hand from beside it",
            ),
            ("left.rs", "use crate::Top;", "`left` imports crate::Top from the root"),
            ("left.rs", "use super::roof::Top;", "crate::roof::Top from above"),
            ("left/inner.rs", "use super::super::roof::Top;", "crate::roof::Top from above"),
            (
                "left.rs",
                "mod inner { use super::super::roof::Top; }",
                "crate::roof::Top from above",
            ),
            ("left.rs", "fn f() -> crate::roof::Top { loop {} }", "crate::roof::Top from above"),
            (
                "ground.rs",
                "fn f() { print!(\"{}\", crate::left::f(1)) }",
                "crate::left::f from above",
            ),
            ("ground.rs", "impl crate::left::Hand for () {}", "crate::left::Hand from above"),
        ];
        for (file, text, said) in cases {
            let found = wrong(&[(file, text)]);
            assert!(found.contains(said) && found.contains(file), "{text}: {found}");
        }
    }

    #[test]
    fn own_files_and_tests_may_import_what_they_like() {
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
        assert!(
            wrong(&[("lib.rs", root), ("ground.rs", "use crate::Top;")]).contains("from the root")
        );
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
}
