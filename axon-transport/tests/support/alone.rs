//! A session without a daemon.

use axon_transport::{
    config::{Config, DaemonPolicy},
    session::{Session, SessionOptions},
};

/// A session that has its process to itself.
pub(crate) fn alone() -> Session {
    let config = Config::builder().daemon(DaemonPolicy::Off).build().unwrap();
    Session::open(&config, SessionOptions::new("test")).unwrap()
}
