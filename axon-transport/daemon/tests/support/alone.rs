//! A session without a daemon.

use axon_transport::{
    Session, SessionOptions,
    config::{Config, DaemonPolicy},
};

/// A session that has its process to itself.
pub(crate) fn alone() -> Session {
    let config = Config::builder().daemon(DaemonPolicy::Off).build().unwrap();
    Session::open(&config, SessionOptions::new("test")).unwrap()
}
