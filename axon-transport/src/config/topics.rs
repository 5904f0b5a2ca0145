//! `[[topic]]` of `axon.toml`: settings of the daemon for topics by name.

use super::{ConfigError, LinkCompression, resolve::COMPRESSION};
use crate::access::{RateLimit, TopicPattern, parse::limit::rate};

/// Maximum number of entries in a file. Matching a topic compares its name with them one by one.
const MAX_ENTRIES: usize = 1024;
/// The names of the priorities.
const PRIORITIES: [(&str, TopicPriority); 3] =
    [("high", TopicPriority::High), ("normal", TopicPriority::Normal), ("low", TopicPriority::Low)];

/// Settings of the daemon for topics and services whose names fit a pattern.
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub struct TopicRule {
    /// Names of the topics and services.
    pub name: TopicPattern,
    /// Priority of the samples between hosts.
    pub priority: TopicPriority,
    /// Maximum number of samples per second of each topic to each other host. The daemon sends the newest
    /// and drops the rest. `None` means no limit.
    pub max_hz: Option<f64>,
    /// Compression of samples for other hosts. It applies only if `[link] compression` enables compression.
    pub compression: LinkCompression,
    /// True if RELIABLE samples, requests and responses of at most 4 KiB also leave over the second path to a host, false if
    /// they do not. It applies only if `[link] paths` is 2. `None`: true, but false in `messages10`, where a copy uses up a
    /// tenth of a KME key.
    pub redundant: Option<bool>,
}

impl TopicRule {
    /// Creates a rule that gives this priority to the topics and services whose names fit.
    pub const fn new(name: TopicPattern, priority: TopicPriority) -> Self {
        Self { name, priority, max_hz: None, compression: LinkCompression::Auto, redundant: None }
    }

    /// Disables compression of the samples.
    #[must_use]
    pub const fn uncompressed(mut self) -> Self {
        self.compression = LinkCompression::Never;
        self
    }

    /// Sends each sample over one path only.
    #[must_use]
    pub const fn over_one_path(mut self) -> Self {
        self.redundant = Some(false);
        self
    }

    /// Sends each small RELIABLE sample over both paths, also in `messages10`.
    #[must_use]
    pub const fn over_both_paths(mut self) -> Self {
        self.redundant = Some(true);
        self
    }

    /// Limits each topic to `samples` per second to each other host.
    #[must_use]
    pub const fn max_hz(mut self, samples: f64) -> Self {
        self.max_hz = Some(samples);
        self
    }
}

/// Order of topics on a link that cannot carry all samples at once.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum TopicPriority {
    /// After all other topics.
    Low,
    /// The priority of topics without an entry.
    #[default]
    Normal,
    /// Before all other topics, for any length of the samples.
    High,
}

/// Parses `[[topic]]`.
pub(super) fn rules(value: toml::Value, place: &str) -> Result<Vec<TopicRule>, ConfigError> {
    let toml::Value::Array(entries) = value else {
        return Err(ConfigError::name("topic", "entries that begin with [[topic]]").at(place));
    };
    if entries.len() > MAX_ENTRIES {
        let read = entries.len().to_string();
        return Err(
            ConfigError::value("topic", &read, format!("{MAX_ENTRIES} entries at most")).at(place)
        );
    }
    let numbered = (1..).zip(entries);
    numbered.map(|(number, entry)| rule(entry, &format!("entry {number} of {place}"))).collect()
}

fn rule(entry: toml::Value, place: &str) -> Result<TopicRule, ConfigError> {
    let toml::Value::Table(entry) = entry else {
        return Err(ConfigError::name("topic", "entries that begin with [[topic]]").at(place));
    };
    let (mut name, mut priority, mut max_hz) = (None, TopicPriority::Normal, None);
    let (mut compression, mut redundant) = (LinkCompression::Auto, None);
    for (key, value) in entry {
        let read = value.as_str().unwrap_or_else(|| value.type_str());
        match key.as_str() {
            "name" => {
                let pattern = match value.as_str() {
                    Some(text) => TopicPattern::new(text),
                    None => Err("a string"),
                };
                let wrong = |what| ConfigError::value("topic.name", read, what).at(place);
                name = Some(pattern.map_err(wrong)?);
            }
            "priority" => {
                let known = PRIORITIES.iter().find(|(word, _)| *word == read);
                let accepted = || PRIORITIES.map(|(word, _)| word).join(", ");
                let wrong = || ConfigError::value("topic.priority", read, accepted()).at(place);
                priority = known.map(|(_, priority)| *priority).ok_or_else(wrong)?;
            }
            "max_hz" => {
                let read = match value {
                    toml::Value::Integer(number) => number.to_string(),
                    toml::Value::Float(number) => number.to_string(),
                    other => other.type_str().to_owned(),
                };
                let wrong = |what| ConfigError::value("topic.max_hz", &read, what).at(place);
                max_hz = Some(rate(&read).map_err(wrong)?);
            }
            "compression" => {
                let known = COMPRESSION.iter().find(|(word, _)| *word == read);
                let accepted = || COMPRESSION.map(|(word, _)| word).join(", ");
                let wrong = || ConfigError::value("topic.compression", read, accepted()).at(place);
                compression = known.map(|(_, compression)| *compression).ok_or_else(wrong)?;
            }
            "redundant" => {
                let wrong =
                    || ConfigError::value("topic.redundant", read, "true or false").at(place);
                redundant = Some(value.as_bool().ok_or_else(wrong)?);
            }
            _ => {
                let name = format!("topic.{key}");
                let known = "name, priority, max_hz, compression, redundant";
                return Err(ConfigError::name(&name, known).at(place));
            }
        }
    }
    let missing = || ConfigError::missing("topic.name", "a topic's name, or a pattern").at(place);
    Ok(TopicRule { name: name.ok_or_else(missing)?, priority, max_hz, compression, redundant })
}

/// Returns the first entry that fits the name of a topic or service.
pub(super) fn first<'r>(rules: &'r [TopicRule], name: &str) -> Option<&'r TopicRule> {
    rules.iter().find(|rule| rule.name.fits(name))
}

impl TopicRule {
    /// Returns the limit that [`max_hz`](Self::max_hz) sets.
    pub(super) fn limit(&self) -> Option<RateLimit> {
        self.max_hz.map(RateLimit::of_rate)
    }
}
