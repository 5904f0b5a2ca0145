//! `axon reload`: makes the daemon read its settings again.

use std::{io::Write as _, process::ExitCode};

use axon_transport::config::DaemonLocation;

use crate::{failure::CliError, session::failure, text::printable};

/// Runs `axon reload`.
///
/// # Errors
/// No daemon runs, or its settings are wrong.
pub(crate) fn run() -> Result<ExitCode, CliError> {
    let report = axon_transport::daemon_reload_at(&DaemonLocation::from_env()?).map_err(failure)?;
    if let Some(error) = &report.error {
        return Err(CliError::Setting(refused(error, &report.changed)));
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

/// Returns the text for a failed reload: the error, and the settings that the daemon changed
/// nevertheless.
fn refused(error: &str, changed: &[String]) -> String {
    match changed {
        [] => format!("nothing was changed: {error}"),
        changed => format!("changed: {}; but {error}", printable(&changed.join(", "))),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_failed_reload_names_the_settings_that_were_changed() {
        assert_eq!(refused("line 3: x", &[]), "nothing was changed: line 3: x");
        let changed = ["access rules".to_owned(), "[[topic]]".to_owned()];
        let text = refused("the gateway did not take them", &changed);
        assert_eq!(text, "changed: access rules, [[topic]]; but the gateway did not take them");
    }
}
