//! Makes the source tree of the crate, and tells `src/lib.rs` where it is.
//!
//! That is rustls's own source, as cargo has it, with `patches/` applied and `added/` added, in `OUT_DIR`.
//! A package has neither this script nor patches to apply: `cargo xtask package` makes its source in the
//! same way.

use std::env;
use std::path::{Path, PathBuf};
use std::process::exit;

#[path = "build/patch.rs"]
mod patch;
#[path = "build/tree.rs"]
mod tree;
#[path = "build/upstream.rs"]
mod upstream;

fn main() {
    match source_tree() {
        Ok(dir) => println!("cargo::rustc-env=RUSTLS_AXON_SRC={}", dir.display()),
        Err(why) => {
            // one `cargo::error` a line is how cargo shows a message of several lines
            for line in why.lines() {
                println!("cargo::error={line}");
            }
            exit(1);
        }
    }
}

fn source_tree() -> Result<PathBuf, String> {
    let var = |name: &str| env::var(name).map_err(|_| format!("{name} is not set by cargo"));
    let crate_dir = PathBuf::from(var("CARGO_MANIFEST_DIR")?);

    if !crate_dir.join("patches").is_dir() {
        return Err(format!(
            "{} has no patches/, so it is no checkout of the repository.\n\
             A package of rustls-axon is made with: cargo xtask package rustls-axon",
            crate_dir.display()
        ));
    }
    for watched in ["patches", "added", "build", "upstream.sha256", "patched.sha256"] {
        println!("cargo::rerun-if-changed={}", crate_dir.join(watched).display());
    }

    let out = PathBuf::from(var("OUT_DIR")?);
    let cargo = var("CARGO")?;
    let upstream = upstream::locate(
        Path::new(&cargo),
        &crate_dir,
        &var("HOST")?,
        &out.join("where-is-rustls"),
    )?;
    let made = tree::assemble(&upstream, &crate_dir)?;
    tree::check(&made, &crate_dir.join("patched.sha256"))?;

    let out = out.join("src");
    tree::write(&made, &out)?;
    Ok(out)
}
