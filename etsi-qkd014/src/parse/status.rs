//! The status (clause 6.1).

use super::json::{Object, text};
use super::malformed;
use crate::{Error, Quirks, Status};

/// Largest key size that is accepted, in bits.
const MAX_SIZE: u64 = 1 << 30;

pub(crate) fn status(body: &[u8], slave_sae: &str, quirks: Quirks) -> Result<Status, Error> {
    let mut object = Object::parse(text(body)?, quirks)?;
    let status = Status {
        source_kme_id: object.need_string("source_KME_ID")?,
        target_kme_id: object.need_string("target_KME_ID")?,
        master_sae_id: object.need_string("master_SAE_ID")?,
        slave_sae_id: object.need_string("slave_SAE_ID")?,
        key_size: size(&mut object, "key_size", quirks)?,
        stored_key_count: number(&mut object, "stored_key_count", quirks)?,
        max_key_count: number(&mut object, "max_key_count", quirks)?,
        max_key_per_request: number(&mut object, "max_key_per_request", quirks)?,
        max_key_size: size(&mut object, "max_key_size", quirks)?,
        min_key_size: size(&mut object, "min_key_size", quirks)?,
        max_sae_id_count: number(&mut object, "max_SAE_ID_count", quirks)?,
        extension: object.take_extension("status_extension")?,
    };
    object.finish()?;
    if status.slave_sae_id != slave_sae {
        return Err(Error::Check {
            clause: "ETSI GS QKD 014 V1.1.1 clause 6.1 (slave_SAE_ID)",
            expected: format!("{slave_sae:?}, which was asked about"),
            got: format!("{:?}", status.slave_sae_id),
        });
    }
    Ok(status)
}

fn number(object: &mut Object<'_>, name: &str, quirks: Quirks) -> Result<u64, Error> {
    match object.take_count(name)? {
        Some(number) => Ok(number),
        None if quirks.contains(Quirks::MISSING_STATUS_NUMBERS) => Ok(0),
        None => Err(malformed(
            object.path(name),
            "is missing (quirk missing-status-numbers reads it as 0)",
        )),
    }
}

/// Returns a size in bits, whatever unit the KME uses.
fn size(object: &mut Object<'_>, name: &str, quirks: Quirks) -> Result<u32, Error> {
    let unit = if quirks.contains(Quirks::SIZE_IN_BYTES) { 8 } else { 1 };
    number(object, name, quirks)?
        .checked_mul(unit)
        .filter(|bits| *bits <= MAX_SIZE)
        .and_then(|bits| u32::try_from(bits).ok())
        .ok_or_else(|| malformed(object.path(name), format!("is over {MAX_SIZE} bits")))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use serde_json::json;

    fn answer() -> serde_json::Value {
        json!({
            "source_KME_ID": "kme-a", "target_KME_ID": "kme-b", "master_SAE_ID": "sae-a",
            "slave_SAE_ID": "sae-b", "key_size": 256, "stored_key_count": 25000,
            "max_key_count": 100000, "max_key_per_request": 128, "max_key_size": 1024,
            "min_key_size": 64, "max_SAE_ID_count": 0
        })
    }

    fn parse(answer: &serde_json::Value, quirks: Quirks) -> Result<Status, Error> {
        status(answer.to_string().as_bytes(), "sae-b", quirks)
    }

    #[test]
    fn every_required_member_is_required_and_typed() {
        let members: Vec<String> = answer().as_object().unwrap().keys().cloned().collect();
        for member in members {
            let mut lacking = answer();
            lacking.as_object_mut().unwrap().remove(&member);
            assert!(parse(&lacking, Quirks::STRICT).is_err(), "{member} absent");
            for wrong in [json!(null), json!([]), json!(-1), json!(1.5), json!(u64::MAX)] {
                let mut bad = answer();
                bad[&member] = wrong.clone();
                let refused = parse(&bad, Quirks::STRICT).is_err();
                let large_count = wrong == json!(u64::MAX) && bad[&member].is_u64();
                assert!(refused || large_count, "{member} = {wrong}");
            }
        }
    }

    #[test]
    fn another_slave_is_refused() {
        let error = status(answer().to_string().as_bytes(), "sae-c", Quirks::STRICT).unwrap_err();
        assert!(matches!(error, Error::Check { .. }), "{error}");
    }

    #[test]
    fn each_quirk_tolerates_only_its_named_deviation() {
        let mut bytes = answer();
        bytes["key_size"] = json!(32);
        assert_eq!(parse(&bytes, Quirks::SIZE_IN_BYTES).unwrap().key_size, 256);
        let mut lacking = answer();
        lacking.as_object_mut().unwrap().remove("stored_key_count");
        assert_eq!(parse(&lacking, Quirks::MISSING_STATUS_NUMBERS).unwrap().stored_key_count, 0);
        let mut extra = answer();
        extra["vendor"] = json!("x");
        assert!(parse(&extra, Quirks::STRICT).is_err());
        parse(&extra, Quirks::EXTRA_MEMBERS).unwrap();
        let mut null = answer();
        null["status_extension"] = json!(null);
        assert!(parse(&null, Quirks::STRICT).is_err());
        assert_eq!(parse(&null, Quirks::NULL_MEMBERS).unwrap().extension, None);
        let mut odd = answer();
        odd["status_extension"] = json!([1]);
        assert!(parse(&odd, Quirks::STRICT).is_err());
        assert_eq!(parse(&odd, Quirks::ANY_EXTENSION).unwrap().extension, Some(json!([1])));
        let lower = answer().to_string().to_ascii_lowercase();
        assert!(status(lower.as_bytes(), "sae-b", Quirks::STRICT).is_err());
        status(lower.as_bytes(), "sae-b", Quirks::ANY_CASE_MEMBERS).unwrap();
    }

    #[test]
    fn the_specified_answer_is_read() {
        let status = parse(&answer(), Quirks::STRICT).unwrap();
        assert_eq!((status.key_size, status.stored_key_count), (256, 25000));
        assert_eq!(status.target_kme_id, "kme-b");
    }

    proptest! {
        #[test]
        fn any_bytes_are_parsed_without_panic(bytes: Vec<u8>) {
            let _ = status(&bytes, "sae-b", Quirks::STRICT);
        }
    }
}
