//! The identity of a pre-shared key, which is sent in the clear.

use std::fmt;

use crate::Error;

/// `axon-qkd-v1:CLIENT-SAE:key_ID`, with both names percent-encoded.
///
/// It is printable ASCII of at most 128 bytes. Each pair of names has one spelling, and the parser
/// refuses all others, so identities can be compared as bytes. The key_ID is kept exactly as given,
/// including case.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub struct PskIdentity {
    client_sae: String,
    key_id: String,
}

impl PskIdentity {
    /// The longest identity, in bytes.
    pub const MAX_LEN: usize = 128;

    /// Makes the identity of the key `key_id` of the client `client_sae`.
    ///
    /// Fails if one of them is empty, or if the identity would be longer than
    /// [`PskIdentity::MAX_LEN`].
    pub fn new(client_sae: &str, key_id: &str) -> Result<Self, Error> {
        if client_sae.is_empty() {
            return Err(Error::Name { what: "client SAE ID", reason: "is empty" });
        }
        if key_id.is_empty() {
            return Err(Error::Name { what: "key_ID", reason: "is empty" });
        }
        let identity = Self { client_sae: client_sae.to_owned(), key_id: key_id.to_owned() };
        if identity.to_string().len() > Self::MAX_LEN {
            return Err(Error::Name {
                what: "client SAE ID and key_ID",
                reason: "are too long: the PSK identity would have more than 128 bytes",
            });
        }
        Ok(identity)
    }

    /// Parses the bytes that a client sent. Accepts exactly the output of
    /// [`PskIdentity::to_bytes()`].
    pub fn parse(bytes: &[u8]) -> Result<Self, Error> {
        if bytes.len() > Self::MAX_LEN {
            return Err(Error::PskIdentity("longer than 128 bytes"));
        }
        let text = std::str::from_utf8(bytes).map_err(|_| Error::PskIdentity("not ASCII"))?;
        let rest = text.strip_prefix(PREFIX).ok_or(Error::PskIdentity("another prefix"))?;
        let (sae, key_id) = rest.split_once(':').ok_or(Error::PskIdentity("no key_ID"))?;

        let decoded = |name| decode(name).ok_or(Error::PskIdentity("not percent-encoded"));
        let identity = Self::new(&decoded(sae)?, &decoded(key_id)?)
            .map_err(|_| Error::PskIdentity("a name is empty"))?;
        if identity.to_string() != text {
            return Err(Error::PskIdentity("percent-encoded in another way than AXON does"));
        }
        Ok(identity)
    }

    /// Returns the SAE ID of the client.
    pub fn client_sae(&self) -> &str {
        &self.client_sae
    }

    /// Returns the key_ID, as the client wrote it.
    pub fn key_id(&self) -> &str {
        &self.key_id
    }

    /// Returns the bytes that the client sends.
    pub fn to_bytes(&self) -> Vec<u8> {
        self.to_string().into_bytes()
    }
}

impl fmt::Display for PskIdentity {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(PREFIX)?;
        encode(f, &self.client_sae)?;
        f.write_str(":")?;
        encode(f, &self.key_id)
    }
}

fn encode(f: &mut fmt::Formatter<'_>, name: &str) -> fmt::Result {
    for byte in name.bytes() {
        if is_unreserved(byte) {
            write!(f, "{}", char::from(byte))?;
        } else {
            write!(f, "%{byte:02X}")?;
        }
    }
    Ok(())
}

const PREFIX: &str = "axon-qkd-v1:";

/// Returns whether RFC 3986 section 2.3 leaves this byte unescaped.
fn is_unreserved(byte: u8) -> bool {
    byte.is_ascii_alphanumeric() || matches!(byte, b'-' | b'.' | b'_' | b'~')
}

fn decode(encoded: &str) -> Option<String> {
    let mut decoded = Vec::with_capacity(encoded.len());
    let mut bytes = encoded.bytes();
    while let Some(byte) = bytes.next() {
        decoded.push(match byte {
            b'%' => {
                let digit = |byte: u8| char::from(byte).to_digit(16);
                let (high, low) = (digit(bytes.next()?)?, digit(bytes.next()?)?);
                u8::try_from(high * 16 + low).ok()?
            }
            byte => byte,
        });
    }
    String::from_utf8(decoded).ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn hostile_identities_are_refused() {
        let long = format!("axon-qkd-v1:{}:k", "a".repeat(115));
        let hostile: [&[u8]; 18] = [
            b"",
            b"axon-qkd-v1",
            b"axon-qkd-v1:",
            b"axon-qkd-v1::",
            b"axon-qkd-v1::key",
            b"axon-qkd-v1:sae:",
            b"axon-qkd-v1:sae",
            b"axon-qkd-v2:sae:key",
            b"AXON-QKD-V1:sae:key",
            b"axon-qkd-v1:sa%e:key",
            b"axon-qkd-v1:sae%4:key",
            b"axon-qkd-v1:%73ae:key",
            b"axon-qkd-v1:sae%c3%a9:key",
            b"axon-qkd-v1:sae%FF:key",
            b"axon-qkd-v1:sae:k y",
            b"axon-qkd-v1:sae:key:more",
            b"axon-qkd-v1:sae:%6bey",
            b"axon-qkd-v1:sae\xff:key",
        ];
        for bytes in hostile.into_iter().chain([long.as_bytes()]) {
            assert!(PskIdentity::parse(bytes).is_err(), "{}", bytes.escape_ascii());
        }
    }

    #[test]
    fn names_come_back_as_they_went() {
        for (sae, key_id) in [
            ("sae-1", "bc490419-7d60-487f-adc1-4ddcc177c139"),
            ("sae:with:colons", "KEY"),
            ("50%", "a/b=="),
            ("sae", "key:with:colons"),
            ("rob\u{f6}ter 7", "k"),
        ] {
            let identity = PskIdentity::new(sae, key_id).unwrap();
            let bytes = identity.to_bytes();
            assert!(bytes.iter().all(u8::is_ascii_graphic));
            assert_eq!(PskIdentity::parse(&bytes).unwrap(), identity);
        }
        assert!(PskIdentity::new(&"a".repeat(114), "k").is_ok());
        assert!(PskIdentity::new(&"a".repeat(115), "k").is_err());
    }
}
