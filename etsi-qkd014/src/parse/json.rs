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

/// Maximum nesting; no extension of the specification needs more.
const MAX_DEPTH: usize = 32;
/// Most members of one object; the largest object of the specification has 12.
const MAX_MEMBERS: usize = 64;
/// Longest text member in bytes.
const MAX_TEXT: usize = 4096;

/// Returns an answer as text.
pub(super) fn text(body: &[u8]) -> Result<&str, Error> {
    std::str::from_utf8(body).map_err(|_| malformed("body", "is not UTF-8"))
}

/// The object that is read. It is formatted only for errors.
#[derive(Clone, Copy)]
pub(super) enum ObjectPlace {
    /// The answer itself.
    Body,
    /// The item of `keys` with this index.
    Key(usize),
}

impl fmt::Display for ObjectPlace {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Body => f.write_str("body"),
            Self::Key(index) => write!(f, "keys[{index}]"),
        }
    }
}

type Member<'a> = (Cow<'a, str>, &'a RawValue);

/// The function that handles each object of `keys`.
pub(super) type Each<'f, 'a> = dyn FnMut(ObjectPlace, &mut Object<'a>) -> Result<(), Error> + 'f;

/// One JSON object. Members are taken out by name; [`finish`](Object::finish) reports the remaining
/// ones.
pub(super) struct Object<'a> {
    at: ObjectPlace,
    members: Vec<Member<'a>>,
    quirks: Quirks,
}

impl<'a> Object<'a> {
    /// Parses `text`, which must be one object.
    pub(super) fn parse(text: &'a str, quirks: Quirks) -> Result<Self, Error> {
        Self::read(text, quirks, None)
    }

    /// Parses `text`, which must be one object. Passes each of the first `wanted` objects of its
    /// member `keys` to `each`. Also returns the number of all objects in `keys`; more than `max`
    /// is an error.
    pub(super) fn parse_keys(
        text: &'a str,
        (wanted, max): (usize, usize),
        quirks: Quirks,
        each: &mut Each<'_, 'a>,
    ) -> Result<(Self, usize), Error> {
        let mut keys = Keys { wanted, max, quirks, each, state: KeysState::Absent };
        let read = Self::read(text, quirks, Some(&mut keys));
        match (keys.state, read) {
            (KeysState::Failed(failure), _) => Err(failure),
            (KeysState::Begun, Err(Error::Malformed { reason, .. })) => {
                Err(malformed("keys", reason))
            }
            (_, Err(error)) => Err(error),
            (KeysState::Counted(count), Ok(object)) => Ok((object, count)),
            (KeysState::Absent | KeysState::Begun, Ok(_)) => Err(malformed("keys", "is missing")),
        }
    }

    fn read(text: &'a str, quirks: Quirks, keys: Option<&mut Keys<'_, 'a>>) -> Result<Self, Error> {
        let mut members = Vec::new();
        let mut deserializer = serde_json::Deserializer::from_str(text);
        Members { found: &mut members, keys }
            .deserialize(&mut deserializer)
            .and_then(|()| deserializer.end())
            .map_err(|e| malformed("body", why(&e, "what clause 6 describes")))?;
        Self::new(members, ObjectPlace::Body, quirks)
    }

    fn new(members: Vec<Member<'a>>, at: ObjectPlace, quirks: Quirks) -> Result<Self, Error> {
        let object = Self { at, members, quirks };
        for (index, (name, _)) in object.members.iter().enumerate() {
            if object.members[..index].iter().any(|(before, _)| object.same(before, name)) {
                return Err(malformed(object.path(name), "is there twice"));
            }
        }
        Ok(object)
    }

    /// Returns the name of the member `name` for errors.
    pub(super) fn path(&self, name: &str) -> String {
        // A name that a KME made up is shown only if it looks like a name, so that nothing else
        // (for example a misplaced key) gets into an error.
        let plain = |c: u8| c.is_ascii_alphanumeric() || c == b'_';
        let shown = if name.len() <= 40 && name.bytes().all(plain) { name } else { "(a member)" };
        match self.at {
            ObjectPlace::Body => shown.to_owned(),
            within => format!("{within}.{shown}"),
        }
    }

    fn same(&self, one: &str, other: &str) -> bool {
        is_same(one, other, self.quirks)
    }

    /// Takes the raw text of an optional member.
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

    /// Takes the raw text of a required member.
    pub(super) fn need(&mut self, name: &str) -> Result<&'a str, Error> {
        self.take(name)?.ok_or_else(|| malformed(self.path(name), "is missing"))
    }

    /// Takes a text member that contains no secret.
    pub(super) fn need_string(&mut self, name: &str) -> Result<String, Error> {
        let raw = self.need(name)?;
        if raw.len() > MAX_TEXT {
            return Err(malformed(self.path(name), format!("is longer than {MAX_TEXT} bytes")));
        }
        let plain = raw.strip_prefix('"').and_then(|rest| rest.strip_suffix('"'));
        match plain {
            // A string without escapes that was read as JSON before is used as it is.
            Some(plain) if !plain.contains('\\') => Ok(plain.to_owned()),
            _ => serde_json::from_str(raw)
                .map_err(|e| malformed(self.path(name), why(&e, "a string"))),
        }
    }

    /// Takes an optional count.
    pub(super) fn take_count(&mut self, name: &str) -> Result<Option<u64>, Error> {
        let Some(raw) = self.take(name)? else { return Ok(None) };
        serde_json::from_str(raw)
            .map(Some)
            .map_err(|e| malformed(self.path(name), why(&e, "a whole number from 0")))
    }

    /// Takes an object whose members a vendor defines.
    pub(super) fn take_extension(&mut self, name: &str) -> Result<Option<Value>, Error> {
        let Some(raw) = self.take(name)? else { return Ok(None) };
        if !raw.starts_with('{') && !self.quirks.contains(Quirks::ANY_EXTENSION) {
            let reason = "is not an object (quirk any-extension tolerates it)";
            return Err(malformed(self.path(name), reason));
        }
        if !is_shallow(raw) {
            let reason = format!("is nested deeper than {MAX_DEPTH} levels");
            return Err(malformed(self.path(name), reason));
        }
        serde_json::from_str(raw).map(Some).map_err(|e| malformed(self.path(name), why(&e, "JSON")))
    }

    /// Checks that the object has no other members.
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

/// Returns whether a value can be made into a [`Value`], for which serde_json recurses.
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

/// Describes an error without serde_json's text, which quotes the input and thus perhaps a key:
/// only its kind and place.
fn why(error: &serde_json::Error, expected: &str) -> String {
    let place = format!("line {} column {}", error.line(), error.column());
    match error.classify() {
        serde_json::error::Category::Eof => format!("is cut off at {place}"),
        serde_json::error::Category::Syntax => format!("is not JSON at {place}"),
        _ => format!("is not {expected}"),
    }
}

fn is_same(one: &str, other: &str, quirks: Quirks) -> bool {
    one == other || quirks.contains(Quirks::ANY_CASE_MEMBERS) && one.eq_ignore_ascii_case(other)
}

/// Reads the members of an object.
struct Members<'m, 'f, 'a> {
    found: &'m mut Vec<Member<'a>>,
    /// Set if the object is the answer: the handling of its `keys`.
    keys: Option<&'m mut Keys<'f, 'a>>,
}

impl<'a> DeserializeSeed<'a> for Members<'_, '_, 'a> {
    type Value = ();

    fn deserialize<D: Deserializer<'a>>(self, deserializer: D) -> Result<(), D::Error> {
        deserializer.deserialize_map(self)
    }
}

impl<'a> Visitor<'a> for Members<'_, '_, 'a> {
    type Value = ();

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("an object")
    }

    fn visit_map<A: MapAccess<'a>>(mut self, mut map: A) -> Result<(), A::Error> {
        while let Some(name) = map.next_key_seed(Name)? {
            match &mut self.keys {
                Some(keys) if is_same(&name, "keys", keys.quirks) => {
                    map.next_value_seed(&mut **keys)?;
                }
                _ if self.found.len() == MAX_MEMBERS => {
                    return Err(A::Error::custom("too many members"));
                }
                _ => self.found.push((name, map.next_value()?)),
            }
        }
        Ok(())
    }
}

/// Reads a member's name, which is copied only if it has escapes.
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

/// Reads the member `keys`.
struct Keys<'f, 'a> {
    wanted: usize,
    max: usize,
    quirks: Quirks,
    each: &'f mut Each<'f, 'a>,
    state: KeysState,
}

enum KeysState {
    Absent,
    Begun,
    Failed(Error),
    Counted(usize),
}

impl Keys<'_, '_> {
    /// Ends the reading. The error that serde_json makes of it is not used.
    fn fail<E: serde::de::Error>(&mut self, failure: Error) -> E {
        self.state = KeysState::Failed(failure);
        E::custom("see the failure")
    }
}

impl<'a> DeserializeSeed<'a> for &mut Keys<'_, 'a> {
    type Value = ();

    fn deserialize<D: Deserializer<'a>>(self, deserializer: D) -> Result<(), D::Error> {
        if !matches!(self.state, KeysState::Absent) {
            return Err(self.fail(malformed("keys", "is there twice")));
        }
        self.state = KeysState::Begun;
        deserializer.deserialize_seq(self)
    }
}

impl<'a> Visitor<'a> for &mut Keys<'_, 'a> {
    type Value = ();

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("an array")
    }

    fn visit_seq<A: SeqAccess<'a>>(self, mut seq: A) -> Result<(), A::Error> {
        let mut count = 0;
        // One block for the members of all objects in turn.
        let mut members = Vec::new();
        while count < self.wanted {
            let next = Members { found: &mut members, keys: None };
            if seq.next_element_seed(next)?.is_none() {
                self.state = KeysState::Counted(count);
                return Ok(());
            }
            let place = ObjectPlace::Key(count);
            let read = Object::new(members, place, self.quirks).and_then(|mut object| {
                (self.each)(place, &mut object)?;
                Ok(object.members)
            });
            members = read.map_err(|failure| self.fail(failure))?;
            members.clear();
            count += 1;
        }
        while seq.next_element::<IgnoredAny>()?.is_some() {
            count += 1;
            if count > self.max {
                let reason = format!("has more than {} items", self.max);
                return Err(self.fail(malformed("keys", reason)));
            }
        }
        self.state = KeysState::Counted(count);
        Ok(())
    }
}
