//! The key container (clause 6.3), and the checks of its promises.

use std::cmp::Ordering;

use secrecy::ExposeSecret;

use super::json::{Object, ObjectPlace, text};
use super::{base64, malformed};
use crate::{Error, Key, KeyContainer, Quirks};

/// Most keys in one answer.
pub(crate) const MAX_KEYS: usize = 16_384;
/// Longest key_ID in bytes.
const MAX_KEY_ID: usize = 128;

/// The request, with which the answer is compared.
pub(crate) enum Asked<'a> {
    /// `enc_keys`: this number of keys.
    Number(usize),
    /// `dec_keys`: the keys with these IDs, which differ not only in letter case.
    Ids(&'a [String]),
}

/// Returns the minimum length of an answer with `number` keys of `size` bits, if each ID has one
/// character.
pub(crate) fn least_length(number: usize, size: Option<u32>) -> u64 {
    const AROUND: u64 = r#"{"keys":[]}"#.len() as u64;
    const EACH: u64 = r#"{"key_ID":"x","key":""},"#.len() as u64;
    let key = (u64::from(size.unwrap_or(8)) / 8).div_ceil(3) * 4;
    // There is no comma after the last key.
    AROUND + (number as u64).saturating_mul(EACH + key).saturating_sub(1)
}

/// Reads a key container and compares it with the request. `size` is the size of every key in bits,
/// if the request or the caller named it; otherwise the keys only have to be of one size.
pub(crate) fn key_container(
    body: &[u8],
    asked: &Asked<'_>,
    size: Option<u32>,
    quirks: Quirks,
) -> Result<KeyContainer, Error> {
    let expected = match asked {
        Asked::Number(number) => *number,
        Asked::Ids(ids) => ids.len(),
    };
    let mut keys = Vec::with_capacity(expected.min(MAX_KEYS));
    let bounds = (expected, MAX_KEYS);
    let (mut object, came) =
        Object::parse_keys(text(body)?, bounds, quirks, &mut |place, object| {
            keys.push(key(place, object, quirks)?);
            Ok(())
        })?;
    if came != expected {
        return Err(check(
            "ETSI GS QKD 014 V1.1.1 clause 6.3 (keys)",
            format!("{expected} keys"),
            format!("{came}"),
        ));
    }
    let extension = object.take_extension("key_container_extension")?;
    object.finish()?;
    check_sizes(&keys, size)?;
    match asked {
        Asked::Number(_) => check_unique(&keys)?,
        Asked::Ids(ids) => put_in_order(&mut keys, ids)?,
    }
    Ok(KeyContainer { keys, extension })
}

fn key(place: ObjectPlace, object: &mut Object<'_>, quirks: Quirks) -> Result<Key, Error> {
    let key_id = object.need_string("key_ID")?;
    check_key_id(&key_id, place, quirks)?;
    let secret =
        base64::decode(object.need("key")?).map_err(|why| malformed(object.path("key"), why))?;
    if secret.expose_secret().is_empty() {
        return Err(malformed(object.path("key"), "is empty"));
    }
    let key_id_extension = object.take_extension("key_ID_extension")?;
    let extension = object.take_extension("key_extension")?;
    object.finish()?;
    Ok(Key::new(key_id, secret, key_id_extension, extension))
}

fn check_key_id(id: &str, place: ObjectPlace, quirks: Quirks) -> Result<(), Error> {
    if is_uuid(id) {
        return Ok(());
    }
    if !is_key_id(id) {
        return Err(malformed(
            format!("{place}.key_ID"),
            format!("is not 1 to {MAX_KEY_ID} visible ASCII characters"),
        ));
    }
    if quirks.contains(Quirks::ANY_KEY_ID) {
        return Ok(());
    }
    Err(check(
        "ETSI GS QKD 014 V1.1.1 clause 6.3 (key_ID)",
        format!("a UUID in {place}.key_ID (quirk any-key-id tolerates others)"),
        format!("{} characters that are none", id.len()),
    ))
}

/// Returns whether an ID can be a key_ID at all, also with [`Quirks::ANY_KEY_ID`].
pub(crate) fn is_key_id(id: &str) -> bool {
    (1..=MAX_KEY_ID).contains(&id.len()) && id.bytes().all(|c| c.is_ascii_graphic())
}

pub(crate) fn is_uuid(id: &str) -> bool {
    let Ok(id) = <&[u8; 36]>::try_from(id.as_bytes()) else { return false };
    // Without an early exit, so that many characters are checked at a time.
    let fits = |(at, c): (usize, &u8)| {
        let dash = matches!(at, 8 | 13 | 18 | 23);
        (dash & (*c == b'-')) | (!dash & c.is_ascii_hexdigit())
    };
    id.iter().enumerate().map(fits).fold(true, |all, fits| all & fits)
}

/// Compares key_IDs without regard to letter case.
fn by_id(one: &str, other: &str) -> Ordering {
    let lower = |c: u8| c.to_ascii_lowercase();
    one.bytes().map(lower).cmp(other.bytes().map(lower))
}

/// Returns a key_ID that occurs twice, in any letter case.
pub(crate) fn repeated<'i>(ids: impl Iterator<Item = &'i str> + Clone) -> Option<&'i str> {
    // Nearly always the first bytes already differ.
    let mut starts: Vec<u64> = ids.clone().map(start).collect();
    starts.sort_unstable();
    if starts.windows(2).all(|pair| pair[0] != pair[1]) {
        return None;
    }
    let mut ids: Vec<&str> = ids.collect();
    ids.sort_unstable_by(|one, other| by_id(one, other));
    ids.windows(2).find(|pair| is_same(pair[0], pair[1])).map(|pair| pair[0])
}

/// Returns the first eight bytes, in lower case.
fn start(id: &str) -> u64 {
    let mut start = [0; 8];
    let length = id.len().min(8);
    start[..length].copy_from_slice(&id.as_bytes()[..length]);
    start.make_ascii_lowercase();
    u64::from_be_bytes(start)
}

fn check_unique(keys: &[Key]) -> Result<(), Error> {
    match repeated(keys.iter().map(Key::key_id)) {
        Some(id) => Err(check(
            "ETSI GS QKD 014 V1.1.1 clause 6.3 (key_ID)",
            "each key_ID once".to_owned(),
            format!("{id} twice"),
        )),
        None => Ok(()),
    }
}

fn check_sizes(keys: &[Key], size: Option<u32>) -> Result<(), Error> {
    let Some(expected) = size.map(|bits| bits as usize / 8).or(keys.first().map(Key::len)) else {
        return Ok(());
    };
    match keys.iter().find(|key| key.len() != expected) {
        Some(key) => Err(check(
            "ETSI GS QKD 014 V1.1.1 clause 6.3 (key)",
            format!("keys of {} bits", expected * 8),
            format!("{} bits for {}", key.len() * 8, key.key_id()),
        )),
        None => Ok(()),
    }
}

/// Puts the keys in the order of the request, and replaces their key_IDs by the caller's: a KME may
/// answer in another order and in another letter case. There must be as many keys as IDs.
fn put_in_order(keys: &mut Vec<Key>, ids: &[String]) -> Result<(), Error> {
    let pairs = |keys: &[Key]| keys.iter().zip(ids).all(|(key, id)| is_same(key.key_id(), id));
    if !pairs(keys) {
        check_unique(keys)?;
        keys.sort_unstable_by(|one, other| by_id(one.key_id(), other.key_id()));
        let is_missing =
            |id: &&String| keys.binary_search_by(|key| by_id(key.key_id(), id)).is_err();
        if let Some(missing) = ids.iter().find(is_missing) {
            return Err(check(
                "ETSI GS QKD 014 V1.1.1 clause 5.4 (key_IDs)",
                format!("the key {missing}, which was asked for"),
                "another key in its place".to_owned(),
            ));
        }
        let mut places: Vec<usize> = (0..ids.len()).collect();
        places.sort_unstable_by(|one, other| by_id(&ids[*one], &ids[*other]));
        let mut placed: Vec<_> = places.into_iter().zip(keys.drain(..)).collect();
        placed.sort_unstable_by_key(|(place, _)| *place);
        keys.extend(placed.into_iter().map(|(_, key)| key));
    }
    for (key, id) in keys.iter_mut().zip(ids).filter(|(key, id)| key.key_id() != *id) {
        key.set_key_id(id.clone());
    }
    Ok(())
}

fn is_same(one: &str, other: &str) -> bool {
    one == other || one.eq_ignore_ascii_case(other)
}

fn check(clause: &'static str, expected: String, got: String) -> Error {
    Error::Check { clause, expected, got }
}

#[cfg(test)]
mod tests;
