//! Patterns of names of topics, services and nodes.

use std::fmt;

/// The longest pattern, in bytes.
const MAX_PATTERN_BYTES: usize = 1024;

/// A pattern of names of topics, services and nodes. A `*` stands for any characters except `/`. A `**` as a whole
/// segment stands for any number of segments, including none. `**` alone fits each name, even one that does not begin
/// with `/`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TopicPattern(String);

impl TopicPattern {
    /// Parses a pattern.
    ///
    /// # Errors
    /// The text is not a pattern. The error describes the accepted text.
    pub fn new(text: &str) -> Result<Self, &'static str> {
        if text.len() > MAX_PATTERN_BYTES {
            return Err("at most 1,024 bytes");
        }
        if text == "**" {
            return Ok(Self(text.to_owned()));
        }
        let Some(segments) = text.strip_prefix('/') else {
            return Err("a name that begins with /, or ** for each name");
        };
        if segments.split('/').any(str::is_empty) {
            return Err("a name without an empty segment");
        }
        if segments.split('/').any(|segment| segment.contains("**") && segment != "**") {
            return Err("** as a whole segment, as in /camera/**");
        }
        Ok(Self(text.to_owned()))
    }

    /// Returns the segments between the slashes. The first one is empty, except in `**`.
    pub(super) fn segments(&self) -> impl Iterator<Item = &str> {
        self.0.split('/')
    }

    /// Returns a pattern of the names that fit, each followed by `rest`, one segment or more.
    pub(super) fn below(&self, rest: &str) -> Self {
        Self(format!("{}/{rest}", self.0))
    }

    /// Returns whether a name fits.
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

/// Returns whether a segment of a name fits a segment of a pattern.
pub(super) fn segment_fits(pattern: &str, name: &str) -> bool {
    fits(pattern.as_bytes(), name.as_bytes(), |byte| *byte == b'*', |byte, other| byte == other)
}

/// Returns whether `items` fit `pattern`. An item of the pattern for which `is_any` holds stands for any number of
/// items. The function tries the shortest run for each such item and lengthens only the last one. The time is
/// therefore at most the product of the lengths.
fn fits<P, T>(
    pattern: &[P],
    items: &[T],
    is_any: impl Fn(&P) -> bool,
    is_one: impl Fn(&P, &T) -> bool,
) -> bool {
    let (mut at, mut item) = (0, 0);
    // The position after the last `is_any` item of the pattern, and the first of the items that were tried after it.
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
            ("/**", "without_slash", false),
            ("**", "without_slash", true),
            ("**", "/a/b", true),
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
    fn invalid_topic_patterns_are_refused() {
        let long = format!("/{}", "a".repeat(MAX_PATTERN_BYTES));
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

    /// The reference definition, in exponential time.
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
