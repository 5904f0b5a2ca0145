//! The failures of commands, and the exit status of each.

use std::{fmt::Display, process::ExitCode};

use axon_transport::config::ConfigError;

use crate::say::say;

/// The reason why a command did not complete its work.
#[derive(Debug)]
pub(crate) enum CliError {
    /// A setting is unknown, obsolete or incomplete. The exit status is 2, and this one line names
    /// the setting.
    Setting(String),
    /// Any other failure. The exit status is 1.
    Failed(String),
}

impl CliError {
    /// Returns a failure that does not concern a setting.
    pub(crate) fn failed(reason: impl Display) -> Self {
        Self::Failed(reason.to_string())
    }

    /// Writes the reason to standard error, and returns the exit status.
    pub(crate) fn report(&self) -> ExitCode {
        match self {
            // Escaping keeps this one line, whatever the setting contains.
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
