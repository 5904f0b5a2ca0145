//! Sessions of this tool: they start the daemon, where one must be started, from this very binary.

use axon_transport::{DaemonCommand, Session, SessionError, SessionOptions, config::Config};

use crate::failure::CliError;

/// Opens a session under `name`.
///
/// # Errors
/// When there is no daemon and none may or can be started, or it has other settings.
pub(crate) fn open(config: &Config, name: &str) -> Result<Session, CliError> {
    let options =
        SessionOptions::new(name).daemon_command(DaemonCommand::current_executable(["daemon"])?);
    Session::open(config, options).map_err(failure)
}

/// What a session's error means for the exit status.
pub(crate) fn failure(error: SessionError) -> CliError {
    match error {
        SessionError::Config(error) => error.into(),
        error => CliError::failed(error),
    }
}
