//! Requests that a KME has to refuse, and that name no existing key.

use serde_json::Value;

use super::party::Party;
use super::report::{Report, Verdict};
use super::wire::{Raw, Wire};
use crate::CommandResult;

/// Returns a new ID, which no KME has given to an SAE or key.
pub(super) fn nobody() -> String {
    format!("kme-sim-probe-{}", unknown_key_id())
}

fn unknown_key_id() -> String {
    // Randomness from std suffices for an ID that only has to be new.
    use std::hash::{BuildHasher, Hasher};
    let random = || std::hash::RandomState::new().build_hasher().finish();
    let (a, b) = (random(), random());
    let (c, d) = (a & 0xfff, b >> 16 & 0xfff);
    format!("{:08x}-{:04x}-4{c:03x}-8{d:03x}-{:012x}", a >> 32, a >> 16 & 0xffff, b >> 16)
}

/// Sends requests that no KME may serve and that name no existing key.
pub(super) async fn refusals(
    party: &Party,
    slave: &str,
    wire: &Wire,
    report: &mut Report,
) -> CommandResult {
    let raw = wire.get(party.method(&nobody(), "status")?).await;
    not_served(
        report,
        "5.2",
        "status of an unknown SAE: refused, as by 400 or 401",
        &raw,
        &[400, 401],
    );
    error_format(report, &raw);

    let id = unknown_key_id();
    let body = serde_json::json!({ "key_IDs": [{ "key_ID": id }] }).to_string();
    let dec_keys = party.method(slave, "dec_keys")?;
    let raw = wire.post(dec_keys.clone(), body).await;
    refused(report, "6.4", "dec_keys of an unknown key_ID by POST: 400", &raw, &[400]);
    message(report, "6.4", &raw, "one or more keys specified are not found on KME");
    let mut url = dec_keys.clone();
    url.query_pairs_mut().append_pair("key_ID", &unknown_key_id());
    let raw = wire.get(url).await;
    refused(report, "6.4", "dec_keys of an unknown key_ID by GET: 400", &raw, &[400]);
    let raw = wire.post(dec_keys.clone(), "{\"key_IDs\":[".to_owned()).await;
    refused(report, "5.4", "dec_keys with broken JSON: 400", &raw, &[400]);
    let raw = wire.post(dec_keys, "{\"key_IDs\":7}".to_owned()).await;
    refused(report, "5.4", "dec_keys with key_IDs of another type: 400", &raw, &[400]);
    Ok(())
}

/// Checks that a request is refused with a code that the specification names for it.
pub(super) fn refused(
    report: &mut Report,
    clause: &'static str,
    expected: &str,
    raw: &Result<Raw, String>,
    codes: &[u16],
) {
    match raw {
        Ok(raw) => report.check(clause, expected, raw.summary(), codes.contains(&raw.status)),
        Err(why) => report.check(clause, expected, why, false),
    }
}

/// Checks a refusal for which the specification names no code. An unusual code is noted and no failure; serving the
/// request is a failure.
pub(super) fn not_served(
    report: &mut Report,
    clause: &'static str,
    expected: &str,
    raw: &Result<Raw, String>,
    usual: &[u16],
) {
    match raw {
        Ok(raw) if matches!(raw.status, 400..=599) && !usual.contains(&raw.status) => {
            report.row(clause, expected, raw.summary(), Verdict::Note);
        }
        _ => refused(report, clause, expected, raw, usual),
    }
}

/// Checks that a refusal has the message that the specification gives.
pub(super) fn message(
    report: &mut Report,
    clause: &'static str,
    raw: &Result<Raw, String>,
    wanted: &str,
) {
    let expected = format!("message {wanted:?}");
    match raw {
        Ok(raw) if raw.status == 400 => {
            let came = raw.message().unwrap_or_default();
            report.check(clause, expected, &came, came == wanted);
        }
        _ => report.skip(clause, expected, "not refused with 400"),
    }
}

/// Checks the error format of clause 6.5, if the answer has a body.
fn error_format(report: &mut Report, raw: &Result<Raw, String>) {
    let expected = "an error: message, and details of objects or none";
    let body = match raw {
        Ok(raw) if raw.status == 400 => raw.json(),
        Ok(raw) if raw.status == 401 => {
            return report.skip("6.5", expected, "401 has no data model");
        }
        _ => return report.skip("6.5", expected, "not refused with 400"),
    };
    let Some(Value::Object(members)) = body else {
        return report.check("6.5", expected, "no JSON object", false);
    };
    let message = members.get("message").is_some_and(Value::is_string);
    let objects = |details: &Vec<Value>| details.iter().all(Value::is_object);
    let details = members.get("details").is_none_or(|d| d.as_array().is_some_and(objects));
    let came = match (message, details) {
        (true, true) => "as expected",
        (false, _) => "no message",
        (true, false) => "other details",
    };
    report.check("6.5", expected, came, message && details);
}
