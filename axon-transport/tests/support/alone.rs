//! A session without a daemon.

use axon_transport::{
    config::{Config, DaemonPolicy, OsFiles},
    session::{Session, SessionOptions},
};

/// A session that has its process to itself.
pub(crate) fn alone() -> Session {
    let config = Config::resolve([], None, &OsFiles).unwrap();
    let config = Config { daemon: DaemonPolicy::Off, ..config };
    Session::open(&config, SessionOptions::new("test")).unwrap()
}
