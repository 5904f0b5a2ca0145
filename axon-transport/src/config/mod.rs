//! Configuration: environment and `axon.toml`, or a [`ConfigBuilder`], in, one validated [`Config`] out.
//!
//! Only this module reads settings from the environment; [`Config::builder`] and [`Config::default`] do not. A
//! setting that is unknown, obsolete or half-given is an error. The error names the variable, the value that was read
//! and the accepted values. Validation creates nothing, reads no private key, and runs in the process that starts,
//! before any daemon does.

#![forbid(unsafe_code)]

use std::{
    collections::BTreeMap,
    ffi::{OsStr, OsString},
    path::{Path, PathBuf},
};

mod builder;
mod daemon_env;
mod daemon_location;
pub(crate) mod elevated;
mod error;
mod files;
mod model;
mod names;
mod resolve;
pub(crate) mod rules_file;
mod sources;
mod summary;
#[cfg(test)]
mod tests;
mod topics;
mod values;

use daemon_env::DaemonEnv;
use sources::Given;

pub use crate::access::TopicPattern;
pub use builder::ConfigBuilder;
pub use daemon_location::DaemonLocation;
pub use error::ConfigError;
// `Config::resolve` reads files through these types, and tests replace them. They are for this project's crates.
#[doc(hidden)]
pub use files::{FileFacts, FileKind, Files, OsFiles};
pub use model::{
    ClassicAuth, ClassicConfig, Config, Congestion, DaemonPolicy, DiscoveryRange, KeyMode,
    LinkCompression, LinkConfig, LinkPoll, PeerAddress, QkdConfig, QkdKex, QkdPeers, QuicCipher,
    Security, SecurityMode,
};
pub use summary::security_settings;
pub use topics::{TopicPriority, TopicRule};

impl Config {
    /// Returns the configuration of this process from its environment and an `axon.toml`. That is the file that
    /// `AXON_CONFIG` names. Otherwise, it is the file beside the daemon (`AXON_DAEMON_PATH`, or this program), if
    /// there is one.
    ///
    /// A process with more rights than its caller (set-uid, set-gid or file capabilities) takes no programs, files or
    /// trusted users from its environment. Such settings are errors.
    pub fn from_env() -> Result<Self, ConfigError> {
        Self::from_env_with([], None)
    }

    /// Like [`from_env`](Self::from_env), for a library that knows where its daemon is installed.
    pub fn from_env_beside(daemon: &Path) -> Result<Self, ConfigError> {
        Self::from_env_with([], Some(daemon))
    }

    /// Like [`from_env`](Self::from_env), with other values of some variables, or without them. For a library that
    /// may know where its daemon is installed.
    pub fn from_env_with(
        overrides: impl IntoIterator<Item = (&'static str, Option<OsString>)>,
        daemon: Option<&Path>,
    ) -> Result<Self, ConfigError> {
        let mut variables = environment()?;
        let overrides: BTreeMap<_, _> = overrides.into_iter().collect();
        for (name, value) in &overrides {
            match value {
                Some(value) => variables.insert(name.into(), value.clone()),
                None => variables.remove(OsStr::new(name)),
            };
        }
        let file = file_beside(variables.get(OsStr::new(DAEMON_PATH)).map(Path::new), daemon)?;
        let daemon_env = DaemonEnv::inherited(overrides, &OsFiles);
        resolve::resolve(variables, &Given::new(), file.as_deref(), &OsFiles, daemon_env)
    }

    /// Returns the configuration of this process, with the values that a builder was given.
    fn from_environment(given: Given) -> Result<Self, ConfigError> {
        let variables = environment()?;
        let daemon = match given.get(DAEMON_PATH) {
            Some(Some(path)) => Some(Path::new(path)),
            _ => variables.get(OsStr::new(DAEMON_PATH)).map(Path::new),
        };
        let file = file_beside(daemon, None)?;
        let set = given.iter().map(|(name, text)| (*name, text.as_ref().map(OsString::from)));
        let daemon_env = DaemonEnv::inherited(set, &OsFiles);
        resolve::resolve(variables, &given, file.as_deref(), &OsFiles, daemon_env)
    }

    /// Returns the configuration of an environment. Reads `default_file` if the environment names no file. This
    /// function does not read the environment of this process, and a daemon that a session starts with the
    /// configuration does not inherit it. [`builder`](Self::builder) does the same with a method for each setting.
    ///
    /// ```
    /// use axon_transport::config::{Config, OsFiles, Security};
    ///
    /// let config = Config::resolve([("ROS_DOMAIN_ID".into(), "7".into())], None, &OsFiles)?;
    /// assert_eq!(config.domain, 7);
    /// assert!(matches!(config.security, Security::Classic(_)));
    ///
    /// let misspelt = [("AXON_SECURITY_MOED".into(), "qkd".into())];
    /// let error = Config::resolve(misspelt, None, &OsFiles).unwrap_err();
    /// assert_eq!(error.variable(), "AXON_SECURITY_MOED");
    /// # Ok::<(), axon_transport::config::ConfigError>(())
    /// ```
    pub fn resolve(
        env: impl IntoIterator<Item = (OsString, OsString)>,
        default_file: Option<&Path>,
        files: &impl Files,
    ) -> Result<Self, ConfigError> {
        let env: Vec<_> = env.into_iter().collect();
        let file = default_file.filter(|path| files.facts(path).is_ok());
        let daemon_env = DaemonEnv::whole(env.iter().cloned(), file, files);
        resolve::resolve(env, &Given::new(), default_file, files, daemon_env)
    }

    /// Returns the warnings that a process with this configuration should show once.
    pub fn warnings(&self) -> Vec<String> {
        let mut warnings = Vec::new();
        match &self.security {
            Security::Classic(classic) if classic.auth == ClassicAuth::None => warnings.push(
                "AXON_CLASSIC_AUTH is none: peers are not authenticated. Traffic is protected \
                 against recording, not against an active attacker who poses as a peer; give \
                 AXON_CLASSIC_KEY and AXON_CLASSIC_TRUST to pin peers"
                    .to_owned(),
            ),
            Security::Qkd(qkd) if qkd.peers == QkdPeers::Any => warnings.push(
                "AXON_QKD_PEERS is *: every SAE that the KME shares keys with may connect"
                    .to_owned(),
            ),
            Security::Classic(_) | Security::Qkd(_) => {}
        }
        warnings.extend(self.unknown_variables());
        if self.runtime_dir.is_none() {
            warnings.push(
                "neither AXON_RUNTIME_DIR nor XDG_RUNTIME_DIR is set: the daemon keeps nothing \
                 across restarts"
                    .to_owned(),
            );
        }
        warnings
    }

    /// Returns a line about the variables that begin with `AXON_` and are not settings, or `None` if there are none.
    pub fn unknown_variables(&self) -> Option<String> {
        let names = self.unknown_variables.iter().map(|name| name.escape_debug().to_string());
        let names = names.collect::<Vec<_>>().join(", ");
        (!names.is_empty()).then(|| {
            format!(
                "ignored, since it is no setting of AXON: {names}; AXON_STRICT_ENV=1 makes it an error"
            )
        })
    }
}

/// Returns the settings of the environment that name files by a relative path, with absolute paths: a daemon leaves its
/// directory. For this project's crates.
#[doc(hidden)]
pub fn absolute_paths() -> Vec<(&'static str, Option<OsString>)> {
    let Ok(directory) = std::env::current_dir() else { return Vec::new() };
    let relative = names::PATHS.iter().filter_map(|name| {
        let value = std::env::var_os(name).filter(|value| !value.is_empty())?;
        Path::new(&value)
            .is_relative()
            .then(|| (*name, Some(directory.join(value).into_os_string())))
    });
    relative.collect()
}

const DAEMON_PATH: &str = "AXON_DAEMON_PATH";

/// Returns the environment. In a program with more rights than its caller, removes or refuses the variables that it
/// must not use.
fn environment() -> Result<BTreeMap<OsString, OsString>, ConfigError> {
    let mut variables: BTreeMap<OsString, OsString> = std::env::vars_os().collect();
    if axon_shm::internal::is_elevated() {
        elevated::restrict(&mut variables)?;
    }
    Ok(variables)
}

/// Returns the path of the `axon.toml` beside the daemon's program: the program that a setting names, otherwise the
/// one that a library knows, otherwise this program.
fn file_beside(named: Option<&Path>, known: Option<&Path>) -> Result<Option<PathBuf>, ConfigError> {
    let daemon = named.or(known).map(Path::to_path_buf).or_else(|| std::env::current_exe().ok());
    let file = daemon.map(|daemon| daemon.with_file_name("axon.toml"));
    if let Some(file) = file.as_deref().filter(|_| axon_shm::internal::is_elevated()) {
        elevated::check_default_file(file)?;
    }
    Ok(file)
}
