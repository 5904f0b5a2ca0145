//! Configuration: environment and `axon.toml` in, one validated [`Config`] out.
//!
//! The only place that reads the environment. A setting that is unknown, obsolete or half-given is
//! an error that names the variable, what was read and what is accepted. Validation creates
//! nothing, reads no private key, and runs in the process that starts, before any daemon does.

#![forbid(unsafe_code)]

use std::{
    collections::BTreeMap,
    ffi::{OsStr, OsString},
    path::{Path, PathBuf},
};

pub(crate) mod elevated;
mod error;
mod files;
mod model;
mod names;
mod resolve;
mod sources;
mod summary;
#[cfg(test)]
mod tests;
mod values;

pub use error::ConfigError;
pub use files::{FileFacts, FileKind, Files, OsFiles};
pub use model::{
    ClassicAuth, ClassicConfig, Config, DaemonPolicy, DiscoveryRange, KeyMode, LinkConfig,
    PeerAddress, QkdConfig, QkdPeers, Security,
};
pub use summary::security_settings;

impl Config {
    /// The configuration of this process: its environment, and the `axon.toml` that `AXON_CONFIG`
    /// names, else the one beside the daemon (`AXON_DAEMON_PATH`, or this very program), if any.
    ///
    /// A process that has more rights than its caller (set-uid, set-gid, file capabilities) takes no
    /// programs, files or users to trust from its environment: they are errors.
    pub fn from_env() -> Result<Self, ConfigError> {
        Self::from_env_with([], None)
    }

    /// As [`from_env`](Self::from_env), for a library that knows where its daemon is installed.
    pub fn from_env_beside(daemon: &Path) -> Result<Self, ConfigError> {
        Self::from_env_with([], Some(daemon))
    }

    /// As [`from_env`](Self::from_env), where these variables have another value than the
    /// environment's, or none; for a library that may know where its daemon is installed.
    pub fn from_env_with(
        overrides: impl IntoIterator<Item = (&'static str, Option<OsString>)>,
        daemon: Option<&Path>,
    ) -> Result<Self, ConfigError> {
        let mut variables: BTreeMap<OsString, OsString> = std::env::vars_os().collect();
        let is_elevated = crate::process::is_elevated();
        if is_elevated {
            elevated::restrict(&mut variables)?;
        }
        for (name, value) in overrides {
            match value {
                Some(value) => variables.insert(name.into(), value),
                None => variables.remove(OsStr::new(name)),
            };
        }
        let named = variables.get(OsStr::new("AXON_DAEMON_PATH")).map(PathBuf::from);
        let beside = named.or_else(|| match daemon {
            Some(daemon) => Some(daemon.to_path_buf()),
            None => std::env::current_exe().ok(),
        });
        let file = beside.map(|daemon| daemon.with_file_name("axon.toml"));
        if let Some(file) = file.as_deref().filter(|_| is_elevated) {
            elevated::check_default_file(file)?;
        }
        Self::resolve(variables, file.as_deref(), &OsFiles)
    }

    /// The configuration that an environment makes, with `default_file` where it names no file.
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
        resolve::resolve(env, default_file, files)
    }

    /// What whoever starts with this configuration should be told, once.
    pub fn warnings(&self) -> Vec<String> {
        let mut warnings = Vec::new();
        match &self.security {
            Security::Classic(classic) if classic.auth == ClassicAuth::None => warnings.push(
                "AXON_CLASSIC_AUTH is none: peers are not authenticated. Traffic is safe from who \
                 records it, not from who answers in a peer's place; give AXON_CLASSIC_KEY and \
                 AXON_CLASSIC_TRUST to pin peers"
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

    /// What to say about variables that begin with `AXON_` and are no settings: one line, or nothing.
    pub(crate) fn unknown_variables(&self) -> Option<String> {
        let names = self.unknown_variables.iter().map(|name| name.escape_debug().to_string());
        let names = names.collect::<Vec<_>>().join(", ");
        (!names.is_empty()).then(|| {
            format!(
                "ignored, since it is no setting of AXON: {names}; AXON_STRICT_ENV=1 makes it an error"
            )
        })
    }
}
