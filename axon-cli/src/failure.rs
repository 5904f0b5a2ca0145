//! How a command fails, and the exit status that says so.

use std::{fmt::Display, process::ExitCode};

use axon_transport::config::ConfigError;

use crate::say::say;

/// Why a command ends without having done its work.
#[derive(Debug)]
pub(crate) enum CliError {
    /// A setting is unknown, obsolete or half-given: status 2, and this one line names it.
    Setting(String),
    /// Anything else: status 1.
    Failed(String),
}

impl CliError {
    /// A failure that is not a setting's.
    pub(crate) fn failed(reason: impl Display) -> Self {
        Self::Failed(reason.to_string())
    }

    /// Says why on standard error; the exit status.
    pub(crate) fn report(&self) -> ExitCode {
        match self {
            // One line, whatever the setting held.
            Self::Setting(line) => {
                say(format_args!("axon: {}", crate::text::printable(line)));
                ExitCode::from(2)
            }
            Self::Failed(reason) => {
                say(format_args!("axon: {reason}"));
                ExitCode::FAILURE
            }
        }
    }
}

impl From<ConfigError> for CliError {
    fn from(error: ConfigError) -> Self {
        Self::Setting(error.to_string())
    }
}

impl From<std::io::Error> for CliError {
    fn from(error: std::io::Error) -> Self {
        Self::failed(error)
    }
}
