//! A daemon of the measurement's own, and sessions with it.

use std::{
    env,
    ffi::OsString,
    process::{Child, Command, Stdio},
    time::{Duration, Instant},
};

use axon_transport::{
    config::{Config, DaemonPolicy, OsFiles},
    session::{Session, SessionOptions, daemon_status},
};

use crate::bench::harness::Result;

/// Longer than any machine needs to start a daemon or to match two endpoints.
pub(super) const PATIENCE: Duration = Duration::from_secs(60);

/// A host of the measurement's own: nobody else's daemon takes part.
pub(super) struct Place {
    dir: tempfile::TempDir,
    daemon: Child,
}

impl Place {
    pub(super) fn start() -> Result<Self> {
        let dir = tempfile::tempdir()?;
        let mut command = Command::new(env::current_exe()?);
        let ours = |name: &str| name.starts_with("AXON_") || name.starts_with("ROS_");
        for (name, _) in env::vars().filter(|(name, _)| ours(name)) {
            command.env_remove(name);
        }
        let directory = dir.path().display().to_string();
        command.args(["daemon", "--while-stdin"]).envs(settings(&directory));
        let daemon = command.stdin(Stdio::piped()).stdout(Stdio::null()).spawn()?;
        let place = Self { dir, daemon };
        let config = config(&place.directory())?;
        let deadline = Instant::now() + PATIENCE;
        while daemon_status(&config).is_err() {
            if Instant::now() > deadline {
                return Err("its daemon does not come up".into());
            }
            std::thread::sleep(Duration::from_millis(10));
        }
        Ok(place)
    }

    /// What another process needs to know to come here, too.
    pub(super) fn directory(&self) -> String {
        self.dir.path().display().to_string()
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        let _ = self.daemon.kill();
        let _ = self.daemon.wait();
    }
}

/// A session with the daemon there.
pub(super) fn session(directory: &str) -> Result<Session> {
    Ok(Session::open(&config(directory)?, SessionOptions::new("bench"))?)
}

fn settings(directory: &str) -> [(&'static str, String); 4] {
    [
        ("AXON_RUNTIME_DIR", directory.to_owned()),
        ("AXON_BIND_ADDRS", "127.0.0.1".to_owned()),
        ("ROS_AUTOMATIC_DISCOVERY_RANGE", "OFF".to_owned()),
        ("AXON_LOG", "error".to_owned()),
    ]
}

fn config(directory: &str) -> Result<Config> {
    let env = settings(directory).map(|(n, v)| (OsString::from(n), OsString::from(v)));
    let config = Config::resolve(env, None, &OsFiles)?;
    Ok(Config { daemon: DaemonPolicy::Require, ..config })
}
