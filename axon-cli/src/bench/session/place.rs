//! Starts a daemon for the measurement, and opens sessions with it.

use std::{
    env,
    ffi::OsString,
    process::{Child, Command, Stdio},
    time::{Duration, Instant},
};

use axon_transport::{
    Session, SessionOptions,
    config::{Config, DaemonPolicy, OsFiles},
    daemon_status,
};
use serde_json::Value;

use crate::bench::harness::Result;

/// Any machine starts a daemon, and matches two endpoints, within this time.
pub(in crate::bench) const MATCH_TIMEOUT: Duration = Duration::from_secs(60);

/// The environment variables of a host's processes.
pub(in crate::bench) type Settings = Vec<(String, String)>;

/// A host for the measurement alone; no other daemon takes part.
pub(super) struct BenchHost {
    _dir: tempfile::TempDir,
    settings: Settings,
    daemon: Child,
}

impl BenchHost {
    pub(super) fn start() -> Result<Self> {
        let dir = tempfile::tempdir()?;
        let mut command = Command::new(env::current_exe()?);
        let ours = |name: &str| name.starts_with("AXON_") || name.starts_with("ROS_");
        for (name, _) in env::vars().filter(|(name, _)| ours(name)) {
            command.env_remove(name);
        }
        let settings: Settings = [
            ("AXON_RUNTIME_DIR", &*dir.path().display().to_string()),
            ("AXON_BIND_ADDRS", "127.0.0.1"),
            ("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST"),
            ("AXON_LOG", "error"),
        ]
        .map(|(name, value)| (name.to_owned(), value.to_owned()))
        .into();
        command.args(["daemon", "--while-stdin"]).envs(settings.iter().cloned());
        let daemon = command.stdin(Stdio::piped()).stdout(Stdio::null()).spawn()?;
        let config = config(&settings)?;
        let place = Self { _dir: dir, settings, daemon };
        let deadline = Instant::now() + MATCH_TIMEOUT;
        while daemon_status(&config).is_err() {
            if Instant::now() > deadline {
                return Err("its daemon does not come up".into());
            }
            std::thread::sleep(Duration::from_millis(10));
        }
        Ok(place)
    }

    /// Returns the settings with which another process joins this host.
    pub(super) fn settings(&self) -> Settings {
        self.settings.clone()
    }
}

impl Drop for BenchHost {
    fn drop(&mut self) {
        let _ = self.daemon.kill();
        let _ = self.daemon.wait();
    }
}

/// Opens a session with the daemon that has these settings.
pub(in crate::bench) fn session(settings: &Settings) -> Result<Session> {
    Ok(Session::open(&config(settings)?, SessionOptions::new("bench"))?)
}

/// Returns the process id of the daemon that has these settings.
pub(in crate::bench) fn daemon_pid(settings: &Settings) -> Result<u32> {
    let status: Value = serde_json::from_str(&daemon_status(&config(settings)?)?)?;
    Ok(u32::try_from(status["pid"].as_u64().ok_or("a status without a pid")?)?)
}

/// Returns a configuration with which a session finds the daemon.
pub(in crate::bench) fn config(settings: &Settings) -> Result<Config> {
    let env = settings.iter().map(|(name, value)| (OsString::from(name), OsString::from(value)));
    let mut config = Config::resolve(env, None, &OsFiles)?;
    config.daemon = DaemonPolicy::Require;
    Ok(config)
}
