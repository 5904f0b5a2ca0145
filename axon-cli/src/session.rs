//! Opens the sessions of this tool. If a daemon must be started, it is started from this same
//! binary.

use axon_transport::{DaemonCommand, Session, SessionError, SessionOptions, config::Config};

use crate::failure::CliError;

/// Opens a session with the name `name`.
///
/// # Errors
/// No daemon runs and none may or can be started, or the daemon has other settings.
pub(crate) fn open(config: &Config, name: &str) -> Result<Session, CliError> {
    let options =
        SessionOptions::new(name).daemon_command(DaemonCommand::current_executable(["daemon"])?);
    Session::open(config, options).map_err(failure)
}

/// Maps a session's error to a failure with its exit status.
pub(crate) fn failure(error: SessionError) -> CliError {
    match error {
        SessionError::Config(error) => error.into(),
        error => CliError::failed(error),
    }
}
