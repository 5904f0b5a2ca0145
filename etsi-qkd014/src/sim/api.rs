//! The three methods, as a KME answers them.

use std::collections::BTreeSet;

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use serde::Deserialize;
use serde_json::{Value, json};
use zeroize::Zeroizing;

use super::fault::Fault;
use super::http::{Answer, Request, percent_decode};
use super::network::{KmeState, Shared};
use super::plan::Method;
use super::store::{Drawn, Refusal, uuid};

/// A member of this name in a mandatory or optional extension is returned in
/// `key_container_extension`; any other mandatory extension is refused.
const ECHO: &str = "kme_sim_echo";

#[derive(Default, Deserialize)]
#[serde(default, deny_unknown_fields)]
struct KeyRequest {
    number: Option<u64>,
    size: Option<u64>,
    #[serde(rename = "additional_slave_SAE_IDs")]
    additional_slaves: Vec<String>,
    extension_mandatory: Vec<serde_json::Map<String, Value>>,
    extension_optional: Vec<serde_json::Map<String, Value>>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct KeyIds {
    #[serde(rename = "key_IDs")]
    ids: Vec<KeyIdItem>,
    #[serde(default, rename = "key_IDs_extension")]
    _extension: Option<Value>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct KeyIdItem {
    #[serde(rename = "key_ID")]
    id: String,
    #[serde(default, rename = "key_ID_extension")]
    _extension: Option<Value>,
}

/// Answers one request of the SAE named by the client's certificate.
pub(super) fn answer(
    shared: &Shared,
    kme: &KmeState,
    caller: Option<&str>,
    request: &Request,
    fault: Option<&Fault>,
) -> Answer {
    let result = route(shared, kme, caller, request, fault);
    let answer = result.unwrap_or_else(|refused| refused);
    if answer.status != 200 {
        kme.count(|counters| counters.refused += 1);
    }
    answer
}

/// The method that a request names, whether or not it can be served.
pub(super) fn method(request: &Request) -> Option<Method> {
    let (_, name) = request.path.strip_prefix("/api/v1/keys/")?.split_once('/')?;
    Method::named(name)
}

pub(super) fn error(status: u16, message: impl Into<String>, details: Vec<Value>) -> Answer {
    let mut body = json!({ "message": message.into() });
    if !details.is_empty() {
        body["details"] = details.into();
    }
    Answer { status, body: body.to_string().into(), retry_after: None }
}

fn bad(message: impl Into<String>) -> Answer {
    error(400, message, Vec::new())
}

fn route(
    shared: &Shared,
    kme: &KmeState,
    caller: Option<&str>,
    request: &Request,
    fault: Option<&Fault>,
) -> Result<Answer, Answer> {
    let unknown = || error(404, "no such resource", Vec::new());
    let rest = request.path.strip_prefix("/api/v1/keys/").ok_or_else(unknown)?;
    let (sae, method) = rest.split_once('/').ok_or_else(unknown)?;
    let sae = percent_decode(sae).ok_or_else(|| bad("the SAE ID in the path is not UTF-8"))?;
    let wrong_method = || error(405, "method not allowed", Vec::new());
    let get = match request.method.as_str() {
        "GET" => true,
        "POST" => false,
        _ => return Err(wrong_method()),
    };
    let counted: fn(&mut super::Counters) = match method {
        "status" if get => |c| c.status_calls += 1,
        "status" => return Err(wrong_method()),
        "enc_keys" => |c| c.enc_keys_calls += 1,
        "dec_keys" => |c| c.dec_keys_calls += 1,
        _ => return Err(unknown()),
    };
    kme.count(counted);
    let unauthorized = || error(401, "the certificate names no SAE of this KME", Vec::new());
    let caller = caller.filter(|id| kme.saes.contains(*id)).ok_or_else(unauthorized)?;
    match fault {
        Some(Fault::Empty) => return Err(error(503, "not enough keys are stored", Vec::new())),
        Some(Fault::Busy(seconds)) => {
            let busy = error(503, "busy", Vec::new());
            return Err(Answer { retry_after: Some(*seconds), ..busy });
        }
        Some(Fault::Status(code)) => {
            return Err(Answer {
                status: *code,
                body: "out of order".to_owned().into(),
                retry_after: None,
            });
        }
        _ => {}
    }
    match method {
        "status" => status(shared, kme, caller, &sae),
        "enc_keys" => {
            let asked = if get {
                enc_query(&request.query)?
            } else {
                serde_json::from_slice(&request.body)
                    .map_err(|e| bad(format!("the key request cannot be read: {e}")))?
            };
            enc_keys(shared, kme, caller, &sae, &asked, fault)
        }
        _ => {
            let ids = if get {
                dec_query(&request.query)?
            } else {
                let ids: KeyIds = serde_json::from_slice(&request.body)
                    .map_err(|e| bad(format!("the key IDs cannot be read: {e}")))?;
                ids.ids.into_iter().map(|item| item.id).collect()
            };
            dec_keys(shared, kme, caller, &sae, &ids, fault)
        }
    }
}

fn pairs(query: &str) -> Result<Vec<(String, String)>, Answer> {
    let pair = |part: &str| {
        let (name, value) = part.split_once('=')?;
        Some((percent_decode(name)?, percent_decode(value)?))
    };
    let parts = query.split('&').filter(|part| !part.is_empty());
    parts.map(|part| pair(part).ok_or_else(|| bad("the query cannot be read"))).collect()
}

fn enc_query(query: &str) -> Result<KeyRequest, Answer> {
    let mut asked = KeyRequest::default();
    for (name, value) in pairs(query)? {
        let number = value.parse().map_err(|_| bad(format!("{name} is not a number")))?;
        match name.as_str() {
            "number" => asked.number = Some(number),
            "size" => asked.size = Some(number),
            _ => return Err(bad(format!("{name:?} is not a parameter of enc_keys"))),
        }
    }
    Ok(asked)
}

fn dec_query(query: &str) -> Result<Vec<String>, Answer> {
    let pairs = pairs(query)?;
    match pairs.as_slice() {
        [(name, id)] if name == "key_ID" => Ok(vec![id.clone()]),
        _ => Err(bad("GET takes one parameter, key_ID")),
    }
}

fn site_of(shared: &Shared, sae: &str) -> Result<usize, Answer> {
    shared.site_of(sae).ok_or_else(|| bad(format!("SAE {sae:?} is not known")))
}

fn status(shared: &Shared, kme: &KmeState, caller: &str, slave: &str) -> Result<Answer, Answer> {
    let target = site_of(shared, slave)?;
    let limits = &shared.limits;
    let body = json!({
        "source_KME_ID": kme.id,
        "target_KME_ID": shared.kme_id(target),
        "master_SAE_ID": caller,
        "slave_SAE_ID": slave,
        "key_size": limits.key_size,
        "stored_key_count": shared.store().stored(kme.index, target),
        "max_key_count": limits.max_stored,
        "max_key_per_request": limits.max_keys_per_request,
        "max_key_size": limits.max_key_size,
        "min_key_size": limits.min_key_size,
        "max_SAE_ID_count": limits.max_sae_ids,
    });
    Ok(Answer { status: 200, body: body.to_string().into(), retry_after: None })
}

fn enc_keys(
    shared: &Shared,
    kme: &KmeState,
    caller: &str,
    slave: &str,
    asked: &KeyRequest,
    fault: Option<&Fault>,
) -> Result<Answer, Answer> {
    let limits = &shared.limits;
    let number = asked.number.unwrap_or(1);
    if !(1..=limits.max_keys_per_request).contains(&number) {
        return Err(bad(format!("number is not in 1..={}", limits.max_keys_per_request)));
    }
    let size = asked.size.unwrap_or(limits.key_size.into());
    let (min, max) = (u64::from(limits.min_key_size), u64::from(limits.max_key_size));
    if !(min..=max).contains(&size) || !size.is_multiple_of(8) {
        return Err(bad(format!("size is not a multiple of 8 in {min}..={max}")));
    }
    if asked.additional_slaves.len() as u64 > limits.max_sae_ids {
        return Err(bad(format!("more than {} additional slave SAEs", limits.max_sae_ids)));
    }
    let unsupported: Vec<Value> = asked
        .extension_mandatory
        .iter()
        .flat_map(|extension| extension.keys())
        .filter(|name| *name != ECHO)
        .map(|name| json!({ "extension_mandatory": name }))
        .collect();
    if !unsupported.is_empty() {
        return Err(error(
            400,
            "not all extension_mandatory parameters are supported",
            unsupported,
        ));
    }
    let mut slaves = BTreeSet::from([slave.to_owned()]);
    let target = site_of(shared, slave)?;
    for additional in &asked.additional_slaves {
        site_of(shared, additional)?;
        slaves.insert(additional.clone());
    }
    let cost = number * size.div_ceil(limits.key_size.into());
    let bytes = usize::try_from(size / 8).map_err(|_| bad("size"))?;
    let drawn = shared
        .store()
        .draw((kme.index, target), number, bytes, cost, caller, &slaves)
        .ok_or_else(|| error(503, "not enough keys are stored", Vec::new()))?;
    kme.count(|counters| counters.keys_to_masters += number);
    let all = asked.extension_mandatory.iter().chain(&asked.extension_optional);
    let echo = all.filter_map(|extension| extension.get(ECHO)).next_back();
    Ok(container(drawn, echo, fault))
}

fn dec_keys(
    shared: &Shared,
    kme: &KmeState,
    caller: &str,
    master: &str,
    ids: &[String],
    fault: Option<&Fault>,
) -> Result<Answer, Answer> {
    if ids.is_empty() || ids.len() as u64 > shared.limits.max_keys_per_request {
        return Err(bad(format!("1 to {} key IDs", shared.limits.max_keys_per_request)));
    }
    let given = shared.store().give(ids, master, caller).map_err(|refusal| match refusal {
        Refusal::NotYours => error(401, "a key was not drawn by that master for this SAE", vec![]),
        Refusal::Unknown(ids) => {
            let details = ids.into_iter().map(|id| json!({ "key_ID": id })).collect();
            error(400, "one or more keys are not found on the KME", details)
        }
    })?;
    kme.count(|counters| counters.keys_to_slaves += given.len() as u64);
    Ok(container(given, None, fault))
}

/// Writes a key container without a copy of a key outside zeroized memory.
fn container(mut keys: Vec<Drawn>, echo: Option<&Value>, fault: Option<&Fault>) -> Answer {
    match fault {
        Some(Fault::WrongLength) => keys.iter_mut().for_each(|key| {
            key.1.pop();
        }),
        Some(Fault::RepeatKeyId) => {
            let first = keys[0].0.clone();
            keys.iter_mut().for_each(|key| key.0.clone_from(&first));
            if keys.len() == 1 {
                keys.extend_from_within(..);
            }
        }
        Some(Fault::KeyMissing) => drop(keys.remove(0)),
        Some(Fault::UpperCaseIds) => keys.iter_mut().for_each(|key| key.0.make_ascii_uppercase()),
        Some(Fault::OtherIds) => keys.iter_mut().for_each(|key| key.0 = uuid()),
        _ => {}
    }
    let text_of_key = |key: &Drawn| key.1.len().div_ceil(3) * 4 + 80;
    let echo = echo.map(ToString::to_string).unwrap_or_default();
    let capacity = 128 + echo.len() + keys.iter().map(text_of_key).sum::<usize>();
    let mut body = Zeroizing::new(String::with_capacity(capacity));
    body.push_str("{\"keys\":[");
    for (index, (id, secret)) in keys.iter().enumerate() {
        if index > 0 {
            body.push(',');
        }
        body.push_str("{\"key_ID\":\"");
        body.push_str(id);
        body.push_str("\",\"key\":\"");
        STANDARD.encode_string(secret.as_slice(), &mut body);
        body.push_str("\"}");
    }
    body.push(']');
    if !echo.is_empty() {
        body.push_str(",\"key_container_extension\":{\"");
        body.push_str(ECHO);
        body.push_str("\":");
        body.push_str(&echo);
        body.push('}');
    }
    body.push('}');
    Answer { status: 200, body, retry_after: None }
}
