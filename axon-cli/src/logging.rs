//! Sends log lines to standard error, filtered by `AXON_LOG`.

use axon_daemon::log;
use axon_transport::config::Config;
use tracing_subscriber::EnvFilter;

use crate::failure::CliError;

/// Reads the configuration and sets up logging accordingly.
///
/// # Errors
/// A setting is unknown, obsolete or incomplete.
pub(crate) fn configure() -> Result<Config, CliError> {
    let config = check()?;
    log::start(&config);
    Ok(config)
}

/// Reads the configuration and the log filter, and sets up nothing.
///
/// # Errors
/// The same as for [`configure`].
pub(crate) fn check() -> Result<Config, CliError> {
    let config = Config::from_env()?;
    EnvFilter::try_new(&config.log).map_err(|error| {
        let accepted = "a level such as info, or target=level pairs";
        CliError::Setting(format!(
            "AXON_LOG: read {:?} ({error}); accepted: {accepted}",
            config.log
        ))
    })?;
    Ok(config)
}
