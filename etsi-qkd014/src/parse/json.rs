//! Cuts JSON text into members and items without interpreting their values.

use std::fmt;

use serde::de::{Deserializer, MapAccess, SeqAccess, Visitor};
use serde_json::Value;
use serde_json::value::RawValue;

use super::malformed;
use crate::{Error, Quirks};

/// Deeper nesting than any answer of the specification needs, extensions included.
const MAX_DEPTH: usize = 32;
/// Members of one object; the largest of the specification has 12.
const MAX_MEMBERS: usize = 64;
/// Longest text member, bytes.
const MAX_TEXT: usize = 4096;

/// An answer's text, checked for its depth.
pub(super) fn text<'a>(body: &'a [u8], what: &str) -> Result<&'a str, Error> {
    let text = std::str::from_utf8(body).map_err(|_| malformed(what, "is not UTF-8"))?;
    let mut depth = 0_usize;
    let mut bytes = text.bytes();
    while let Some(byte) = bytes.next() {
        match byte {
            b'"' => skip_string(&mut bytes),
            b'[' | b'{' => depth += 1,
            b']' | b'}' => depth = depth.saturating_sub(1),
            _ => {}
        }
        if depth > MAX_DEPTH {
            return Err(malformed(what, format!("is nested deeper than {MAX_DEPTH} levels")));
        }
    }
    Ok(text)
}

fn skip_string(bytes: &mut std::str::Bytes<'_>) {
    while let Some(byte) = bytes.next() {
        match byte {
            b'"' => return,
            b'\\' => drop(bytes.next()),
            _ => {}
        }
    }
}

/// One JSON object. Members are taken out by name; [`finish`](Object::finish) complains of what
/// is left.
pub(super) struct Object<'a> {
    at: String,
    members: Vec<(String, &'a RawValue)>,
    quirks: Quirks,
}

impl<'a> Object<'a> {
    /// `at` is how errors call the object: empty for the answer itself.
    pub(super) fn parse(text: &'a str, at: String, quirks: Quirks) -> Result<Self, Error> {
        let mut deserializer = serde_json::Deserializer::from_str(text);
        let members = deserializer
            .deserialize_map(Members)
            .and_then(|members| deserializer.end().map(|()| members))
            .map_err(|e| malformed(name_of(&at), why(&e, "a JSON object")))?;
        let mut object = Self { at, members: Vec::with_capacity(members.len()), quirks };
        for (name, value) in members {
            if object.position(&name).is_some() {
                return Err(malformed(object.path(&name), "is there twice"));
            }
            object.members.push((name, value));
        }
        Ok(object)
    }

    /// How errors call the member `name`.
    pub(super) fn path(&self, name: &str) -> String {
        // A name that a KME made up is shown only where it looks like one, so that nothing else
        // (a key in the wrong place) gets into an error.
        let plain = |c: u8| c.is_ascii_alphanumeric() || c == b'_';
        let shown = if name.len() <= 40 && name.bytes().all(plain) { name } else { "(a member)" };
        if self.at.is_empty() { shown.to_owned() } else { format!("{}.{shown}", self.at) }
    }

    fn position(&self, name: &str) -> Option<usize> {
        let any_case = self.quirks.contains(Quirks::ANY_CASE_MEMBERS);
        self.members.iter().position(|(n, _)| n == name || any_case && n.eq_ignore_ascii_case(name))
    }

    /// The raw text of a member that may be absent.
    pub(super) fn take(&mut self, name: &str) -> Result<Option<&'a str>, Error> {
        let Some(position) = self.position(name) else { return Ok(None) };
        let (_, value) = self.members.swap_remove(position);
        if value.get() == "null" {
            if self.quirks.contains(Quirks::NULL_MEMBERS) {
                return Ok(None);
            }
            return Err(malformed(self.path(name), "is null (quirk null-members tolerates it)"));
        }
        Ok(Some(value.get()))
    }

    /// The raw text of a member that must be there.
    pub(super) fn need(&mut self, name: &str) -> Result<&'a str, Error> {
        self.take(name)?.ok_or_else(|| malformed(self.path(name), "is missing"))
    }

    /// A text member that holds no secret.
    pub(super) fn need_string(&mut self, name: &str) -> Result<String, Error> {
        let raw = self.need(name)?;
        if raw.len() > MAX_TEXT {
            return Err(malformed(self.path(name), format!("is longer than {MAX_TEXT} bytes")));
        }
        serde_json::from_str(raw).map_err(|e| malformed(self.path(name), why(&e, "a string")))
    }

    /// A count that may be absent.
    pub(super) fn take_count(&mut self, name: &str) -> Result<Option<u64>, Error> {
        let Some(raw) = self.take(name)? else { return Ok(None) };
        serde_json::from_str(raw)
            .map(Some)
            .map_err(|e| malformed(self.path(name), why(&e, "a whole number from 0")))
    }

    /// Any JSON, which a vendor defines.
    pub(super) fn take_extension(&mut self, name: &str) -> Result<Option<Value>, Error> {
        let Some(raw) = self.take(name)? else { return Ok(None) };
        serde_json::from_str(raw).map(Some).map_err(|e| malformed(self.path(name), why(&e, "JSON")))
    }

    /// Nothing else may be in the object.
    pub(super) fn finish(self) -> Result<(), Error> {
        match self.members.first() {
            Some((name, _)) if !self.quirks.contains(Quirks::EXTRA_MEMBERS) => Err(malformed(
                self.path(name),
                "is no member that the specification lists (quirk extra-members ignores them)",
            )),
            _ => Ok(()),
        }
    }
}

/// The raw items of a JSON array of at most `max`.
pub(super) fn items<'a>(raw: &'a str, at: &str, max: usize) -> Result<Vec<&'a RawValue>, Error> {
    let mut deserializer = serde_json::Deserializer::from_str(raw);
    let items = deserializer
        .deserialize_seq(Items(max))
        .map_err(|e| malformed(at, why(&e, "an array, not too long")))?;
    if items.len() > max {
        return Err(malformed(at, format!("has more than {max} items")));
    }
    Ok(items)
}

fn name_of(at: &str) -> &str {
    if at.is_empty() { "body" } else { at }
}

/// serde_json's own words quote the text, which may be a key: only the kind and place are told.
fn why(error: &serde_json::Error, expected: &str) -> String {
    let place = format!("line {} column {}", error.line(), error.column());
    match error.classify() {
        serde_json::error::Category::Eof => format!("is cut off at {place}"),
        serde_json::error::Category::Syntax => format!("is not JSON at {place}"),
        _ => format!("is not {expected}"),
    }
}

struct Members;

impl<'de> Visitor<'de> for Members {
    type Value = Vec<(String, &'de RawValue)>;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("an object")
    }

    fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<Self::Value, A::Error> {
        let mut members = Vec::new();
        while let Some(member) = map.next_entry()? {
            if members.len() == MAX_MEMBERS {
                return Err(serde::de::Error::custom("too many members"));
            }
            members.push(member);
        }
        Ok(members)
    }
}

struct Items(usize);

impl<'de> Visitor<'de> for Items {
    type Value = Vec<&'de RawValue>;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("an array")
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut seq: A) -> Result<Self::Value, A::Error> {
        let mut items = Vec::new();
        while let Some(item) = seq.next_element()? {
            items.push(item);
            if items.len() > self.0 {
                // The caller counts; reading on would only cost memory.
                while seq.next_element::<serde::de::IgnoredAny>()?.is_some() {}
                break;
            }
        }
        Ok(items)
    }
}
