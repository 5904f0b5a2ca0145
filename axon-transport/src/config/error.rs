//! The error for a refused configuration, in one line.

use std::fmt::{self, Write as _};

use crate::{access::AccessError, text::is_plain};

/// A refused setting: its name, the value that was read, and the accepted values.
///
/// The `Display` text is one line and never shows a secret. A program that gets this error exits with
/// status 2.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ConfigError {
    variable: String,
    place: Option<String>,
    read: Read,
    accepted: String,
}

/// The refused input.
#[derive(Clone, Debug, PartialEq, Eq)]
enum Read {
    Value(String),
    Missing,
    /// The setting has a value that is not shown, because it may be a secret.
    Withheld,
    /// The name itself is wrong.
    Name,
    /// The text of access rules is wrong at this place in its file.
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

    /// Sets the source of the setting if it is not the environment.
    pub(super) fn at(mut self, place: impl Into<String>) -> Self {
        self.place = Some(place.into());
        self
    }

    /// Creates the error for access rules that cannot be used.
    pub(super) fn rules(variable: &str, error: &AccessError) -> Self {
        let place = format!("line {}, column {}", error.line, error.column);
        Self::new(variable, Read::Place(place), &*error.what)
    }

    fn new(variable: &str, read: Read, accepted: impl Into<String>) -> Self {
        Self { variable: variable.to_owned(), place: None, read, accepted: accepted.into() }
    }

    /// Returns the setting's `AXON_` name (or `ROS_DOMAIN_ID`, `link.mtu` and the like). The name is the
    /// same for the environment and for `axon.toml`.
    pub fn variable(&self) -> &str {
        &self.variable
    }

    /// Returns the value that was read. `None` if there was no value, if the value may be a secret, if a
    /// name is wrong, or if the text of access rules is wrong.
    pub fn read(&self) -> Option<&str> {
        match &self.read {
            Read::Value(text) => Some(text),
            Read::Missing | Read::Withheld | Read::Name | Read::Place(_) => None,
        }
    }

    /// Returns the accepted values and the remedy.
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
            // For access rules, `accepted` is a complete message.
            Read::Place(at) => return write!(f, ": {at}: {}", OneLine(&self.accepted)),
        }
        write!(f, ", accepted: {}", OneLine(&self.accepted))
    }
}

impl std::error::Error for ConfigError {}

/// External text, escaped so that it stays on one line, and truncated after `LONGEST` characters.
struct OneLine<'a>(&'a str);

impl fmt::Display for OneLine<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        const LONGEST: usize = 400;
        let mut chars = self.0.chars();
        for c in chars.by_ref().take(LONGEST) {
            // Quotes stay readable. Control characters, line breaks and bidi marks are escaped.
            if is_plain(c) {
                f.write_char(c)?;
            } else {
                write!(f, "{}", c.escape_debug())?;
            }
        }
        if chars.next().is_some() { f.write_str("…") } else { Ok(()) }
    }
}
