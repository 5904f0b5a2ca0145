//! The value of `key`: a JSON string of base64, decoded without an unzeroized copy.

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use zeroize::Zeroizing;

/// Decodes the raw text of a JSON string, quotes included. Strict RFC 4648 base64 with padding;
/// white space between the characters is allowed, and JSON escapes of base64 characters are
/// undone, as serializers that escape `/` or `+` write them.
pub(super) fn decode(raw: &str) -> Result<Zeroizing<Box<[u8]>>, &'static str> {
    let inner = raw
        .strip_prefix('"')
        .and_then(|rest| rest.strip_suffix('"'))
        .ok_or("is not a string")?
        .as_bytes();
    // Nearly every KME writes nothing but base64, which is decoded where it lies.
    decode_text(inner).or_else(|why| {
        if inner.iter().any(|byte| is_space(*byte) || *byte == b'\\') {
            decode_text(&plain(inner)?)
        } else {
            Err(why)
        }
    })
}

/// Straight into the only block that will hold the key.
pub(crate) fn decode_text(text: &[u8]) -> Result<Zeroizing<Box<[u8]>>, &'static str> {
    let padding = text.iter().rev().take_while(|byte| **byte == b'=').count();
    let length = (text.len() / 4 * 3).saturating_sub(padding);
    let mut secret = Zeroizing::new(vec![0_u8; length].into_boxed_slice());
    match STANDARD.decode_slice(text, &mut secret) {
        Ok(written) if written == length => Ok(secret),
        _ => Err("is not base64 with padding (RFC 4648 section 4)"),
    }
}

/// The text without white space and escapes.
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

/// One JSON escape at the start of `text`: its byte, and how long the escape is.
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
    use proptest::prelude::*;

    #[test]
    fn it_refuses_what_is_not_strict() {
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
            assert_eq!(*decode(same).unwrap(), *plain, "{same}");
        }
    }

    proptest! {
        #[test]
        fn any_text_is_decoded_without_panic(text: String) {
            let _ = decode(&text);
            let _ = decode(&format!("\"{text}\""));
        }

        #[test]
        fn what_was_encoded_comes_back(bytes: Vec<u8>) {
            let text = format!("\"{}\"", STANDARD.encode(&bytes));
            prop_assert_eq!(&**decode(&text).unwrap(), &bytes[..]);
        }
    }
}
