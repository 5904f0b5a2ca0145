//! Parsers of a KME's answers. They are bounded, do not panic, and make no copy of a key outside
//! zeroized memory.
//!
//! serde_json only splits the text into members ([`json`]). It never makes the value of `key` into
//! a `String`: that value is decoded from the raw text into zeroized bytes ([`base64`]).

mod base64;
mod container;
mod error;
mod json;
mod status;

pub(crate) use base64::decode_text as base64_text;
pub(crate) use container::{
    Asked, MAX_KEYS, is_key_id, is_uuid, key_container, least_length, repeated,
};
pub(crate) use error::{ErrorAnswer, error_answer};
pub(crate) use status::status;

use crate::Error;

fn malformed(what: impl Into<String>, reason: impl Into<String>) -> Error {
    Error::Malformed { what: what.into(), reason: reason.into() }
}
