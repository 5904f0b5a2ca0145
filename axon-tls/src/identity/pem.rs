//! Reads a private key from its PEM text, and leaves no copy of it in memory.

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use zeroize::Zeroizing;

use crate::Error;

const BEGIN: &str = "-----BEGIN PRIVATE KEY-----";
const END: &str = "-----END PRIVATE KEY-----";

/// Returns the DER of the first `PRIVATE KEY` (PKCS#8).
///
/// Both buffers have their full size from the start, because a buffer that grows leaves its former
/// contents in memory.
pub(super) fn private_key(text: &str) -> Result<Zeroizing<Vec<u8>>, Error> {
    let section = || {
        let (_, from) = text.split_once(BEGIN)?;
        let (body, _) = from.split_once(END)?;
        Some(body)
    };
    let body = section().ok_or_else(|| Error::PrivateKey(missing(text)))?;

    let mut encoded = Zeroizing::new(Vec::with_capacity(body.len()));
    encoded.extend(body.bytes().filter(|byte| !byte.is_ascii_whitespace()));
    let mut der = Zeroizing::new(vec![0; encoded.len() / 4 * 3 + 3]);
    let len = STANDARD
        .decode_slice(&*encoded, &mut der)
        .map_err(|_| Error::PrivateKey("the PEM section `PRIVATE KEY` is not base64"))?;
    der.truncate(len);
    Ok(der)
}

/// Describes what the text contains instead of a PKCS#8 key.
fn missing(text: &str) -> &'static str {
    const OTHERS: [(&str, &str); 5] = [
        (
            "ENCRYPTED PRIVATE KEY",
            "the key is encrypted, and nobody is asked for a passphrase; write it without one: openssl \
             pkcs8 -topk8 -nocrypt",
        ),
        (
            "EC PRIVATE KEY",
            "a PEM section `EC PRIVATE KEY` (SEC1), and PKCS#8 is needed; convert it: openssl pkcs8 -topk8 \
             -nocrypt",
        ),
        (
            "RSA PRIVATE KEY",
            "a PEM section `RSA PRIVATE KEY` (PKCS#1), and PKCS#8 is needed; convert it: openssl pkcs8 \
             -topk8 -nocrypt",
        ),
        (
            "OPENSSH PRIVATE KEY",
            "a key of OpenSSH, and PKCS#8 is needed; make one: axon trust keygen, or openssl genpkey",
        ),
        ("CERTIFICATE", "a certificate and no private key"),
    ];
    let has = |label: &str| text.contains(&format!("-----BEGIN {label}-----"));
    let other = OTHERS.iter().find(|(label, _)| has(label));
    other.map_or("no PEM section `PRIVATE KEY` (PKCS#8)", |(_, why)| why)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn private_key_refuses_invalid_pem() {
        let endless = format!("{BEGIN}\nAAAA\n");
        let encrypted =
            "-----BEGIN ENCRYPTED PRIVATE KEY-----\nAAAA\n-----END ENCRYPTED PRIVATE KEY-----";
        let backwards = format!("{END}\nAAAA\n{BEGIN}");
        let not_base64 = format!("{BEGIN}\nAA\u{e4}A\0\n{END}");
        for text in ["", BEGIN, END, &endless, encrypted, &backwards, &not_base64] {
            assert!(private_key(text).is_err(), "{text}");
        }
    }

    #[test]
    fn other_sections_are_named() {
        for (label, said) in [
            ("EC PRIVATE KEY", "SEC1"),
            ("RSA PRIVATE KEY", "PKCS#1"),
            ("ENCRYPTED PRIVATE KEY", "encrypted"),
            ("OPENSSH PRIVATE KEY", "OpenSSH"),
            ("CERTIFICATE", "certificate"),
            ("PUBLIC KEY", "no PEM section"),
        ] {
            let text = format!("-----BEGIN {label}-----\nAAAA\n-----END {label}-----\n");
            let error = private_key(&text).unwrap_err().to_string();
            assert!(error.contains(said), "{label}: {error}");
        }
    }

    #[test]
    fn line_ends_do_not_matter() {
        for text in [
            format!("comment\r\n{BEGIN}\r\nAQID\r\nBAU=\r\n{END}\r\n"),
            format!("{BEGIN}\nAQIDBAU=\n{END}"),
            format!("{BEGIN}AQIDBAU={END}{BEGIN}AAAA{END}"),
        ] {
            assert_eq!(**private_key(&text).unwrap(), [1, 2, 3, 4, 5], "{text}");
        }
    }
}
