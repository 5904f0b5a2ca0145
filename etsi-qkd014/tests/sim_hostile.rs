//! Clients that a simulated KME has to live with: heads and bodies that are too large or not whole,
//! clients that are slow or deaf. `sim_connections.rs` has those that come in thousands.

mod raw;

use std::time::Duration;

use etsi_qkd014::sim::{Network, NetworkBuilder};
use etsi_qkd014::{Client, RetryPolicy};
use raw::{get, post};
use tokio::io::AsyncWriteExt;
use tokio::time::timeout;

fn builder() -> NetworkBuilder {
    Network::builder().kme("kme-a", "127.0.0.1:0".parse().unwrap(), ["sae-a", "sae-c"]).kme(
        "kme-b",
        "127.0.0.2:0".parse().unwrap(),
        ["sae-b"],
    )
}

async fn network() -> Network {
    builder().strict().start().await.unwrap()
}

/// Returns a client that calls once, with a limit of a minute.
fn client(network: &Network) -> Client {
    let builder = network.client_builder("sae-c").retry(RetryPolicy::none());
    let minute = Duration::from_secs(60);
    builder.timeout(minute).connect_timeout(minute).deadline(minute).build().unwrap()
}

async fn served(network: &Network) {
    client(network).enc_keys("sae-b").send().await.expect("an honest client is served");
}

const PATH: &str = "/api/v1/keys/sae-b/enc_keys";

#[tokio::test(flavor = "multi_thread")]
async fn requests_that_are_too_large_or_ambiguous_are_refused_in_words() {
    let network = network().await;
    let json = "Content-Type: application/json";
    let length =
        |text: &str| format!("POST {PATH} HTTP/1.1\r\nHost: x\r\n{json}\r\n{text}\r\n\r\n");
    let head = |text: &str| format!("GET {PATH} HTTP/1.1\r\nHost: x\r\n{text}");
    for (status, word, request) in [
        (431, "16 KiB", head(&format!("X: {}", "x".repeat(512 << 10)))),
        (431, "16 KiB", head(&"X: y\r\n".repeat(50_000))),
        (431, "16 KiB", format!("GET /{}", "x".repeat(512 << 10))),
        (413, "1 MiB", length("Content-Length: 1048577")),
        (413, "1 MiB", length("Content-Length: 9999999999999999")),
        (413, "1 MiB", length(&format!("Content-Length: 2000000\r\n\r\n{}", " ".repeat(1 << 20)))),
        (400, "HTTP/1.1", length("Content-Length: 99999999999999999999")),
        (400, "HTTP/1.1", length("Content-Length: -1")),
        (400, "HTTP/1.1", length("Content-Length: 2, 2")),
        (400, "HTTP/1.1", length("Content-Length:")),
        (400, "HTTP/1.1", length("Content-Length : 2")),
        (400, "HTTP/1.1", length("Content-Length: 2\r\nContent-Length: 2")),
        (400, "HTTP/1.1", length("Content-Length: 2\r\nTransfer-Encoding: chunked")),
        (400, "HTTP/1.1", head("A: b\r\n c\r\n\r\n")),
        (400, "HTTP/1.1", head("A: b\r\nGET / HTTP/1.1\r\n\r\n")),
        (400, "HTTP/1.1", format!("GET {PATH} HTTP/1.0\r\nHost: x\r\n\r\n")),
        (400, "HTTP/1.1", format!("GET {PATH} HTTP/2.0\r\nHost: x\r\n\r\n")),
        (400, "HTTP/1.1", "\0\u{1}\u{2}\r\n\r\n".to_owned()),
        (411, "Content-Length", length("Transfer-Encoding: chunked") + "2\r\n{}\r\n0\r\n\r\n"),
        // Without a length there is no body.
        (400, "body", length("X: y")),
        (400, "body", post("sae-b/enc_keys", &"[".repeat(500_000))),
        (400, "body", post("sae-b/enc_keys", &format!("{{\"number\":{}1}}", "0".repeat(500_000)))),
    ] {
        let mut connection = raw::connect(&network, "sae-a").await;
        // It may be refused before it has all been sent.
        let _ = connection.send(&request).await;
        let start: String = request.chars().take(120).collect();
        let answer = connection.answer().await.unwrap_or_else(|| panic!("no answer: {start}"));
        assert_eq!(answer.status, status, "{start}: {}", answer.body);
        let message = answer.body["message"].as_str().unwrap_or_default();
        assert!(message.contains(word), "{start}: {message}");
    }
    assert_eq!(network.kme("kme-a").unwrap().counters().keys_to_masters, 0);
    served(&network).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn bodies_in_chunks_that_are_too_large_or_ambiguous_are_refused_in_words() {
    let network = builder().start().await.unwrap();
    let coded = |coding: &str, body: &str| {
        format!(
            "POST {PATH} HTTP/1.1\r\nHost: x\r\nContent-Type: application/json\r\n\
             Transfer-Encoding: {coding}\r\n\r\n{body}"
        )
    };
    let chunks = |body: &str| coded("chunked", body);
    let million = format!("100000\r\n{}\r\n", " ".repeat(1 << 20));
    for (status, word, request) in [
        (413, "1 MiB", chunks("100001\r\n")),
        (413, "1 MiB", chunks("ffffffffffffffff\r\n")),
        (413, "1 MiB", chunks(&format!("{million}1\r\n"))),
        (413, "1 MiB", chunks(&"1\r\n \r\n".repeat((1 << 20) + 1))),
        (400, "chunk", chunks("fffffffffffffffff\r\n")),
        (400, "chunk", chunks("\r\n")),
        (400, "chunk", chunks(" 2\r\n{}\r\n0\r\n\r\n")),
        (400, "chunk", chunks("+2\r\n{}\r\n0\r\n\r\n")),
        (400, "chunk", chunks("0x2\r\n{}\r\n0\r\n\r\n")),
        (400, "chunk", chunks("2 2\r\n{}\r\n0\r\n\r\n")),
        (400, "chunk", chunks("2\n{}\r\n0\r\n\r\n")),
        (400, "chunk", chunks("1\r\n{}\r\n0\r\n\r\n")),
        (400, "chunk", chunks("2\r\n{}0\r\n\r\n")),
        (400, "chunk", chunks("2;a=\n\r\n{}\r\n0\r\n\r\n")),
        (400, "chunk", chunks(&format!("2;{}", "x".repeat(512 << 10)))),
        (431, "16 KiB", chunks(&format!("0\r\nX: {}", "x".repeat(512 << 10)))),
        (431, "16 KiB", chunks(&format!("0\r\n{}", "X: y\r\n".repeat(50_000)))),
        (501, "chunked", coded("gzip, chunked", "2\r\n{}\r\n0\r\n\r\n")),
        (501, "chunked", coded("identity", "{}")),
        (501, "chunked", coded("", "{}")),
        (501, "chunked", coded("chunked\r\nTransfer-Encoding: chunked", "0\r\n\r\n")),
    ] {
        let mut connection = raw::connect(&network, "sae-a").await;
        // It may be refused before it has all been sent.
        let _ = connection.send(&request).await;
        let start: String = request.chars().skip(80).take(120).collect();
        let answer = connection.answer().await.unwrap_or_else(|| panic!("no answer: {start}"));
        assert_eq!(answer.status, status, "{start}: {}", answer.body);
        let message = answer.body["message"].as_str().unwrap_or_default();
        assert!(message.contains(word), "{start}: {message}");
    }
    // A body without an end is not a request.
    for body in ["", "2", "2\r\n{", "2\r\n{}\r\n", "2\r\n{}\r\n0\r\n"] {
        let mut connection = raw::connect(&network, "sae-a").await;
        connection.send(&chunks(body)).await.unwrap();
        connection.stream.shutdown().await.unwrap();
        assert!(connection.answer().await.is_none(), "{body:?}");
    }
    assert_eq!(network.kme("kme-a").unwrap().counters().keys_to_masters, 0);
    served(&network).await;
}

#[tokio::test]
async fn bodies_in_chunks_are_read_whichever_way_they_come() {
    let network = builder().start().await.unwrap();
    let head = |expect: &str| {
        format!(
            "POST {PATH} HTTP/1.1\r\nHost: x\r\nContent-Type: application/json\r\n{expect}\
             Transfer-Encoding: chunked\r\n\r\n"
        )
    };
    let body = |number: usize| {
        let text = format!("{{\"number\":{number}}}{}", " ".repeat(300));
        let mut chunks = String::new();
        for piece in text.as_bytes().chunks(number) {
            let piece = std::str::from_utf8(piece).unwrap();
            chunks += &format!("{:X}\r\n{piece}\r\n", piece.len());
        }
        chunks + "0\r\n\r\n"
    };
    let mut connection = raw::connect(&network, "sae-a").await;
    let all: String = (1..=20).map(|number| head("") + &body(number)).collect();
    // In pieces that end anywhere.
    for piece in all.as_bytes().chunks(97) {
        connection.stream.write_all(piece).await.unwrap();
        connection.stream.flush().await.unwrap();
    }
    for number in 1..=20 {
        let answer = connection.answer().await.unwrap();
        assert_eq!(answer.body["keys"].as_array().unwrap().len(), number, "{}", answer.body);
    }
    connection.send(&head("Expect: 100-continue\r\n")).await.unwrap();
    assert_eq!(connection.answer().await.unwrap().status, 100);
    connection.send(&body(3)).await.unwrap();
    assert_eq!(connection.answer().await.unwrap().status, 200);
}

#[tokio::test]
async fn other_methods_and_resources_are_refused() {
    let network = network().await;
    for (status, method, path) in [
        (405, "PUT", PATH),
        (405, "DELETE", PATH),
        (405, "get", PATH),
        (405, "HEAD", PATH),
        (405, "POST", "/api/v1/keys/sae-b/status"),
        (404, "GET", "/"),
        (404, "GET", "/api/v1/keys/sae-b"),
        (404, "GET", "/api/v1/keys/sae-b/enc_keys/"),
        (404, "GET", "/api/v1/keys/sae-b/x/../enc_keys"),
        (404, "GET", "/api/v2/keys/sae-b/enc_keys"),
        (404, "GET", "/API/v1/keys/sae-b/enc_keys"),
        (400, "GET", "/api/v1/keys//enc_keys"),
        (400, "GET", "/api/v1/keys/%ff/enc_keys"),
        (400, "GET", "/api/v1/keys/%/enc_keys"),
        (400, "GET", "/api/v1/keys/sae-b/enc_keys?number=1&number=1"),
        (400, "GET", "/api/v1/keys/sae-b/enc_keys?number"),
        (400, "GET", "/api/v1/keys/sae-b/enc_keys?number=-1"),
        (400, "GET", "/api/v1/keys/sae-b/enc_keys?Number=1"),
        (400, "GET", "/api/v1/keys/sae-b/dec_keys"),
        (400, "GET", "/api/v1/keys/sae-b/dec_keys?key_ID=a&key_ID=b"),
    ] {
        let mut connection = raw::connect(&network, "sae-a").await;
        let request = format!("{method} {path} HTTP/1.1\r\nHost: x\r\n\r\n");
        connection.send(&request).await.unwrap();
        let answer = connection.answer().await.unwrap();
        assert_eq!(answer.status, status, "{method} {path}");
        // Bytes after an answer to HEAD would be read as another answer.
        assert_eq!(method == "HEAD", answer.head.contains("Connection: close"), "{method}");
    }
    assert_eq!(network.kme("kme-a").unwrap().counters().keys_to_masters, 0);
}

#[tokio::test]
async fn a_client_that_waits_for_leave_to_send_its_body_gets_it() {
    let network = network().await;
    let head = |length: usize| {
        format!(
            "POST {PATH} HTTP/1.1\r\nHost: x\r\nContent-Type: application/json\r\n\
             Expect: 100-continue\r\nContent-Length: {length}\r\n\r\n"
        )
    };
    let mut connection = raw::connect(&network, "sae-a").await;
    connection.send(&head(12)).await.unwrap();
    assert_eq!(connection.answer().await.unwrap().status, 100);
    connection.send("{\"number\":2}").await.unwrap();
    let answer = connection.answer().await.unwrap();
    assert_eq!((answer.status, answer.body["keys"].as_array().unwrap().len()), (200, 2));
    // The body came without being asked for.
    connection.send(&(head(2) + "{}")).await.unwrap();
    assert_eq!(connection.answer().await.unwrap().status, 200);
    // Leave to send too much is not given.
    connection.send(&head(2 << 20)).await.unwrap();
    assert_eq!(connection.answer().await.unwrap().status, 413);
}

#[tokio::test]
async fn pipelined_requests_are_answered_in_their_order() {
    let network = network().await;
    let mut connection = raw::connect(&network, "sae-a").await;
    let mut all = String::new();
    for number in 1..=20 {
        all += &get(&format!("sae-b/enc_keys?number={number}"));
        all += &post("sae-b/enc_keys", &format!("{{\"number\":{}}}", number + 20));
    }
    // In pieces that end anywhere.
    for piece in all.as_bytes().chunks(97) {
        connection.stream.write_all(piece).await.unwrap();
        connection.stream.flush().await.unwrap();
    }
    for number in 1..=20 {
        for expected in [number, number + 20] {
            let answer = connection.answer().await.unwrap();
            assert_eq!(answer.body["keys"].as_array().unwrap().len(), expected);
        }
    }
    // Requests after the one that ends the connection are not served.
    let last = get("sae-b/status").replace("Host: x", "Host: x\r\nConnection: close");
    connection.send(&(last + &get("sae-b/enc_keys").repeat(3))).await.unwrap();
    assert_eq!(connection.answer().await.unwrap().status, 200);
    assert!(connection.answer().await.is_none());
    let counters = network.kme("kme-a").unwrap().counters();
    assert_eq!((counters.enc_keys_calls, counters.keys_to_masters), (40, 820));
}

#[tokio::test(flavor = "multi_thread")]
async fn slow_and_non_reading_clients_do_not_block_others() {
    let network = network().await;
    let mut slow = Vec::new();
    for _ in 0..64 {
        let mut connection = raw::connect(&network, "sae-a").await;
        connection.send("POST /api/v1/keys/sae-b/enc_keys HTTP/1.1\r\nHo").await.unwrap();
        slow.push(connection);
    }
    // These ask for more than the sockets hold, and take none of it.
    let mut deaf = Vec::new();
    for _ in 0..2 {
        let mut connection = raw::connect(&network, "sae-a").await;
        let requests = get("sae-b/enc_keys?number=128").repeat(300_000);
        let all = timeout(Duration::from_millis(500), connection.send(&requests)).await;
        assert!(all.is_err(), "the KME does not store what it cannot answer");
        deaf.push(connection);
    }
    served(&network).await;
    // A byte at a time is a request too.
    let mut last = slow.pop().unwrap();
    for byte in "st: x\r\nContent-Type: application/json\r\nContent-Length: 2\r\n\r\n{}".chars() {
        last.send(&byte.to_string()).await.unwrap();
    }
    assert_eq!(last.answer().await.unwrap().status, 200);
    // Half a request is none.
    drop(slow);
    drop(deaf);
    served(&network).await;
}
