//! `axon trust`: manages this host's key and the keys of the hosts that it connects to.

pub(crate) mod cli;
mod files;
mod keygen;
mod line;
mod list;
mod look;
mod scan;
mod target;

use self::cli::Trust;
use crate::failure::CliError;

/// Runs `axon trust`.
pub(crate) fn run(args: &Trust) -> Result<(), CliError> {
    match args {
        Trust::Keygen(args) => keygen::run(args),
        Trust::List(args) => list::run(args),
        Trust::Scan(args) => scan::run(args),
    }
}
