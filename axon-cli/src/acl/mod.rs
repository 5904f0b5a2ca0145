//! `axon acl`: shows, tests and writes the access rules of this host.

mod check;
pub(crate) mod cli;
mod import;
mod learn;
mod test;
mod write;

use std::{path::Path, process::ExitCode};

use axon_transport::{
    access::{AccessRules, Principal},
    config::{ClassicAuth, Config, Security},
    internal::config::parse_rules_file,
};

use self::cli::Acl;
use crate::{failure::CliError, logging};

/// Runs `axon acl`.
pub(crate) fn run(args: &Acl) -> Result<ExitCode, CliError> {
    match args {
        Acl::Check(args) => check::run(args),
        Acl::Test(args) => test::run(args),
        Acl::Import(args) => import::run(args),
        Acl::Learn(args) => learn::run(args),
    }
}

/// Returns the party that a name stands for. With certificates, upper and lower case are the same.
fn party(name: &str) -> Result<Principal<'_>, &'static str> {
    let with_certificates = Config::from_env().is_ok_and(
        |config| matches!(config.security, Security::Classic(c) if c.auth == ClassicAuth::Ca),
    );
    Principal::parse(name).map(|party| match party {
        Principal::Name(name) if with_certificates => Principal::Certificate(name),
        other => other,
    })
}

/// Returns the rules of a file, or without a file those that a daemon with these settings has.
fn rules(file: Option<&Path>) -> Result<AccessRules, CliError> {
    let Some(path) = file else { return Ok(logging::check()?.with_rules_of_host()?.access) };
    let shown = path.display();
    let text = std::fs::read_to_string(path)
        .map_err(|error| CliError::Setting(format!("{shown}: {error}")))?;
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    let rules = parse_rules_file(&text, &name);
    rules.map_err(|error| CliError::Setting(error.to_string()))
}
