//! `[[topic]]` of `axon.toml`: what the daemon does for topics of some names.

use super::{ConfigError, LinkCompression, resolve::COMPRESSION};
use crate::access::{RateLimit, TopicPattern, parse::limit::rate};

/// As many entries as a file may have. A topic is compared with each of them when it is matched.
const MAX_ENTRIES: usize = 1024;
/// The names of the priorities.
const PRIORITIES: [(&str, TopicPriority); 3] =
    [("high", TopicPriority::High), ("normal", TopicPriority::Normal), ("low", TopicPriority::Low)];

/// What the daemon does for the topics and services whose names fit a pattern.
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub struct TopicRule {
    /// Which topics and services.
    pub name: TopicPattern,
    /// What goes first between hosts.
    pub priority: TopicPriority,
    /// Samples a second of each topic that go to each other host at most: the newest, and the rest is dropped.
    pub max_hz: Option<f64>,
    /// Whether samples are compressed for other hosts, where `[link] compression` has them compressed.
    pub compression: LinkCompression,
}

impl TopicRule {
    /// The topics and services whose names fit have this priority.
    pub const fn new(name: TopicPattern, priority: TopicPriority) -> Self {
        Self { name, priority, max_hz: None, compression: LinkCompression::Auto }
    }

    /// Their samples are never compressed.
    #[must_use]
    pub const fn uncompressed(mut self) -> Self {
        self.compression = LinkCompression::Never;
        self
    }

    /// Of each topic so many samples a second go to each other host at most.
    #[must_use]
    pub const fn max_hz(mut self, samples: f64) -> Self {
        self.max_hz = Some(samples);
        self
    }
}

/// What goes first where a link cannot carry all at once.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum TopicPriority {
    /// After all others.
    Low,
    /// As topics without an entry.
    #[default]
    Normal,
    /// Before all others, whatever the length of the samples.
    High,
}

/// Reads `[[topic]]`.
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
    let mut compression = LinkCompression::Auto;
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
            _ => {
                let name = format!("topic.{key}");
                let known = "name, priority, max_hz, compression";
                return Err(ConfigError::name(&name, known).at(place));
            }
        }
    }
    let missing = || ConfigError::missing("topic.name", "a topic's name, or a pattern").at(place);
    Ok(TopicRule { name: name.ok_or_else(missing)?, priority, max_hz, compression })
}

/// The first entry that the name of a topic or service fits.
pub(super) fn first<'r>(rules: &'r [TopicRule], name: &str) -> Option<&'r TopicRule> {
    rules.iter().find(|rule| rule.name.fits(name))
}

impl TopicRule {
    /// What [`max_hz`](Self::max_hz) limits.
    pub(super) fn limit(&self) -> Option<RateLimit> {
        self.max_hz.map(RateLimit::of_rate)
    }
}
