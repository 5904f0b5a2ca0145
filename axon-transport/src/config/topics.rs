//! `[[topic]]` of `axon.toml`: what the daemon does for topics of some names.

use super::ConfigError;
use crate::access::TopicPattern;

/// As many entries as a file may have. A topic is compared with each of them when it is matched.
const MOST: usize = 1024;
/// The names of the priorities.
const PRIORITIES: [(&str, TopicPriority); 3] =
    [("high", TopicPriority::High), ("normal", TopicPriority::Normal), ("low", TopicPriority::Low)];

/// What the daemon does for the topics and services whose names fit a pattern.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct TopicRule {
    /// Which topics and services.
    pub name: TopicPattern,
    /// What goes first between hosts.
    pub priority: TopicPriority,
}

impl TopicRule {
    /// The topics and services whose names fit have this priority.
    pub const fn new(name: TopicPattern, priority: TopicPriority) -> Self {
        Self { name, priority }
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
    if entries.len() > MOST {
        let read = entries.len().to_string();
        return Err(ConfigError::value("topic", &read, format!("{MOST} entries at most")).at(place));
    }
    let numbered = (1..).zip(entries);
    numbered.map(|(number, entry)| rule(entry, &format!("entry {number} of {place}"))).collect()
}

fn rule(entry: toml::Value, place: &str) -> Result<TopicRule, ConfigError> {
    let toml::Value::Table(entry) = entry else {
        return Err(ConfigError::name("topic", "entries that begin with [[topic]]").at(place));
    };
    let (mut name, mut priority) = (None, TopicPriority::Normal);
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
            _ => {
                let name = format!("topic.{key}");
                return Err(ConfigError::name(&name, "name, priority").at(place));
            }
        }
    }
    let missing = || ConfigError::missing("topic.name", "a topic's name, or a pattern").at(place);
    Ok(TopicRule { name: name.ok_or_else(missing)?, priority })
}

/// The priority of a topic or service: that of the first entry that its name fits.
pub(super) fn priority(rules: &[TopicRule], name: &str) -> TopicPriority {
    let first = rules.iter().find(|rule| rule.name.fits(name));
    first.map_or(TopicPriority::Normal, |rule| rule.priority)
}
