//! Entry points for fuzz targets. They are not part of the API and may change in any release.
//!
//! Each returns whether the input was accepted, and panics if the accepted value breaks a promise
//! of this crate.

use std::collections::HashSet;

use secrecy::ExposeSecret;

use crate::parse::{self, Asked};
use crate::{KeyContainer, Quirks};

/// Returns the quirks that `bits` select.
fn quirks(bits: [u8; 2]) -> Quirks {
    let bits = u16::from_le_bytes(bits);
    let chosen = Quirks::NAMES.iter().enumerate().filter(|(i, _)| bits >> i & 1 == 1);
    chosen.fold(Quirks::STRICT, |all, (_, (_, quirk))| all | *quirk)
}

/// Parses a status. The first two bytes select quirks, the rest is the body.
pub fn status_response(data: &[u8]) -> bool {
    let Some((&bits, body)) = data.split_first_chunk::<2>() else { return false };
    let status = parse::status(body, "sae-b", quirks(bits));
    status.is_ok_and(|status| {
        assert_eq!(status.slave_sae_id, "sae-b");
        true
    })
}

/// Parses a key container. The first two bytes select quirks, the third the number of keys, the
/// rest is the body.
pub fn key_container(data: &[u8]) -> bool {
    let Some((&[low, high, number], body)) = data.split_first_chunk::<3>() else { return false };
    let bits = [low, high];
    let number = usize::from(number);
    let by_number = parse::key_container(body, &Asked::Number(number), None, quirks(bits));
    if let Ok(container) = &by_number {
        check(container, number);
    }
    let ids = [
        "bc490419-7d60-487f-adc1-4ddcc177c139".to_owned(),
        "0a782fb5-3434-48fe-aa4d-14f41d46cf92".to_owned(),
    ];
    // One of the IDs, or both in the other order.
    let ids = if number % 2 == 1 { &ids[..1] } else { &ids[..] };
    let by_id = parse::key_container(body, &Asked::Ids(ids), Some(256), quirks(bits));
    if let Ok(container) = &by_id {
        check(container, ids.len());
        assert!(container.keys.iter().zip(ids).all(|(key, id)| key.key_id() == id));
        assert!(container.keys.iter().all(|key| key.len() == 32));
    }
    by_number.is_ok() || by_id.is_ok()
}

/// Checks that there are `number` keys, of one size, with distinct and valid key_IDs.
fn check(container: &KeyContainer, number: usize) {
    let keys = &container.keys;
    assert_eq!(keys.len(), number);
    assert!(keys.iter().all(|key| key.len() == keys[0].len() && !key.expose_secret().is_empty()));
    let ids: HashSet<_> = keys.iter().map(|key| key.key_id().to_ascii_lowercase()).collect();
    assert_eq!(ids.len(), number);
    assert!(ids.iter().all(|id| parse::is_key_id(id)));
}

/// Parses the body of an answer other than 200.
pub fn error_response(data: &[u8]) -> bool {
    let answer = parse::error_answer(data);
    assert!(answer.message.len() < 600 && !answer.message.contains(char::is_control));
    !answer.message.is_empty()
}

/// Parses the subject of a certificate.
pub fn certificate_subject(data: &[u8]) -> bool {
    let subject = crate::subject::common_name_in(data);
    let certificate = crate::subject::common_name(&data.into());
    subject.is_some() || certificate.is_some()
}
