//! The few settings that determine where a daemon listens, for tools that look for a daemon and open no session.

use std::{
    ffi::OsString,
    path::{Path, PathBuf},
};

use super::{
    Config, ConfigError, Files, OsFiles, environment, file_beside,
    names::{RUNTIME_DIR, TRUSTED_UIDS},
    resolve,
    sources::SettingSources,
    values::Values,
};

/// The location of the daemon of this user and domain, and the users who may run it. The location is valid even if
/// other settings, or the files that they name, are wrong. Tools use it to inspect a daemon without opening a
/// session.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct DaemonLocation {
    pub(super) domain: u32,
    pub(super) runtime_dir: Option<PathBuf>,
    pub(super) socket_in_runtime_dir: bool,
    pub(super) trusted_uids: Vec<u32>,
}

impl DaemonLocation {
    /// Returns the location by the environment of this process and the `axon.toml` that [`Config::from_env`] would
    /// read. A file that cannot be read, or that is not TOML, counts as absent.
    ///
    /// # Errors
    /// `ROS_DOMAIN_ID`, `AXON_RUNTIME_DIR` or `AXON_TRUSTED_UIDS` is wrong. In a process with more rights than its
    /// caller, a variable that names programs, files or trusted users is an error, too.
    pub fn from_env() -> Result<Self, ConfigError> {
        let variables = environment()?;
        let named = variables.get::<std::ffi::OsStr>("AXON_DAEMON_PATH".as_ref()).map(Path::new);
        let file = file_beside(named, None)?;
        Self::resolve(variables, file.as_deref(), &OsFiles)
    }

    /// Like [`from_env`](Self::from_env), with another environment. Reads `default_file` if the environment names no
    /// file.
    ///
    /// # Errors
    /// `ROS_DOMAIN_ID`, `AXON_RUNTIME_DIR` or `AXON_TRUSTED_UIDS` is wrong.
    pub fn resolve(
        env: impl IntoIterator<Item = (OsString, OsString)>,
        default_file: Option<&Path>,
        files: &impl Files,
    ) -> Result<Self, ConfigError> {
        let only = &[RUNTIME_DIR, TRUSTED_UIDS];
        let sources = SettingSources::collect_only(only, env, default_file, files)?;
        let values = Values { sources: &sources, files };
        let (runtime_dir, socket_in_runtime_dir) = resolve::runtime_dir(&values)?;
        Ok(Self {
            domain: resolve::domain(&sources)?,
            runtime_dir,
            socket_in_runtime_dir,
            trusted_uids: values.uids(TRUSTED_UIDS)?,
        })
    }

    /// Returns a configuration that only locates this daemon. All other settings are defaults.
    pub(crate) fn config(&self) -> Config {
        let Self { domain, runtime_dir, socket_in_runtime_dir, trusted_uids } = self.clone();
        Config { domain, runtime_dir, socket_in_runtime_dir, trusted_uids, ..Config::default() }
    }
}

impl From<&Config> for DaemonLocation {
    fn from(config: &Config) -> Self {
        Self {
            domain: config.domain,
            runtime_dir: config.runtime_dir.clone(),
            socket_in_runtime_dir: config.socket_in_runtime_dir,
            trusted_uids: config.trusted_uids.clone(),
        }
    }
}
