//! `axon reload`: the daemon reads its settings again.

use std::{io::Write as _, process::ExitCode};

use axon_transport::config::DaemonPlace;

use crate::{failure::CliError, session::failure, text::printable};

/// Runs `axon reload`.
///
/// # Errors
/// There is no daemon, or its settings are wrong.
pub(crate) fn run() -> Result<ExitCode, CliError> {
    let report = axon_transport::daemon_reload_at(&DaemonPlace::from_env()?).map_err(failure)?;
    if let Some(error) = report.error {
        return Err(CliError::Setting(format!("nothing was changed: {error}")));
    }
    let list = |all: &[String]| match all.is_empty() {
        true => "nothing".to_owned(),
        false => printable(&all.join(", ")),
    };
    let mut text = format!("changed: {}\n", list(&report.changed));
    if !report.needs_restart.is_empty() {
        text += &format!("needs a restart: {}\n", list(&report.needs_restart));
    }
    std::io::stdout().lock().write_all(text.as_bytes())?;
    Ok(ExitCode::SUCCESS)
}
