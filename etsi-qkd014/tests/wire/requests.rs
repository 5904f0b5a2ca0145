//! Tests the requests of this client: method, path, query, body and headers of each call. The mock answers a request
//! that differs with 404, and the call fails.

use std::time::Duration;

use etsi_qkd014::{KeyContainer, Quirks, RetryPolicy};
use serde_json::json;
use wiremock::matchers::{body_json, body_string, header, method, path};
use wiremock::{Match, Mock, MockBuilder, Request, ResponseTemplate};

use crate::kme::{ID, KEY, Kme, container, ok};

/// No `Content-Type`, `Authorization` or cookie where there is nothing to label or to show.
struct Without(&'static [&'static str]);

impl Match for Without {
    fn matches(&self, request: &Request) -> bool {
        self.0.iter().all(|name| !request.headers.contains_key(*name))
    }
}

/// The whole query.
struct Query(&'static str);

impl Match for Query {
    fn matches(&self, request: &Request) -> bool {
        request.url.query().unwrap_or_default() == self.0
    }
}

fn get(at: &str, query: &'static str) -> MockBuilder {
    Mock::given(method("GET"))
        .and(path(format!("/api/v1/keys/{at}")))
        .and(Query(query))
        .and(header("accept", "application/json"))
        .and(header("accept-encoding", "identity"))
        .and(body_string(""))
        .and(Without(&["content-type", "authorization", "cookie", "referer", "transfer-encoding"]))
}

fn post(at: &str, body: serde_json::Value) -> MockBuilder {
    Mock::given(method("POST"))
        .and(path(format!("/api/v1/keys/{at}")))
        .and(Query(""))
        .and(header("accept", "application/json"))
        .and(header("content-type", "application/json"))
        .and(header("accept-encoding", "identity"))
        .and(body_json(body))
        .and(Without(&["authorization", "cookie", "referer", "transfer-encoding", "expect"]))
}

/// Answers one call, and fails the test if there was not exactly one.
async fn once(kme: &Kme, request: MockBuilder) {
    request.respond_with(ok(container())).expect(1).mount(&kme.mock).await;
}

fn one(container: KeyContainer) {
    assert_eq!(container.into_single().key_id(), ID);
}

#[tokio::test]
async fn status_is_a_get_without_a_body() {
    let kme = Kme::start().await;
    let answer = json!({
        "source_KME_ID": "kme-a", "target_KME_ID": "kme-b",
        "master_SAE_ID": "sae-a", "slave_SAE_ID": "sae-b",
        "key_size": 256, "stored_key_count": 7, "max_key_count": 10, "max_key_per_request": 5,
        "max_key_size": 1024, "min_key_size": 64, "max_SAE_ID_count": 0,
    });
    get("sae-b/status", "").respond_with(ok(answer.to_string())).expect(1).mount(&kme.mock).await;
    let status = kme.client().build().unwrap().status("sae-b").await.unwrap();
    assert_eq!((status.stored_key_count, status.max_key_per_request), (7, 5));
}

/// Clause 6.2: all members are optional, and one that is not needed is absent, not `null` or empty.
#[tokio::test]
async fn enc_keys_by_post_carries_only_the_requested_members() {
    let kme = Kme::start().await;
    let client = kme.client().build().unwrap();
    once(&kme, post("sae-b/enc_keys", json!({}))).await;
    one(client.enc_keys("sae-b").send().await.unwrap());

    once(&kme, post("sae-b/enc_keys", json!({ "number": 1, "size": 256 }))).await;
    one(client.enc_keys("sae-b").number(1).size(256).send().await.unwrap());

    let whole = json!({
        "size": 256,
        "additional_slave_SAE_IDs": ["sae-c", "sae-d"],
        "extension_mandatory": [{ "abc_route": { "hops": [1, 2] } }],
        "extension_optional": [{ "a": null }, { "b": "\u{fc}" }],
    });
    once(&kme, post("sae-b/enc_keys", whole)).await;
    let request = client
        .enc_keys("sae-b")
        .size(256)
        .additional_slave_sae_ids(["sae-c", "sae-d"])
        .extension_mandatory(json!({ "abc_route": { "hops": [1, 2] } }))
        .extension_optional(json!({ "a": null }))
        .extension_optional(json!({ "b": "\u{fc}" }));
    one(request.send().await.unwrap());
}

#[tokio::test]
async fn enc_keys_by_get_carries_number_and_size_in_the_query() {
    let kme = Kme::start().await;
    let client = kme.client().build().unwrap();
    once(&kme, get("sae-b/enc_keys", "")).await;
    one(client.enc_keys("sae-b").via_get().send().await.unwrap());

    once(&kme, get("sae-b/enc_keys", "number=1&size=256")).await;
    one(client.enc_keys("sae-b").number(1).size(256).via_get().send().await.unwrap());
}

#[tokio::test]
async fn dec_keys_carries_the_key_ids_as_they_were_given() {
    let kme = Kme::start().await;
    let client = kme.client().build().unwrap();
    let upper = ID.to_uppercase();
    once(&kme, post("sae-a/dec_keys", json!({ "key_IDs": [{ "key_ID": upper }] }))).await;
    let key = client.dec_keys("sae-a").key_id(&upper).size(256).send().await.unwrap();
    assert_eq!(key.into_single().key_id(), upper);

    let extended = json!({
        "key_IDs": [{ "key_ID": ID, "key_ID_extension": { "x": 1 } }],
        "key_IDs_extension": { "y": [] },
    });
    once(&kme, post("sae-a/dec_keys", extended)).await;
    let request = client.dec_keys("sae-a").key_id_with_extension(ID, json!({ "x": 1 }));
    one(request.key_ids_extension(json!({ "y": [] })).send().await.unwrap());

    once(&kme, get("sae-a/dec_keys", "key_ID=bc490419-7d60-487f-adc1-4ddcc177c139")).await;
    one(client.dec_keys("sae-a").key_id(ID).via_get().send().await.unwrap());
}

/// An SAE ID is one segment of the path, whatever is in it.
#[tokio::test]
async fn an_sae_id_is_one_segment_of_the_path() {
    let kme = Kme::start().await;
    let client = kme.client().build().unwrap();
    for (id, segment) in [("a/../b", "a%2F..%2Fb"), ("a?b#c", "a%3Fb%23c"), ("a%2Fb", "a%252Fb")] {
        once(&kme, post(&format!("{segment}/enc_keys"), json!({}))).await;
        one(client.enc_keys(id).send().await.unwrap());
    }
}

#[tokio::test]
async fn a_kme_that_counts_in_bytes_is_asked_in_bytes_under_its_quirk() {
    let kme = Kme::start().await;
    once(&kme, post("sae-b/enc_keys", json!({ "size": 32 }))).await;
    let client = kme.client().quirks(Quirks::SIZE_IN_BYTES).build().unwrap();
    one(client.enc_keys("sae-b").size(256).send().await.unwrap());
}

/// The repeat is the same request, and the policy's number of repeats is the most there are.
#[tokio::test]
async fn a_call_refused_for_want_of_keys_is_repeated_as_it_was() {
    let kme = Kme::start().await;
    let body = json!({ "number": 1, "size": 256 });
    let empty = ResponseTemplate::new(503).set_body_json(json!({ "message": "no keys" }));
    let first = post("sae-b/enc_keys", body.clone()).respond_with(empty.clone());
    first.up_to_n_times(2).expect(2).mount(&kme.mock).await;
    once(&kme, post("sae-b/enc_keys", body.clone())).await;
    let policy =
        RetryPolicy::none().enc_keys(2).pause(Duration::from_millis(1), Duration::from_millis(2));
    let client = kme.client().retry(policy.clone()).build().unwrap();
    one(client.enc_keys("sae-b").number(1).size(256).send().await.unwrap());

    let kme = Kme::start().await;
    post("sae-b/enc_keys", body).respond_with(empty).expect(3).mount(&kme.mock).await;
    let client = kme.client().retry(policy).build().unwrap();
    let error = client.enc_keys("sae-b").number(1).size(256).send().await.err().unwrap();
    assert_eq!(error.status_code(), Some(503), "{error}");
    assert!(!error.to_string().contains(KEY));
}
