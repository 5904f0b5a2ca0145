//! Reads a private key from PEM text (RFC 7468) without leaving a copy behind. The parser of
//! rustls-pki-types, which is used for certificates, frees the base64 text without erasing it.

use rustls::pki_types::{PrivateKeyDer, PrivatePkcs1KeyDer, PrivatePkcs8KeyDer, PrivateSec1KeyDer};
use secrecy::{ExposeSecret, SecretSlice};
use zeroize::Zeroizing;

use crate::parse::base64_text;

/// The content of a section of PEM text.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Form {
    Pkcs8,
    Sec1,
    Pkcs1,
}

/// The DER of a private key, zeroized on drop.
pub(crate) struct PrivateKey {
    form: Form,
    der: SecretSlice<u8>,
}

impl PrivateKey {
    /// Returns the first private key of the text; `None` if there is none that can be read, for
    /// example if it is encrypted.
    pub(crate) fn from_pem(text: &[u8]) -> Option<Self> {
        let mut rest = text;
        loop {
            let (_, section) = split(rest, b"-----BEGIN ")?;
            let (label, section) = split(section, b"-----")?;
            let form = match label {
                b"PRIVATE KEY" => Form::Pkcs8,
                b"EC PRIVATE KEY" => Form::Sec1,
                b"RSA PRIVATE KEY" => Form::Pkcs1,
                _ => {
                    rest = section;
                    continue;
                }
            };
            let (body, end) = split(section, b"-----END ")?;
            if !end.strip_prefix(label)?.starts_with(b"-----") {
                return None;
            }
            let mut base64 = Zeroizing::new(Vec::with_capacity(body.len()));
            base64.extend(body.iter().filter(|byte| !byte.is_ascii_whitespace()));
            return Some(Self { form, der: base64_text(&base64).ok()? });
        }
    }

    pub(crate) fn der(&self) -> PrivateKeyDer<'_> {
        let der = self.der.expose_secret();
        match self.form {
            Form::Pkcs8 => PrivatePkcs8KeyDer::from(der).into(),
            Form::Sec1 => PrivateSec1KeyDer::from(der).into(),
            Form::Pkcs1 => PrivatePkcs1KeyDer::from(der).into(),
        }
    }
}

/// Returns the text before `mark` and the text after it.
fn split<'t>(text: &'t [u8], mark: &[u8]) -> Option<(&'t [u8], &'t [u8])> {
    let at = text.windows(mark.len()).position(|window| window == mark)?;
    Some((&text[..at], &text[at + mark.len()..]))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn read(text: &str) -> Option<(Form, Vec<u8>)> {
        PrivateKey::from_pem(text.as_bytes())
            .map(|key| (key.form, key.der.expose_secret().to_vec()))
    }

    #[test]
    fn incomplete_pem_sections_are_refused() {
        for bad in [
            "",
            "-----BEGIN ",
            "-----BEGIN PRIVATE KEY-----",
            "-----BEGIN PRIVATE KEY-----\nAAAA",
            "-----BEGIN PRIVATE KEY-----\nAAAA\n-----END ",
            "-----BEGIN PRIVATE KEY-----\nAAAA\n-----END PRIVATE KEY",
            "-----BEGIN PRIVATE KEY-----\nAAAA\n-----END EC PRIVATE KEY-----",
            "-----BEGIN PRIVATE KEY-----\nAAA\n-----END PRIVATE KEY-----",
            "-----BEGIN ENCRYPTED PRIVATE KEY-----\nAAAA\n-----END ENCRYPTED PRIVATE KEY-----",
            "-----BEGIN RSA PRIVATE KEY-----\nProc-Type: 4,ENCRYPTED\n\nAAAA\n-----END RSA PRIVATE KEY-----",
            "-----BEGIN CERTIFICATE-----\nAAAA\n-----END CERTIFICATE-----",
        ] {
            assert_eq!(read(bad), None, "{bad}");
        }
    }

    #[test]
    fn the_first_private_key_is_found_among_other_sections() {
        let text = "curve\n-----BEGIN EC PARAMETERS-----\nBggqhkjOPQMBBw==\n\
            -----END EC PARAMETERS-----\r\n-----BEGIN EC PRIVATE KEY-----\r\nAQ\r\nID\r\n\
            -----END EC PRIVATE KEY-----\n-----BEGIN PRIVATE KEY-----\nBAUG\n-----END PRIVATE KEY-----";
        assert_eq!(read(text), Some((Form::Sec1, vec![1, 2, 3])));
    }

    proptest! {
        #[test]
        fn any_bytes_are_read_without_panic(text: Vec<u8>) {
            let _ = PrivateKey::from_pem(&text);
            let _ = PrivateKey::from_pem(&[b"-----BEGIN PRIVATE KEY-----", &*text].concat());
        }
    }
}
