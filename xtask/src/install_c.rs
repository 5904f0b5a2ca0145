//! Installs what a C program needs of axon-transport: header, libraries, daemon and pkg-config file.

use std::env;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

type Result<T> = std::result::Result<T, String>;

/// Builds with this profile of cargo's and installs under `prefix`.
pub(crate) fn install(prefix: &Path, profile: &str) -> Result<String> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("xtask is in the repository");
    let package = root.join("axon-transport");
    let prefix = std::path::absolute(prefix).map_err(|e| format!("{}: {e}", prefix.display()))?;
    let cargo = |args: &[&str]| {
        let mut command = Command::new(env::var_os("CARGO").unwrap_or_else(|| "cargo".into()));
        command.current_dir(root).args(args);
        match command.args(["--profile", profile]).status() {
            Ok(status) if status.success() => Ok(()),
            Ok(status) => Err(format!("cargo {}: {status}", args[0])),
            Err(error) => Err(format!("cargo {}: {error}", args[0])),
        }
    };
    cargo(&["build", "--package", "axon-daemon", "--bin", "axon_daemon"])?;
    let libraries = "staticlib,cdylib";
    cargo(&["rustc", "--package", "axon-transport", "--lib", "--crate-type", libraries])?;

    let target = env::var_os("CARGO_TARGET_DIR").map_or_else(|| root.join("target"), PathBuf::from);
    let built = target.join(if profile == "dev" { "debug" } else { profile });
    let to = |within: &str| prefix.join(within);
    copy(&package.join("include/axon.h"), &to("include/axon.h"))?;
    copy(&built.join("libaxon_transport.a"), &to("lib/libaxon_transport.a"))?;
    copy(&built.join("libaxon_transport.so"), &to("lib/libaxon_transport.so"))?;
    copy(&built.join("axon_daemon"), &to("bin/axon_daemon"))?;
    let template = package.join("axon-transport.pc.in");
    let text = fs::read_to_string(&template).map_err(|e| format!("{}: {e}", template.display()))?;
    let text = text
        .replace("@prefix@", &prefix.to_string_lossy())
        .replace("@version@", env!("CARGO_PKG_VERSION"));
    let file = to("lib/pkgconfig/axon-transport.pc");
    make_room(&file)?;
    fs::write(&file, text).map_err(|e| format!("{}: {e}", file.display()))?;
    Ok(format!("installed under {}", prefix.display()))
}

fn copy(from: &Path, to: &Path) -> Result<()> {
    make_room(to)?;
    fs::copy(from, to).map_err(|e| format!("{} to {}: {e}", from.display(), to.display()))?;
    Ok(())
}

fn make_room(file: &Path) -> Result<()> {
    let directory = file.parent().expect("it is under the prefix");
    fs::create_dir_all(directory).map_err(|e| format!("{}: {e}", directory.display()))
}
