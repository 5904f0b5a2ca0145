//! Checks that draw keys, and refusals for which a faulty KME might deliver keys.

use std::collections::BTreeSet;

use etsi_qkd014::{Error, Key, KeyContainer, Status};
use serde_json::{Value, json};

use super::party::Party;
use super::quirks::{self, Tolerated};
use super::refusals::{message, nobody, not_served, refused};
use super::report::{Report, Verdict};
use super::wire::{Raw, Wire};
use crate::{CommandResult, other};

/// Most keys drawn in one request.
const BATCH: u64 = 3;

/// Sends `enc_keys` requests that the KME has to refuse.
pub(super) async fn refusals(
    master: &Party,
    slave: &str,
    status: &Status,
    wire: &Wire,
    report: &mut Report,
) -> CommandResult {
    let url = master.method(slave, "enc_keys")?;
    let post = async |body: Value| wire.post(url.clone(), body.to_string()).await;
    let most = status.max_key_per_request;
    let expected = "number over max_key_per_request: refused, as by 400";
    match most.checked_add(1).filter(|_| most > 0) {
        Some(number) => {
            let raw = post(json!({ "number": number })).await;
            not_served(report, "6.2", expected, &raw, &[400]);
        }
        None => report.skip("6.2", expected, "the status does not say how many"),
    }
    let (min, max) = (status.min_key_size, status.max_key_size);
    let expected = "size over max_key_size: refused, as by 400";
    if max == 0 {
        report.skip("6.2", expected, "the status does not say how large");
    } else {
        let raw = post(json!({ "size": u64::from(max) + 8 })).await;
        not_served(report, "6.2", expected, &raw, &[400]);
    }
    let expected = "size under min_key_size: refused, as by 400";
    if min <= 8 {
        report.skip("6.2", expected, "no smaller size to ask for");
    } else {
        let raw = post(json!({ "size": min - 8 })).await;
        not_served(report, "6.2", expected, &raw, &[400]);
    }
    match status.key_size.checked_sub(1) {
        Some(size) => odd_size(&post(json!({ "size": size })).await, report),
        None => report.skip("6.2", "size of broken bytes", "the status does not say how large"),
    }

    let raw = post(json!({ "extension_mandatory": [{ "kmesim_unsupported": true }] })).await;
    refused(report, "6.2", "unsupported extension_mandatory: 400", &raw, &[400]);
    message(report, "6.2", &raw, "not all extension_mandatory parameters are supported");
    let expected = "more than max_SAE_ID_count additional slaves: refused, as by 400";
    match status.max_sae_id_count {
        count @ 0..1000 => {
            let ids: Vec<_> = (0..=count).map(|_| nobody()).collect();
            let raw = post(json!({ "additional_slave_SAE_IDs": ids })).await;
            not_served(report, "6.2", expected, &raw, &[400]);
        }
        count => report.skip("6.2", expected, &format!("{count} are too many to try")),
    }
    let raw = post(json!({ "number": "one" })).await;
    refused(report, "6.2", "number of another type: 400", &raw, &[400]);
    let mut get = url.clone();
    get.query_pairs_mut().append_pair("number", "one");
    refused(report, "6.2", "number in the URL that is none: 400", &wire.get(get).await, &[400]);
    let raw = wire.get(master.method(&nobody(), "enc_keys")?).await;
    let expected = "enc_keys for an unknown SAE: refused, as by 400 or 401";
    not_served(report, "5.3", expected, &raw, &[400, 401]);
    Ok(())
}

/// Checks the answer to a size that is no multiple of 8. A KME may serve any size, or say that it
/// serves whole bytes only.
fn odd_size(raw: &Result<Raw, String>, report: &mut Report) {
    const WANTED: &str = "size shall be a multiple of 8";
    let expected = format!("size of broken bytes: 200, or 400 {WANTED:?}");
    match raw {
        Ok(raw) => {
            let passed = match raw.status {
                200 => true,
                400 => raw.message().is_some_and(|message| message == WANTED),
                _ => false,
            };
            report.check("6.2", expected, raw.summary(), passed);
        }
        Err(why) => report.check("6.2", expected, why, false),
    }
}

/// Draws keys, and the same keys at the other end if the slave is known.
pub(super) async fn delivery(
    (master, slave): (&Party, Option<&Party>),
    slave_sae: &str,
    status: &Status,
    wire: &Wire,
    report: &mut Report,
) -> CommandResult {
    let bits = status.key_size;
    let number = u32::try_from(status.max_key_per_request.clamp(1, BATCH)).map_err(other)?;
    let expected = format!("enc_keys by GET: 1 key of {bits} bits");
    let drawn = quirks::least(async |quirks| {
        master.client(quirks)?.enc_keys(slave_sae).via_get().send().await
    });
    let first = container(drawn.await, expected, report);
    let expected = format!("enc_keys by POST: {number} keys of {bits} bits");
    let drawn = quirks::least(async |quirks| {
        master.client(quirks)?.enc_keys(slave_sae).number(number).size(bits).send().await
    });
    let batch = container(drawn.await, expected, report);
    let keys: Vec<Key> = first.into_iter().chain(batch).flat_map(|drawn| drawn.keys).collect();
    if keys.is_empty() {
        report.skip("6.3", "what is true of all keys", "no key was delivered");
        report.skip("5.4", "the same keys by dec_keys", "no key was delivered");
        return Ok(());
    }
    of_all_keys(&keys, bits, report);
    optional(master, slave_sae, report).await;
    not_for_the_master(master, &keys[0], wire, report).await?;
    match slave {
        Some(slave) => at_the_other_end(slave, &master.sae, &keys, report).await,
        None => report.skip("5.4", "the same keys by dec_keys, once", "no --slave-env"),
    }
    Ok(())
}

/// Reports one answer with keys, as the client reads it.
fn container(
    drawn: Result<Tolerated<KeyContainer>, Error>,
    expected: String,
    report: &mut Report,
) -> Option<KeyContainer> {
    match drawn {
        Ok(Tolerated { value, needed }) => {
            let bits = value.keys.first().map_or(0, |key| key.len() * 8);
            let came = format!("{} of {bits} bits", value.keys.len());
            let verdict =
                if needed.is_empty() { Verdict::Pass } else { Verdict::Tolerated(needed) };
            report.row("6.3", expected, came, verdict);
            Some(value)
        }
        Err(error) => {
            report.check("6.3", expected, error.cause().to_string(), false);
            None
        }
    }
}

fn of_all_keys(keys: &[Key], bits: u32, report: &mut Report) {
    let lengths: BTreeSet<_> = keys.iter().map(|key| key.len() * 8).collect();
    let came = lengths.iter().map(ToString::to_string).collect::<Vec<_>>().join(", ");
    let right = lengths.iter().all(|length| *length == bits as usize);
    report.check("6.3", format!("each key of {bits} bits"), came, right);
    let folded = keys.iter().map(|key| key.key_id().to_ascii_lowercase());
    let unique = folded.collect::<BTreeSet<_>>().len();
    let came = format!("{unique} of {}", keys.len());
    report.check("6.3", "each key_ID another", came, unique == keys.len());
    let uuids = keys.iter().filter(|key| is_uuid(key.key_id())).count();
    let came = format!("{uuids} of {}", keys.len());
    report.check("6.3", "each key_ID a UUID", came, uuids == keys.len());
    let repeated = (1..keys.len()).any(|at| keys[..at].iter().any(|key| *key == keys[at]));
    let came = if repeated { "one came twice" } else { "all differ" };
    report.check("5.3", "no key delivered twice", came, !repeated);
}

/// Returns whether an ID has the form of a UUID of any version.
fn is_uuid(id: &str) -> bool {
    let fits = |(at, c): (usize, u8)| match at {
        8 | 13 | 18 | 23 => c == b'-',
        _ => c.is_ascii_hexdigit(),
    };
    id.len() == 36 && id.bytes().enumerate().all(fits)
}

fn ids(keys: &[Key]) -> String {
    let ids = keys.iter().map(|key| json!({ "key_ID": key.key_id() }));
    json!({ "key_IDs": ids.collect::<Value>() }).to_string()
}

/// Checks that an unknown optional extension is ignored, or refused with the specified message.
async fn optional(master: &Party, slave_sae: &str, report: &mut Report) {
    const REFUSAL: &str = "not all extension_optional request options handled";
    let expected = format!("unknown extension_optional: 200, or 400 {REFUSAL:?}");
    let drawn = quirks::least(async |quirks| {
        let client = master.client(quirks)?;
        let asked = client.enc_keys(slave_sae);
        asked.extension_optional(json!({ "kmesim_optional": true })).send().await
    });
    match drawn.await {
        // The quirks that an answer needs are reported with the keys.
        Ok(_) => report.check("6.2", expected, "200", true),
        Err(error) => {
            let cause = error.cause();
            let refused = matches!(cause, Error::BadRequest { message, .. } if message == REFUSAL);
            report.check("6.2", expected, cause.to_string(), refused);
        }
    }
}

/// Checks that a key is given only to the slaves that were named when it was drawn.
async fn not_for_the_master(
    master: &Party,
    key: &Key,
    wire: &Wire,
    report: &mut Report,
) -> CommandResult {
    let url = master.method(&master.sae, "dec_keys")?;
    let raw = wire.post(url, ids(std::slice::from_ref(key))).await;
    refused(report, "5.4", "dec_keys by an SAE that was not named: 401", &raw, &[401]);
    Ok(())
}

async fn at_the_other_end(slave: &Party, master: &str, keys: &[Key], report: &mut Report) {
    let (first, rest) = keys.split_at(1);
    fetch(slave, master, first, true, "dec_keys by GET: the same key", report).await;
    if !rest.is_empty() {
        let expected = format!("dec_keys by POST: the same {} keys", rest.len());
        fetch(slave, master, rest, false, &expected, report).await;
    }
    again(slave, master, &keys[0], report).await;
}

async fn fetch(
    slave: &Party,
    master: &str,
    keys: &[Key],
    get: bool,
    expected: &str,
    report: &mut Report,
) {
    let drawn = quirks::least(async |quirks| {
        let client = slave.client(quirks)?;
        let asked = client.dec_keys(master).key_ids(keys.iter().map(Key::key_id));
        if get { asked.via_get().send().await } else { asked.send().await }
    });
    match drawn.await {
        Ok(Tolerated { value, needed }) => {
            let same = keys.iter().zip(&value.keys).filter(|(ours, theirs)| ours == theirs);
            let same = same.count();
            let verdict = match (same == keys.len() && same == value.keys.len(), needed) {
                (false, _) => Verdict::Fail,
                (true, needed) if needed.is_empty() => Verdict::Pass,
                (true, needed) => Verdict::Tolerated(needed),
            };
            report.row("5.4", expected, format!("{same} of {} the same", keys.len()), verdict);
        }
        Err(error) => report.check("5.4", expected, error.cause().to_string(), false),
    }
}

/// Checks that a key is removed once it has been given (post-condition of clause 5.4).
async fn again(slave: &Party, master: &str, key: &Key, report: &mut Report) {
    let expected = "dec_keys of the same key again: 400";
    let Ok(client) = slave.client(quirks::lenient()) else { return };
    match client.dec_keys(master).key_id(key.key_id()).send().await {
        Ok(_) => report.check("5.4", expected, "a key", false),
        Err(error) => {
            let refused = error.status_code() == Some(400);
            report.check("5.4", expected, error.cause().to_string(), refused);
        }
    }
}
