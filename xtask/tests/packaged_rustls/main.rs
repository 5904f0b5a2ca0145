//! rustls-axon as its package has it: built in an empty project that also uses the newest rustls.
//!
//! The other tests build it in this workspace, from rustls's source and the patches. A project
//! that gets it from a registry has the patched tree, its own versions of everything, and no patches.
//!
//! `cargo test -p xtask --test packaged_rustls -- --include-ignored` also builds what is long:
//! aws-lc once more from a vendored copy, and the documentation.

#[path = "../support/mod.rs"]
mod support;

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::sync::LazyLock;

use support::{profiles, reached, run, target, unpack, workspace};

/// Both crates used in one program: a handshake in memory with each.
const PROGRAM: &str = include_str!("program.rs");

/// Of the stock server in the program, for the name `stock`, until 2126. They protect nothing.
const CERTIFICATE: &[u8] = include_bytes!("certificate.der");
const KEY: &[u8] = include_bytes!("key.der");

/// A stock rustls of the same line that is newer than all there are.
const NEWER: &str = "0.23.9999";

fn scratch() -> PathBuf {
    Path::new(env!("CARGO_TARGET_TMPDIR")).join("packaged-rustls")
}

/// Cargo, in the directory of a package. What it inherits from the outer one is of this workspace.
fn cargo(dir: &Path, args: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO"));
    command.args(args).current_dir(dir).env_remove("CARGO_TARGET_DIR");
    command
}

/// The unpacked package, made once, as a release makes it.
static PACKAGE: LazyLock<PathBuf> = LazyLock::new(|| {
    let _ = fs::remove_dir_all(scratch());
    let out = scratch().join("out");
    fs::create_dir_all(&out).unwrap();
    let package = ["package", "rustls-axon", "--no-verify", "--allow-dirty", "--offline"];
    let xtask = env!("CARGO_BIN_EXE_xtask");
    run(Command::new(xtask).args(package).arg("--target-dir").arg(&out));

    let mut packed = fs::read_dir(out.join("package")).unwrap().map(|entry| entry.unwrap().path());
    let packed = packed.find(|path| path.extension().is_some_and(|end| end == "crate")).unwrap();
    unpack(&packed, &scratch())
});

/// A new project that depends on the package and the newest rustls, and has all it needs in cargo's
/// cache. `None` without a registry.
fn project(name: &str, features: &str, main: &str) -> Option<PathBuf> {
    let dir = scratch().join(name);
    let package = PACKAGE.file_name().unwrap().to_str().unwrap();
    let profiles = profiles();
    fs::create_dir_all(dir.join("src")).unwrap();
    fs::write(
        dir.join("Cargo.toml"),
        format!(
            "[package]\nname = \"{name}\"\nversion = \"0.0.0\"\nedition = \"2024\"\n[workspace]\n\
             [dependencies]\nzeroize = \"1\"\n\
             rustls = {{ version = \"0.23\", default-features = false, features = [{features}] }}\n\
             [dependencies.rustls-axon]\npath = \"../{package}\"\n\
             default-features = false\nfeatures = [{features}]\n{profiles}"
        ),
    )
    .unwrap();
    fs::write(dir.join("src/main.rs"), main).unwrap();
    fs::write(dir.join("src/certificate.der"), CERTIFICATE).unwrap();
    fs::write(dir.join("src/key.der"), KEY).unwrap();
    fs::copy(workspace().join("Cargo.lock"), dir.join("Cargo.lock")).unwrap();

    // the workspace is not asked for its rustls: the newest one is
    for step in [&["update", "--package", "rustls"][..], &["fetch"]] {
        reached(&mut cargo(&dir, step))?;
    }
    Some(dir)
}

/// The releases of rustls in a lock file.
fn locked(project: &Path) -> Vec<String> {
    let lock = fs::read_to_string(project.join("Cargo.lock")).unwrap();
    lock.split("name = \"rustls\"\nversion = \"")
        .skip(1)
        .map(|rest| rest.split('"').next().unwrap().to_owned())
        .collect()
}

#[track_caller]
fn both_shook_hands(output: &Output) {
    let text = String::from_utf8_lossy(&output.stdout);
    assert_eq!(text, "rustls: TLSv1_3, no PSK\nrustls-axon: TLSv1_3, PSK of the test\n");
}

const PROVIDERS: &str = "\"aws_lc_rs\", \"std\"";

#[test]
fn the_package_runs_beside_the_newest_rustls() {
    let Some(project) = project("beside", PROVIDERS, PROGRAM) else { return };
    eprintln!("beside rustls {}", locked(&project).join(", "));
    let run_it = ["run", "--offline", "--locked"];
    both_shook_hands(&run(cargo(&project, &run_it).env("CARGO_TARGET_DIR", target())));
}

/// Who adds the package compiles rustls's source once: as this crate, and not to build it.
#[test]
fn the_package_has_no_build_script_and_no_build_dependencies() {
    let manifest = fs::read_to_string(PACKAGE.join("Cargo.toml")).unwrap();
    assert!(manifest.contains("\nbuild = false\n"), "{manifest}");
    for part in ["build-dependencies", "[dependencies.rustls]", "publish"] {
        let text = manifest.split("[dev-dependencies").next().unwrap();
        assert!(!text.contains(part), "{part}: {text}");
    }
    assert!(!PACKAGE.join("build.rs").exists());
    for file in ["src/external_psk.rs", "src/lib.rs", "patches", "LICENSE-ISC", "README.md"] {
        assert!(PACKAGE.join(file).exists(), "{file}");
    }
    assert!(!PACKAGE.join("src/lib_body.rs").exists());
}

/// Cargo's own command would pack what cannot be built.
#[test]
fn a_checkout_cannot_be_packaged_without_its_source() {
    let out = scratch().join("refused");
    let package = ["package", "--package", "rustls-axon", "--no-verify", "--allow-dirty"];
    let mut command = cargo(workspace(), &package);
    let output = command.args(["--offline", "--target-dir"]).arg(&out).output().unwrap();
    let why = String::from_utf8_lossy(&output.stderr);
    assert!(!output.status.success() && why.contains("made-by-cargo-xtask-package"), "{why}");
}

/// In a checkout, another rustls than the pinned one is an error; in the package it is none.
#[test]
fn the_package_does_not_care_which_rustls_stands_beside_it() {
    let main =
        "fn main() {\n    let _ = (&rustls::version::TLS13, &rustls_axon::version::TLS13);\n}\n";
    let Some(project) = project("newer", "\"std\"", main) else { return };

    let metadata = run(&mut cargo(&project, &["metadata", "--format-version=1", "--offline"]));
    let metadata: serde_json::Value = serde_json::from_slice(&metadata.stdout).unwrap();
    let packages = metadata["packages"].as_array().unwrap();
    let rustls = packages.iter().find(|package| package["name"] == "rustls").unwrap();
    let source = Path::new(rustls["manifest_path"].as_str().unwrap()).parent().unwrap();
    let newer = scratch().join("rustls-newer");
    run(Command::new("cp").arg("-r").arg(source).arg(&newer));
    let manifest = fs::read_to_string(newer.join("Cargo.toml")).unwrap();
    let version = format!("\nversion = {}\n", rustls["version"]);
    assert_eq!(manifest.matches(&version).count(), 1);
    let manifest = manifest.replace(&version, &format!("\nversion = \"{NEWER}\"\n"));
    fs::write(newer.join("Cargo.toml"), manifest).unwrap();

    let patch = "patch.crates-io.rustls.path=\"../rustls-newer\"";
    let update = ["update", "--offline", "--package", "rustls", "--config", patch];
    run(&mut cargo(&project, &update));
    assert_eq!(locked(&project), [NEWER]);
    let check = ["check", "--offline", "--locked", "--config", patch];
    run(cargo(&project, &check).env("CARGO_TARGET_DIR", target()));
}

/// Cargo has an empty home, and all it finds is in `vendor/`.
#[test]
#[ignore = "builds aws-lc, which takes minutes"]
fn the_package_builds_offline_from_a_vendored_copy() {
    let Some(project) = project("vendored", PROVIDERS, PROGRAM) else { return };
    let config = run(&mut cargo(&project, &["vendor", "--locked", "--offline"]));
    fs::create_dir_all(project.join(".cargo")).unwrap();
    fs::write(project.join(".cargo/config.toml"), config.stdout).unwrap();
    let home = scratch().join("empty-home");
    fs::create_dir_all(&home).unwrap();

    let run_it = ["run", "--offline", "--locked", "--target-dir", "target"];
    both_shook_hands(&run(cargo(&project, &run_it).env("CARGO_HOME", &home)));
    assert!(!home.join("registry/src").exists(), "sources came from elsewhere");
}

/// The default features, and what the manifest adds for docs.rs.
const DOCUMENTED: &str = "\"aws_lc_rs\", \"std\", \"logging\", \"tls12\"";

/// docs.rs has no network, sets `DOCS_RS`, and takes the features that the manifest names for it.
#[test]
#[ignore = "documents all of rustls"]
fn the_package_documents_itself_as_on_docs_rs() {
    let Some(project) = project("documented", DOCUMENTED, "fn main() {}\n") else { return };
    let manifest = fs::read_to_string(PACKAGE.join("Cargo.toml")).unwrap();
    let (_, docs_rs) = manifest.split_once("[package.metadata.docs.rs]").unwrap();
    let docs_rs = docs_rs.split("\n[").next().unwrap();
    assert!(docs_rs.contains("\"logging\"") && docs_rs.contains("\"tls12\""), "{docs_rs}");

    let doc = ["doc", "--offline", "--locked", "--no-deps", "--package", "rustls-axon"];
    // not the workspace's target directory: with DOCS_RS aws-lc is built in another way
    let target = scratch().join("documented-target");
    run(cargo(&project, &doc).env("CARGO_TARGET_DIR", &target).env("DOCS_RS", "1"));
    let page = fs::read_to_string(target.join("doc/rustls_axon/external_psk/index.html")).unwrap();
    for item in ["ExternalPsk", "ImportedPsk", "ResolvesExternalPsk", "PskKeyExchangeMode"] {
        assert!(page.contains(item), "{item} is not documented");
    }
}
