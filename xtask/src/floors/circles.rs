//! Circles of files inside a room.
//!
//! A file imports another one if it names a path into it. A path through a module that hands a name on by `use` leads
//! to the file that the name comes from. Files that import each other in a circle have to be read together. That is
//! easy in a *small room* alone: a folder that has, with its subfolders, no more than [`MOST_FILES`] files without
//! tests and [`MOST_LINES`] lines. The smallest folder that holds a whole circle has to be one.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use syn::visit::Visit;
use syn::{Item, UseTree, Visibility};

use super::source::{Paths, Source, is_test};

/// Files of a small room, without tests.
pub(super) const MOST_FILES: usize = 15;
/// Their lines.
pub(super) const MOST_LINES: usize = 4000;

/// A circle that stays.
struct Allowed {
    /// One of its files.
    file: &'static str,
    /// How many files it has. One that shrinks is counted anew here, so that it does not grow again.
    files: usize,
    reason: &'static str,
}

const ALLOWED: &[Allowed] = &[];

/// Files each of which leads to each other one by imports.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct Circle {
    /// The smallest folder that holds all, from the sources' on.
    folder: PathBuf,
    /// From the sources' folder on.
    files: Vec<PathBuf>,
    /// Imports along one of the shortest circles.
    shortest: Vec<PathBuf>,
}

/// A path of modules from the crate's root.
type Module = Vec<String>;

/// What a module hands on: names, and the paths that they stand for.
type HandedOn = BTreeMap<Module, BTreeMap<String, Vec<String>>>;

/// What is wrong with the circles of a crate, and with what is allowed.
pub(super) fn judge(crate_folder: &str, circles: &[Circle]) -> Vec<String> {
    judge_by(ALLOWED, crate_folder, circles)
}

fn judge_by(allowed: &[Allowed], crate_folder: &str, circles: &[Circle]) -> Vec<String> {
    let is_of = |circle: &Circle, of: &Allowed| {
        circle.files.iter().any(|file| Path::new(crate_folder).join(file) == Path::new(of.file))
    };
    let shown = |files: &[PathBuf], between: &str| {
        let files: Vec<_> = files.iter().map(|file| file.display().to_string()).collect();
        files.join(between)
    };
    let mut wrong = Vec::new();
    for circle in circles {
        let count = circle.files.len();
        let most = allowed.iter().find(|of| is_of(circle, of)).map_or(0, |of| of.files);
        if count > most {
            let folder = Path::new(crate_folder).join(&circle.folder);
            let known = if most > 0 { format!(" ({most} are allowed)") } else { String::new() };
            wrong.push(format!(
                "{}: {count} files import each other in a circle{known}, and this is no small room: {}; all: {}",
                folder.display(),
                shown(&circle.shortest, " -> "),
                shown(&circle.files, ", "),
            ));
        }
    }
    for of in allowed.iter().filter(|of| Path::new(of.file).starts_with(crate_folder)) {
        let files = circles.iter().find(|circle| is_of(circle, of)).map_or(0, |c| c.files.len());
        if files < of.files {
            wrong.push(format!(
                "{}: a circle of {} files is allowed, since {}: it has {files}",
                of.file, of.files, of.reason
            ));
        }
    }
    wrong
}

/// The circles of a crate in folders that are no small rooms.
pub(super) fn find(root: &Path, sources: &[Source]) -> Vec<Circle> {
    let tests: Vec<Module> = sources.iter().flat_map(Source::test_modules).collect();
    let product: Vec<&Source> = sources
        .iter()
        // The root hands out the rooms, and no room may import from it.
        .filter(|source| !source.module.is_empty())
        .filter(|source| !tests.iter().any(|test| source.module.starts_with(test)))
        .collect();
    let files: BTreeMap<&[String], usize> =
        product.iter().enumerate().map(|(number, source)| (&source.module[..], number)).collect();
    let handed_on = handed_on(&product);
    let imports: Vec<BTreeSet<usize>> = product
        .iter()
        .enumerate()
        .map(|(number, source)| {
            let paths = paths_of(source).into_iter();
            let to = paths.filter_map(|path| target(&path, &files, &handed_on));
            to.filter(|to| *to != number).collect()
        })
        .collect();
    let inside = |number: usize| product[number].path.strip_prefix(root).expect("below it");
    let folders = (0..product.len()).filter_map(|n| Some(inside(n).parent()?.to_owned())).collect();
    let mut circles = Vec::new();
    for circle in strongly_connected(&imports) {
        let folder = common_folder(circle.iter().map(|number| inside(*number)), &folders);
        let room = product.iter().filter(|source| source.path.starts_with(root.join(&folder)));
        let (count, lines) = room.fold((0, 0), |(n, lines), s| (n + 1, lines + s.lines));
        if count <= MOST_FILES && lines <= MOST_LINES {
            continue;
        }
        let shortest = shortest(&circle, &imports);
        circles.push(Circle {
            folder,
            files: circle.iter().map(|number| inside(*number).to_owned()).collect(),
            shortest: shortest.into_iter().map(|number| inside(number).to_owned()).collect(),
        });
    }
    circles.sort_by(|a, b| a.files.cmp(&b.files));
    circles
}

/// The paths into the crate that a file names, without those that it only hands on.
fn paths_of(source: &Source) -> Vec<Vec<String>> {
    let children = children_of(&source.file.items);
    let mut paths = Vec::new();
    for item in &source.file.items {
        match item {
            Item::Use(item) if matches!(item.vis, Visibility::Inherited) => {
                if is_test(&item.attrs) {
                    continue;
                }
                let mut names = Vec::new();
                names_and_paths(&mut Vec::new(), &item.tree, &mut names);
                let absolute = names
                    .into_iter()
                    .filter_map(|(_, path)| absolute(&source.module, &children, &path));
                paths.extend(absolute);
            }
            Item::Use(_) => {}
            item => {
                let mut found = Paths { module: source.module.clone(), found: Vec::new() };
                found.visit_item(item);
                paths.extend(found.found);
            }
        }
    }
    paths
}

/// The modules that a file declares.
fn children_of(items: &[Item]) -> BTreeSet<String> {
    let names = items.iter().filter_map(|item| match item {
        Item::Mod(item) => Some(item.ident.to_string()),
        _ => None,
    });
    names.collect()
}

/// What modules hand on to who names it by their paths: their own imports, too, which their children see.
fn handed_on(sources: &[&Source]) -> HandedOn {
    let mut all = HandedOn::new();
    for source in sources {
        let children = children_of(&source.file.items);
        for item in &source.file.items {
            let Item::Use(item) = item else { continue };
            if is_test(&item.attrs) {
                continue;
            }
            let mut names = Vec::new();
            names_and_paths(&mut Vec::new(), &item.tree, &mut names);
            let names = names.into_iter().filter_map(|(name, path)| {
                Some((name, absolute(&source.module, &children, &path)?))
            });
            all.entry(source.module.clone()).or_default().extend(names);
        }
    }
    all
}

/// The names that a `use` brings, each with its path.
fn names_and_paths(
    before: &mut Vec<String>,
    tree: &UseTree,
    found: &mut Vec<(String, Vec<String>)>,
) {
    let path = |before: &[String], name: &str| [before, &[name.to_owned()]].concat();
    match tree {
        UseTree::Path(part) => {
            before.push(part.ident.to_string());
            names_and_paths(before, &part.tree, found);
            before.pop();
        }
        UseTree::Group(group) => {
            group.items.iter().for_each(|tree| names_and_paths(before, tree, found));
        }
        UseTree::Name(name) if name.ident == "self" => {
            let last = before.last().cloned().unwrap_or_default();
            found.push((last, before.clone()));
        }
        UseTree::Name(name) => {
            let name = name.ident.to_string();
            found.push((name.clone(), path(before, &name)));
        }
        UseTree::Rename(name) => {
            found.push((name.rename.to_string(), path(before, &name.ident.to_string())));
        }
        UseTree::Glob(_) => found.push(("*".to_owned(), path(before, "*"))),
    }
}

/// A path in a module as one from the crate's root; `None` if it leads to another crate.
fn absolute(
    module: &[String],
    children: &BTreeSet<String>,
    path: &[String],
) -> Option<Vec<String>> {
    let join = |above: &[String], rest: &[String]| Some([above, rest].concat());
    match path.first()?.as_str() {
        "crate" => Some(path[1..].to_vec()),
        "self" => join(module, &path[1..]),
        "super" => {
            let ups = path.iter().take_while(|part| *part == "super").count();
            join(&module[..module.len().saturating_sub(ups)], &path[ups..])
        }
        first if children.contains(first) => join(module, path),
        _ => None,
    }
}

/// The file to which a path leads.
fn target(
    path: &[String],
    files: &BTreeMap<&[String], usize>,
    handed_on: &HandedOn,
) -> Option<usize> {
    let mut path = path.to_vec();
    // A name is handed on a few times at most. In a circle of hands it leads nowhere.
    for _ in 0..16 {
        let depth = (0..=path.len()).rev().find(|depth| files.contains_key(&path[..*depth]))?;
        let next = path.get(depth).and_then(|name| handed_on.get(&path[..depth])?.get(name));
        match next {
            Some(next) => path = [&next[..], &path[depth + 1..]].concat(),
            None => return files.get(&path[..depth]).copied(),
        }
    }
    None
}

/// The smallest folder that holds some files. `part.rs` counts for the folder `part`, if there is one.
fn common_folder<'a>(
    files: impl Iterator<Item = &'a Path>,
    folders: &BTreeSet<PathBuf>,
) -> PathBuf {
    let folders = files.map(|file| {
        let own = file.with_extension("");
        if folders.contains(&own) { own } else { file.parent().unwrap_or(Path::new("")).to_owned() }
    });
    let common = |one: PathBuf, other: PathBuf| {
        one.iter().zip(other.iter()).take_while(|(a, b)| a == b).map(|(a, _)| a).collect()
    };
    folders.reduce(common).unwrap_or_default()
}

/// The sets of more than one node in which each leads to each other.
fn strongly_connected(edges: &[BTreeSet<usize>]) -> Vec<Vec<usize>> {
    let reached: Vec<BTreeSet<usize>> = (0..edges.len()).map(|from| reach(from, edges)).collect();
    let mut seen = BTreeSet::new();
    let mut found = Vec::new();
    for from in 0..edges.len() {
        if seen.contains(&from) || !reached[from].contains(&from) {
            continue;
        }
        let circle: Vec<usize> =
            reached[from].iter().copied().filter(|to| reached[*to].contains(&from)).collect();
        seen.extend(circle.iter().copied());
        found.push(circle);
    }
    found
}

/// The nodes to which one leads; itself only by a circle.
fn reach(from: usize, edges: &[BTreeSet<usize>]) -> BTreeSet<usize> {
    let mut reached = BTreeSet::new();
    let mut next: Vec<usize> = edges[from].iter().copied().collect();
    while let Some(node) = next.pop() {
        if reached.insert(node) {
            next.extend(&edges[node]);
        }
    }
    reached
}

/// One of the shortest ways round in a circle, with its first node at both ends.
fn shortest(circle: &[usize], edges: &[BTreeSet<usize>]) -> Vec<usize> {
    let ways = circle.iter().filter_map(|from| {
        let mut ways = std::collections::VecDeque::from([vec![*from]]);
        let mut seen = BTreeSet::new();
        while let Some(way) = ways.pop_front() {
            for to in &edges[*way.last().expect("it has a first")] {
                let longer = [&way[..], &[*to]].concat();
                if to == from {
                    return Some(longer);
                }
                if seen.insert(*to) {
                    ways.push_back(longer);
                }
            }
        }
        None
    });
    ways.min_by_key(Vec::len).unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;
    use crate::floors::source::read;

    /// The circles of a crate with these files, and as many empty ones in the folder `room` as make it a large room.
    fn circles(files: &[(&str, &str)]) -> Vec<Circle> {
        let dir = tempfile::tempdir().expect("a directory");
        let put = |name: &str, text: &str| {
            let path = dir.path().join(name);
            fs::create_dir_all(path.parent().expect("a folder")).expect("a folder");
            fs::write(path, text).expect("a file");
        };
        (0..MOST_FILES).for_each(|n| put(&format!("room/part{n}.rs"), ""));
        files.iter().for_each(|(name, text)| put(name, text));
        let mut sources = Vec::new();
        read(dir.path(), dir.path(), &mut sources).expect("it is read");
        find(dir.path(), &sources)
    }

    fn files(circles: &[Circle]) -> Vec<Vec<String>> {
        let names = |files: &[PathBuf]| {
            let mut names: Vec<_> = files.iter().map(|file| file.display().to_string()).collect();
            names.sort();
            names
        };
        circles.iter().map(|circle| names(&circle.files)).collect()
    }

    const ROOM: (&str, &str) = ("room/mod.rs", "mod a; mod b; pub use a::A;");

    #[test]
    fn files_that_import_each_other_are_a_circle() {
        let a = ("room/a.rs", "use super::b::B; pub struct A;");
        let both = vec![vec!["room/a.rs".to_owned(), "room/b.rs".to_owned()]];
        for text in [
            "use super::a::A;",
            "use crate::room::{a, c};",
            "fn f() { crate::room::a::f() }",
            "use crate::room::A;",
            "use super::A as Other;",
        ] {
            assert_eq!(files(&circles(&[ROOM, a, ("room/b.rs", text)])), both, "{text}");
        }
        assert_eq!(circles(&[ROOM, a, ("room/b.rs", "use crate::other::A;")]), []);
    }

    #[test]
    fn a_parent_and_a_child_that_use_each_other_are_a_circle() {
        let parent = ("room/mod.rs", "mod a; use self::a::A; pub struct Parent(A);");
        let found = circles(&[parent, ("room/a.rs", "use super::Parent; pub struct A;")]);
        assert_eq!(files(&found), [["room/a.rs", "room/mod.rs"]]);
        // Only to hand a name on is no use of it.
        let parent = ("room/mod.rs", "mod a; pub use self::a::A; pub struct Parent;");
        assert_eq!(circles(&[parent, ("room/a.rs", "use super::Parent; pub struct A;")]), []);
    }

    #[test]
    fn the_shortest_way_round_is_shown() {
        let found = circles(&[
            ("room/mod.rs", "mod a; mod b; mod c;"),
            ("room/a.rs", "use super::{b::B, c::C};"),
            ("room/b.rs", "use super::c::C;"),
            ("room/c.rs", "use super::a::A;"),
        ]);
        assert_eq!(found[0].files.len(), 3);
        assert_eq!(found[0].shortest.len(), 3, "two, and the first again: {found:?}");
    }

    #[test]
    fn a_small_room_and_tests_may_have_circles() {
        let [a, b] = ["use super::b::B;", "use super::a::A;"];
        let small = [("small/mod.rs", "mod a; mod b;"), ("small/a.rs", a), ("small/b.rs", b)];
        assert_eq!(circles(&small), []);
        let long = "//\n".repeat(MOST_LINES);
        let long = [small[0], small[1], small[2], ("small/long.rs", &long)];
        assert_eq!(circles(&long)[0].folder, Path::new("small"));
        let tests = ("room/mod.rs", "mod a; #[cfg(test)] mod b;");
        assert_eq!(circles(&[tests, ("room/a.rs", a), ("room/b.rs", b)]), []);
        let tests =
            "#[cfg(test)] use super::b::B; #[cfg(test)] mod tests { use crate::room::b::B; }";
        assert_eq!(circles(&[ROOM, ("room/a.rs", tests), ("room/b.rs", b)]), []);
    }

    #[test]
    fn a_file_with_a_folder_of_its_name_is_in_that() {
        let files = [
            ("room/small.rs", "mod a; use self::a::A;"),
            ("room/small/a.rs", "use super::B;"),
            ("room/mod.rs", "mod small;"),
        ];
        assert_eq!(circles(&files), []);
    }

    #[test]
    fn a_circle_that_is_allowed_may_not_grow_and_is_counted_when_it_shrinks() {
        let found = circles(&[
            ROOM,
            ("room/a.rs", "use super::b::B; pub struct A;"),
            ("room/b.rs", "use super::a::A;"),
        ]);
        let judge = |file, files| {
            let allowed = [Allowed { file, files, reason: "of a reason" }];
            judge_by(&allowed, "src", &found).join("\n")
        };
        assert_eq!(judge("src/room/a.rs", 2), "");
        assert!(judge("src/room/a.rs", 1).contains("2 files import each other in a circle (1 are"));
        assert!(judge("src/room/a.rs", 3).contains("since of a reason: it has 2"));
        let other = judge("src/room/c.rs", 2);
        assert!(
            other.contains("2 files") && other.contains("room/c.rs") && other.contains("has 0")
        );
        assert!(!judge("other/room/c.rs", 2).contains("room/c.rs"), "of another crate");
    }
}
