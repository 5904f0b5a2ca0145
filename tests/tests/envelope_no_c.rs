//! With `rust-crypto` alone, axon-envelope needs no C: nothing in its dependency tree compiles,
//! finds or links a C library.

use std::collections::BTreeSet;
use std::process::Command;

/// A target without an operating system or `std`.
const BARE_METAL: &str = "thumbv7em-none-eabi";

/// Packages in a build of axon-envelope, its build scripts and macros included.
fn packages(features: &str, target: &str) -> BTreeSet<String> {
    let output = Command::new(env!("CARGO"))
        .args(["tree", "--locked", "--quiet", "--package", "axon-envelope"])
        .args(["--no-default-features", "--features", features])
        .args(["--edges", "normal,build", "--target", target])
        .args(["--prefix", "none", "--format", "{p}"])
        .current_dir(env!("CARGO_MANIFEST_DIR"))
        .output()
        .unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let names = String::from_utf8(output.stdout).unwrap();
    names.lines().filter_map(|line| line.split_whitespace().next()).map(str::to_owned).collect()
}

fn brings_c(package: &str) -> bool {
    package.ends_with("-sys")
        || ["aws-lc-rs", "bindgen", "cc", "cmake", "pkg-config", "vcpkg"].contains(&package)
}

#[test]
fn rust_crypto_brings_no_c_anywhere() {
    for target in [BARE_METAL, "x86_64-unknown-linux-gnu", "aarch64-unknown-linux-gnu"] {
        let packages = packages("rust-crypto", target);
        assert!(packages.contains("axon-envelope") && packages.contains("aes-gcm"));
        let c: Vec<_> = packages.iter().filter(|package| brings_c(package)).collect();
        assert!(c.is_empty(), "{target}: {c:?}");
    }
}

#[test]
fn the_other_back_end_would_have_been_noticed() {
    let packages = packages("aws-lc-rs", "x86_64-unknown-linux-gnu");
    let c: Vec<_> = packages.iter().filter(|package| brings_c(package)).collect();
    for package in ["aws-lc-rs", "aws-lc-sys", "cc"] {
        assert!(c.iter().any(|name| *name == package), "{package} is not among {c:?}");
    }
}
