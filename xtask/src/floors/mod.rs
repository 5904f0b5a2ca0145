//! Keeps the arrows between the rooms of a crate: imports run down only.
//!
//! A room is a module at a crate's root. `docs/architecture.md` has a table for each crate whose rooms stand on
//! floors: one row a floor, the highest first. A room may import from the rooms below its own row, and from
//! its own files; not from above, not from a room beside it, and not from the crate's root, which is the top.
//! Tests may import what they like.
//!
//! A large room has a table of its own: its folders and files are the rooms of that table, and its `mod.rs` is the
//! root. Imports from outside the large room are judged by the crate's table. The rooms of its first row may import
//! from its root: they hold methods of the object there.
//!
//! Inside a room files may import each other in a circle only where the room is [small](circles).

mod circles;
mod source;
#[cfg(test)]
mod tests;

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};

use syn::visit::Visit;

use self::source::{Paths, Source, read};

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
    for house in of_page(root)? {
        let House { folder, floors, crowded } = &house;
        let sources = sources(root, &house)?;
        if house.is_crate() {
            wrong.extend(judge_crowds(&root.join(folder), &sources, crowded));
            let circles = circles::find(&root.join(folder), &sources);
            wrong.extend(circles::judge(folder, &circles));
        }
        let imports = imports(sources, &house.module());
        wrong.extend(judge(&house, &imports));
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

/// A crate, or a large room, as the page describes it.
pub(crate) struct House {
    /// The folder of its sources: a crate's `src`, or a folder in one.
    pub(crate) folder: String,
    /// The rooms in the first column of the table.
    pub(crate) floors: Floors,
    /// Folders in it that may have too many files.
    crowded: BTreeSet<PathBuf>,
}

impl House {
    /// Returns the folder of the crate's sources, and the path of the large room in it.
    fn parts(&self) -> (&str, &str) {
        const SOURCES: &str = "src";
        match self.folder.split_once("src/") {
            Some((before, room)) => (&self.folder[..before.len() + SOURCES.len()], room),
            None => (&self.folder, ""),
        }
    }

    /// Returns whether this is a crate, and not a large room of one.
    pub(crate) fn is_crate(&self) -> bool {
        self.parts().1.is_empty()
    }

    /// Returns the path of the large room's module from the crate's root, which is empty for a crate.
    fn module(&self) -> Vec<String> {
        self.parts().1.split('/').filter(|part| !part.is_empty()).map(str::to_owned).collect()
    }
}

/// Reads the sources of the crate to which a table belongs.
fn sources(root: &Path, house: &House) -> Result<Vec<Source>, String> {
    let folder = root.join(house.parts().0);
    let mut sources = Vec::new();
    read(&folder, &folder, &mut sources)?;
    Ok(sources)
}

/// The crates and large rooms of which the page has a table.
pub(crate) fn of_page(root: &Path) -> Result<Vec<House>, String> {
    let page = root.join("docs/architecture.md");
    let text = fs::read_to_string(&page).map_err(|e| format!("{}: {e}", page.display()))?;
    let houses = houses(&text)?;
    if houses.is_empty() {
        return Err(format!("{} has no table of floors", page.display()));
    }
    Ok(houses)
}

/// Returns which rooms of a crate, or of a large room, import from which others.
pub(crate) fn arrows(root: &Path, house: &House) -> Result<BTreeSet<(String, String)>, String> {
    let imports = imports(sources(root, house)?, &house.module());
    let imports = imports.into_iter().filter(|import| !import.to.is_empty());
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
                let room = room.trim_end_matches(".rs");
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

/// Returns the faults of a crate's imports and of its table.
fn judge(house: &House, imports: &BTreeSet<Import>) -> Vec<String> {
    let House { folder, floors, .. } = house;
    let may_import_root = |room: &String| !house.is_crate() && floors.get(room) == Some(&0);
    let mut wrong = Vec::new();
    let rooms: BTreeSet<&String> = imports.iter().map(|import| &import.from).collect();
    for room in rooms.iter().filter(|room| !floors.contains_key(**room)) {
        wrong.push(format!("{folder}: `{room}` is on no floor of docs/architecture.md"));
    }
    for import in imports {
        let Import { from, file, to, what } = import;
        let file = file.display();
        if to.is_empty() {
            if may_import_root(from) {
                continue;
            }
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

/// Returns all imports between the rooms, and from the root, of the module `house`, which is a crate's root if it is
/// empty.
fn imports(sources: Vec<Source>, house: &[String]) -> BTreeSet<Import> {
    let room_of = |path: &[String]| path.strip_prefix(house)?.first().cloned();
    let rooms: BTreeSet<String> = sources.iter().filter_map(|s| room_of(&s.module)).collect();
    let roots = sources.iter().filter(|source| source.module.is_empty());
    let foreign: BTreeSet<String> = roots.flat_map(|root| root.of_other_crates(&rooms)).collect();
    let tests: Vec<Vec<String>> = sources.iter().flat_map(Source::test_modules).collect();
    let mut found = BTreeSet::new();
    for Source { path, module, file, .. } in sources {
        let Some(from) = room_of(&module) else { continue };
        if tests.iter().any(|test| module.starts_with(test)) {
            continue;
        }
        let mut paths = Paths { module, found: Vec::new() };
        paths.visit_file(&file);
        for what in paths.found {
            if !what.starts_with(house) || what.first().is_some_and(|f| foreign.contains(f)) {
                continue;
            }
            let to = room_of(&what).filter(|room| rooms.contains(room)).unwrap_or_default();
            if to != from {
                let what = format!("crate::{}", what.join("::"));
                found.insert(Import { from: from.clone(), file: path.clone(), to, what });
            }
        }
    }
    found
}
