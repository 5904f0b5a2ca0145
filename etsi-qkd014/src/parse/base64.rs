//! The value of `key`: a JSON string of base64, which is decoded without a copy that is not zeroized.

use secrecy::{ExposeSecretMut, SecretSlice};
use zeroize::Zeroizing;

/// Decodes the raw text of a JSON string with its quotes. Accepts strict RFC 4648 base64 with padding, and white space
/// between the characters. Undoes JSON escapes of base64 characters, because some serializers escape `/` or `+`.
pub(super) fn decode(raw: &str) -> Result<SecretSlice<u8>, &'static str> {
    let inner = raw
        .strip_prefix('"')
        .and_then(|rest| rest.strip_suffix('"'))
        .ok_or("is not a string")?
        .as_bytes();
    // Nearly every KME writes only base64, which is decoded in place.
    decode_text(inner).or_else(|why| {
        if inner.iter().any(|byte| is_space(*byte) || *byte == b'\\') {
            decode_text(&plain(inner)?)
        } else {
            Err(why)
        }
    })
}

/// Decodes directly into the only block that will contain the key.
pub(crate) fn decode_text(text: &[u8]) -> Result<SecretSlice<u8>, &'static str> {
    const REFUSED: &str = "is not base64 with padding (RFC 4648 section 4)";
    let padding = text.iter().rev().take(2).take_while(|byte| **byte == b'=').count();
    if !text.len().is_multiple_of(4) {
        return Err(REFUSED);
    }
    let digits = &text[..text.len() - padding];
    let mut secret = SecretSlice::from(vec![0; text.len() / 4 * 3 - padding].into_boxed_slice());
    let bytes = secret.expose_secret_mut();
    let mut values = Zeroizing::new([0; PART]);
    let mut sound = true;
    for (digits, bytes) in digits.chunks(PART).zip(bytes.chunks_mut(PART / 4 * 3)) {
        for (value, digit) in values.iter_mut().zip(digits) {
            *value = value_of(*digit);
            sound &= *value != NONE;
        }
        sound &= join(&values[..digits.len()], bytes);
    }
    if sound { Ok(secret) } else { Err(REFUSED) }
}

/// Number of characters that are decoded at a time.
const PART: usize = 64;

/// The value of a byte that is no base64 character.
const NONE: u8 = 0xff;

/// Returns the six bits of a character. Uses neither a branch nor a table: a table look-up shows in the cache which
/// part of the table it accessed.
fn value_of(digit: u8) -> u8 {
    // Adds the distance to the value if the character is in the range.
    let within = |first: u8, last: u8, value: u8| {
        let is_in = u8::from(digit.wrapping_sub(first) <= last - first);
        is_in.wrapping_neg() & digit.wrapping_sub(first).wrapping_add(value).wrapping_sub(NONE)
    };
    NONE.wrapping_add(within(b'A', b'Z', 0))
        .wrapping_add(within(b'a', b'z', 26))
        .wrapping_add(within(b'0', b'9', 52))
        .wrapping_add(within(b'+', b'+', 62))
        .wrapping_add(within(b'/', b'/', 63))
}

/// Joins each four values to three bytes, and the remaining values to one or two. Returns whether the unused bits are
/// zero.
fn join(values: &[u8], bytes: &mut [u8]) -> bool {
    let (fours, rest) = values.as_chunks::<4>();
    let (threes, last) = bytes.as_chunks_mut::<3>();
    for ([a, b, c, d], three) in fours.iter().zip(threes) {
        *three = [a << 2 | b >> 4, b << 4 | c >> 2, c << 6 | d];
    }
    match (rest, last) {
        ([a, b], [one]) => {
            *one = a << 2 | b >> 4;
            b << 4 == 0
        }
        ([a, b, c], [one, two]) => {
            (*one, *two) = (a << 2 | b >> 4, b << 4 | c >> 2);
            c << 6 == 0
        }
        _ => true,
    }
}

/// Returns the text without white space and escapes.
fn plain(inner: &[u8]) -> Result<Zeroizing<Vec<u8>>, &'static str> {
    let mut text = Zeroizing::new(Vec::with_capacity(inner.len()));
    let mut at = 0;
    while at < inner.len() {
        let (byte, taken) = match inner[at] {
            b'\\' => unescape(&inner[at..]).ok_or("has an escape that is no base64 character")?,
            plain => (plain, 1),
        };
        at += taken;
        if !is_space(byte) {
            text.push(byte);
        }
    }
    Ok(text)
}

fn is_space(byte: u8) -> bool {
    matches!(byte, b' ' | b'\t' | b'\r' | b'\n')
}

/// Decodes one JSON escape at the start of `text`. Returns its byte, and the length of the escape.
fn unescape(text: &[u8]) -> Option<(u8, usize)> {
    match text.get(1)? {
        b'/' => Some((b'/', 2)),
        b'n' => Some((b'\n', 2)),
        b'r' => Some((b'\r', 2)),
        b't' => Some((b'\t', 2)),
        b'u' => {
            let hex = std::str::from_utf8(text.get(2..6)?).ok()?;
            let byte = u8::try_from(u16::from_str_radix(hex, 16).ok()?).ok()?;
            byte.is_ascii().then_some((byte, 6))
        }
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use base64::Engine;
    use base64::engine::general_purpose::STANDARD;
    use proptest::prelude::*;
    use secrecy::ExposeSecret;

    #[test]
    fn decoder_refuses_non_strict_base64() {
        for bad in [
            "",
            "\"",
            "1",
            "null",
            "[]",
            "\"A\"",
            "\"AA\"",
            "\"AAA\"",
            "\"AA=\"",
            "\"AA==AA==\"",
            "\"AB==\"", // trailing bits that are not zero
            "\"AA-_\"",
            "\"AAA=\\\"\"",
            "\"\\u00e9AAA\"",
            "\"\\u00\"",
            "\"\\\"",
            "\"A\u{e9}AA\"",
        ] {
            assert!(decode(bad).is_err(), "{bad}");
        }
    }

    #[test]
    fn it_undoes_white_space_and_escapes() {
        let plain = decode("\"+/+/AA==\"").unwrap();
        for same in ["\"+/+/\\r\\nAA==\"", "\"\\u002b\\/\\u002B\\/AA\\u003d=\"", "\" +/+/ AA== \""]
        {
            assert_eq!(decode(same).unwrap().expose_secret(), plain.expose_secret(), "{same}");
        }
    }

    #[test]
    fn every_byte_has_the_value_of_the_standard() {
        let alphabet = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
        for byte in 0..=u8::MAX {
            let place = alphabet.iter().position(|c| *c == byte);
            assert_eq!(value_of(byte), place.map_or(NONE, |place| place as u8), "{byte}");
        }
    }

    proptest! {
        #[test]
        fn any_text_is_decoded_without_panic(text: String) {
            let _ = decode(&text);
            let _ = decode(&format!("\"{text}\""));
        }

        #[test]
        fn decoder_agrees_with_the_reference(text in "[A-Za-z0-9+/]{0,9}[A-Za-z0-9+/=_ -]{0,4}") {
            for text in [text.clone(), text.repeat(16)] {
                let (ours, theirs) = (decode_text(text.as_bytes()), STANDARD.decode(&text));
                prop_assert_eq!(ours.ok().map(|secret| secret.expose_secret().to_vec()), theirs.ok());
            }
        }

        #[test]
        fn base64_survives_a_round_trip(bytes: Vec<u8>) {
            let text = format!("\"{}\"", STANDARD.encode(&bytes));
            let decoded = decode(&text).unwrap();
            prop_assert_eq!(decoded.expose_secret(), &bytes[..]);
        }
    }
}
