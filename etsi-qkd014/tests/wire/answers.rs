//! Tests whole HTTP answers that no KME should give. Each fails the call. The error states truthfully whether keys may
//! be lost, and reveals no key.

use etsi_qkd014::{Error, KeyContainer, Quirks};
use serde_json::{Value, json};
use wiremock::ResponseTemplate;

use crate::kme::{ID, KEY, Kme, container, ok};

const OTHER_ID: &str = "0a782fb5-3434-48fe-aa4d-14f41d46cf92";
const OTHER_KEY: &str = "OeGMPxh1+2RpJpNCYixWHFLYRubpOKCw94FcCI7VdJA=";

async fn enc(answer: ResponseTemplate, number: u32) -> Result<KeyContainer, Error> {
    let kme = Kme::start().await;
    kme.mount(answer).await;
    let client = kme.client().max_body(64 << 10).build().unwrap();
    client.enc_keys("sae-b").number(number).size(256).send().await
}

/// Checks that the call fails after its keys may have been consumed, and that the error reveals no key.
async fn in_doubt(answer: ResponseTemplate, number: u32) -> Error {
    let error = enc(answer, number).await.err().expect("the answer must not be taken");
    assert!(error.keys_may_be_consumed(), "{error}");
    for key in [KEY, OTHER_KEY] {
        assert!(!format!("{error} {error:?}").contains(&key[..12]), "{error:?}");
    }
    error
}

fn keys(keys: &[(&str, &str)]) -> ResponseTemplate {
    let keys: Vec<Value> =
        keys.iter().map(|(id, key)| json!({ "key_ID": id, "key": key })).collect();
    ok(json!({ "keys": keys }).to_string())
}

#[tokio::test]
async fn an_answer_of_another_content_type_needs_its_quirk() {
    let answer = |label| ResponseTemplate::new(200).set_body_raw(container(), label);
    for label in ["text/plain", "text/html; charset=utf-8", "application/jsonp", "", "json", "*/*"]
    {
        let error = in_doubt(answer(label), 1).await;
        assert!(matches!(error.cause(), Error::Malformed { .. }), "{label}: {error}");
        let kme = Kme::start().await;
        kme.mount(answer(label)).await;
        let client = kme.client().quirks(Quirks::ANY_MEDIA_TYPE).build().unwrap();
        client.enc_keys("sae-b").send().await.unwrap();
    }
}

#[tokio::test]
async fn json_cut_off_at_any_byte_is_refused() {
    let whole = container();
    let kme = Kme::start().await;
    let client = kme.client().build().unwrap();
    for end in 0..whole.len() {
        kme.mock.reset().await;
        kme.mount(ok(&whole.as_bytes()[..end])).await;
        let error = client.enc_keys("sae-b").send().await.err().expect("it was taken");
        assert!(matches!(error.cause(), Error::Malformed { .. }), "{end}: {error}");
        assert!(error.keys_may_be_consumed(), "{end}: {error}");
    }
    kme.mock.reset().await;
    kme.mount(ok(whole)).await;
    client.enc_keys("sae-b").send().await.unwrap();
}

#[tokio::test]
async fn a_body_over_the_limit_is_refused_by_its_length_and_by_its_bytes() {
    let mut huge = container().into_bytes();
    huge.resize(8 << 20, b' ');
    let error = in_doubt(ok(huge), 1).await;
    assert!(matches!(error.cause(), Error::BodyTooLarge { limit: 65536 }), "{error}");
    let mut largest = container().into_bytes();
    largest.resize(64 << 10, b' ');
    enc(ok(largest.clone()), 1).await.unwrap();
    largest.push(b' ');
    let error = in_doubt(ok(largest), 1).await;
    assert!(matches!(error.cause(), Error::BodyTooLarge { .. }), "{error}");
}

#[tokio::test]
async fn another_number_of_keys_than_asked_for_is_refused() {
    let two = [(ID, KEY), (OTHER_ID, OTHER_KEY)];
    assert_eq!(enc(keys(&two), 2).await.unwrap().keys.len(), 2);
    for (answer, number) in [(&two[..], 1), (&two[..1], 2), (&[], 1), (&two[..], 3)] {
        let error = in_doubt(keys(answer), number).await;
        assert!(matches!(error.cause(), Error::Check { .. }), "{error}");
    }
}

#[tokio::test]
async fn one_key_id_for_two_keys_is_refused_in_any_letter_case() {
    for id in [ID.to_owned(), ID.to_uppercase()] {
        let error = in_doubt(keys(&[(ID, KEY), (&id, OTHER_KEY)]), 2).await;
        assert!(matches!(error.cause(), Error::Check { .. }), "{id}: {error}");
    }
}

#[tokio::test]
async fn keys_of_another_size_than_asked_for_are_refused() {
    for key in ["AAAA", &"AAAA".repeat(22), "", "AA=="] {
        let error = in_doubt(keys(&[(ID, key)]), 1).await;
        let cause = error.cause();
        assert!(matches!(cause, Error::Check { .. } | Error::Malformed { .. }), "{key}: {cause}");
    }
}

/// A 200 with the body of an error, and errors with the body of a 200.
#[tokio::test]
async fn the_status_code_decides_how_a_body_is_parsed() {
    let message = json!({ "message": "no keys", "details": [] }).to_string();
    let error = in_doubt(ok(message), 1).await;
    assert!(matches!(error.cause(), Error::Malformed { .. }), "{error}");
    for code in [400, 401, 403, 404, 418, 429, 503] {
        let answer = ResponseTemplate::new(code).set_body_raw(container(), "application/json");
        let error = enc(answer, 1).await.err().expect("it is an error");
        assert_eq!(error.status_code(), Some(code), "{error}");
        assert!(!error.keys_may_be_consumed(), "{error}");
        assert!(!format!("{error} {error:?}").contains(&KEY[..12]), "{error:?}");
    }
    for code in [201, 202, 206, 500, 502, 504] {
        let answer = ResponseTemplate::new(code).set_body_raw(container(), "application/json");
        assert_eq!(in_doubt(answer, 1).await.status_code(), Some(code));
    }
}

#[tokio::test]
async fn a_redirect_is_not_followed() {
    let elsewhere = Kme::answering(container().as_bytes()).await;
    let place = format!("http://{}/", elsewhere.mock.address());
    for code in [301, 302, 303, 307, 308] {
        let answer = ResponseTemplate::new(code).insert_header("location", place.as_str());
        let error = enc(answer, 1).await.err().expect("it is no answer");
        assert_eq!(error.status_code(), Some(code), "{error}");
    }
    assert!(elsewhere.mock.received_requests().await.unwrap().is_empty());
}

/// The text of an error is the KME's, and goes into logs.
#[tokio::test]
async fn the_message_of_an_error_is_bounded_and_has_no_control_characters() {
    for message in ["\u{1b}[2J\r\n\u{202e}forged".to_owned(), "x".repeat(1 << 20)] {
        let body = json!({ "message": message }).to_string();
        let answer = ResponseTemplate::new(400).set_body_raw(body, "application/json");
        let shown = enc(answer, 1).await.err().expect("it is an error").to_string();
        assert!(shown.len() < 4096, "{} bytes", shown.len());
        assert!(!shown.chars().any(char::is_control), "{shown:?}");
    }
}

/// `dec_keys` gives the keys asked for or none: not others, nor theirs under another key_ID.
#[tokio::test]
async fn dec_keys_with_the_keys_of_other_ids_is_refused() {
    let kme = Kme::start().await;
    let client = kme.client().build().unwrap();
    for answer in [
        keys(&[(OTHER_ID, KEY)]),
        keys(&[(ID, KEY), (OTHER_ID, OTHER_KEY)]),
        keys(&[(ID, KEY), (ID, KEY)]),
        keys(&[]),
    ] {
        kme.mock.reset().await;
        kme.mount(answer).await;
        let error = client.dec_keys("sae-a").key_id(ID).send().await.err().expect("it was taken");
        assert!(error.keys_may_be_consumed(), "{error}");
        assert!(matches!(error.cause(), Error::Check { .. }), "{error}");
    }
}
