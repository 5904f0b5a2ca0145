//! Parses settings: one function for each kind of value.

use std::{
    net::IpAddr,
    ops::RangeInclusive,
    path::{Path, PathBuf},
    str::FromStr,
};

use super::{
    ConfigError, PeerAddress, QkdConfig, QkdPeers,
    files::{FileKind, Files},
    names,
    sources::{self, Setting, SettingOrigin, SettingSources},
};

/// Maximum number of daemon peers, user IDs or quirks.
const LONGEST_LIST: usize = 64;
/// Longest SAE ID, in bytes. The beacon and the envelope have no room for more.
const LONGEST_SAE_ID: usize = 63;
/// Longest SAE ID after percent-encoding, in bytes. The TLS identity is at most 128 bytes, of which
/// `axon-qkd-v1:`, `:` and a UUID take 49.
const LONGEST_ENCODED_SAE_ID: usize = 128 - 12 - 1 - 36;

/// Use of a file, which determines its checks.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) enum FileUse {
    /// Certificates and pins, which the daemon reads and sessions digest.
    Public,
    /// A private key. Its content is not read.
    Secret,
    /// A program to start.
    Program,
}

/// The settings, and the file system of the files that they name.
pub(super) struct Values<'a, F> {
    pub(super) sources: &'a SettingSources,
    pub(super) files: &'a F,
}

impl<F: Files> Values<'_, F> {
    pub(super) fn is_set(&self, name: &str) -> bool {
        self.sources.settings.contains_key(name)
    }

    /// Returns an error about the value of `name`, or about its absence.
    pub(super) fn refuse(&self, name: &str, accepted: impl Into<String>) -> ConfigError {
        match self.sources.settings.get(name) {
            Some(setting) => refuse(name, setting, accepted),
            None => ConfigError::missing(name, accepted),
        }
    }

    /// Returns the text of `name`. An empty text is an error.
    fn text(&self, name: &str, accepted: &str) -> Result<Option<&Setting>, ConfigError> {
        match self.sources.settings.get(name) {
            Some(setting) if setting.text.is_empty() => {
                Err(refuse(name, setting, format!("{accepted}; unset it for the default")))
            }
            other => Ok(other),
        }
    }

    /// Returns the value of one of `words`.
    pub(super) fn choice<T: Copy>(
        &self,
        name: &str,
        words: &[(&str, T)],
    ) -> Result<Option<T>, ConfigError> {
        let accepted = words.iter().map(|(word, _)| *word).collect::<Vec<_>>().join(", ");
        let Some(setting) = self.text(name, &accepted)? else { return Ok(None) };
        if let Some((_, value)) = words.iter().find(|(word, _)| *word == setting.text) {
            return Ok(Some(*value));
        }
        let close =
            names::nearest(&setting.text.to_ascii_lowercase(), words.iter().map(|(word, _)| *word));
        let hint = close.map_or(String::new(), |word| format!(" (did you mean {word}?)"));
        Err(refuse(name, setting, accepted + &hint))
    }

    /// Returns a whole number in `range`.
    pub(super) fn number(
        &self,
        name: &str,
        range: RangeInclusive<u64>,
        unit: &str,
    ) -> Result<Option<u64>, ConfigError> {
        let accepted = format!("{} to {} ({unit})", range.start(), range.end());
        let Some(setting) = self.text(name, &accepted)? else { return Ok(None) };
        match decimal(&setting.text) {
            Some(number) if range.contains(&number) => Ok(Some(number)),
            _ => Err(refuse(name, setting, accepted)),
        }
    }

    /// Returns entries separated by `;` or `,`, without duplicates. An empty text is an empty list.
    fn list<T: PartialEq>(
        &self,
        name: &str,
        accepted: &str,
        most: usize,
        parse: impl Fn(&str) -> Option<T>,
    ) -> Result<Vec<T>, ConfigError> {
        let Some(setting) = self.sources.settings.get(name) else { return Ok(Vec::new()) };
        let mut values = Vec::new();
        if setting.text.trim().is_empty() {
            return Ok(values);
        }
        for entry in setting.text.split([';', ',']).map(str::trim) {
            let Some(value) = parse(entry) else { return Err(refuse(name, setting, accepted)) };
            if !values.contains(&value) {
                values.push(value);
            }
            if values.len() > most {
                return Err(refuse(name, setting, format!("at most {most}: {accepted}")));
            }
        }
        Ok(values)
    }

    /// Returns IP addresses that a single host can have.
    pub(super) fn addresses(&self, name: &str, most: usize) -> Result<Vec<IpAddr>, ConfigError> {
        let accepted = "IP addresses separated by ; (not 0.0.0.0, ::, multicast or broadcast)";
        self.list(name, accepted, most, |entry| {
            entry.parse().ok().filter(|address: &IpAddr| match address {
                IpAddr::V4(v4) => !v4.is_unspecified() && !v4.is_multicast() && !v4.is_broadcast(),
                IpAddr::V6(v6) => !v6.is_unspecified() && !v6.is_multicast(),
            })
        })
    }

    pub(super) fn peer_addresses(&self, name: &str) -> Result<Vec<PeerAddress>, ConfigError> {
        let accepted =
            "host or host:port, separated by ; or , (IPv6 with a port as [address]:port)";
        self.list(name, accepted, LONGEST_LIST, peer_address)
    }

    pub(super) fn uids(&self, name: &str) -> Result<Vec<u32>, ConfigError> {
        self.list(name, "numeric user ids, separated by ;", LONGEST_LIST, |entry| {
            decimal(entry).and_then(|number| u32::try_from(number).ok())
        })
    }

    pub(super) fn quirks(&self, name: &str) -> Result<Vec<String>, ConfigError> {
        let known = QkdConfig::KME_QUIRKS;
        let mut quirks = self.list(name, &known.join(", "), LONGEST_LIST, |entry| {
            known.contains(&entry).then(|| entry.to_owned())
        })?;
        // Quirks are a set, and sessions and the daemon compare them.
        quirks.sort_unstable();
        Ok(quirks)
    }

    pub(super) fn sae_id(&self, name: &str) -> Result<Option<String>, ConfigError> {
        let accepted = "an SAE ID: 1 to 63 visible ASCII characters but ; , and * (at most 79 when \
                        percent-encoded)";
        let Some(setting) = self.text(name, accepted)? else { return Ok(None) };
        if is_sae_id(&setting.text) {
            return Ok(Some(setting.text.clone()));
        }
        Err(refuse(name, setting, accepted))
    }

    pub(super) fn qkd_peers(&self, name: &str) -> Result<Option<QkdPeers>, ConfigError> {
        let accepted = "SAE IDs separated by ;, or * alone for every SAE that the KME knows";
        let Some(setting) = self.text(name, accepted)? else { return Ok(None) };
        if setting.text.trim() == "*" {
            return Ok(Some(QkdPeers::Any));
        }
        let saes =
            self.list(name, accepted, 256, |entry| is_sae_id(entry).then(|| entry.to_owned()))?;
        if saes.is_empty() {
            return Err(refuse(name, setting, accepted));
        }
        Ok(Some(QkdPeers::Listed(saes)))
    }

    pub(super) fn kme_id(&self, name: &str) -> Result<Option<String>, ConfigError> {
        let accepted = "the KME's ID, the common name of its certificate: 1 to 128 printable ASCII \
                        characters";
        let Some(setting) = self.text(name, accepted)? else { return Ok(None) };
        let printable = setting.text.bytes().all(|byte| matches!(byte, b' '..=b'~'));
        if printable && setting.text.len() <= 128 {
            return Ok(Some(setting.text.clone()));
        }
        Err(refuse(name, setting, accepted))
    }

    pub(super) fn kme_url(&self, name: &str) -> Result<Option<String>, ConfigError> {
        let accepted = "https://host, https://host:port or either with a path";
        let Some(setting) = self.text(name, accepted)? else { return Ok(None) };
        if setting.text.contains('@') {
            // The text before `@` may be a password.
            let accepted = format!("{accepted}, without user or password");
            return Err(at(ConfigError::withheld(name, accepted), name, setting));
        }
        if is_https_url(&setting.text) {
            return Ok(Some(setting.text.clone()));
        }
        Err(refuse(name, setting, accepted))
    }

    /// Returns a directive list of `tracing`: levels, or `target=level`, separated by commas.
    pub(super) fn log_filter(&self, name: &str) -> Result<Option<String>, ConfigError> {
        let accepted = "error, warn, info, debug, trace, off, or target=level, separated by ,";
        let Some(setting) = self.text(name, accepted)? else { return Ok(None) };
        if setting.text.len() <= 1024 && setting.text.split(',').all(is_directive) {
            return Ok(Some(setting.text.clone()));
        }
        Err(refuse(name, setting, accepted))
    }

    /// Returns the path of a file that exists, has a mode that suits its use, and can be used.
    pub(super) fn file(&self, name: &str, usage: FileUse) -> Result<Option<PathBuf>, ConfigError> {
        let Some(setting) = self.text(name, "the path of a file")? else { return Ok(None) };
        let path = self.path(name, setting)?;
        let facts = self.files.facts(&path).map_err(|error| {
            refuse(name, setting, format!("the path of a file that exists ({error})"))
        })?;
        if facts.kind != FileKind::Regular {
            return Err(refuse(name, setting, "the path of a regular file"));
        }
        match usage {
            FileUse::Secret if facts.mode & 0o077 != 0 => Err(refuse(
                name,
                setting,
                format!(
                    "a key file that only its owner may read, mode 0600 or 0400 (it has {:04o}); \
                     chmod 600",
                    facts.mode & 0o777
                ),
            )),
            FileUse::Public if facts.mode & 0o002 != 0 => {
                Err(refuse(name, setting, "a file that not everybody may write; chmod o-w"))
            }
            FileUse::Program if facts.mode & 0o111 == 0 => {
                Err(refuse(name, setting, "a program that may be executed; chmod +x"))
            }
            FileUse::Public => match self.files.readable(&path) {
                Ok(()) => Ok(Some(path)),
                Err(error) => {
                    Err(refuse(name, setting, format!("a file that can be read ({error})")))
                }
            },
            FileUse::Secret | FileUse::Program => Ok(Some(path)),
        }
    }

    /// Returns the absolute path of a directory. The directory may be absent, but no other kind of file may
    /// be there.
    pub(super) fn directory(&self, name: &str) -> Result<Option<PathBuf>, ConfigError> {
        let Some(setting) = self.text(name, DIRECTORY)? else { return Ok(None) };
        match absolute_directory(&setting.text, self.files) {
            Some(path) => Ok(Some(path)),
            None => Err(refuse(name, setting, DIRECTORY)),
        }
    }

    fn path(&self, name: &str, setting: &Setting) -> Result<PathBuf, ConfigError> {
        let file = match &setting.origin {
            SettingOrigin::Environment | SettingOrigin::Builder => None,
            SettingOrigin::File(path) => Some(path.as_path()),
        };
        sources::absolute(name, &setting.text, file, self.files)
    }
}

/// Description of the values that [`absolute_directory`] accepts.
pub(super) const DIRECTORY: &str = "the absolute path of a directory";

/// Returns the path `text` if it is absolute and no other file than a directory is there.
pub(super) fn absolute_directory(text: &str, files: &impl Files) -> Option<PathBuf> {
    let path = PathBuf::from(text);
    let taken = files.facts(&path).is_ok_and(|facts| facts.kind != FileKind::Directory);
    (path.is_absolute() && !taken && !text.contains('\0')).then_some(path)
}

fn refuse(name: &str, setting: &Setting, accepted: impl Into<String>) -> ConfigError {
    at(ConfigError::value(name, &setting.text, accepted), name, setting)
}

fn at(error: ConfigError, name: &str, setting: &Setting) -> ConfigError {
    match &setting.origin {
        SettingOrigin::Environment => error,
        SettingOrigin::Builder => error.at(method(name)),
        SettingOrigin::File(path) => error.at(in_file(name, path)),
    }
}

/// Returns the method of the builder that sets a setting.
pub(super) fn method(name: &str) -> String {
    let name = name.strip_prefix("AXON_").or(name.strip_prefix("ROS_")).unwrap_or(name);
    let name = name.to_ascii_lowercase();
    format!("ConfigBuilder::{}", name.strip_suffix("_s").unwrap_or(&name))
}

fn in_file(name: &str, path: &Path) -> String {
    let key = name.strip_prefix("AXON_").unwrap_or(name).to_ascii_lowercase();
    format!("{key} in {}", path.display())
}

/// Parses digits only: `FromStr` would also accept a sign.
pub(super) fn decimal(text: &str) -> Option<u64> {
    let digits = !text.is_empty() && text.bytes().all(|byte| byte.is_ascii_digit());
    digits.then(|| u64::from_str(text).ok())?
}

fn is_sae_id(text: &str) -> bool {
    let unreserved = |byte: &u8| byte.is_ascii_alphanumeric() || b"-._~".contains(byte);
    let encoded: usize = text.bytes().map(|byte| if unreserved(&byte) { 1 } else { 3 }).sum();
    (1..=LONGEST_SAE_ID).contains(&text.len())
        && text.bytes().all(|byte| byte.is_ascii_graphic() && !b";,*".contains(&byte))
        && encoded <= LONGEST_ENCODED_SAE_ID
}

/// Parses `host`, `host:port`, `v4`, `v4:port`, `v6`, `[v6]` or `[v6]:port`.
fn peer_address(text: &str) -> Option<PeerAddress> {
    if let Ok(address) = text.parse::<IpAddr>() {
        return Some(PeerAddress { host: address.to_string(), port: None });
    }
    let (host, port) = match text.strip_prefix('[') {
        Some(rest) => {
            let (host, port) = rest.split_once(']')?;
            host.parse::<std::net::Ipv6Addr>().ok()?;
            match port {
                "" => (host, None),
                port => (host, Some(port.strip_prefix(':')?)),
            }
        }
        None => {
            let (host, port) = match text.split_once(':') {
                Some((host, port)) => (host, Some(port)),
                None => (text, None),
            };
            (is_host_name(host) || host.parse::<std::net::Ipv4Addr>().is_ok())
                .then_some((host, port))?
        }
    };
    let port = match port {
        Some(port) => Some(decimal(port).and_then(|p| u16::try_from(p).ok()).filter(|p| *p != 0)?),
        None => None,
    };
    Some(PeerAddress { host: host.to_owned(), port })
}

/// Returns whether `text` is a host name: labels of letters, digits, `-` and `_`, the last one not a
/// number. `10.0.0.256` is a mistyped address, not a name.
pub(super) fn is_host_name(text: &str) -> bool {
    let name = text.strip_suffix('.').unwrap_or(text);
    let label = |label: &str| {
        (1..=63).contains(&label.len())
            && label.bytes().all(|byte| byte.is_ascii_alphanumeric() || b"-_".contains(&byte))
    };
    let numeric = |label: &str| label.bytes().all(|byte| byte.is_ascii_digit());
    name.len() <= 253 && name.split('.').all(label) && !name.rsplit('.').next().is_some_and(numeric)
}

fn is_https_url(text: &str) -> bool {
    let Some(rest) = text.strip_prefix("https://") else { return false };
    let authority = rest.split('/').next().unwrap_or_default();
    text.len() <= 2048
        && text.bytes().all(|byte| byte.is_ascii_graphic() && !b"\"<>\\^`{|}?#".contains(&byte))
        && peer_address(authority).is_some()
        // A bare IPv6 address is a peer, but not an authority.
        && (authority.starts_with('[') || authority.matches(':').count() <= 1)
}

fn is_directive(text: &str) -> bool {
    let level = |word: &str| {
        ["off", "error", "warn", "info", "debug", "trace"]
            .iter()
            .any(|level| level.eq_ignore_ascii_case(word))
    };
    let target = |word: &str| {
        !word.is_empty() && word.bytes().all(|byte| byte.is_ascii_graphic() && byte != b'=')
    };
    match text.trim().rsplit_once('=') {
        Some((name, word)) => target(name) && level(word),
        None => level(text.trim()),
    }
}
