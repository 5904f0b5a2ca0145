//! Finds or makes the source tree of the crate, and tells `src/lib.rs` where it is.
//!
//! In a checkout: rustls's own source, as cargo has it, with `patches/` applied and `added/` added,
//! in `OUT_DIR`. In a package: `patched/`, which was made in the same way before packaging.

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

    for watched in ["patches", "added", "build", "patched", "upstream.sha256", "patched.sha256"] {
        if crate_dir.join(watched).exists() {
            println!("cargo::rerun-if-changed={}", crate_dir.join(watched).display());
        }
    }

    if !crate_dir.join("patches").is_dir() {
        let packaged = crate_dir.join("patched/src");
        if !packaged.is_dir() {
            return Err(format!(
                "{} has neither patches/ nor patched/: the package is incomplete",
                crate_dir.display()
            ));
        }
        tree::check(&tree::read_dir(&packaged)?, &crate_dir.join("patched.sha256"))?;
        return Ok(packaged);
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
