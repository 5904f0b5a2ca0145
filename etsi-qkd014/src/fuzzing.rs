//! Entry points for fuzz targets. Not part of the API: they may change in any release.
//!
//! Each returns whether the input was accepted.

use crate::Quirks;
use crate::parse::{self, Asked};

/// The quirks that `bits` select.
fn quirks(bits: u8) -> Quirks {
    let chosen = Quirks::NAMES.iter().enumerate().filter(|(i, _)| bits >> i & 1 == 1);
    chosen.fold(Quirks::STRICT, |all, (_, (_, quirk))| all | *quirk)
}

/// The first byte selects quirks, the rest is the body.
pub fn status_response(data: &[u8]) -> bool {
    let Some((&bits, body)) = data.split_first() else { return false };
    parse::status(body, "sae-b", quirks(bits)).is_ok()
}

/// The first byte selects quirks, the second the number of keys asked for, the rest is the body.
pub fn key_container(data: &[u8]) -> bool {
    let Some((&[bits, number], body)) = data.split_first_chunk::<2>() else { return false };
    let by_number = parse::key_container(body, &Asked::Number(number.into()), None, quirks(bits));
    let ids = ["bc490419-7d60-487f-adc1-4ddcc177c139".to_owned()];
    let by_id = parse::key_container(body, &Asked::Ids(&ids), Some(256), quirks(bits));
    by_number.is_ok() || by_id.is_ok()
}

/// The body of an answer other than 200.
pub fn error_response(data: &[u8]) -> bool {
    !parse::error_answer(data).message.is_empty()
}

/// The subject of a certificate.
pub fn certificate_subject(data: &[u8]) -> bool {
    let subject = crate::subject::common_name_in(data);
    let certificate = crate::subject::common_name(&data.into());
    subject.is_some() || certificate.is_some()
}
