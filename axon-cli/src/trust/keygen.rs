//! `axon trust keygen`: creates a key for this host.

use std::{
    fs::{self, File, OpenOptions},
    io::{ErrorKind, Write as _},
    os::unix::fs::OpenOptionsExt as _,
    path::Path,
};

use axon_tls::identity::SigningKey;

use super::{cli, files::failed, line::line};
use crate::failure::CliError;

/// Runs `axon trust keygen`.
pub(super) fn run(args: &cli::Keygen) -> Result<(), CliError> {
    let name = args.name.clone().unwrap_or_else(node_name);
    let pem = SigningKey::generate_pem_with(args.algorithm.into()).map_err(CliError::failed)?;
    let key = SigningKey::from_pem(&pem).map_err(CliError::failed)?;
    // A name that no trust file can hold is refused before the file is created.
    let line = line(&name, key.spki_digest())?;
    create(&args.file, pem.as_bytes())?;
    writeln!(std::io::stdout().lock(), "{line}")?;
    Ok(())
}

/// Writes a file that must not exist yet. Only its owner can read it.
fn create(path: &Path, content: &[u8]) -> Result<(), CliError> {
    let mut options = OpenOptions::new();
    options.write(true).create_new(true).mode(0o600);
    let file = options.open(path).map_err(|error| match error.kind() {
        ErrorKind::AlreadyExists => {
            failed(path, &"exists, and is not overwritten; delete it, or name another file")
        }
        ErrorKind::NotFound => {
            failed(path, &"its directory does not exist; make that first, or name another file")
        }
        ErrorKind::PermissionDenied => {
            failed(path, &"this user may not make it there; name another file, or ask who may")
        }
        _ => failed(path, &error),
    })?;
    write(file, content).map_err(|error| {
        // An incomplete key is of no use, and would make the next attempt fail.
        let _ = fs::remove_file(path);
        failed(path, &error)
    })
}

fn write(mut file: File, content: &[u8]) -> std::io::Result<()> {
    file.write_all(content)?;
    file.sync_all()
}

fn node_name() -> String {
    rustix::system::uname().nodename().to_string_lossy().into_owned()
}
