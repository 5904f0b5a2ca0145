//! Checks whether a daemon could start its gateway with a configuration, without starting one.

use axon_shm::internal::erase_from_now_on;
use axon_transport::config::{Config, Security};

use crate::{error::GatewayError, identity, keys::Kme};

/// Reads the files that a daemon with this configuration would read, its private key included, and reports the errors
/// that the daemon would report. Opens no connection and keeps nothing.
///
/// From here on this process erases what it frees, where [`ErasingHeap`](crate::ErasingHeap) is
/// its allocator.
///
/// # Errors
/// A file that cannot be read or used, by the name of its variable.
pub fn check(config: &Config) -> Result<(), GatewayError> {
    erase_from_now_on();
    match &config.security {
        Security::Classic(classic) => identity::check(classic),
        Security::Qkd(qkd) => Ok(Kme::check(qkd)?),
    }
}
