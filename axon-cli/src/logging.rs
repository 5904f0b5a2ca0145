//! Where log lines go: standard error, filtered by `AXON_LOG`.

use std::io::IsTerminal;

use axon_transport::config::Config;
use tracing_subscriber::EnvFilter;

use crate::failure::Failure;

/// Reads the configuration and sets logging up as it says.
///
/// # Errors
/// A setting that is unknown, obsolete or half-given.
pub(crate) fn configure() -> Result<Config, Failure> {
    let config = check()?;
    start(&config);
    Ok(config)
}

/// Reads the configuration, the log filter included, and sets nothing up.
///
/// # Errors
/// As for [`configure`].
pub(crate) fn check() -> Result<Config, Failure> {
    let config = Config::from_env()?;
    EnvFilter::try_new(&config.log).map_err(|error| {
        let accepted = "a level such as info, or target=level pairs";
        Failure::Setting(format!("AXON_LOG: read {:?} ({error}); accepted: {accepted}", config.log))
    })?;
    Ok(config)
}

/// Sets logging up as a checked configuration says.
pub(crate) fn start(config: &Config) {
    tracing_subscriber::fmt()
        .with_env_filter(EnvFilter::new(&config.log))
        .with_writer(std::io::stderr)
        .with_ansi(std::io::stderr().is_terminal())
        .init();
}
