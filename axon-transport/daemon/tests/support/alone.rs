//! A session without a daemon.

use axon_transport::{
    Session, SessionOptions,
    config::{Config, DaemonPolicy},
};

/// Opens a session in this process without a daemon.
pub(crate) fn alone() -> Session {
    let config = Config::builder().daemon(DaemonPolicy::Off).build().unwrap();
    Session::open(&config, SessionOptions::new("test")).unwrap()
}
