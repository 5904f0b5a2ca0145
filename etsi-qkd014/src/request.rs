//! Requests for keys: `enc_keys` and `dec_keys`.

use reqwest::Url;
use serde::Serialize;
use serde_json::Value;

use crate::client::check_sae_id;
use crate::exchange::{Call, Prepared};
use crate::parse::{self, Asked};
use crate::{Client, Error, KeyContainer, Quirks};

/// A request for fresh keys (clauses 5.3 and 6.2). [`send`](EncKeys::send) sends it.
#[must_use = "nothing is sent before send()"]
#[derive(Debug)]
pub struct EncKeys<'c> {
    client: &'c Client,
    slave_sae: String,
    number: Option<u32>,
    size: Option<u32>,
    additional_slaves: Vec<String>,
    mandatory: Vec<Value>,
    optional: Vec<Value>,
    via_get: bool,
}

impl<'c> EncKeys<'c> {
    pub(crate) fn new(client: &'c Client, slave_sae: String) -> Self {
        Self {
            client,
            slave_sae,
            number: None,
            size: None,
            additional_slaves: Vec::new(),
            mandatory: Vec::new(),
            optional: Vec::new(),
            via_get: false,
        }
    }

    /// Sets the number of keys. Default 1.
    pub fn number(mut self, keys: u32) -> Self {
        self.number = Some(keys);
        self
    }

    /// Sets the size of each key in bits, a multiple of 8. Default the KME's
    /// [`key_size`](crate::Status::key_size). If this client has asked for the peer's
    /// [`status`](Client::status) before, the keys must have the size in the last status. Otherwise
    /// they only have to be of one size.
    pub fn size(mut self, bits: u32) -> Self {
        self.size = Some(bits);
        self
    }

    /// Sets further slaves that may draw the same keys (multicast).
    pub fn additional_slave_sae_ids<I>(mut self, saes: I) -> Self
    where
        I: IntoIterator<Item: Into<String>>,
    {
        self.additional_slaves.extend(saes.into_iter().map(Into::into));
        self
    }

    /// Adds an extension, a JSON object. A KME that does not support it must refuse the request.
    pub fn extension_mandatory(mut self, extension: Value) -> Self {
        self.mandatory.push(extension);
        self
    }

    /// Adds an extension, a JSON object, which the KME may ignore.
    pub fn extension_optional(mut self, extension: Value) -> Self {
        self.optional.push(extension);
        self
    }

    /// Sends the request as GET, which carries only `number` and `size`.
    pub fn via_get(mut self) -> Self {
        self.via_get = true;
        self
    }

    /// Sends the request and checks the answer: exactly as many keys as requested, each of the
    /// requested size, with distinct key_IDs.
    ///
    /// # Errors
    /// See [`Error`]. After [`KeyPossiblyConsumed`](Error::KeyPossiblyConsumed) the KME may have
    /// used up keys for this call.
    pub async fn send(self) -> Result<KeyContainer, Error> {
        let number = self.number.unwrap_or(1) as usize;
        let size = self.size.or_else(|| self.client.key_size(&self.slave_sae));
        self.check()?;
        check_answer(self.client, number, size)?;
        let quirks = self.client.limits().quirks;
        let url = self.client.url(&self.slave_sae, "enc_keys")?;
        let prepared = if self.via_get { self.get(url) } else { self.post(url) };
        let body = self.client.call(Call::EncKeys, &prepared).await?;
        parse::key_container(&body, &Asked::Number(number), size, quirks)
            .map_err(|e| Call::EncKeys.consumed(e))
    }

    fn check(&self) -> Result<(), Error> {
        if self.number == Some(0) {
            return Err(refuse("number is 0"));
        }
        check_size(self.size)?;
        let extensions = || self.mandatory.iter().chain(&self.optional);
        if extensions().any(|extension| !extension.is_object()) {
            return Err(refuse("an extension is a JSON object (clause 6.2)"));
        }
        let simple = self.additional_slaves.is_empty() && extensions().next().is_none();
        if self.via_get && !simple {
            return Err(refuse("GET carries only number and size; send it as POST (clause 6.2)"));
        }
        self.additional_slaves.iter().try_for_each(|sae| check_sae_id(sae))
    }

    /// Returns the size in the unit of the KME.
    fn wire_size(&self) -> Option<u32> {
        let bytes = self.client.limits().quirks.contains(Quirks::SIZE_IN_BYTES);
        self.size.map(|bits| if bytes { bits / 8 } else { bits })
    }

    fn get(&self, mut url: Url) -> Prepared {
        if self.number.is_some() || self.size.is_some() {
            let mut query = url.query_pairs_mut();
            if let Some(number) = self.number {
                query.append_pair("number", &number.to_string());
            }
            if let Some(size) = self.wire_size() {
                query.append_pair("size", &size.to_string());
            }
        }
        Prepared::get(url)
    }

    fn post(&self, url: Url) -> Prepared {
        let body = KeyRequest {
            number: self.number,
            size: self.wire_size(),
            additional_slave_sae_ids: &self.additional_slaves,
            extension_mandatory: &self.mandatory,
            extension_optional: &self.optional,
        };
        Prepared::post(url, &body)
    }
}

/// The body of `enc_keys` (clause 6.2). Members that were not set are absent.
#[derive(Serialize)]
struct KeyRequest<'r> {
    #[serde(skip_serializing_if = "Option::is_none")]
    number: Option<u32>,
    #[serde(skip_serializing_if = "Option::is_none")]
    size: Option<u32>,
    #[serde(rename = "additional_slave_SAE_IDs", skip_serializing_if = "<[_]>::is_empty")]
    additional_slave_sae_ids: &'r [String],
    #[serde(skip_serializing_if = "<[_]>::is_empty")]
    extension_mandatory: &'r [Value],
    #[serde(skip_serializing_if = "<[_]>::is_empty")]
    extension_optional: &'r [Value],
}

/// The body of `dec_keys` (clause 6.4).
#[derive(Serialize)]
struct KeyIds<'r> {
    #[serde(rename = "key_IDs")]
    key_ids: Vec<KeyId<'r>>,
    #[serde(rename = "key_IDs_extension", skip_serializing_if = "Option::is_none")]
    extension: Option<&'r Value>,
}

#[derive(Serialize)]
struct KeyId<'r> {
    #[serde(rename = "key_ID")]
    key_id: &'r str,
    #[serde(rename = "key_ID_extension", skip_serializing_if = "Option::is_none")]
    extension: Option<&'r Value>,
}

/// A request for keys by their key_IDs (clauses 5.4 and 6.4). [`send`](DecKeys::send) sends it.
#[must_use = "nothing is sent before send()"]
#[derive(Debug)]
pub struct DecKeys<'c> {
    client: &'c Client,
    master_sae: String,
    ids: Vec<String>,
    id_extensions: Vec<(usize, Value)>,
    extension: Option<Value>,
    size: Option<u32>,
    via_get: bool,
}

impl<'c> DecKeys<'c> {
    pub(crate) fn new(client: &'c Client, master_sae: String) -> Self {
        Self {
            client,
            master_sae,
            ids: Vec::new(),
            id_extensions: Vec::new(),
            extension: None,
            size: None,
            via_get: false,
        }
    }

    /// Adds a key_ID, exactly as the master gave it.
    pub fn key_id(mut self, id: impl Into<String>) -> Self {
        self.ids.push(id.into());
        self
    }

    /// Adds a key_ID with a `key_ID_extension` (clause 6.4): a JSON object.
    pub fn key_id_with_extension(mut self, id: impl Into<String>, extension: Value) -> Self {
        self.id_extensions.push((self.ids.len(), extension));
        self.key_id(id)
    }

    /// Sets the `key_IDs_extension` of the request (clause 6.4): a JSON object.
    pub fn key_ids_extension(mut self, extension: Value) -> Self {
        self.extension = Some(extension);
        self
    }

    /// Adds key_IDs.
    pub fn key_ids<I>(mut self, ids: I) -> Self
    where
        I: IntoIterator<Item: Into<String>>,
    {
        self.ids.extend(ids.into_iter().map(Into::into));
        self
    }

    /// Sets the size in bits that every key must have. It is not sent. Without it, the keys only
    /// have to be of one size.
    pub fn size(mut self, bits: u32) -> Self {
        self.size = Some(bits);
        self
    }

    /// Sends the request as GET, which carries one key_ID.
    pub fn via_get(mut self) -> Self {
        self.via_get = true;
        self
    }

    /// Sends the request and checks the answer: exactly the requested keys, in their order.
    ///
    /// # Errors
    /// See [`Error`]. After [`KeyPossiblyConsumed`](Error::KeyPossiblyConsumed) the KME may have
    /// destroyed the keys of this call.
    pub async fn send(self) -> Result<KeyContainer, Error> {
        self.check()?;
        let quirks = self.client.limits().quirks;
        let mut url = self.client.url(&self.master_sae, "dec_keys")?;
        let prepared = if self.via_get {
            url.query_pairs_mut().append_pair("key_ID", &self.ids[0]);
            Prepared::get(url)
        } else {
            Prepared::post(url, &self.body())
        };
        let body = self.client.call(Call::DecKeys, &prepared).await?;
        parse::key_container(&body, &Asked::Ids(&self.ids), self.size, quirks)
            .map_err(|e| Call::DecKeys.consumed(e))
    }

    fn body(&self) -> KeyIds<'_> {
        let plain = |id| KeyId { key_id: id, extension: None };
        let mut key_ids: Vec<_> = self.ids.iter().map(|id| plain(id.as_str())).collect();
        for (at, extension) in &self.id_extensions {
            key_ids[*at].extension = Some(extension);
        }
        KeyIds { key_ids, extension: self.extension.as_ref() }
    }

    fn check(&self) -> Result<(), Error> {
        check_size(self.size)?;
        let mut extensions = self.id_extensions.iter().map(|(_, one)| one).chain(&self.extension);
        if extensions.any(|extension| !extension.is_object()) {
            return Err(refuse("an extension is a JSON object (clause 6.4)"));
        }
        if self.via_get && !(self.id_extensions.is_empty() && self.extension.is_none()) {
            return Err(refuse("GET carries no extension; send it as POST (clause 6.4)"));
        }
        if self.ids.is_empty() {
            return Err(refuse("no key_ID was given"));
        }
        if self.via_get && self.ids.len() > 1 {
            return Err(refuse("GET carries one key_ID; send it as POST (clause 6.4)"));
        }
        let any = self.client.limits().quirks.contains(Quirks::ANY_KEY_ID);
        for id in self.ids.iter().filter(|id| !parse::is_uuid(id)) {
            if !parse::is_key_id(id) {
                return Err(refuse("a key_ID is 1 to 128 visible ASCII characters"));
            }
            // The answer could not pass the checks either, and the keys would be consumed.
            if !any {
                return Err(refuse(&format!(
                    "key_ID {id} is not a UUID (clause 6.4; quirk any-key-id tolerates others)"
                )));
            }
        }
        match parse::repeated(self.ids.iter().map(String::as_str)) {
            Some(id) => Err(refuse(&format!("key_ID {id} is asked for twice"))),
            None => check_answer(self.client, self.ids.len(), self.size),
        }
    }
}

/// Refuses a request whose answer would always be refused, after its keys were consumed.
fn check_answer(client: &Client, number: usize, size: Option<u32>) -> Result<(), Error> {
    if number > parse::MAX_KEYS {
        let most = parse::MAX_KEYS;
        return Err(refuse(&format!("{number} keys; this client takes {most} at a time")));
    }
    let least = parse::least_length(number, size);
    let limit = client.limits().max_body;
    if least > limit as u64 {
        return Err(refuse(&format!(
            "the answer would have {least} bytes or more, over max_body ({limit}); ask for fewer keys"
        )));
    }
    Ok(())
}

fn check_size(size: Option<u32>) -> Result<(), Error> {
    match size {
        Some(bits) if bits == 0 || !bits.is_multiple_of(8) => Err(refuse(&format!(
            "size {bits} is not a positive multiple of 8 bits; this client takes whole bytes only"
        ))),
        _ => Ok(()),
    }
}

fn refuse(reason: &str) -> Error {
    Error::Request { reason: reason.to_owned() }
}
