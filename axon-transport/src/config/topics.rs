//! `[[topic]]` of `axon.toml`: what the daemon does for topics of some names.

use std::fmt;

use super::ConfigError;

/// As many entries as a file may have. A topic is compared with each of them when it is matched.
const MOST: usize = 1024;
/// The longest pattern, in bytes.
const LONGEST: usize = 1024;
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

/// Names of topics: `*` stands for any characters but `/`, and `**` as a whole segment for any number of segments, none
/// included.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TopicPattern(String);

impl TopicPattern {
    /// A pattern.
    ///
    /// # Errors
    /// The text is no pattern; the error says what is one.
    pub fn new(text: &str) -> Result<Self, &'static str> {
        if text.len() > LONGEST {
            return Err("at most 1,024 bytes");
        }
        let Some(segments) = text.strip_prefix('/') else {
            return Err("a name that begins with /");
        };
        if segments.split('/').any(str::is_empty) {
            return Err("a name without an empty segment");
        }
        if segments.split('/').any(|segment| segment.contains("**") && segment != "**") {
            return Err("** as a whole segment, as in /camera/**");
        }
        Ok(Self(text.to_owned()))
    }

    /// Whether a name fits.
    pub fn fits(&self, name: &str) -> bool {
        let pattern: Vec<_> = self.0.split('/').collect();
        let name: Vec<_> = name.split('/').collect();
        fits(
            &pattern,
            &name,
            |segment| *segment == "**",
            |segment, name| segment_fits(segment, name),
        )
    }
}

impl fmt::Display for TopicPattern {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

/// Whether a segment of a name fits one of a pattern.
fn segment_fits(pattern: &str, name: &str) -> bool {
    fits(pattern.as_bytes(), name.as_bytes(), |byte| *byte == b'*', |byte, other| byte == other)
}

/// Whether `items` fit `pattern`, in which an item that `is_any` stands for any number of items. It tries the shortest
/// run for each such item and lengthens the last one alone: so the time is the product of the lengths at most.
fn fits<P, T>(
    pattern: &[P],
    items: &[T],
    is_any: impl Fn(&P) -> bool,
    is_one: impl Fn(&P, &T) -> bool,
) -> bool {
    let (mut at, mut item) = (0, 0);
    // Behind the last item of the pattern that stands for any, and the items that it was tried with.
    let mut retry: Option<(usize, usize)> = None;
    while item < items.len() {
        match pattern.get(at) {
            Some(any) if is_any(any) => {
                at += 1;
                retry = Some((at, item));
            }
            Some(one) if is_one(one, &items[item]) => {
                at += 1;
                item += 1;
            }
            _ => {
                let Some((behind, tried)) = &mut retry else { return false };
                *tried += 1;
                (at, item) = (*behind, *tried);
            }
        }
    }
    pattern[at..].iter().all(is_any)
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

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn pattern(text: &str) -> TopicPattern {
        TopicPattern::new(text).unwrap()
    }

    #[test]
    fn a_pattern_fits_whole_names() {
        for (text, name, expected) in [
            ("/cmd_vel", "/cmd_vel", true),
            ("/cmd_vel", "/cmd_vel/raw", false),
            ("/cmd_vel", "/robot/cmd_vel", false),
            ("/*/cmd_vel", "/robot/cmd_vel", true),
            ("/*/cmd_vel", "/cmd_vel", false),
            ("/*/cmd_vel", "/a/b/cmd_vel", false),
            ("/**/cmd_vel", "/a/b/cmd_vel", true),
            ("/**/cmd_vel", "/cmd_vel", true),
            ("/camera/**", "/camera", true),
            ("/camera/**", "/camera/left/image", true),
            ("/camera/**", "/cameras", false),
            ("/**", "/anything/at/all", true),
            ("/cam*/im*ge", "/camera_2/image", true),
            ("/cam*/im*ge", "/camera_2/images", false),
            ("/a*b*c", "/abcbc", true),
            ("/a*b*c", "/abcb", false),
            ("/**/a/**/b", "/x/a/y/a/b", true),
            ("/**/a/**/b", "/x/a/y/a/b/c", false),
        ] {
            assert_eq!(pattern(text).fits(name), expected, "{text} {name}");
        }
    }

    #[test]
    fn what_is_no_pattern_is_refused() {
        let long = format!("/{}", "a".repeat(LONGEST));
        for text in ["", "cmd_vel", "/", "/a//b", "/a/", "/a**", "/a/***", &long] {
            TopicPattern::new(text).unwrap_err();
        }
    }

    #[test]
    fn a_pattern_of_many_stars_takes_no_long_time() {
        let many = pattern(&format!("/{}b", "*a".repeat(500)));
        assert!(!many.fits(&format!("/{}", "a".repeat(100_000))));
        let many = pattern(&format!("/{}b", "**/a/".repeat(200)));
        assert!(!many.fits(&"/a".repeat(50_000)));
    }

    /// The definition, in exponential time.
    fn model(pattern: &[u8], name: &[u8]) -> bool {
        match (pattern.first(), name.first()) {
            (None, None) => true,
            (Some(b'*'), _) if model(&pattern[1..], name) => true,
            (Some(b'*'), Some(_)) => model(pattern, &name[1..]),
            (Some(one), Some(other)) => one == other && model(&pattern[1..], &name[1..]),
            _ => false,
        }
    }

    proptest! {
        #[test]
        fn a_segment_fits_as_the_definition_says(text in "[ab*]{0,8}", name in "[ab]{0,8}") {
            prop_assert_eq!(segment_fits(&text, &name), model(text.as_bytes(), name.as_bytes()));
        }
    }
}
