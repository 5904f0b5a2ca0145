//! Checks that only read: the connection and the status.

use etsi_qkd014::{Error, Status};
use serde_json::Value;

use super::party::Party;
use super::quirks::{self, Tolerated};
use super::report::{Report, Verdict};
use super::tls::{self, Auth, GROUPS, VERSIONS};
use super::wire::{Raw, Wire};
use crate::CommandResult;

const IDS: [&str; 4] = ["source_KME_ID", "target_KME_ID", "master_SAE_ID", "slave_SAE_ID"];
const NUMBERS: [&str; 7] = [
    "key_size",
    "stored_key_count",
    "max_key_count",
    "max_key_per_request",
    "max_key_size",
    "min_key_size",
    "max_SAE_ID_count",
];

/// Checks whether the KME can be reached at all. All other checks depend on it.
pub(super) async fn connection(
    party: &Party,
    slave: &str,
    report: &mut Report,
) -> CommandResult<bool> {
    let expected = match &party.kme_id {
        Some(id) => format!("certificate of the CA given, KME ID {id:?}"),
        None => "certificate of the CA given, for the URL's host".to_owned(),
    };
    let client = party.client(etsi_qkd014::Quirks::STRICT).map_err(crate::other)?;
    if let Err(error) = client.status(slave).await
        && let Error::Tls { .. } | Error::Unreachable { .. } | Error::Timeout { .. } = error.cause()
    {
        report.check("5.1", expected, error.to_string(), false);
        return Ok(false);
    }
    report.check("5.1", expected, "as expected", true);

    let mut offered = Vec::new();
    for (version, name) in VERSIONS.into_iter().zip(["TLS 1.3", "TLS 1.2"]) {
        let config = tls::config(party, &[version], &GROUPS, Auth::Sae)?;
        if let Ok(group) = tls::handshake(party, config).await {
            offered.push(format!("{name} ({group})"));
        }
    }
    report.check("5.1", "TLS 1.2 or higher", offered.join(", "), !offered.is_empty());
    let (refused, came) = tls::old_version(party).await?;
    report.check("5.1", "TLS 1.1 refused", came, refused);
    let mut groups = Vec::new();
    for group in GROUPS {
        let config = tls::config(party, &VERSIONS, &[group], Auth::Sae)?;
        if tls::handshake(party, config).await.is_ok() {
            groups.push(format!("{:?}", group.name()));
        }
    }
    report.row("-", "key exchange, hybrid wanted", groups.join(", "), Verdict::Note);

    for (auth, expected) in [
        (Auth::None, "client without a certificate rejected"),
        (Auth::Stranger, "client certificate of another CA rejected"),
    ] {
        let wire = Wire::new(party, tls::config(party, &VERSIONS, &GROUPS, auth)?)?;
        match wire.get(party.method(slave, "status")?).await {
            Err(why) => {
                // A KME that does not answer at all has not refused.
                let timed_out = why.contains("timed out");
                report.check("5.1", expected, why, !timed_out);
            }
            // Front ends of some KMEs complete the handshake and refuse by status code.
            Ok(raw) => {
                report.check("5.1", expected, raw.summary(), matches!(raw.status, 400 | 401))
            }
        }
    }
    Ok(true)
}

/// Checks the status, both the raw answer and as the client reads it.
pub(super) async fn status(
    party: &Party,
    slave: &str,
    wire: &Wire,
    report: &mut Report,
) -> CommandResult<Option<Tolerated<Status>>> {
    let read = quirks::least(async |quirks| party.client(quirks)?.status(slave).await).await;
    let needed = read.as_ref().map(|read| read.needed.clone()).unwrap_or_default();
    match wire.get(party.method(slave, "status")?).await {
        Ok(raw) => raw_status(party, slave, &raw, &needed, report),
        Err(why) => report.check("5.2", "status answered 200", why, false),
    }
    let expected = "a status that the client accepts";
    match read {
        Ok(ref read) if read.needed.is_empty() => report.check("6.1", expected, "accepted", true),
        Ok(ref read) => {
            report.row(
                "6.1",
                expected,
                "accepted with quirks",
                Verdict::Tolerated(read.needed.clone()),
            );
        }
        Err(ref error) => report.check("6.1", expected, error.to_string(), false),
    }
    Ok(read.ok())
}

/// Returns the verdict: a failed check is tolerated if the client needs one of the quirks that
/// help.
fn judge(passed: bool, helps: &[&'static str], needed: &[&'static str]) -> Verdict {
    let used: Vec<_> = helps.iter().copied().filter(|name| needed.contains(name)).collect();
    match (passed, used.is_empty()) {
        (true, _) => Verdict::Pass,
        (false, true) => Verdict::Fail,
        (false, false) => Verdict::Tolerated(used),
    }
}

fn raw_status(party: &Party, slave: &str, raw: &Raw, needed: &[&'static str], report: &mut Report) {
    report.check("5.2", "status answered 200", raw.summary(), raw.status == 200);
    if raw.status != 200 {
        return;
    }
    let http = judge(raw.version != "HTTP/1.0", &["http-1.0"], needed);
    report.row("5.1", "HTTP/1.1 (RFC 7230)", &raw.version, http);
    let media = raw.media.clone().unwrap_or_default();
    let essence = media.split(';').next().unwrap_or_default().trim();
    let json = judge(essence.eq_ignore_ascii_case("application/json"), &["any-media-type"], needed);
    report.row("5.1", "Content-Type application/json", &media, json);
    let Some(Value::Object(members)) = raw.json() else {
        report.check("5.1", "a JSON object", format!("{} other bytes", raw.body.len()), false);
        return;
    };
    report.check("5.1", "a JSON object", format!("{} members", members.len()), true);

    let wrong = |names: &[&'static str], right: fn(&Value) -> bool| {
        let right = |name: &&&str| !members.get(**name).is_some_and(right);
        names.iter().filter(right).copied().collect::<Vec<_>>().join(", ")
    };
    for (expected, wrong, helps) in [
        ("4 IDs, strings", wrong(&IDS, Value::is_string), &["any-case-members"][..]),
        (
            "7 sizes and counts, integers",
            wrong(&NUMBERS, Value::is_u64),
            &["any-case-members", "missing-status-numbers", "null-members"],
        ),
    ] {
        let passed = wrong.is_empty();
        let came = if passed { "all".to_owned() } else { format!("not {wrong}") };
        report.row("6.1", expected, came, judge(passed, helps, needed));
    }
    let known = |name: &&String| {
        IDS.contains(&name.as_str())
            || NUMBERS.contains(&name.as_str())
            || *name == "status_extension"
    };
    let extra: Vec<_> = members.keys().filter(|name| !known(name)).cloned().collect();
    let passed = extra.is_empty();
    let came = if passed { "none".to_owned() } else { extra.join(", ") };
    let helps = ["any-case-members", "extra-members"];
    report.row("6.1", "no members that are not listed", came, judge(passed, &helps, needed));
    let extension = members.get("status_extension");
    let fits = extension.is_none_or(Value::is_object);
    let came = if extension.is_some() { "there" } else { "absent" };
    let verdict = judge(fits, &["null-members", "any-extension"], needed);
    report.row("6.1", "status_extension: an object or absent", came, verdict);

    let text = |name: &str| members.get(name).and_then(Value::as_str).unwrap_or("?").to_owned();
    let mut ids = vec![("master_SAE_ID", party.sae.as_str()), ("slave_SAE_ID", slave)];
    ids.extend(party.kme_id.as_deref().map(|id| ("source_KME_ID", id)));
    for (name, expected) in ids {
        let came = text(name);
        report.check("6.1", format!("{name} {expected:?}"), &came, came == expected);
    }
    let number = |name: &str| members.get(name).and_then(Value::as_u64);
    let [Some(size), Some(stored), Some(count), Some(per), Some(max), Some(min), Some(_)] =
        NUMBERS.map(number)
    else {
        report.skip("6.1", "numbers that agree", "not all are there");
        return;
    };
    let came = format!("{min} <= {size} <= {max} bits");
    report.check(
        "6.1",
        "min_key_size <= key_size <= max_key_size",
        came,
        min <= size && size <= max,
    );
    let came = format!("{stored} of {count}");
    report.check("6.1", "stored_key_count <= max_key_count", came, stored <= count);
    report.check("6.1", "max_key_per_request at least 1", per.to_string(), per >= 1);
}
