//! The two sources of settings, environment and `axon.toml`, merged under the settings' names.

use std::{
    collections::BTreeMap,
    ffi::{OsStr, OsString},
    path::{Path, PathBuf},
    rc::Rc,
};

use super::{
    ConfigError, TopicRule,
    files::{FileKind, Files},
    names, topics,
};
use crate::access::{AccessRules, parse::position};

/// One setting as text, before its value is checked.
#[derive(Clone, Debug)]
pub(super) struct Setting {
    pub(super) text: String,
    pub(super) origin: SettingOrigin,
}

#[derive(Clone, Debug)]
pub(super) enum SettingOrigin {
    Environment,
    /// A method of [`ConfigBuilder`](super::ConfigBuilder).
    Builder,
    File(Rc<PathBuf>),
}

/// All given settings, and the few variables of other programs that affect the configuration.
#[derive(Debug, Default)]
pub(super) struct SettingSources {
    pub(super) settings: BTreeMap<&'static str, Setting>,
    /// `ROS_*` and `XDG_RUNTIME_DIR`, from the environment alone.
    pub(super) foreign: BTreeMap<&'static str, String>,
    /// Variables that begin with `AXON_` and belong to other programs.
    pub(super) strangers: Vec<String>,
    /// The section `[qkd]` of the file, if present. Its settings apply once the mode is `qkd`.
    of_qkd: Option<BTreeMap<&'static str, Setting>>,
    /// The only settings to read. `None` means all.
    only: Option<&'static [&'static str]>,
    /// The section `[link]` of the file.
    pub(super) link: toml::Table,
    /// The entries `[[topic]]` of the file.
    pub(super) topics: Vec<TopicRule>,
    /// The access rules of the file.
    pub(super) access: AccessRules,
    pub(super) file: Option<Rc<PathBuf>>,
}

/// Values that a builder was given, spelled like environment variables. `None` hides a variable of the
/// environment.
pub(super) type Given = BTreeMap<&'static str, Option<String>>;

/// Variables of other programs that affect the configuration.
pub(super) const FOREIGN: &[&str] = &[
    "ROS_DOMAIN_ID",
    "ROS_AUTOMATIC_DISCOVERY_RANGE",
    "ROS_STATIC_PEERS",
    "ROS_LOCALHOST_ONLY",
    "XDG_RUNTIME_DIR",
];

impl SettingSources {
    /// Reads the environment, then the file that it names, or `default_file`. The environment wins over the
    /// file. A builder's `given` values replace those of the environment. `default_file` may be absent; a
    /// file that `AXON_CONFIG` names may not.
    pub(super) fn collect(
        env: impl IntoIterator<Item = (OsString, OsString)>,
        given: &Given,
        default_file: Option<&Path>,
        files: &impl Files,
    ) -> Result<Self, ConfigError> {
        let mut sources = Self::default();
        let replaced = |name: &OsString| name.to_str().is_some_and(|n| given.contains_key(n));
        sources.take_environment(env.into_iter().filter(|(name, _)| !replaced(name)))?;
        sources.take_given(given);

        let file = match sources.settings.remove(names::CONFIG) {
            Some(setting) => Some(named_file(&setting.text, files)?),
            None => match default_file.map(|path| (path, files.facts(path))) {
                Some((path, Ok(facts))) if facts.kind == FileKind::Regular => {
                    Some(path.to_path_buf())
                }
                Some((path, Ok(_))) => {
                    let read = path.to_string_lossy();
                    return Err(ConfigError::value(names::CONFIG, &read, "a regular file"));
                }
                // Only a file that certainly does not exist counts as absent.
                Some((_, Err(error))) if error.kind() == std::io::ErrorKind::NotFound => None,
                Some((path, Err(error))) => return Err(unreadable(path, &error)),
                None => None,
            },
        };
        if let Some(path) = file {
            sources.take_file(path, files)?;
        }
        Ok(sources)
    }

    fn take_environment(
        &mut self,
        env: impl IntoIterator<Item = (OsString, OsString)>,
    ) -> Result<(), ConfigError> {
        // Sorted by name, so that each run reports the same one of two defects.
        let mut ours: BTreeMap<OsString, OsString> = env
            .into_iter()
            .filter(|(name, _)| is_ours(name) || FOREIGN.iter().any(|f| name == f))
            .collect();
        let obsolete = |name: &OsString| name.to_str().is_some_and(names::is_obsolete);
        if let Some(name) = ours.keys().find(|name| obsolete(name)) {
            names::setting(&name.to_string_lossy())?;
        }
        let strict = match ours.remove(OsStr::new(names::STRICT)) {
            Some(value) => strict(&utf8(names::STRICT, &value)?)?,
            None => false,
        };
        for (name, value) in ours {
            let shown = name.to_string_lossy();
            if let Some(foreign) = FOREIGN.iter().find(|f| name == **f) {
                self.foreign.insert(foreign, utf8(&shown, &value)?);
                continue;
            }
            let setting = match names::setting(&shown) {
                Err(_) if !strict && name.to_str().is_some_and(|name| !names::resembles(name)) => {
                    self.strangers.push(shown.into_owned());
                    continue;
                }
                setting => setting?,
            };
            let text = utf8(setting, &value)?;
            self.settings.insert(setting, Setting { text, origin: SettingOrigin::Environment });
        }
        Ok(())
    }

    /// Collects the settings in `only`, and ignores errors in others. A file that cannot be used counts as
    /// absent.
    pub(super) fn collect_only(
        only: &'static [&'static str],
        env: impl IntoIterator<Item = (OsString, OsString)>,
        default_file: Option<&Path>,
        files: &impl Files,
    ) -> Result<Self, ConfigError> {
        let counts = |name: &OsString| {
            only.iter().chain(FOREIGN).chain([&names::CONFIG]).any(|known| name == known)
        };
        let env: Vec<_> = env.into_iter().filter(|(name, _)| counts(name)).collect();
        let mut sources = Self { only: Some(only), ..Self::default() };
        sources.take_environment(env)?;
        let file = match sources.settings.remove(names::CONFIG) {
            Some(setting) => named_file(&setting.text, files).ok(),
            None => default_file.map(Path::to_path_buf),
        };
        if let Some(file) = file {
            let _ = sources.take_file(file, files);
        }
        Ok(sources)
    }

    fn take_given(&mut self, given: &Given) {
        for (name, text) in given.iter().filter_map(|(name, text)| Some((*name, text.as_ref()?))) {
            if FOREIGN.contains(&name) {
                self.foreign.insert(name, text.clone());
            } else {
                let setting = Setting { text: text.clone(), origin: SettingOrigin::Builder };
                self.settings.insert(name, setting);
            }
        }
    }

    fn take_file(&mut self, path: PathBuf, files: &impl Files) -> Result<(), ConfigError> {
        let shown = path.to_string_lossy().into_owned();
        let facts = files.facts(&path).map_err(|e| unreadable(&path, &e))?;
        if facts.mode & 0o002 != 0 && facts.kind == FileKind::Regular {
            return Err(ConfigError::value(
                names::CONFIG,
                &shown,
                "a file that not everybody may write: chmod o-w",
            ));
        }
        let bytes = files.read(&path).map_err(|e| unreadable(&path, &e))?;
        let text = String::from_utf8(bytes)
            .map_err(|_| ConfigError::value(names::CONFIG, &shown, "a file in UTF-8"))?;
        let table: toml::Table = text.parse().map_err(|error: toml::de::Error| {
            let (line, column) = error.span().map_or((1, 1), |span| position(&text, span.start));
            ConfigError::value(
                names::CONFIG,
                &shown,
                format!("a file in TOML; line {line}, column {column}: {}", error.message()),
            )
        })?;

        let path = Rc::new(path);
        let mut from_file = BTreeMap::new();
        for (key, value) in table {
            let name = format!("AXON_{}", key.to_ascii_uppercase());
            if self.only.is_some_and(|only| !only.contains(&name.as_str())) {
                continue;
            }
            if key == "link" {
                let toml::Value::Table(link) = value else {
                    return Err(ConfigError::name("link", "a section, [link]").at(shown));
                };
                self.link = link;
                continue;
            }
            if AccessRules::is_key(&key) {
                continue;
            }
            if key == "topic" {
                self.topics = topics::rules(value, &shown)?;
                continue;
            }
            if key == "qkd" {
                let toml::Value::Table(qkd) = value else {
                    return Err(ConfigError::name("qkd", "a section, [qkd]").at(shown));
                };
                let of_qkd = self.of_qkd.insert(BTreeMap::new());
                for (key, value) in qkd {
                    let (name, setting) = setting_of_file(&key, value, &path)?;
                    if !names::QKD_ONLY.contains(&name) {
                        let accepted =
                            "the settings of qkd in [qkd]; put this one above all sections";
                        let place = format!("{key} in {shown}");
                        return Err(ConfigError::name(name, accepted).at(place));
                    }
                    of_qkd.insert(name, setting);
                }
                continue;
            }
            let (name, setting) = setting_of_file(&key, value, &path)?;
            from_file.insert(name, setting);
        }
        let of_qkd = self.of_qkd.iter().flat_map(BTreeMap::keys);
        if let Some(name) = of_qkd.copied().find(|name| from_file.contains_key(name)) {
            let accepted = "one of the two, in [qkd] or above all sections";
            return Err(ConfigError::name(name, accepted).at(shown));
        }
        for (name, setting) in from_file {
            self.settings.entry(name).or_insert(setting);
        }
        if self.only.is_none() {
            let name = path.file_name().unwrap_or_default().to_string_lossy();
            self.access = AccessRules::parse_among_settings(&text, &name)
                .map_err(|error| ConfigError::rules(names::CONFIG, &error).at(shown))?;
        }
        self.file = Some(path);
        Ok(())
    }

    /// Returns whether the file has a section `[qkd]`.
    pub(super) fn has_qkd(&self) -> bool {
        self.of_qkd.is_some()
    }

    /// Adds the settings of the file's section `[qkd]`, because the mode is `qkd`. Existing settings win.
    pub(super) fn enter_qkd(&mut self) {
        for (name, setting) in self.of_qkd.take().unwrap_or_default() {
            self.settings.entry(name).or_insert(setting);
        }
    }
}

/// Returns whether all unknown `AXON_` variables are refused, even those that resemble no setting.
fn strict(text: &str) -> Result<bool, ConfigError> {
    match text {
        "0" => Ok(false),
        "1" => Ok(true),
        other => Err(ConfigError::value(names::STRICT, other, "0, 1")),
    }
}

/// Returns the setting of a key in the file. The text is spelled like an environment variable.
fn setting_of_file(
    key: &str,
    value: toml::Value,
    file: &Rc<PathBuf>,
) -> Result<(&'static str, Setting), ConfigError> {
    let place = format!("{key} in {}", file.display());
    let name = setting_of_key(key).map_err(|e| e.at(&*place))?;
    let text = text_of(name, value).map_err(|e| e.at(&*place))?;
    Ok((name, Setting { text, origin: SettingOrigin::File(Rc::clone(file)) }))
}

/// Returns whether a top-level key of a file belongs to the settings.
pub(super) fn is_setting_key(key: &str) -> bool {
    ["link", "qkd", "topic"].contains(&key) || setting_of_key(key).is_ok()
}

fn is_ours(name: &OsStr) -> bool {
    name.as_encoded_bytes().starts_with(b"AXON_")
}

fn utf8(name: &str, value: &OsStr) -> Result<String, ConfigError> {
    match value.to_str() {
        Some(text) => Ok(text.to_owned()),
        None => Err(ConfigError::withheld(name, "text in UTF-8")),
    }
}

fn named_file(text: &str, files: &impl Files) -> Result<PathBuf, ConfigError> {
    let accepted = "the path of an axon.toml; unset it to use the one beside the daemon";
    if text.is_empty() {
        return Err(ConfigError::value(names::CONFIG, text, accepted));
    }
    let path = absolute(names::CONFIG, text, None, files)?;
    match files.facts(&path) {
        // `/dev/null` is the usual way to disable an installed file.
        Ok(_) if path == Path::new("/dev/null") => Ok(path),
        Ok(facts) if facts.kind == FileKind::Regular => Ok(path),
        Ok(_) => Err(ConfigError::value(names::CONFIG, text, accepted)),
        Err(error) => Err(unreadable(&path, &error)),
    }
}

/// Returns `text` as an absolute path. A relative path is relative to the file that contains it, otherwise
/// to the current directory.
pub(super) fn absolute(
    name: &str,
    text: &str,
    file: Option<&Path>,
    files: &impl Files,
) -> Result<PathBuf, ConfigError> {
    let path = Path::new(text);
    if path.is_absolute() {
        return Ok(path.to_path_buf());
    }
    if let Some(parent) = file.and_then(Path::parent) {
        return Ok(parent.join(path));
    }
    match files.current_dir() {
        Ok(directory) => Ok(directory.join(path)),
        Err(_) => {
            Err(ConfigError::value(name, text, "an absolute path: there is no current directory"))
        }
    }
}

fn unreadable(path: &Path, error: &std::io::Error) -> ConfigError {
    let read = path.to_string_lossy();
    ConfigError::value(names::CONFIG, &read, format!("a file that can be read ({error})"))
}

fn setting_of_key(key: &str) -> Result<&'static str, ConfigError> {
    let upper = format!("AXON_{}", key.to_ascii_uppercase());
    if [names::CONFIG, names::STRICT].contains(&upper.as_str()) {
        return Err(ConfigError::name(&upper, "in the environment only"));
    }
    if names::LINK.contains(&upper.as_str()) {
        let key = key.strip_prefix("link_").unwrap_or(key);
        return Err(ConfigError::name(&upper, format!("{key} in the section [link]")));
    }
    // Only one spelling is valid: `QKD_Peers` beside `qkd_peers` would be two keys of one setting.
    if key.bytes().any(|byte| byte.is_ascii_uppercase()) {
        let key = key.strip_prefix("AXON_").unwrap_or(key).to_ascii_lowercase();
        return Err(ConfigError::name(&upper, format!("lower-case keys, here {key}")));
    }
    names::setting(&upper)
}

/// Returns a value of the file, spelled like an environment variable.
fn text_of(name: &str, value: toml::Value) -> Result<String, ConfigError> {
    match value {
        toml::Value::String(text) => Ok(text),
        toml::Value::Integer(number) => Ok(number.to_string()),
        toml::Value::Boolean(flag) if name == "AXON_SHM_COPY" => Ok(u8::from(flag).to_string()),
        toml::Value::Array(values) => {
            let mut texts = Vec::with_capacity(values.len());
            for value in values {
                match value {
                    toml::Value::String(text) if !text.contains([';', ',']) => texts.push(text),
                    toml::Value::Integer(number) => texts.push(number.to_string()),
                    other => return Err(wrong_type(name, &other)),
                }
            }
            Ok(texts.join(";"))
        }
        other => Err(wrong_type(name, &other)),
    }
}

fn wrong_type(name: &str, value: &toml::Value) -> ConfigError {
    let accepted = "a string, a whole number, or an array of strings without ; and ,";
    ConfigError::value(name, value.type_str(), accepted)
}
