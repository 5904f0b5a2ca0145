//! The error for a refused configuration, in one line.

use std::fmt::{self, Write as _};

use crate::{access::AccessError, text::is_plain};

/// A setting that was refused: which one, what was read, what is accepted.
///
/// Its `Display` is one line and never shows a secret; a program that meets it ends with status 2.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ConfigError {
    variable: String,
    place: Option<String>,
    read: Read,
    accepted: String,
}

/// What stood where a good value should be.
#[derive(Clone, Debug, PartialEq, Eq)]
enum Read {
    Value(String),
    Missing,
    /// Set, but not to be repeated: it may be a secret.
    Withheld,
    /// The name itself is wrong.
    Name,
    /// Something in a file that holds more than settings, at this place.
    Place(String),
}

impl ConfigError {
    pub(super) fn value(variable: &str, read: &str, accepted: impl Into<String>) -> Self {
        Self::new(variable, Read::Value(read.to_owned()), accepted)
    }

    pub(super) fn missing(variable: &str, accepted: impl Into<String>) -> Self {
        Self::new(variable, Read::Missing, accepted)
    }

    pub(super) fn withheld(variable: &str, accepted: impl Into<String>) -> Self {
        Self::new(variable, Read::Withheld, accepted)
    }

    pub(super) fn name(variable: &str, accepted: impl Into<String>) -> Self {
        Self::new(variable, Read::Name, accepted)
    }

    /// Says where the setting stands when that is not the environment.
    pub(super) fn at(mut self, place: impl Into<String>) -> Self {
        self.place = Some(place.into());
        self
    }

    /// Access rules that cannot be used.
    pub(super) fn rules(variable: &str, error: &AccessError) -> Self {
        let place = format!("line {}, column {}", error.line, error.column);
        Self::new(variable, Read::Place(place), &*error.what)
    }

    fn new(variable: &str, read: Read, accepted: impl Into<String>) -> Self {
        Self { variable: variable.to_owned(), place: None, read, accepted: accepted.into() }
    }

    /// The setting's `AXON_` name (or `ROS_DOMAIN_ID`, or `link.mtu` and the like), whether it came
    /// from the environment or from `axon.toml`.
    pub fn variable(&self) -> &str {
        &self.variable
    }

    /// What was read; `None` where nothing was, and where it may be a secret.
    pub fn read(&self) -> Option<&str> {
        match &self.read {
            Read::Value(text) => Some(text),
            Read::Missing | Read::Withheld | Read::Name | Read::Place(_) => None,
        }
    }

    /// What would have been accepted, and what to do.
    pub fn accepted(&self) -> &str {
        &self.accepted
    }
}

impl fmt::Display for ConfigError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        OneLine(&self.variable).fmt(f)?;
        if let Some(place) = &self.place {
            write!(f, " ({})", OneLine(place))?;
        }
        match &self.read {
            Read::Value(text) => write!(f, ": read \"{}\"", OneLine(text))?,
            Read::Missing => f.write_str(": not set")?,
            Read::Withheld => f.write_str(": set (value not shown)")?,
            Read::Name => f.write_str(": unknown name")?,
            // What is accepted there is a sentence of its own.
            Read::Place(at) => return write!(f, ": {at}: {}", OneLine(&self.accepted)),
        }
        write!(f, ", accepted: {}", OneLine(&self.accepted))
    }
}

impl std::error::Error for ConfigError {}

/// Text from outside, escaped and cut so that it stays on one line of bearable length.
struct OneLine<'a>(&'a str);

impl fmt::Display for OneLine<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        const LONGEST: usize = 400;
        let mut chars = self.0.chars();
        for c in chars.by_ref().take(LONGEST) {
            // Quotes stay readable; control characters, line breaks and bidi marks do not get through.
            if is_plain(c) {
                f.write_char(c)?;
            } else {
                write!(f, "{}", c.escape_debug())?;
            }
        }
        if chars.next().is_some() { f.write_str("…") } else { Ok(()) }
    }
}
