//! Cuts JSON text into members and items without interpreting their values.

use std::borrow::Cow;
use std::fmt;

use serde::de::{
    DeserializeSeed, Deserializer, Error as _, IgnoredAny, MapAccess, SeqAccess, Visitor,
};
use serde_json::Value;
use serde_json::value::RawValue;

use super::malformed;
use crate::{Error, Quirks};

/// Deeper nesting than any answer of the specification needs in an extension.
const MAX_DEPTH: usize = 32;
/// Members of one object; the largest of the specification has 12.
const MAX_MEMBERS: usize = 64;
/// Longest text member, bytes.
const MAX_TEXT: usize = 4096;

/// An answer as text.
pub(super) fn text(body: &[u8]) -> Result<&str, Error> {
    std::str::from_utf8(body).map_err(|_| malformed("body", "is not UTF-8"))
}

/// Which object is read: put into words only where there is an error to tell.
#[derive(Clone, Copy)]
pub(super) enum Place {
    /// The answer itself.
    Body,
    /// The item of `keys` with this index.
    Key(usize),
}

impl fmt::Display for Place {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Body => f.write_str("body"),
            Self::Key(index) => write!(f, "keys[{index}]"),
        }
    }
}

type Member<'a> = (Cow<'a, str>, &'a RawValue);

/// One JSON object. Members are taken out by name; [`finish`](Object::finish) complains of what
/// is left.
pub(super) struct Object<'a> {
    at: Place,
    members: Vec<Member<'a>>,
    quirks: Quirks,
}

impl<'a> Object<'a> {
    /// The object that is all of `text`.
    pub(super) fn parse(text: &'a str, quirks: Quirks) -> Result<Self, Error> {
        let mut members = Vec::new();
        let mut deserializer = serde_json::Deserializer::from_str(text);
        Members(&mut members)
            .deserialize(&mut deserializer)
            .and_then(|()| deserializer.end())
            .map_err(|e| malformed("body", why(&e, "a JSON object")))?;
        Self::new(members, Place::Body, quirks)
    }

    fn new(members: Vec<Member<'a>>, at: Place, quirks: Quirks) -> Result<Self, Error> {
        let object = Self { at, members, quirks };
        for (index, (name, _)) in object.members.iter().enumerate() {
            if object.members[..index].iter().any(|(before, _)| object.same(before, name)) {
                return Err(malformed(object.path(name), "is there twice"));
            }
        }
        Ok(object)
    }

    /// How errors call the member `name`.
    pub(super) fn path(&self, name: &str) -> String {
        // A name that a KME made up is shown only where it looks like one, so that nothing else
        // (a key in the wrong place) gets into an error.
        let plain = |c: u8| c.is_ascii_alphanumeric() || c == b'_';
        let shown = if name.len() <= 40 && name.bytes().all(plain) { name } else { "(a member)" };
        match self.at {
            Place::Body => shown.to_owned(),
            within => format!("{within}.{shown}"),
        }
    }

    fn same(&self, one: &str, other: &str) -> bool {
        one == other
            || self.quirks.contains(Quirks::ANY_CASE_MEMBERS) && one.eq_ignore_ascii_case(other)
    }

    /// The raw text of a member that may be absent.
    pub(super) fn take(&mut self, name: &str) -> Result<Option<&'a str>, Error> {
        let found = self.members.iter().position(|(known, _)| self.same(known, name));
        let Some(position) = found else { return Ok(None) };
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
        if !is_shallow(raw) {
            let reason = format!("is nested deeper than {MAX_DEPTH} levels");
            return Err(malformed(self.path(name), reason));
        }
        serde_json::from_str(raw).map(Some).map_err(|e| malformed(self.path(name), why(&e, "JSON")))
    }

    /// Nothing else may be in the object.
    pub(super) fn finish(&self) -> Result<(), Error> {
        match self.members.first() {
            Some((name, _)) if !self.quirks.contains(Quirks::EXTRA_MEMBERS) => Err(malformed(
                self.path(name),
                "is no member that the specification lists (quirk extra-members ignores them)",
            )),
            _ => Ok(()),
        }
    }
}

/// Hands the objects of a JSON array to `each`, but for those after the first `wanted`, and says
/// how many there are. What is larger than `max` is not looked through.
pub(super) fn objects<'a>(
    raw: &'a str,
    (wanted, max): (usize, usize),
    quirks: Quirks,
    each: impl FnMut(Place, &mut Object<'a>) -> Result<(), Error>,
) -> Result<usize, Error> {
    let mut failure = None;
    let mut items = Items { wanted, max, quirks, each, failure: &mut failure };
    let counted = serde_json::Deserializer::from_str(raw).deserialize_seq(&mut items);
    match (failure, counted) {
        (Some(failure), _) => Err(failure),
        (None, counted) => {
            counted.map_err(|e| malformed("keys", why(&e, "an array of objects, not too long")))
        }
    }
}

/// Whether a value may be made into a [`Value`], for which serde_json goes into the depth.
pub(super) fn is_shallow(raw: &str) -> bool {
    let mut depth = 0_usize;
    let mut bytes = raw.bytes();
    while let Some(byte) = bytes.next() {
        match byte {
            b'"' => skip_string(&mut bytes),
            b'[' | b'{' => depth += 1,
            b']' | b'}' => depth = depth.saturating_sub(1),
            _ => {}
        }
        if depth > MAX_DEPTH {
            return false;
        }
    }
    true
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

/// serde_json's own words quote the text, which may be a key: only the kind and place are told.
fn why(error: &serde_json::Error, expected: &str) -> String {
    let place = format!("line {} column {}", error.line(), error.column());
    match error.classify() {
        serde_json::error::Category::Eof => format!("is cut off at {place}"),
        serde_json::error::Category::Syntax => format!("is not JSON at {place}"),
        _ => format!("is not {expected}"),
    }
}

/// Reads the members of an object.
struct Members<'m, 'a>(&'m mut Vec<Member<'a>>);

impl<'a> DeserializeSeed<'a> for Members<'_, 'a> {
    type Value = ();

    fn deserialize<D: Deserializer<'a>>(self, deserializer: D) -> Result<(), D::Error> {
        deserializer.deserialize_map(self)
    }
}

impl<'a> Visitor<'a> for Members<'_, 'a> {
    type Value = ();

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("an object")
    }

    fn visit_map<A: MapAccess<'a>>(self, mut map: A) -> Result<(), A::Error> {
        while let Some(name) = map.next_key_seed(Name)? {
            if self.0.len() == MAX_MEMBERS {
                return Err(A::Error::custom("too many members"));
            }
            self.0.push((name, map.next_value()?));
        }
        Ok(())
    }
}

/// Reads a member's name, which is copied only where it has escapes.
struct Name;

impl<'a> DeserializeSeed<'a> for Name {
    type Value = Cow<'a, str>;

    fn deserialize<D: Deserializer<'a>>(self, deserializer: D) -> Result<Self::Value, D::Error> {
        deserializer.deserialize_str(self)
    }
}

impl<'a> Visitor<'a> for Name {
    type Value = Cow<'a, str>;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("a name")
    }

    fn visit_borrowed_str<E>(self, name: &'a str) -> Result<Self::Value, E> {
        Ok(Cow::Borrowed(name))
    }

    fn visit_str<E>(self, name: &str) -> Result<Self::Value, E> {
        Ok(Cow::Owned(name.to_owned()))
    }
}

struct Items<'f, F> {
    wanted: usize,
    max: usize,
    quirks: Quirks,
    each: F,
    failure: &'f mut Option<Error>,
}

impl<'a, F: FnMut(Place, &mut Object<'a>) -> Result<(), Error>> Visitor<'a> for &mut Items<'_, F> {
    type Value = usize;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("an array")
    }

    fn visit_seq<A: SeqAccess<'a>>(self, mut seq: A) -> Result<usize, A::Error> {
        let mut count = 0;
        // One block for the members of all objects, one after the other.
        let mut members = Vec::new();
        while count < self.wanted {
            if seq.next_element_seed(Members(&mut members))?.is_none() {
                return Ok(count);
            }
            let place = Place::Key(count);
            let read = Object::new(members, place, self.quirks).and_then(|mut object| {
                (self.each)(place, &mut object)?;
                Ok(object.members)
            });
            members = read.map_err(|failure| {
                *self.failure = Some(failure);
                A::Error::custom("see the failure")
            })?;
            members.clear();
            count += 1;
        }
        while seq.next_element::<IgnoredAny>()?.is_some() {
            count += 1;
            if count > self.max {
                return Err(A::Error::custom("too many items"));
            }
        }
        Ok(count)
    }
}
