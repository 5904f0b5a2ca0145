//! The simulator's answers byte by byte: the words of the specification, no leniency that a client could
//! come to rely on where it is strict, and what clients in the field send where it is not.

mod raw;

use etsi_qkd014::RetryPolicy;
use etsi_qkd014::sim::{FillRate, Network, NetworkBuilder};
use raw::Answer;
use serde_json::{Value, json};

fn three() -> NetworkBuilder {
    Network::builder()
        .kme("kme-a", "127.0.0.1:0".parse().unwrap(), ["sae-a", "sae-d"])
        .kme("kme-b", "127.0.0.2:0".parse().unwrap(), ["sae-b"])
        .kme("kme-c", "127.0.0.3:0".parse().unwrap(), ["sae-c"])
}

struct Got {
    status: u16,
    head: String,
    body: Value,
    /// Whether the connection was closed after the answer.
    closed: bool,
}

/// Sends `request` as it is and reads one answer.
async fn exchange(network: &Network, sae: &str, request: &str) -> Got {
    let mut connection = raw::connect(network, sae).await;
    connection.send(request).await.unwrap();
    let Answer { status, head, body } = connection.answer().await.expect("an answer");
    // A second request is answered where the connection lives on.
    let _ = connection.send(&raw::get("sae-b/status")).await;
    let closed = connection.answer().await.is_none();
    Got { status, head, body, closed }
}

async fn post(network: &Network, sae: &str, path: &str, body: &str) -> Got {
    exchange(network, sae, &raw::post(path, body)).await
}

async fn enc_keys(network: &Network, body: &str) -> Got {
    post(network, "sae-a", "sae-b/enc_keys", body).await
}

#[tokio::test]
async fn refusals_have_the_words_of_the_specification() {
    let network = three().start().await.unwrap();
    for size in [7, 1001, 999_999_999] {
        let got = enc_keys(&network, &json!({ "size": size }).to_string()).await;
        assert_eq!(
            (got.status, got.body),
            (400, json!({"message": "size shall be a multiple of 8"}))
        );
    }
    let get = "GET /api/v1/keys/sae-b/enc_keys?size=1001 HTTP/1.1\r\nHost: x\r\n\r\n";
    let got = exchange(&network, "sae-a", get).await;
    assert_eq!((got.status, &got.body["message"]), (400, &json!("size shall be a multiple of 8")));

    let unknown = r#"{"key_IDs":[{"key_ID":"bc490419-7d60-487f-adc1-4ddcc177c139"}]}"#;
    let got = post(&network, "sae-b", "sae-a/dec_keys", unknown).await;
    let words = json!("one or more keys specified are not found on KME");
    assert_eq!((got.status, &got.body["message"]), (400, &words));

    let got = enc_keys(&network, r#"{"extension_mandatory":[{"abc_route_type":"direct"}]}"#).await;
    // The second example of clause 6.5, whole.
    let example = json!({
        "message": "not all extension_mandatory parameters are supported",
        "details": [{"extension_mandatory_unsupported": "abc_route_type is not supported"}],
    });
    assert_eq!((got.status, got.body), (400, example));

    let indirect = r#"{"extension_mandatory":[{"kme_sim_route_type":"indirect"}]}"#;
    let got = enc_keys(&network, indirect).await;
    let words = json!("not all extension_mandatory request options could be met");
    assert_eq!((got.status, &got.body["message"]), (400, &words));
    assert_eq!(network.kme("kme-a").unwrap().counters().keys_to_masters, 0);
}

#[tokio::test]
async fn a_strict_kme_refuses_bodies_that_are_not_as_specified() {
    let network = three().strict().start().await.unwrap();
    for body in [
        "",
        "null",
        "[]",
        "[1,256]",
        "1",
        "{",
        "{}x",
        r#"{"number":null}"#,
        r#"{"size":null}"#,
        r#"{"number":0}"#,
        r#"{"number":"1"}"#,
        r#"{"number":1.0}"#,
        r#"{"number":true}"#,
        r#"{"number":1,"number":1}"#,
        r#"{"Number":1}"#,
        r#"{"additional_slave_SAE_IDs":null}"#,
        r#"{"additional_slave_SAE_IDs":"sae-c"}"#,
        r#"{"extension_mandatory":{}}"#,
        r#"{"extension_optional":[1]}"#,
    ] {
        let got = enc_keys(&network, body).await;
        assert_eq!(got.status, 400, "{body}");
        assert!(got.body["message"].is_string(), "{body}");
    }
    assert_eq!(enc_keys(&network, "{}").await.status, 200);

    let key = enc_keys(&network, " {} ").await.body["keys"][0]["key_ID"].clone();
    let id = key.as_str().unwrap();
    for body in [
        format!(r#"[[{{"key_ID":"{id}"}}]]"#),
        format!(r#"{{"key_IDs":[["{id}"]]}}"#),
        format!(r#"{{"key_IDs":["{id}"]}}"#),
        format!(r#"{{"key_IDs":{{"key_ID":"{id}"}}}}"#),
        format!(r#"{{"key_IDs":[{{"key_ID":"{id}"}}],"key_IDs_extension":null}}"#),
        format!(r#"{{"key_IDs":[{{"key_ID":"{id}","key_ID_extension":1}}]}}"#),
        r#"{"key_IDs":[]}"#.to_owned(),
        "{}".to_owned(),
    ] {
        assert_eq!(post(&network, "sae-b", "sae-a/dec_keys", &body).await.status, 400, "{body}");
    }
    let body = format!(
        r#"{{"key_IDs":[{{"key_ID":"{id}","key_ID_extension":{{}}}}],"key_IDs_extension":{{}}}}"#
    );
    assert_eq!(post(&network, "sae-b", "sae-a/dec_keys", &body).await.status, 200);
}

#[tokio::test]
async fn a_kme_passes_over_nulls_and_members_that_the_specification_does_not_list() {
    let network = three().start().await.unwrap();
    for body in [
        r#"{"number":null}"#,
        r#"{"number":1,"size":null,"extension_mandatory":null,"extension_optional":null}"#,
        r#"{"additional_slave_SAE_IDs":null}"#,
        r#"{"number":1,"Number":7,"client":{"name":"field","version":[1,2]}}"#,
    ] {
        let got = enc_keys(&network, body).await;
        assert_eq!(got.status, 200, "{body}: {}", got.body);
        assert_eq!(got.body["keys"].as_array().unwrap().len(), 1, "{body}");
    }
    let key = enc_keys(&network, "{}").await.body["keys"][0]["key_ID"].clone();
    let id = key.as_str().unwrap();
    for body in [
        "[]".to_owned(),
        r#"{"number":"1"}"#.to_owned(),
        r#"{"number":1,"number":1}"#.to_owned(),
        r#"{"extension_optional":[1]}"#.to_owned(),
    ] {
        assert_eq!(enc_keys(&network, &body).await.status, 400, "{body}");
    }
    for body in [
        "{}".to_owned(),
        r#"{"key_IDs":null}"#.to_owned(),
        r#"{"key_IDs":[]}"#.to_owned(),
        r#"{"key_IDs":[{"key_ID":null}]}"#.to_owned(),
        format!(r#"{{"key_IDs":["{id}"]}}"#),
    ] {
        assert_eq!(post(&network, "sae-b", "sae-a/dec_keys", &body).await.status, 400, "{body}");
    }
    let body = format!(
        r#"{{"key_IDs":[{{"key_ID":"{id}","key_ID_extension":null,"hint":1}}],"key_IDs_extension":null,"more":[]}}"#
    );
    let got = post(&network, "sae-b", "sae-a/dec_keys", &body).await;
    assert_eq!(got.status, 200, "{}", got.body);

    let get = "GET /api/v1/keys/sae-b/enc_keys?number=1&trace=on HTTP/1.1\r\nHost: x\r\n\r\n";
    assert_eq!(exchange(&network, "sae-a", get).await.status, 200);
    let strict = three().strict().start().await.unwrap();
    assert_eq!(exchange(&strict, "sae-a", get).await.status, 400);
}

/// Returns a POST without a length, whose body is `pieces`, each a chunk.
fn chunked(path: &str, pieces: &[&str]) -> String {
    let mut text = format!(
        "POST /api/v1/keys/{path} HTTP/1.1\r\nHost: x\r\nContent-Type: application/json\r\n\
         Transfer-Encoding: chunked\r\n\r\n"
    );
    for piece in pieces.iter().chain([&""]) {
        text += &format!("{:x}\r\n{piece}\r\n", piece.len());
    }
    text
}

#[tokio::test]
async fn a_body_in_chunks_is_taken_unless_the_kme_is_strict() {
    let network = three().start().await.unwrap();
    let strict = three().strict().start().await.unwrap();
    let plain = chunked("sae-b/enc_keys", &["{\"num", "b", "er\":2,\"size\":128}"]);
    let extended = plain
        .replace("\r\n1\r\n", "\r\n01 ;a=\"b\"\r\n")
        .replace("\r\n0\r\n", "\r\n000\r\nTrailer: is passed over\r\n")
        .replace("chunked", "Chunked");
    for request in [plain, extended] {
        let got = exchange(&network, "sae-a", &request).await;
        assert_eq!(got.status, 200, "{request}: {}", got.body);
        assert_eq!(got.body["keys"].as_array().unwrap().len(), 2, "{}", got.body);
        assert!(!got.closed, "the next request begins where the body ends");
        assert_eq!(exchange(&strict, "sae-a", &request).await.status, 411, "{request}");
    }
    let key = enc_keys(&network, "{}").await.body["keys"][0]["key_ID"].clone();
    let body = json!({ "key_IDs": [{ "key_ID": key }] }).to_string();
    let got = exchange(&network, "sae-b", &chunked("sae-a/dec_keys", &[&body])).await;
    assert_eq!(got.status, 200, "{}", got.body);
}

#[tokio::test]
async fn an_empty_body_asks_for_the_default_unless_the_kme_is_strict() {
    let network = three().start().await.unwrap();
    let strict = three().strict().start().await.unwrap();
    let bare = |path: &str, head: &str| {
        format!("POST /api/v1/keys/{path} HTTP/1.1\r\nHost: x\r\n{head}\r\n")
    };
    for request in [
        raw::post("sae-b/enc_keys", ""),
        chunked("sae-b/enc_keys", &[]),
        // This is a request of `curl -X POST`: without a body there is no content type either.
        bare("sae-b/enc_keys", ""),
        bare("sae-b/enc_keys", "Content-Length: 0\r\n"),
    ] {
        let got = exchange(&network, "sae-a", &request).await;
        assert_eq!((got.status, got.closed), (200, false), "{request}: {}", got.body);
        let keys = got.body["keys"].as_array().unwrap();
        assert_eq!(keys.len(), 1, "{request}");
        // 256 bits, in base64.
        assert_eq!(keys[0]["key"].as_str().unwrap().len(), 44, "{request}");
        let refused = exchange(&strict, "sae-a", &request).await.status;
        assert!([400, 411].contains(&refused), "{request}: {refused}");
    }
    // Which keys has to be said.
    for request in [raw::post("sae-a/dec_keys", ""), chunked("sae-a/dec_keys", &[])] {
        let got = exchange(&network, "sae-b", &request).await;
        assert_eq!(got.status, 400, "{request}");
        assert!(got.body["message"].as_str().unwrap().contains("key_IDs"), "{}", got.body);
    }
    assert_eq!(enc_keys(&network, " ").await.status, 400);
    assert_eq!(strict.kme("kme-a").unwrap().counters().keys_to_masters, 0);
}

#[tokio::test]
async fn heads_that_are_not_http_1_1_are_refused() {
    let network = three().start().await.unwrap();
    let path = "/api/v1/keys/sae-b/enc_keys";
    let json = "Content-Type: application/json\r\n";
    for request in [
        format!("GET {path} HTTP/1.1\r\n\r\n"),
        format!("GET {path} HTTP/1.1\r\nHost: x\r\nHost: x\r\n\r\n"),
        format!("GET {path} HTTP/1.1\r\nHost: x\r\nContent-Length: 2\r\n\r\n{{}}"),
        format!("POST {path} HTTP/1.1\r\nHost: x\r\nContent-Length: 2\r\n\r\n{{}}"),
        format!(
            "POST {path} HTTP/1.1\r\nHost: x\r\nContent-Type: text/plain\r\nContent-Length: 2\r\n\
             \r\n{{}}"
        ),
        format!("POST {path} HTTP/1.1\r\nHost: x\r\n{json}{json}Content-Length: 2\r\n\r\n{{}}"),
    ] {
        assert_eq!(exchange(&network, "sae-a", &request).await.status, 400, "{request}");
    }
    assert_eq!(network.kme("kme-a").unwrap().counters().keys_to_masters, 0);
    let utf8 = format!(
        "POST {path} HTTP/1.1\r\nHost: x\r\nContent-Type: application/json; charset=utf-8\r\n\
         Content-Length: 2\r\n\r\n{{}}"
    );
    assert_eq!(exchange(&network, "sae-a", &utf8).await.status, 200);
}

#[tokio::test]
async fn the_connection_is_closed_where_the_client_asks_for_it() {
    let network = three().start().await.unwrap();
    let request = |connection: &str| {
        format!("GET /api/v1/keys/sae-b/status HTTP/1.1\r\nHost: x\r\n{connection}\r\n")
    };
    let kept = exchange(&network, "sae-a", &request("")).await;
    assert!(kept.status == 200 && !kept.closed && !kept.head.contains("Connection"));
    let closed = exchange(&network, "sae-a", &request("Connection: close\r\n")).await;
    assert!(closed.status == 200 && closed.closed && closed.head.contains("Connection: close"));
}

#[tokio::test]
async fn keys_in_one_request_are_bounded() {
    for keys in [0, 1025, u64::MAX] {
        let error = three().max_keys_per_request(keys).start().await.err().expect("refused");
        assert!(error.to_string().contains("max_keys_per_request"), "{error}");
    }
    let network = three().max_keys_per_request(1024).max_stored(20_000).start().await.unwrap();
    let client = network.client_builder("sae-a").build().unwrap();
    let all = client.enc_keys("sae-b").number(1024).size(4096).send().await.unwrap();
    assert_eq!(all.keys.len(), 1024, "within the client's default limit of an answer");
}

#[tokio::test]
async fn multicast_spends_the_stock_of_every_link_that_carries_it() {
    let network =
        three().fill_rate(FillRate::PerSecond(0.0)).initially_stored(3).start().await.unwrap();
    let client = network.client_builder("sae-a").retry(RetryPolicy::none()).build().unwrap();
    let stored = async || {
        let of = async |sae| client.status(sae).await.unwrap().stored_key_count;
        (of("sae-b").await, of("sae-c").await, of("sae-d").await)
    };
    client.enc_keys("sae-b").additional_slave_sae_ids(["sae-c"]).number(2).send().await.unwrap();
    assert_eq!(stored().await, (1, 1, 3));
    client.enc_keys("sae-c").send().await.unwrap();
    let both = client.enc_keys("sae-b").additional_slave_sae_ids(["sae-c"]).send().await;
    assert_eq!(both.err().expect("one link is empty").status_code(), Some(503));
    assert_eq!(stored().await, (1, 0, 3), "nothing was spent on keys that were not given");
    // Two slaves at one KME are reached over one link.
    client.enc_keys("sae-b").additional_slave_sae_ids(["sae-b"]).send().await.unwrap();
    assert_eq!(stored().await, (0, 0, 3));
}

#[tokio::test]
async fn extensions_of_status_and_keys_reach_the_client() {
    let network = three().start().await.unwrap();
    let client = network.client_builder("sae-a").build().unwrap();
    let extension = client.status("sae-b").await.unwrap().extension.unwrap();
    assert_eq!(extension, json!({"kme_sim_extensions": ["kme_sim_echo", "kme_sim_route_type"]}));

    let direct = json!({"kme_sim_route_type": "direct"});
    let request = client.enc_keys("sae-b").number(2);
    let container = request.extension_mandatory(direct.clone()).send().await.unwrap();
    assert!(container.keys.iter().all(|key| key.extension() == Some(&direct)));
    // A preference that cannot be met is not refused; the answer states the actual value.
    let preferred = json!({"kme_sim_route_type": "indirect"});
    let request = client.enc_keys("sae-b").extension_optional(preferred);
    assert_eq!(request.send().await.unwrap().into_single().extension(), Some(&direct));
    assert_eq!(client.enc_keys("sae-b").send().await.unwrap().into_single().extension(), None);
}
