//! Files, with errors that name them.

use std::fs;
use std::path::Path;

pub(super) fn read(file: &Path) -> Result<String, String> {
    fs::read_to_string(file).map_err(|err| format!("cannot read {}: {err}", file.display()))
}

/// Writes a file, in a folder that may have to be made.
pub(super) fn write(file: &Path, text: &str) -> Result<(), String> {
    file.parent()
        .map_or(Ok(()), fs::create_dir_all)
        .and_then(|()| fs::write(file, text))
        .map_err(|err| format!("cannot write {}: {err}", file.display()))
}

pub(super) fn remove(file: &Path) -> Result<(), String> {
    fs::remove_file(file).map_err(|err| format!("cannot remove {}: {err}", file.display()))
}

/// Reads a file and writes it changed.
pub(super) fn change(
    file: &Path,
    change: impl FnOnce(&str) -> Result<String, String>,
) -> Result<(), String> {
    write(file, &change(&read(file)?)?)
}

/// The paths of all files below a folder, sorted.
pub(super) fn below(folder: &Path) -> Result<Vec<String>, String> {
    let mut files = Vec::new();
    collect(folder, "", &mut files)?;
    files.sort();
    Ok(files)
}

fn collect(root: &Path, within: &str, files: &mut Vec<String>) -> Result<(), String> {
    let failed = |err| format!("cannot read {}: {err}", root.join(within).display());
    for entry in fs::read_dir(root.join(within)).map_err(failed)? {
        let entry = entry.map_err(failed)?;
        let name = entry.file_name();
        let name = name
            .to_str()
            .ok_or_else(|| format!("{} has no name in UTF-8", entry.path().display()))?;
        let path = if within.is_empty() { name.to_owned() } else { format!("{within}/{name}") };
        if entry.file_type().map_err(failed)?.is_dir() {
            collect(root, &path, files)?;
        } else {
            files.push(path);
        }
    }
    Ok(())
}

/// The bytes of all files below a folder.
pub(super) fn size(folder: &Path) -> Result<u64, String> {
    let size = |path: &String| {
        let file = folder.join(path);
        let read = fs::symlink_metadata(&file);
        read.map(|about| about.len()).map_err(|err| format!("{}: {err}", file.display()))
    };
    below(folder)?.iter().map(size).sum()
}
