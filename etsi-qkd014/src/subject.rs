//! The common name in a certificate's subject, which contains the ID of a KME or SAE.

use rustls::pki_types::CertificateDer;

/// Returns the subject's common name. Returns `None` if the certificate cannot be parsed, has no
/// common name or more than one, or one in an encoding other than UTF8String or PrintableString.
pub(crate) fn common_name(cert: &CertificateDer<'_>) -> Option<String> {
    let cert = webpki::EndEntityCert::try_from(cert).ok()?;
    common_name_in(cert.subject())
}

const SEQUENCE: u8 = 0x30;
const SET: u8 = 0x31;
const OID: u8 = 0x06;
const UTF8_STRING: u8 = 0x0c;
const PRINTABLE_STRING: u8 = 0x13;
/// id-at-commonName, 2.5.4.3.
const COMMON_NAME: [u8; 3] = [0x55, 0x04, 0x03];

/// Returns the common name in `rdns`, the content of an RDNSequence (RFC 5280, 4.1.2.4).
pub(crate) fn common_name_in(mut rdns: &[u8]) -> Option<String> {
    let mut found = None;
    while !rdns.is_empty() {
        let mut set = element(&mut rdns, SET)?;
        while !set.is_empty() {
            let mut attribute = element(&mut set, SEQUENCE)?;
            if element(&mut attribute, OID)? != COMMON_NAME {
                continue;
            }
            let tag = *attribute.first()?;
            if tag != UTF8_STRING && tag != PRINTABLE_STRING {
                return None;
            }
            let text = std::str::from_utf8(element(&mut attribute, tag)?).ok()?;
            if found.replace(text.to_owned()).is_some() {
                // With two common names, it is not clear which one the certificate means.
                return None;
            }
        }
    }
    found
}

/// Takes one DER element of the given tag from the front of `input` and returns its content.
fn element<'a>(input: &mut &'a [u8], tag: u8) -> Option<&'a [u8]> {
    let (&[first, length], rest) = input.split_first_chunk::<2>()?;
    if first != tag {
        return None;
    }
    let (length, rest) = match length {
        short @ 0..=0x7f => (usize::from(short), rest),
        0x81 => {
            let (&long, rest) = rest.split_first()?;
            (usize::from(long), rest)
        }
        0x82 => {
            let (long, rest) = rest.split_first_chunk::<2>()?;
            (usize::from(u16::from_be_bytes(*long)), rest)
        }
        _ => return None,
    };
    let (content, rest) = rest.split_at_checked(length)?;
    *input = rest;
    Some(content)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn rdn(oid: &[u8], tag: u8, text: &[u8]) -> Vec<u8> {
        let mut attribute = vec![OID, oid.len() as u8];
        attribute.extend_from_slice(oid);
        attribute.extend_from_slice(&[tag, text.len() as u8]);
        attribute.extend_from_slice(text);
        let mut out = vec![SET, attribute.len() as u8 + 2, SEQUENCE, attribute.len() as u8];
        out.extend_from_slice(&attribute);
        out
    }

    #[test]
    fn it_refuses_a_subject_that_names_two_or_none() {
        let one = rdn(&COMMON_NAME, UTF8_STRING, b"sae-a");
        assert_eq!(common_name_in(&[one.clone(), one.clone()].concat()), None);
        assert_eq!(common_name_in(&rdn(&[0x55, 0x04, 0x0a], UTF8_STRING, b"sae-a")), None);
        assert_eq!(common_name_in(b""), None);
        assert_eq!(common_name_in(&one[..one.len() - 1]), None);
        assert_eq!(common_name_in(&rdn(&COMMON_NAME, 0x1e, b"\0s\0a")), None);
    }

    #[test]
    fn it_finds_the_name_beside_other_attributes() {
        let subject = [
            rdn(&[0x55, 0x04, 0x06], PRINTABLE_STRING, b"NL"),
            rdn(&COMMON_NAME, PRINTABLE_STRING, b"sae-a"),
        ]
        .concat();
        assert_eq!(common_name_in(&subject).as_deref(), Some("sae-a"));
    }

    proptest! {
        #[test]
        fn any_bytes_are_parsed_without_panic(bytes: Vec<u8>) {
            let _ = common_name_in(&bytes);
        }
    }
}
