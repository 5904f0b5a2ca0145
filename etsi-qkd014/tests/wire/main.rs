//! Tests the bytes on the wire, as far as the specification fixes them: the requests that this client sends, and
//! answers that no KME should give. The answers are wiremock's; answers that are not even HTTP are in
//! `tests/adversary`.

mod answers;
mod json;
mod kme;
mod requests;
