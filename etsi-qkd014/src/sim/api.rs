//! The answers of a KME to the three methods.

use std::collections::BTreeSet;

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use serde::de::value::MapAccessDeserializer;
use serde::de::{Deserialize, DeserializeOwned, Deserializer, Error as _, MapAccess, Visitor};
use serde_json::{Value, json};
use zeroize::Zeroizing;

use super::fault::Fault;
use super::http::{Answer, Request, percent_decode};
use super::network::{KmeState, NetworkShared};
use super::plan::Method;
use super::store::{Drawn, Refusal, uuid};

/// The KME returns a member of this name, in a mandatory or optional extension, in `key_container_extension`.
const ECHO: &str = "kme_sim_echo";

/// A member of this name, in a mandatory or optional extension, asks for a kind of route. Every key then states its
/// kind in its `key_extension`. Any two KMEs of a network have a link of their own, so there are only [`DIRECT`]
/// routes.
const ROUTE: &str = "kme_sim_route_type";
const DIRECT: &str = "direct";

/// The mandatory extensions that are supported, as listed in the `status_extension`.
const EXTENSIONS: [&str; 2] = [ECHO, ROUTE];

#[derive(Default, serde::Deserialize)]
#[serde(default, deny_unknown_fields)]
struct KeyRequest {
    #[serde(deserialize_with = "present")]
    number: Option<u64>,
    #[serde(deserialize_with = "present")]
    size: Option<u64>,
    #[serde(rename = "additional_slave_SAE_IDs")]
    additional_slaves: Vec<String>,
    extension_mandatory: Vec<serde_json::Map<String, Value>>,
    extension_optional: Vec<serde_json::Map<String, Value>>,
}

#[derive(serde::Deserialize)]
#[serde(deny_unknown_fields)]
struct KeyIds {
    #[serde(rename = "key_IDs")]
    ids: Vec<Object<KeyIdItem>>,
    #[serde(default, rename = "key_IDs_extension")]
    _extension: serde_json::Map<String, Value>,
}

#[derive(serde::Deserialize)]
#[serde(deny_unknown_fields)]
struct KeyIdItem {
    #[serde(rename = "key_ID")]
    id: String,
    #[serde(default, rename = "key_ID_extension")]
    _extension: serde_json::Map<String, Value>,
}

/// The body of a POST.
trait Body: DeserializeOwned {
    /// The members that the specification lists.
    const MEMBERS: &'static [&'static str];
    /// The member that is an array of objects, and the members of these objects.
    const ITEMS: Option<(&'static str, &'static [&'static str])>;
}

impl Body for KeyRequest {
    const MEMBERS: &'static [&'static str] = &[
        "number",
        "size",
        "additional_slave_SAE_IDs",
        "extension_mandatory",
        "extension_optional",
    ];
    const ITEMS: Option<(&'static str, &'static [&'static str])> = None;
}

impl Body for KeyIds {
    const MEMBERS: &'static [&'static str] = &["key_IDs", "key_IDs_extension"];
    const ITEMS: Option<(&'static str, &'static [&'static str])> =
        Some(("key_IDs", &["key_ID", "key_ID_extension"]));
}

/// Removes members that are not in `members`, and members that are `null`. The specification forbids neither other
/// members nor `null` for an absent optional member. A mandatory member that is `null` is then missing.
fn prune(object: &mut serde_json::Map<String, Value>, members: &[&str]) {
    object.retain(|name, value| members.contains(&name.as_str()) && !value.is_null());
}

/// Parses the JSON object of a POST.
fn posted<B: Body>(request: &Request, strict: bool) -> Result<B, Answer> {
    let unreadable = |error| bad(format!("the body cannot be read: {error}"));
    let whole = || serde_json::from_slice::<Object<B>>(&request.body).map(|Object(body)| body);
    if strict {
        return whole().map_err(unreadable);
    }
    // All members of enc_keys are optional, so a body without any may be empty (clause 6.2).
    let body: &[u8] = if request.body.is_empty() { b"{}" } else { &request.body[..] };
    let Object(Unique(mut object)) = serde_json::from_slice(body).map_err(unreadable)?;
    prune(&mut object, B::MEMBERS);
    if let Some((name, members)) = B::ITEMS
        && let Some(items) = object.get_mut(name).and_then(Value::as_array_mut)
    {
        items.iter_mut().filter_map(Value::as_object_mut).for_each(|item| prune(item, members));
    }
    serde_json::from_value::<Object<B>>(Value::Object(object))
        .map(|Object(body)| body)
        .map_err(unreadable)
}

/// The members of an object. Parsing refuses duplicates.
struct Unique(serde_json::Map<String, Value>);

impl<'de> Deserialize<'de> for Unique {
    fn deserialize<D: Deserializer<'de>>(from: D) -> Result<Self, D::Error> {
        struct Members;

        impl<'de> Visitor<'de> for Members {
            type Value = Unique;

            fn expecting(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                f.write_str("an object")
            }

            fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<Unique, A::Error> {
                let mut object = serde_json::Map::new();
                while let Some((name, value)) = map.next_entry::<String, Value>()? {
                    if object.contains_key(&name) {
                        return Err(A::Error::custom(format!("duplicate member {name:?}")));
                    }
                    object.insert(name, value);
                }
                Ok(Unique(object))
            }
        }
        from.deserialize_map(Members)
    }
}

/// A JSON object only; a derived `Deserialize` would also accept an array of the members.
struct Object<T>(T);

impl<'de, T: DeserializeOwned> Deserialize<'de> for Object<T> {
    fn deserialize<D: Deserializer<'de>>(from: D) -> Result<Self, D::Error> {
        struct Members<T>(std::marker::PhantomData<T>);

        impl<'de, T: DeserializeOwned> Visitor<'de> for Members<T> {
            type Value = Object<T>;

            fn expecting(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                f.write_str("an object")
            }

            fn visit_map<A: MapAccess<'de>>(self, map: A) -> Result<Object<T>, A::Error> {
                T::deserialize(MapAccessDeserializer::new(map)).map(Object)
            }
        }
        from.deserialize_map(Members(std::marker::PhantomData))
    }
}

/// Parses a member that may be absent, but not `null`.
fn present<'de, D: Deserializer<'de>>(from: D) -> Result<Option<u64>, D::Error> {
    u64::deserialize(from).map(Some)
}

/// Answers one request of the SAE named by the client's certificate.
pub(super) fn answer(
    shared: &NetworkShared,
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
    // The answer to a HEAD must not have a body, but this one has, so the connection is closed.
    Answer { close: request.close || request.method == "HEAD", ..answer }
}

/// Returns the method that a request names, whether or not it can be served.
pub(super) fn method(request: &Request) -> Option<Method> {
    let (_, name) = request.path.strip_prefix("/api/v1/keys/")?.split_once('/')?;
    Method::named(name)
}

pub(super) fn error(status: u16, message: impl Into<String>, details: Vec<Value>) -> Answer {
    let mut body = json!({ "message": message.into() });
    if !details.is_empty() {
        body["details"] = details.into();
    }
    Answer { status, body: body.to_string().into(), retry_after: None, close: false }
}

fn bad(message: impl Into<String>) -> Answer {
    error(400, message, Vec::new())
}

fn route(
    shared: &NetworkShared,
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
                close: false,
            });
        }
        _ => {}
    }
    if get && !request.body.is_empty() {
        return Err(bad("a GET has no body"));
    }
    // An absent body needs no media type.
    if !get && !request.json && (shared.strict || !request.body.is_empty()) {
        return Err(bad("the Content-Type is not application/json"));
    }
    match method {
        "status" => status(shared, kme, caller, &sae),
        "enc_keys" => {
            let asked = if get {
                enc_query(&request.query, shared.strict)?
            } else {
                posted(request, shared.strict)?
            };
            enc_keys(shared, kme, caller, &sae, &asked, fault)
        }
        _ => {
            let ids = if get {
                dec_query(&request.query, shared.strict)?
            } else {
                let ids: KeyIds = posted(request, shared.strict)?;
                ids.ids.into_iter().map(|Object(item)| item.id).collect()
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
    let mut pairs = Vec::new();
    for part in query.split('&').filter(|part| !part.is_empty()) {
        let (name, value) = pair(part).ok_or_else(|| bad("the query cannot be read"))?;
        if pairs.iter().any(|(other, _)| *other == name) {
            return Err(bad("a parameter is given twice"));
        }
        pairs.push((name, value));
    }
    Ok(pairs)
}

fn enc_query(query: &str, strict: bool) -> Result<KeyRequest, Answer> {
    let mut asked = KeyRequest::default();
    for (name, value) in pairs(query)? {
        let number = match name.as_str() {
            "number" => &mut asked.number,
            "size" => &mut asked.size,
            _ if strict => return Err(bad(format!("{name:?} is not a parameter of enc_keys"))),
            _ => continue,
        };
        *number = Some(value.parse().map_err(|_| bad(format!("{name} is not a number")))?);
    }
    Ok(asked)
}

fn dec_query(query: &str, strict: bool) -> Result<Vec<String>, Answer> {
    let mut pairs = pairs(query)?;
    if !strict {
        pairs.retain(|(name, _)| name == "key_ID");
    }
    match pairs.as_slice() {
        [(name, id)] if name == "key_ID" => Ok(vec![id.clone()]),
        _ => Err(bad("GET takes one parameter, key_ID")),
    }
}

fn site_of(shared: &NetworkShared, sae: &str) -> Result<usize, Answer> {
    shared.site_of(sae).ok_or_else(|| bad(format!("SAE {sae:?} is not known")))
}

fn status(
    shared: &NetworkShared,
    kme: &KmeState,
    caller: &str,
    slave: &str,
) -> Result<Answer, Answer> {
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
        "status_extension": { "kme_sim_extensions": EXTENSIONS },
    });
    Ok(Answer { status: 200, body: body.to_string().into(), retry_after: None, close: false })
}

fn enc_keys(
    shared: &NetworkShared,
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
    if !size.is_multiple_of(8) {
        return Err(bad("size shall be a multiple of 8"));
    }
    if !(min..=max).contains(&size) {
        return Err(bad(format!("size is not in {min}..={max}")));
    }
    if asked.additional_slaves.len() as u64 > limits.max_sae_ids {
        return Err(bad(format!("more than {} additional slave SAEs", limits.max_sae_ids)));
    }
    mandatory(&asked.extension_mandatory)?;
    let mut slaves = BTreeSet::new();
    let mut links = BTreeSet::new();
    for slave in asked.additional_slaves.iter().map(String::as_str).chain([slave]) {
        links.insert((kme.index, site_of(shared, slave)?));
        slaves.insert(slave.to_owned());
    }
    let cost = number * size.div_ceil(limits.key_size.into());
    let bytes = usize::try_from(size / 8).map_err(|_| bad("size"))?;
    let mut drawn = shared
        .store()
        .draw(&links, number, bytes, cost, caller, &slaves)
        .ok_or_else(|| error(503, "not enough keys are stored", Vec::new()))?;
    kme.count(|counters| counters.keys_to_masters += number);
    kme.last_key_id(|last| {
        if let (Some(Fault::ReuseKeyId), Some(before)) = (fault, last.take()) {
            drawn[0].0 = before;
        }
        *last = drawn.last().map(|(id, _)| id.clone());
    });
    let named = |name: &str| {
        let all = asked.extension_mandatory.iter().chain(&asked.extension_optional);
        all.filter_map(|extension| extension.get(name)).next_back()
    };
    let extensions = Extensions {
        container: named(ECHO).map(|echo| json!({ ECHO: echo }).to_string()),
        key: named(ROUTE).map(|_| json!({ ROUTE: DIRECT }).to_string()),
    };
    Ok(container(drawn, &extensions, fault))
}

/// Refuses mandatory extensions that are not supported, or whose request cannot be met (clause 6.2).
fn mandatory(extensions: &[serde_json::Map<String, Value>]) -> Result<(), Answer> {
    let all = || extensions.iter().flatten();
    let details = |what: &str, of: Vec<(&String, &str)>| -> Vec<Value> {
        of.into_iter().map(|(name, why)| json!({ what: format!("{name} {why}") })).collect()
    };
    let unsupported: Vec<_> = all()
        .filter(|(name, _)| !EXTENSIONS.contains(&name.as_str()))
        .map(|(name, _)| (name, "is not supported"))
        .collect();
    if !unsupported.is_empty() {
        let details = details("extension_mandatory_unsupported", unsupported);
        return Err(error(400, "not all extension_mandatory parameters are supported", details));
    }
    let unmet: Vec<_> = all()
        .filter(|(name, value)| *name == ROUTE && *value != DIRECT)
        .map(|(name, _)| (name, "is direct for every key of this KME"))
        .collect();
    if !unmet.is_empty() {
        let details = details("extension_mandatory_unmet", unmet);
        let message = "not all extension_mandatory request options could be met";
        return Err(error(400, message, details));
    }
    Ok(())
}

fn dec_keys(
    shared: &NetworkShared,
    kme: &KmeState,
    caller: &str,
    master: &str,
    ids: &[String],
    fault: Option<&Fault>,
) -> Result<Answer, Answer> {
    if ids.is_empty() || ids.len() as u64 > shared.limits.max_keys_per_request {
        return Err(bad(format!("1 to {} key IDs", shared.limits.max_keys_per_request)));
    }
    let keep = fault == Some(&Fault::KeyKept);
    let given =
        shared.store().give(ids, master, caller, keep).map_err(|refusal| match refusal {
            Refusal::NotYours => {
                error(401, "a key was not drawn by that master for this SAE", vec![])
            }
            Refusal::Unknown(ids) => {
                let details = ids.into_iter().map(|id| json!({ "key_ID": id })).collect();
                error(400, "one or more keys specified are not found on KME", details)
            }
        })?;
    kme.count(|counters| counters.keys_to_slaves += given.len() as u64);
    Ok(container(given, &Extensions::default(), fault))
}

/// JSON texts that go with keys. They contain no secret.
#[derive(Default)]
struct Extensions {
    /// `key_container_extension`.
    container: Option<String>,
    /// `key_extension` of each key.
    key: Option<String>,
}

/// Writes a key container without leaving a copy of a key outside zeroized memory.
fn container(mut keys: Vec<Drawn>, extensions: &Extensions, fault: Option<&Fault>) -> Answer {
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
        Some(Fault::WrongKey) => keys[0].1.iter_mut().for_each(|byte| *byte = !*byte),
        Some(Fault::KeyMissing) => drop(keys.remove(0)),
        Some(Fault::UpperCaseIds) => keys.iter_mut().for_each(|key| key.0.make_ascii_uppercase()),
        Some(Fault::OtherIds) => keys.iter_mut().for_each(|key| key.0 = uuid()),
        _ => {}
    }
    let length = |text: &Option<String>| text.as_ref().map_or(0, |text| text.len() + 40);
    let of_key = length(&extensions.key) + 80;
    let text_of_key = |key: &Drawn| key.1.len().div_ceil(3) * 4 + of_key;
    let of_container = length(&extensions.container) + 40;
    let capacity = of_container + keys.iter().map(text_of_key).sum::<usize>();
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
        body.push('"');
        if let Some(extension) = &extensions.key {
            body.push_str(",\"key_extension\":");
            body.push_str(extension);
        }
        body.push('}');
    }
    body.push(']');
    if let Some(extension) = &extensions.container {
        body.push_str(",\"key_container_extension\":");
        body.push_str(extension);
    }
    body.push('}');
    debug_assert!(body.len() <= capacity, "a grown string leaves a copy of the keys behind");
    Answer { status: 200, body, retry_after: None, close: false }
}
