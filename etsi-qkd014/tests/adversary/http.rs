//! HTTP that is allowed but rare, and HTTP that is not.

use std::time::Duration;

use etsi_qkd014::Error;

use crate::server::{KEY, Server, Then, answer, container, ok};

/// Calls `enc_keys` for one key, with a limit of a second.
async fn enc(answer: Vec<u8>, then: Then) -> Result<(), Error> {
    let server = Server::start(answer, then).await;
    let client = server.client().timeout(Duration::from_secs(1)).build().unwrap();
    let container = client.enc_keys("sae-b").size(256).send().await?;
    assert_eq!(container.keys.len(), 1);
    Ok(())
}

/// Checks that the call fails, that its keys are in doubt, and that the error reveals no key.
async fn in_doubt(answer: Vec<u8>, then: Then) -> Error {
    let error = enc(answer, then).await.unwrap_err();
    assert!(error.keys_may_be_consumed(), "{error}");
    assert!(!format!("{error} {error:?}").contains(&KEY[..12]), "{error:?}");
    error
}

#[tokio::test]
async fn a_body_without_length_counts_only_if_tls_was_ended() {
    let head = "HTTP/1.1 200 OK\r\nContent-Type: application/json\r\nConnection: close\r\n\r\n";
    let whole = [head.as_bytes(), container().as_bytes()].concat();
    let error = in_doubt(whole.clone(), Then::CutOff).await;
    assert!(matches!(error.cause(), Error::Interrupted { .. }), "{error}");
    enc(whole, Then::Close).await.unwrap();
}

#[tokio::test]
async fn informational_answers_are_passed_over_and_end_with_the_time_allowed() {
    let early = "HTTP/1.1 100 Continue\r\n\r\nHTTP/1.1 103 Early Hints\r\nLink: </x>\r\n\r\n";
    let answer = [early.as_bytes(), &ok(container().as_bytes())].concat();
    enc(answer, Then::KeepAlive).await.unwrap();
    let one = b"HTTP/1.1 100 Continue\r\n\r\n".to_vec();
    let length = one.len();
    in_doubt(one, Then::Repeat(length)).await;
}

#[tokio::test]
async fn another_protocol_is_not_switched_to() {
    let head = "HTTP/1.1 101 Switching Protocols\r\nConnection: upgrade\r\nUpgrade: x\r\n\r\n";
    let error = in_doubt([head.as_bytes(), container().as_bytes()].concat(), Then::Close).await;
    assert_eq!(error.status_code(), Some(101), "{error}");
}

#[tokio::test]
async fn chunks_may_have_extensions_and_trailers_which_tell_nothing() {
    let head = "HTTP/1.1 200 OK\r\nContent-Type: application/json\r\n\
        Transfer-Encoding: chunked\r\nTrailer: Content-Type, Content-Length\r\n\r\n";
    let body = container();
    let (first, last) = body.split_at(20);
    let chunk = |text: &str| format!("{:X};name=\"value\"\r\n{text}\r\n", text.len());
    let chunks = [head, &chunk(first), &chunk(last), "0\r\n"].concat();
    let trailers = "Content-Type: text/plain\r\nContent-Length: 3\r\n\r\n";
    enc([&chunks, trailers].concat().into_bytes(), Then::KeepAlive).await.unwrap();
    // Endless trailers.
    let line = "X-Trailer: y\r\n";
    in_doubt([&*chunks, line].concat().into_bytes(), Then::Repeat(line.len())).await;
}

#[tokio::test]
async fn a_chunk_that_is_none_and_one_that_is_cut_off_are_refused() {
    let head = "HTTP/1.1 200 OK\r\nContent-Type: application/json\r\n\
        Transfer-Encoding: chunked\r\n\r\n";
    let body = container();
    for chunks in [
        format!("{:x}\r\n{body}\r\n", body.len()),
        format!("FFFFFFFFFFFFFFFFFF\r\n{body}\r\n0\r\n\r\n"),
        format!("-1\r\n{body}\r\n0\r\n\r\n"),
        format!("{body}\r\n0\r\n\r\n"),
    ] {
        let error = in_doubt([head, &chunks].concat().into_bytes(), Then::Close).await;
        assert!(matches!(error.cause(), Error::Interrupted { .. }), "{error}");
    }
}

#[tokio::test]
async fn two_lengths_are_refused() {
    let body = container();
    for lines in [
        format!("Content-Length: {}\r\nContent-Length: 3\r\n", body.len()),
        format!("Content-Length: {}, 3\r\n", body.len()),
        "Content-Length: -1\r\n".to_owned(),
        "Content-Length: 99999999999999999999999999\r\n".to_owned(),
    ] {
        let head = format!("HTTP/1.1 200 OK\r\nContent-Type: application/json\r\n{lines}\r\n");
        in_doubt([head.as_bytes(), body.as_bytes()].concat(), Then::Close).await;
    }
}

#[tokio::test]
async fn a_compressed_body_is_not_asked_for_and_not_taken() {
    for coding in ["gzip", "br", "identity, gzip"] {
        let lines = format!("Content-Type: application/json\r\nContent-Encoding: {coding}\r\n");
        let answer = answer("200 OK", &lines, container().as_bytes());
        let error = in_doubt(answer, Then::KeepAlive).await;
        assert!(error.to_string().contains("Content-Encoding"), "{error}");
    }
    let lines = "Content-Type: application/json\r\nContent-Encoding: Identity\r\n";
    let server =
        Server::start(answer("200 OK", lines, container().as_bytes()), Then::KeepAlive).await;
    server.client().build().unwrap().enc_keys("sae-b").send().await.unwrap();
    assert!(server.heads()[0].contains("\r\naccept-encoding: identity\r\n"));
}

/// Clause 5.1: UTF-8. RFC 8259 defines no parameter `charset`, so its value is ignored.
#[tokio::test]
async fn a_body_is_utf_8_regardless_of_its_charset_label() {
    for label in ["; charset=utf-8", ";charset=\"UTF-8\"", "; charset=iso-8859-1", " ; x=y"] {
        let line = format!("Content-Type: Application/JSON{label}\r\n");
        enc(answer("200 OK", &line, container().as_bytes()), Then::KeepAlive).await.unwrap();
    }
    let wide: Vec<u8> = container().encode_utf16().flat_map(u16::to_be_bytes).collect();
    let latin = container().replace("\"keys\"", "\"k\u{e9}ys\"");
    let latin: Vec<u8> = latin.chars().map(|c| c as u8).collect();
    let marked = [b"\xef\xbb\xbf", container().as_bytes()].concat();
    for body in [wide, latin, marked, b"".to_vec(), b"\xff".to_vec()] {
        let error = in_doubt(ok(&body), Then::KeepAlive).await;
        assert!(matches!(error.cause(), Error::Malformed { .. }), "{error}");
    }
    for label in ["text/json", "application/json5", "application/problem+json", "", ";", "\x7f"] {
        let line = format!("Content-Type: {label}\r\n");
        in_doubt(answer("200 OK", &line, container().as_bytes()), Then::KeepAlive).await;
    }
}

#[tokio::test]
async fn heads_are_bounded() {
    let begin = "HTTP/1.1 200 OK\r\nContent-Type: application/json\r\n";
    let many = "X-Header: 0123456789\r\n";
    in_doubt([begin, many].concat().into_bytes(), Then::Repeat(many.len())).await;
    let long = [begin, "X-Header: ", &"0".repeat(1 << 20)].concat();
    in_doubt(long.into_bytes(), Then::Repeat(1 << 20)).await;
}

#[tokio::test]
async fn answers_that_are_no_http_are_ambiguous() {
    for answer in ["hello\r\n\r\n", "HTTP/9.9 200 OK\r\n\r\n", "HTTP/1.1 2000 OK\r\n\r\n", "\0", ""]
    {
        in_doubt(answer.into(), Then::Close).await;
    }
}

#[tokio::test]
async fn an_unrequested_answer_is_never_used_for_the_next_call() {
    let other = container().replace("bc490419", "00000000");
    let twice = [ok(container().as_bytes()), ok(other.as_bytes())].concat();
    let server = Server::start(twice, Then::KeepAlive).await;
    let client = server.client().build().unwrap();
    for call in 1..=3 {
        let key = client.enc_keys("sae-b").send().await.unwrap().into_single();
        assert!(key.key_id().starts_with("bc490419"), "the second answer was taken");
        assert_eq!(server.connections(), call, "a connection out of step is not used again");
    }
}

#[tokio::test]
async fn a_refusal_counts_though_its_body_does_not_end() {
    let lines = "Content-Type: application/json\r\nContent-Length: 100\r\n\r\n{\"message\"";
    for (status, code) in [("400 Bad", 400), ("401 No", 401), ("503 Empty", 503), ("404 No", 404)] {
        let answer = format!("HTTP/1.1 {status}\r\n{lines}");
        let error = enc(answer.into_bytes(), Then::Stall).await.unwrap_err();
        assert_eq!(error.status_code(), Some(code), "{error}");
        assert!(!error.keys_may_be_consumed(), "{error}");
    }
}

#[tokio::test]
async fn a_long_message_is_cut_and_details_are_bounded() {
    let details = vec![r#"{"a":[[[[1]]]]}"#; 1000].join(",");
    let body = format!(r#"{{"message":"{}","details":[{details}]}}"#, "é".repeat(10_000));
    let error = enc(answer("400 Bad", "", body.as_bytes()), Then::KeepAlive).await.unwrap_err();
    let Error::BadRequest { message, details } = &error else { panic!("{error}") };
    assert!(message.len() < 600 && message.starts_with('é'), "{message}");
    assert_eq!(details.len(), 64);
    let deep = format!(r#"{{"message":"m","details":[{}{}]}}"#, "[".repeat(90), "]".repeat(90));
    let error = enc(answer("400 Bad", "", deep.as_bytes()), Then::KeepAlive).await.unwrap_err();
    let Error::BadRequest { message, details } = &error else { panic!("{error}") };
    assert_eq!((message.as_str(), details.len()), ("m", 0));
}
