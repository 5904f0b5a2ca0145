//! The names of all settings, and the error for an unknown name.

use super::ConfigError;

/// `AXON_` settings that `axon.toml` may also hold, there in lower case and without the prefix.
pub(super) const SETTINGS: &[&str] = &[
    "AXON_SECURITY_MODE",
    "AXON_QKD_KEY_MODE",
    "AXON_QKD_KEX",
    "AXON_QKD_PEERS",
    "AXON_QKD_SESSION_MAX_AGE",
    "AXON_QUIC_CIPHER",
    "AXON_CLASSIC_AUTH",
    "AXON_CLASSIC_KEY",
    "AXON_CLASSIC_TRUST",
    "AXON_CLASSIC_CA",
    "AXON_CLASSIC_CERT",
    "AXON_CLASSIC_CRL",
    "AXON_KME_URL",
    "AXON_KME_CA",
    "AXON_KME_ID",
    "AXON_KME_QUIRKS",
    "AXON_KME_CONNECT_TIMEOUT",
    "AXON_KME_ANSWER_TIMEOUT",
    "AXON_SAE_ID",
    "AXON_SAE_CERT",
    "AXON_SAE_KEY",
    "AXON_DAEMON",
    "AXON_DAEMON_PATH",
    RUNTIME_DIR,
    "AXON_BIND_ADDRS",
    "AXON_DAEMON_PEERS",
    "AXON_ADVERTISE_ADDRS",
    "AXON_RING_BUFFER_SIZE_MB",
    "AXON_MAX_MESSAGE_MB",
    "AXON_RELIABLE_QUEUE_MB",
    "AXON_SHM",
    "AXON_SHM_COPY",
    TRUSTED_UIDS,
    ACCESS_FILE,
    "AXON_LOG",
];

/// Settings of `[link]` in `axon.toml`, as variables. `AXON_LINK_MTU` is `mtu` there.
pub(super) const LINK: &[&str] = &[
    "AXON_LINK_GRACE_S",
    "AXON_LINK_STALLED_S",
    "AXON_LINK_MTU",
    "AXON_LINK_GRAPH_MB",
    "AXON_LINK_HELD_MB",
    "AXON_LINK_POLL",
    QLOG,
    "AXON_LINK_CONGESTION",
    "AXON_LINK_COMPRESSION",
    "AXON_LINK_PATHS",
];

/// Settings that name files. A relative path depends on the current directory of the process.
pub(super) const PATHS: &[&str] = &[
    CONFIG,
    "AXON_DAEMON_PATH",
    "AXON_CLASSIC_KEY",
    "AXON_CLASSIC_TRUST",
    "AXON_CLASSIC_CA",
    "AXON_CLASSIC_CERT",
    "AXON_CLASSIC_CRL",
    "AXON_KME_CA",
    "AXON_SAE_CERT",
    "AXON_SAE_KEY",
    ACCESS_FILE,
];

/// Directory for the daemon's files, always an absolute path.
pub(super) const RUNTIME_DIR: &str = "AXON_RUNTIME_DIR";

/// Directory to which the daemon writes QUIC's events, always an absolute path.
pub(super) const QLOG: &str = "AXON_LINK_QLOG";

/// A file of access rules.
pub(super) const ACCESS_FILE: &str = "AXON_ACCESS_FILE";

/// Trusted users.
pub(super) const TRUSTED_UIDS: &str = "AXON_TRUSTED_UIDS";

/// The path of `axon.toml`. The file itself cannot hold this setting.
pub(super) const CONFIG: &str = "AXON_CONFIG";

/// Settings that are valid in `qkd` only.
pub(super) const QKD_ONLY: &[&str] = &[
    "AXON_QKD_KEY_MODE",
    "AXON_QKD_KEX",
    "AXON_QKD_PEERS",
    "AXON_QKD_SESSION_MAX_AGE",
    "AXON_KME_URL",
    "AXON_KME_CA",
    "AXON_KME_ID",
    "AXON_KME_QUIRKS",
    "AXON_KME_CONNECT_TIMEOUT",
    "AXON_KME_ANSWER_TIMEOUT",
    "AXON_SAE_ID",
    "AXON_SAE_CERT",
    "AXON_SAE_KEY",
];

/// Settings that are valid in `classic` only.
pub(super) const CLASSIC_ONLY: &[&str] = &[
    "AXON_CLASSIC_AUTH",
    "AXON_CLASSIC_KEY",
    "AXON_CLASSIC_TRUST",
    "AXON_CLASSIC_CA",
    "AXON_CLASSIC_CERT",
    "AXON_CLASSIC_CRL",
];

/// Obsolete settings and their replacements.
const OBSOLETE: &[(&str, &str)] = &[
    (
        "AXON_SECURITY_PROFILE",
        "nothing, this setting is obsolete; remove it and say AXON_SECURITY_MODE=classic or \
         AXON_SECURITY_MODE=qkd",
    ),
    (
        "AXON_ENCRYPTION_MODE",
        "nothing, this setting is obsolete; remove it: encryption is always on, AXON_SECURITY_MODE \
         chooses its keys and AXON_QUIC_CIPHER its cipher",
    ),
    (
        "AXON_ENCRYPTION_KEY",
        "nothing, this setting is obsolete; remove it: keys come from the handshake or, with \
         AXON_SECURITY_MODE=qkd, from the KME, and never from a setting",
    ),
];

/// A variable of the environment only. `1` refuses every variable that begins with `AXON_` and is not a
/// setting.
pub(super) const STRICT: &str = "AXON_STRICT_ENV";

/// Words of security settings. A variable whose name contains one is never taken for another program's.
const SECURITY_WORDS: &[&str] = &[
    "AUTH",
    "AUTHENTICATION",
    "CA",
    "CERT",
    "CERTIFICATE",
    "CERTS",
    "CIPHER",
    "CLASSIC",
    "CRL",
    "ENCRYPT",
    "ENCRYPTED",
    "ENCRYPTION",
    "IDENTITY",
    "INSECURE",
    "KEX",
    "KEY",
    "KEYS",
    "KME",
    "MODE",
    "PEER",
    "PEERS",
    "PIN",
    "PINNED",
    "PINS",
    "PLAINTEXT",
    "PSK",
    "QKD",
    "SAE",
    "SECRET",
    "SECURE",
    "SECURITY",
    "TLS",
    "TRUST",
    "VERIFY",
];

/// Returns whether the environment variable `name`, which is not a setting, was meant to be one. It was if
/// it is close to a current or obsolete setting, shares its first word with one, or contains a word about
/// security.
pub(super) fn resembles(name: &str) -> bool {
    let upper = name.to_ascii_uppercase();
    let words = || upper.split('_').skip(1);
    let names = || {
        let obsolete = OBSOLETE.iter().map(|(name, _)| *name);
        SETTINGS.iter().chain(LINK).copied().chain([CONFIG, STRICT]).chain(obsolete)
    };
    let is_word = |word: &str| {
        SECURITY_WORDS
            .iter()
            .any(|known| *known == word || (known.len() > 4 && distance(word, known) == 1))
    };
    nearest_name(name, names()).is_some()
        || names().any(|known| known.split('_').nth(1) == words().next())
        || words().any(is_word)
}

/// Returns the setting called `name`, or the error for an unknown or obsolete name.
pub(super) fn setting(name: &str) -> Result<&'static str, ConfigError> {
    if let Some(known) = SETTINGS.iter().chain(LINK).chain([&CONFIG]).find(|known| **known == name)
    {
        return Ok(known);
    }
    if let Some((_, instead)) = obsolete(name) {
        // The value may be a key.
        return Err(ConfigError::withheld(name, *instead));
    }
    let close = nearest_name(name, SETTINGS.iter().chain(LINK).copied().chain([CONFIG, STRICT]));
    let accepted = match close {
        Some(close) => format!("the settings of docs/configuration.md; did you mean {close}?"),
        None => "the settings of docs/configuration.md; remove this one".to_owned(),
    };
    Err(ConfigError::name(name, accepted))
}

/// Returns whether `name` is an obsolete setting.
pub(super) fn is_obsolete(name: &str) -> bool {
    obsolete(name).is_some()
}

fn obsolete(name: &str) -> Option<&'static (&'static str, &'static str)> {
    OBSOLETE.iter().find(|(old, _)| *old == name)
}

/// Returns the name that `name` most likely meant, if any is close. Compares only the parts after `AXON_`:
/// with the common prefix, each short name would be close to every other.
fn nearest_name<'a>(name: &str, names: impl IntoIterator<Item = &'a str>) -> Option<&'a str> {
    let own = |name: &'a str| name.strip_prefix("AXON_").unwrap_or(name);
    let meant = name.strip_prefix("AXON_").unwrap_or(name);
    let names: Vec<&str> = names.into_iter().collect();
    let close = nearest(meant, names.iter().copied().map(own))?;
    names.into_iter().find(|name| own(name) == close)
}

/// Returns the candidate that `text` most likely meant, if any is close.
pub(super) fn nearest<'a>(
    text: &str,
    candidates: impl IntoIterator<Item = &'a str>,
) -> Option<&'a str> {
    // The text is longer than any name: no name is close, and computing the distance would cost time.
    if text.len() > 64 {
        return None;
    }
    candidates
        .into_iter()
        .map(|candidate| (distance(text, candidate), candidate))
        .filter(|(d, candidate)| *d <= 3 && *d * 3 <= candidate.len())
        .min()
        .map(|(_, candidate)| candidate)
}

/// Returns the number of edits (insert, delete or replace a byte) from one text to the other.
fn distance(a: &str, b: &str) -> usize {
    let mut row: Vec<usize> = (0..=b.len()).collect();
    for (i, x) in a.bytes().enumerate() {
        let mut diagonal = row[0];
        row[0] = i + 1;
        for (j, y) in b.bytes().enumerate() {
            let above = row[j + 1];
            row[j + 1] = (above + 1).min(row[j] + 1).min(diagonal + usize::from(x != y));
            diagonal = above;
        }
    }
    row[b.len()]
}
