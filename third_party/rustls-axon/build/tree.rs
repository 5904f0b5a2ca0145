//! The source tree: rustls's files, checked, patched, added to, and checked again.

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;

use sha2::{Digest, Sha256};

use super::patch;

/// Paths below `src/`, with `/` between the parts, and what the files contain.
pub(crate) type Tree = BTreeMap<String, String>;

/// Makes the tree from rustls's `src` directory and what the crate in `crate_dir` has for it.
///
/// The result is for the caller to [`check()`] against `patched.sha256`.
pub(crate) fn assemble(upstream_src: &Path, crate_dir: &Path) -> Result<Tree, String> {
    let mut tree = read_dir(upstream_src)?;
    check(&tree, &crate_dir.join("upstream.sha256"))?;
    change(&mut tree, &read_patches(crate_dir)?, &read_added(crate_dir)?)?;
    adapt(tree)
}

/// The patches by their file names, in the order in which they apply.
pub(crate) fn read_patches(crate_dir: &Path) -> Result<Tree, String> {
    read_flat(&crate_dir.join("patches"), "patch")
}

/// The files that are new.
pub(crate) fn read_added(crate_dir: &Path) -> Result<Tree, String> {
    read_dir(&crate_dir.join("added/src"))
}

/// Applies the patches and adds the added files.
///
/// On an error the tree is as far as this got: it must not be used.
pub(crate) fn change(tree: &mut Tree, patches: &Tree, added: &Tree) -> Result<(), String> {
    for (name, text) in patches {
        patch::apply(tree, text).map_err(|why| format!("patches/{name}: {why}"))?;
    }
    for (path, text) in added {
        if tree.insert(path.clone(), text.clone()).is_some() {
            return Err(format!("added/src/{path}: rustls has a file of that name"));
        }
    }
    Ok(())
}

/// Makes rustls's changed source the source of a crate of another name.
pub(crate) fn adapt(mut tree: Tree) -> Result<Tree, String> {
    let lib = tree.remove("lib.rs").ok_or("rustls has no src/lib.rs")?;
    tree.insert("lib_body.rs".into(), lib_body(&lib)?.into());

    for contents in tree.values_mut() {
        *contents = without_unit_tests(contents);
    }
    Ok(tree)
}

/// Turns rustls's unit tests off: they include files that its package does not have.
fn without_unit_tests(contents: &str) -> String {
    contents
        .replace("#[cfg(test)]", "#[cfg(any())]")
        .replace("#[cfg(all(test, ", "#[cfg(all(any(), ")
}

/// The part of rustls's `lib.rs` that can be `include!`d: all but the crate's documentation and
/// attributes, which `src/lib.rs` of this crate has instead.
fn lib_body(lib: &str) -> Result<&str, String> {
    const FIRST_ITEM: &str = "\nextern crate alloc;\n";
    match lib.match_indices(FIRST_ITEM).map(|(at, _)| at).collect::<Vec<_>>()[..] {
        [at] => Ok(&lib[at + 1..]),
        _ => Err("rustls's src/lib.rs must have one line `extern crate alloc;`".into()),
    }
}

/// Compares every file with a list of digests, as made by [`digests()`].
///
/// Every file must be listed, and every listed file be there.
pub(crate) fn check(tree: &Tree, list: &Path) -> Result<(), String> {
    let text =
        fs::read_to_string(list).map_err(|err| format!("cannot read {}: {err}", list.display()))?;
    let name = list.file_name().unwrap_or_default().to_string_lossy();

    let mut listed = BTreeMap::new();
    for line in text.lines().filter(|line| !line.starts_with('#')) {
        let (digest, path) = line
            .split_once("  ")
            .ok_or_else(|| format!("{name}: not a line of the form `DIGEST  PATH`: {line}"))?;
        listed.insert(path, digest);
    }

    for (path, contents) in tree {
        match listed.remove(path.as_str()) {
            Some(digest) if digest == sha256(contents) => {}
            Some(_) => return Err(format!("src/{path} is not the file whose digest {name} has")),
            None => return Err(format!("src/{path} is not listed in {name}")),
        }
    }
    match listed.keys().next() {
        Some(path) => Err(format!("src/{path} is listed in {name} and does not exist")),
        None => Ok(()),
    }
}

/// The list that [`check()`] reads: a heading, then a line a file.
#[allow(dead_code)] // used by xtask, not by the build script
pub(crate) fn digests(tree: &Tree, heading: &str) -> String {
    let mut list = format!("# {heading}\n");
    for (path, contents) in tree {
        list.push_str(&format!("{}  {path}\n", sha256(contents)));
    }
    list
}

fn sha256(contents: &str) -> String {
    Sha256::digest(contents).iter().map(|byte| format!("{byte:02x}")).collect()
}

/// Reads every file below `dir`.
pub(crate) fn read_dir(dir: &Path) -> Result<Tree, String> {
    fn walk(dir: &Path, prefix: &str, tree: &mut Tree) -> Result<(), String> {
        let failed = |err| format!("cannot read {}: {err}", dir.display());
        for entry in fs::read_dir(dir).map_err(failed)? {
            let entry = entry.map_err(failed)?;
            let name = entry.file_name().to_string_lossy().into_owned();
            let path = if prefix.is_empty() { name } else { format!("{prefix}/{name}") };
            if entry.file_type().map_err(failed)?.is_dir() {
                walk(&entry.path(), &path, tree)?;
            } else {
                let contents = fs::read_to_string(entry.path())
                    .map_err(|err| format!("cannot read {}: {err}", entry.path().display()))?;
                tree.insert(path, contents);
            }
        }
        Ok(())
    }

    let mut tree = Tree::new();
    walk(dir, "", &mut tree)?;
    Ok(tree)
}

/// Reads the files in `dir` that have `extension`, in the order of their names.
fn read_flat(dir: &Path, extension: &str) -> Result<Tree, String> {
    let mut files = read_dir(dir)?;
    files.retain(|name, _| {
        !name.contains('/') && Path::new(name).extension().is_some_and(|found| found == extension)
    });
    Ok(files)
}

/// Makes `dir` hold exactly `tree`. Files that are right already keep their modification time.
pub(crate) fn write(tree: &Tree, dir: &Path) -> Result<(), String> {
    if dir.exists() {
        for path in read_dir(dir)?.keys().filter(|path| !tree.contains_key(*path)) {
            let path = dir.join(path);
            fs::remove_file(&path)
                .map_err(|err| format!("cannot remove {}: {err}", path.display()))?;
        }
    }
    for (path, contents) in tree {
        let path = dir.join(path);
        if fs::read(&path).is_ok_and(|present| present == contents.as_bytes()) {
            continue;
        }
        path.parent()
            .map_or(Ok(()), fs::create_dir_all)
            .and_then(|()| fs::write(&path, contents))
            .map_err(|err| format!("cannot write {}: {err}", path.display()))?;
    }
    Ok(())
}
