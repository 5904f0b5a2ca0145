//! Key container (clause 6.3), and the checks of its promises.

use super::json::{Object, items, text};
use super::{base64, malformed};
use crate::{Error, Key, KeyContainer, Quirks};

/// Most keys in one answer.
const MAX_KEYS: usize = 16_384;
/// Longest key_ID, bytes.
const MAX_KEY_ID: usize = 128;

/// What the request asked for, to hold the answer against.
pub(crate) enum Asked<'a> {
    /// `enc_keys`: so many keys.
    Number(usize),
    /// `dec_keys`: the keys with these IDs.
    Ids(&'a [String]),
}

/// Reads a key container and checks it against what was asked. `size`: bits of every key, where
/// the request (or the caller) named it; otherwise the keys need only be of one size.
pub(crate) fn key_container(
    body: &[u8],
    asked: &Asked<'_>,
    size: Option<u32>,
    quirks: Quirks,
) -> Result<KeyContainer, Error> {
    let mut object = Object::parse(text(body, "body")?, String::new(), quirks)?;
    let raw = items(object.need("keys")?, "keys", MAX_KEYS)?;
    let expected = match asked {
        Asked::Number(number) => *number,
        Asked::Ids(ids) => ids.len(),
    };
    if raw.len() != expected {
        return Err(check(
            "ETSI GS QKD 014 V1.1.1 clause 6.3 (keys)",
            format!("{expected} keys"),
            format!("{}", raw.len()),
        ));
    }
    let mut keys = Vec::with_capacity(raw.len());
    for (index, item) in raw.iter().enumerate() {
        keys.push(key(item.get(), index, quirks)?);
    }
    let extension = object.take_extension("key_container_extension")?;
    object.finish()?;
    check_unique(&keys)?;
    check_sizes(&keys, size)?;
    if let Asked::Ids(ids) = asked {
        keys = in_order_asked(keys, ids)?;
    }
    Ok(KeyContainer { keys, extension })
}

fn key(text: &str, index: usize, quirks: Quirks) -> Result<Key, Error> {
    let mut object = Object::parse(text, format!("keys[{index}]"), quirks)?;
    let key_id = object.need_string("key_ID")?;
    check_key_id(&key_id, &object.path("key_ID"), quirks)?;
    let secret =
        base64::decode(object.need("key")?).map_err(|why| malformed(object.path("key"), why))?;
    if secret.is_empty() {
        return Err(malformed(object.path("key"), "is empty"));
    }
    let key_id_extension = object.take_extension("key_ID_extension")?;
    let extension = object.take_extension("key_extension")?;
    object.finish()?;
    Ok(Key::new(key_id, secret, key_id_extension, extension))
}

fn check_key_id(id: &str, at: &str, quirks: Quirks) -> Result<(), Error> {
    if id.is_empty() || id.len() > MAX_KEY_ID || !id.bytes().all(|c| c.is_ascii_graphic()) {
        return Err(malformed(at, format!("is not 1 to {MAX_KEY_ID} visible ASCII characters")));
    }
    if !quirks.contains(Quirks::ANY_KEY_ID) && !is_uuid(id) {
        return Err(check(
            "ETSI GS QKD 014 V1.1.1 clause 6.3 (key_ID)",
            format!("a UUID in {at} (quirk any-key-id tolerates others)"),
            format!("{} characters that are none", id.len()),
        ));
    }
    Ok(())
}

fn is_uuid(id: &str) -> bool {
    id.len() == 36
        && id.bytes().enumerate().all(|(at, c)| match at {
            8 | 13 | 18 | 23 => c == b'-',
            _ => c.is_ascii_hexdigit(),
        })
}

fn check_unique(keys: &[Key]) -> Result<(), Error> {
    let mut ids: Vec<String> = keys.iter().map(|key| key.key_id().to_ascii_lowercase()).collect();
    ids.sort_unstable();
    match ids.windows(2).find(|pair| pair[0] == pair[1]) {
        Some(pair) => Err(check(
            "ETSI GS QKD 014 V1.1.1 clause 6.3 (key_ID)",
            "each key_ID once".to_owned(),
            format!("{} twice", pair[0]),
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

/// A KME may answer in another order and in another letter case: the caller's bytes count.
fn in_order_asked(mut keys: Vec<Key>, ids: &[String]) -> Result<Vec<Key>, Error> {
    let mut ordered = Vec::with_capacity(ids.len());
    for id in ids {
        let position = keys.iter().position(|key| key.key_id().eq_ignore_ascii_case(id));
        let Some(position) = position else {
            return Err(check(
                "ETSI GS QKD 014 V1.1.1 clause 5.4 (key_IDs)",
                format!("the key {id}, which was asked for"),
                "another key in its place".to_owned(),
            ));
        };
        let mut key = keys.swap_remove(position);
        key.set_key_id(id.clone());
        ordered.push(key);
    }
    Ok(ordered)
}

fn check(clause: &'static str, expected: String, got: String) -> Error {
    Error::Check { clause, expected, got }
}

#[cfg(test)]
mod tests;
