//! Files of access rules: the file that the settings name, the file of the host, and any other file that a caller
//! names.

use std::{
    io::ErrorKind,
    path::{Path, PathBuf},
};

use super::{
    ClassicAuth, Config, ConfigError, Security,
    files::{FileKind, Files, OsFiles},
    names,
    sources::is_setting_key,
    values::{FileUse, Values},
};
use crate::access::{AccessError, AccessRules, HostPattern};

/// The access rules of the host. A daemon uses them if its settings name no rules.
const OF_HOST: &str = "/etc/axon/access.toml";
/// The value of `AXON_ACCESS_FILE` for no rules, which disables those of the host as well.
const NO_FILE: &str = "/dev/null";

/// Parses the rules of a file. A file with a setting is parsed as an `axon.toml` with rules, as `AXON_CONFIG` may
/// name it. Any other file is parsed like the file of `AXON_ACCESS_FILE`.
///
/// # Errors
/// The first fault of a rule. The settings are not checked.
pub fn parse(text: &str, file: &str) -> Result<AccessRules, AccessError> {
    let table = text.parse::<toml::Table>();
    if table.is_ok_and(|table| table.keys().any(|key| is_setting_key(key))) {
        return AccessRules::parse_among_settings(text, file);
    }
    AccessRules::parse(text, file)
}

/// Returns the rules that the settings name, and the file that contains them.
pub(super) fn of_settings(
    values: &Values<'_, impl Files>,
    security: &Security,
) -> Result<(AccessRules, Option<PathBuf>), ConfigError> {
    const NAME: &str = names::ACCESS_FILE;
    let inline = &values.sources.access;
    let named = match values.sources.settings.get(NAME) {
        Some(setting) if setting.text == NO_FILE => Some(NO_FILE.into()),
        _ => values.file(NAME, FileUse::Public)?,
    };
    let (rules, file) = match named {
        Some(_) if inline.file().is_some() => {
            let accepted = "rules in one place: in this file, or in axon.toml without this setting";
            return Err(values.refuse(NAME, accepted));
        }
        Some(path) if path == Path::new(NO_FILE) => (AccessRules::default(), Some(path)),
        Some(path) => (read(&path, values.files)?, Some(path)),
        None if inline.file().is_none() => (AccessRules::default(), None),
        None => (inline.clone(), values.sources.file.as_deref().cloned()),
    };
    if let Some(file) = &file {
        check_parties(&rules, file, security)?;
    }
    Ok((rules, file))
}

impl Config {
    /// Takes the access rules of this host, `/etc/axon/access.toml`, if the settings name no rules and the file
    /// exists. A daemon calls this before it starts, because the environment of the session that started it may name
    /// no rules.
    ///
    /// For this project's crates.
    ///
    /// # Errors
    /// The file cannot be read or used. Such a file never counts as no rules.
    #[doc(hidden)]
    pub fn with_rules_of_host(self) -> Result<Self, ConfigError> {
        self.with_rules_of(Path::new(OF_HOST), &OsFiles)
    }

    pub(super) fn with_rules_of(
        mut self,
        path: &Path,
        files: &impl Files,
    ) -> Result<Self, ConfigError> {
        if self.access_file.is_some() {
            return Ok(self);
        }
        let wrong = |accepted: String| {
            let place = "not set: the rules of this host count";
            ConfigError::value(names::ACCESS_FILE, &path.to_string_lossy(), accepted).at(place)
        };
        let facts = match files.facts(path) {
            Ok(facts) => facts,
            // Only a file that certainly does not exist counts as absent.
            Err(error) if error.kind() == ErrorKind::NotFound => return Ok(self),
            Err(error) => return Err(wrong(format!("a file that can be read ({error})"))),
        };
        if facts.kind != FileKind::Regular {
            return Err(wrong("a regular file".into()));
        }
        if facts.mode & 0o002 != 0 {
            return Err(wrong("a file that not everybody may write; chmod o-w".into()));
        }
        let rules = read(path, files)?;
        check_parties(&rules, path, &self.security)?;
        (self.access, self.access_file) = (rules, Some(path.to_path_buf()));
        Ok(self)
    }
}

/// Reads a file that contains only rules.
fn read(path: &Path, files: &impl Files) -> Result<AccessRules, ConfigError> {
    const NAME: &str = names::ACCESS_FILE;
    let shown = path.to_string_lossy();
    let wrong = |what: String| ConfigError::value(NAME, &shown, what);
    let bytes = files.read(path);
    let bytes = bytes.map_err(|e| wrong(format!("a file that can be read ({e})")))?;
    let text = String::from_utf8(bytes).map_err(|_| wrong("a file in UTF-8".into()))?;
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    let rules = AccessRules::parse(&text, &name);
    rules.map_err(|error| ConfigError::rules(NAME, &error).at(&*shown))
}

/// Refuses a rule that no peer can match in this mode, because it would protect nothing.
fn check_parties(rules: &AccessRules, file: &Path, security: &Security) -> Result<(), ConfigError> {
    let unnamed = matches!(security, Security::Classic(c) if c.auth == ClassicAuth::None);
    let dead = rules.hosts().find_map(|host| match host {
        HostPattern::Name(name) if unnamed => Some((
            name.to_owned(),
            "*, local, uid: and a number, or address: and an address: with AXON_CLASSIC_AUTH=none no host \
             proves a name. Pin the hosts, or name addresses",
        )),
        HostPattern::Address(address) if !unnamed => Some((
            format!("address:{address}"),
            "names: hosts prove theirs in this mode, and rules know them by these alone",
        )),
        _ => None,
    });
    match dead {
        Some((peer, accepted)) => {
            Err(ConfigError::value("peer", &peer, accepted).at(file.display().to_string()))
        }
        None => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::access::{Principal, Verb};

    const RULES: &str = "[[deny]]\npeer = \"*\"\ncall = \"/reboot\"\n";

    #[test]
    fn rules_are_found_alone_or_among_settings_under_any_file_name() {
        for settings in [
            "",
            "quic_cipher = \"aes-256-gcm\"\n",
            "[link]\nmtu = 1400\n",
            "[[topic]]\nname = \"/a\"\n",
            "[qkd]\nsae_id = \"a\"\n",
        ] {
            let rules = parse(&format!("{settings}{RULES}"), "robot.toml").unwrap();
            let line = 3 + settings.matches('\n').count();
            let decision = rules.check(Principal::User(7), Verb::Call, "/reboot");
            assert_eq!(decision.line(), Some(line as u32), "{settings}");
        }
    }

    #[test]
    fn unknown_key_in_a_rules_file_is_refused() {
        let error = parse(&format!("{RULES}[[alow]]\npeer = \"*\"\n"), "f").unwrap_err();
        assert!(error.what.contains("unknown key \"alow\""), "{error}");
        let among = format!("security_mode = \"classic\"\n{RULES}[[allow]]\npeer = 7\n");
        assert_eq!(parse(&among, "f").unwrap_err().line, 6);
        parse("# nothing", "f").unwrap_err();
        parse("= x", "f").unwrap_err();
    }
}
