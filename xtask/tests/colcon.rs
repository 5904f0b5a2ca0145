//! colcon takes each folder with a `Cargo.toml` for a package once colcon-cargo is installed. In this repository
//! `rmw_axon` alone is one. tests/ros/test_colcon asks colcon itself.

use std::{
    fs,
    path::{Path, PathBuf},
};

/// Returns the folders below `folder`, down to `depth`, that contain a `Cargo.toml`. Build output is left out.
fn crates_below(folder: &Path, depth: usize) -> Vec<PathBuf> {
    let mut found = Vec::new();
    for entry in fs::read_dir(folder).unwrap() {
        let entry = entry.unwrap();
        let name = entry.file_name();
        let is_hidden = name.to_string_lossy().starts_with('.');
        if is_hidden || name == "target" || !entry.file_type().unwrap().is_dir() {
            continue;
        }
        if entry.path().join("Cargo.toml").exists() {
            found.push(entry.path());
        }
        if depth > 1 {
            found.extend(crates_below(&entry.path(), depth - 1));
        }
    }
    found
}

#[test]
fn colcon_passes_over_each_crate() {
    let crates = crates_below(Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap(), 3);
    assert!(crates.len() > 10, "{crates:?}");
    let seen: Vec<_> =
        crates.iter().filter(|folder| !folder.join("COLCON_IGNORE").exists()).collect();
    assert!(
        seen.is_empty(),
        "colcon would build these; give each an empty file COLCON_IGNORE: {seen:?}"
    );
}
