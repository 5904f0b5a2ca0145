//! The environment of a daemon that a session starts. The session passes its settings to that daemon only through
//! the environment.

use std::{
    collections::BTreeMap,
    ffi::{OsStr, OsString},
    path::Path,
};

use super::{files::Files, names, sources::FOREIGN};

/// The variables of a daemon that a session starts.
#[derive(Clone, Debug, Default)]
pub(crate) struct DaemonEnv {
    /// True if the daemon also inherits the settings in the session's environment, as they are when it is started.
    pub(crate) inherits: bool,
    /// Variables that have this value, or are unset, even if the session's environment differs.
    pub(crate) variables: BTreeMap<OsString, Option<OsString>>,
}

impl DaemonEnv {
    /// Returns the daemon's environment for a session that did not read its own environment: these settings alone,
    /// and no `axon.toml` except `file`.
    pub(super) fn whole(
        settings: impl IntoIterator<Item = (OsString, OsString)>,
        file: Option<&Path>,
        files: &impl Files,
    ) -> Self {
        let file = file.unwrap_or(Path::new("/dev/null"));
        let mut variables = BTreeMap::from([(names::CONFIG.into(), Some(file.into()))]);
        let is_setting = |name: &OsString| {
            let known = |name: &str| FOREIGN.contains(&name) || names::setting(name).is_ok();
            name.to_str().is_some_and(known)
        };
        variables.extend(
            settings.into_iter().filter(|(name, _)| is_setting(name)).map(|(n, v)| (n, Some(v))),
        );
        Self { inherits: false, variables }.absolute(files)
    }

    /// Returns the session's environment with these variables replaced.
    pub(super) fn inherited(
        variables: impl IntoIterator<Item = (&'static str, Option<OsString>)>,
        files: &impl Files,
    ) -> Self {
        let variables = variables.into_iter().map(|(name, value)| (name.into(), value)).collect();
        Self { inherits: true, variables }.absolute(files)
    }

    /// Makes paths absolute, because the session's process may be in another directory when it starts a daemon.
    fn absolute(mut self, files: &impl Files) -> Self {
        let Ok(directory) = files.current_dir() else { return self };
        for name in names::PATHS {
            if let Some(Some(value)) = self.variables.get_mut(OsStr::new(name))
                && !value.is_empty()
            {
                *value = directory.join(&*value).into();
            }
        }
        self
    }
}
