//! Restricts the settings of a set-uid, set-gid or file-capability program: its caller may name no programs, no
//! files and no trusted users.
//!
//! The caller controls the environment of such a program. The program would execute or read a path from it with
//! rights that the caller does not have.

use std::{
    collections::BTreeMap,
    ffi::{OsStr, OsString},
    os::unix::fs::MetadataExt,
    path::Path,
};

use super::{ConfigError, names};

/// Returns the settings that name programs, files, directories or trusted users.
fn refused() -> impl Iterator<Item = &'static str> {
    names::PATHS.iter().copied().chain([names::RUNTIME_DIR, names::TRUSTED_UIDS, names::QLOG])
}

const ACCEPTED: &str = "nothing from the environment: this program runs with more rights than its caller \
                        (set-uid, set-gid or file capabilities; AT_SECURE). Unset it, and write it into \
                        an axon.toml beside the daemon's program";

/// Refuses the settings of `refused`, and removes `XDG_RUNTIME_DIR`.
///
/// # Errors
/// The caller set one of these settings.
pub(super) fn restrict(variables: &mut BTreeMap<OsString, OsString>) -> Result<(), ConfigError> {
    for name in refused() {
        if let Some(value) = variables.get(OsStr::new(name)) {
            return Err(ConfigError::value(name, &value.to_string_lossy(), ACCEPTED));
        }
    }
    // Every login sets this variable, so it is not an error. The program does not use the directory.
    variables.remove(OsStr::new("XDG_RUNTIME_DIR"));
    Ok(())
}

/// Checks that the caller cannot replace the default `axon.toml`. Through a hard link, the program can
/// stand in a directory of its caller.
///
/// # Errors
/// Another user could have written the file.
pub(super) fn check_default_file(file: &Path) -> Result<(), ConfigError> {
    match std::fs::symlink_metadata(file) {
        // The file is absent, or the program cannot read it either.
        Err(_) => Ok(()),
        Ok(_) => check_owner(file).map_err(|why| {
            let accepted = format!("a file that the caller of this program cannot replace: {why}");
            ConfigError::value(names::CONFIG, &file.to_string_lossy(), accepted)
        }),
    }
}

/// Checks that only root, and the user whose rights this process has been given, can replace a file. Checks
/// the owner and mode of the file and of all directories above it.
///
/// # Errors
/// The fault and its path.
pub(crate) fn check_owner(path: &Path) -> Result<(), String> {
    if !path.is_absolute() {
        return Err(format!("{} is no absolute path", path.display()));
    }
    let path = std::fs::canonicalize(path).map_err(|e| format!("{}: {e}", path.display()))?;
    let given = rustix::process::geteuid();
    // In a set-gid program and in one with capabilities the effective user is the caller.
    let given = Some(given).filter(|given| *given != rustix::process::getuid());
    for part in path.ancestors() {
        let shown = part.display();
        let facts = std::fs::symlink_metadata(part).map_err(|e| format!("{shown}: {e}"))?;
        if facts.uid() != 0 && given.is_none_or(|given| facts.uid() != given.as_raw()) {
            return Err(format!("{shown} is user {}'s", facts.uid()));
        }
        // In a directory with the sticky bit, only a file's owner can replace it.
        let sticky = facts.is_dir() && facts.mode() & 0o1000 != 0;
        if facts.mode() & 0o022 != 0 && !sticky {
            return Err(format!("others may write {shown}"));
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::PermissionsExt;

    use super::*;

    fn environment(name: &str) -> BTreeMap<OsString, OsString> {
        [
            ("ROS_DOMAIN_ID", "3"),
            ("AXON_LOG", "info"),
            ("XDG_RUNTIME_DIR", "/run/user/1"),
            (name, "/x"),
        ]
        .into_iter()
        .map(|(name, value)| (name.into(), value.into()))
        .collect()
    }

    #[test]
    fn every_setting_that_names_a_path_is_refused() {
        for name in refused() {
            let error = restrict(&mut environment(name)).unwrap_err();
            assert_eq!(error.variable(), name);
            assert!(error.to_string().contains("AT_SECURE"), "{error}");
        }
        let mut rest = environment("AXON_MAX_MESSAGE_MB");
        restrict(&mut rest).unwrap();
        assert!(!rest.contains_key(OsStr::new("XDG_RUNTIME_DIR")) && rest.len() == 3);
    }

    /// A new setting must be checked: does its value name a path?
    #[test]
    fn no_setting_is_forgotten() {
        let paths = ["_KEY", "_TRUST", "_CA", "_CERT", "_CRL", "_PATH", "_DIR", "_FILE", "_CONFIG"];
        for name in names::SETTINGS {
            let named = paths.iter().any(|end| name.ends_with(end));
            assert!(!named || refused().any(|one| one == *name), "{name}");
        }
    }

    #[test]
    fn a_file_that_others_can_replace_is_not_taken() {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("axon.toml");
        check_default_file(&file).unwrap();
        std::fs::write(&file, "").unwrap();
        if rustix::process::geteuid().is_root() {
            check_default_file(&file).unwrap();
        } else {
            assert!(check_default_file(&file).is_err(), "it is the caller's");
        }
        std::fs::set_permissions(dir.path(), std::fs::Permissions::from_mode(0o777)).unwrap();
        let error = check_default_file(&file).unwrap_err();
        assert_eq!(error.variable(), "AXON_CONFIG");
        assert!(check_owner(Path::new("axon_daemon")).unwrap_err().contains("absolute"));
    }
}
