//! Tests KMEs that misbehave: each fault gives its own error, which states truthfully whether keys may be lost.

use std::time::Duration;

use etsi_qkd014::sim::{Fault, Kme, Network};
use etsi_qkd014::{Client, ClientBuilder, Error, KeyContainer, Quirks, RefusedBy, RetryPolicy};

async fn network() -> Network {
    Network::builder()
        .strict()
        .kme("kme-a", "127.0.0.1:0".parse().unwrap(), ["sae-a"])
        .kme("kme-b", "127.0.0.2:0".parse().unwrap(), ["sae-b"])
        .start()
        .await
        .unwrap()
}

fn once(network: &Network) -> ClientBuilder {
    network.client_builder("sae-a").retry(RetryPolicy::none()).timeout(Duration::from_secs(5))
}

fn kme_a(network: &Network) -> &Kme {
    network.kme("kme-a").unwrap()
}

/// Requests one key of a KME with a fault, and returns the error.
async fn enc(fault: Fault, setting: impl FnOnce(ClientBuilder) -> ClientBuilder) -> Error {
    let network = network().await;
    let client = setting(once(&network)).build().unwrap();
    kme_a(&network).inject(fault, 1);
    let error = failed(client.enc_keys("sae-b").number(2).size(256).send().await);
    // The fault is over, and so is the harm.
    client.enc_keys("sae-b").number(2).size(256).send().await.unwrap();
    error
}

fn failed(result: Result<KeyContainer, Error>) -> Error {
    result.err().expect("the call must fail")
}

#[tokio::test]
async fn answers_that_break_off_leave_keys_in_doubt() {
    for fault in [Fault::CutAnswer, Fault::ResetAfterRequest] {
        let error = enc(fault.clone(), |b| b).await;
        assert!(error.keys_may_be_consumed(), "{fault:?}: {error}");
        assert!(matches!(error.cause(), Error::Interrupted { .. }), "{fault:?}: {error}");
        assert!(error.is_transient(), "{fault:?}");
    }
}

#[tokio::test]
async fn answers_that_do_not_come_in_time_leave_keys_in_doubt() {
    let slow = [
        Fault::Silence,
        Fault::Drip(Duration::from_millis(100)),
        Fault::Latency(Duration::from_secs(60)),
    ];
    for fault in slow {
        let error = enc(fault.clone(), |b| b.timeout(Duration::from_millis(400))).await;
        assert!(error.keys_may_be_consumed(), "{fault:?}: {error}");
        assert!(matches!(error.cause(), Error::Timeout { phase: "answer", .. }), "{error}");
    }
}

#[tokio::test]
async fn a_refused_handshake_consumes_nothing() {
    let error = enc(Fault::HandshakeRefused, |b| b).await;
    assert!(matches!(error, Error::Tls { refused_by: RefusedBy::Kme, .. }), "{error}");
    let error = enc(Fault::HandshakeDropped, |b| b).await;
    assert!(matches!(error, Error::Unreachable { .. } | Error::Tls { .. }), "{error}");
}

#[tokio::test]
async fn a_port_that_accepts_and_says_nothing_times_out_while_connecting() {
    let network = network().await;
    let deaf = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
    let url = format!("https://{}", deaf.local_addr().unwrap());
    let client =
        once(&network).kme_url(url).connect_timeout(Duration::from_millis(200)).build().unwrap();
    let error = failed(client.enc_keys("sae-b").send().await);
    assert!(matches!(error, Error::Timeout { phase: "connect", .. }), "{error}");
}

#[tokio::test]
async fn a_port_that_speaks_no_tls_is_told_as_such() {
    use tokio::io::AsyncWriteExt;
    let network = network().await;
    let plain = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
    let url = format!("https://{}", plain.local_addr().unwrap());
    let server = tokio::spawn(async move {
        let (mut stream, _) = plain.accept().await.unwrap();
        stream.write_all(b"HTTP/1.1 400 Bad Request\r\n\r\n").await.unwrap();
        stream
    });
    let client = once(&network).kme_url(url).build().unwrap();
    let error = failed(client.enc_keys("sae-b").send().await);
    assert!(matches!(error, Error::Tls { .. }), "{error}");
    server.await.unwrap();
}

#[tokio::test]
async fn answers_beyond_the_limit_are_not_read() {
    for fault in [Fault::Endless, Fault::LyingLength] {
        let error = enc(fault.clone(), |b| b.max_body(20_000)).await;
        assert!(error.keys_may_be_consumed(), "{error}");
        let cause = error.cause();
        assert!(matches!(cause, Error::BodyTooLarge { limit: 20_000 }), "{fault:?}: {cause}");
    }
}

#[tokio::test]
async fn answers_that_are_no_key_container_are_malformed() {
    let error = enc(Fault::Garbage, |b| b).await;
    assert!(error.keys_may_be_consumed());
    assert!(matches!(error.cause(), Error::Malformed { .. }), "{error}");
}

#[tokio::test]
async fn broken_promises_name_their_clause() {
    for fault in [Fault::WrongLength, Fault::RepeatKeyId, Fault::KeyMissing] {
        let error = enc(fault.clone(), |b| b).await;
        assert!(error.keys_may_be_consumed());
        match error.cause() {
            Error::Check { clause, .. } => assert!(clause.contains("clause 6."), "{clause}"),
            other => panic!("{fault:?}: {other}"),
        }
    }
}

#[tokio::test]
async fn the_default_size_is_the_one_that_the_last_status_named() {
    let network = network().await;
    let client = once(&network).build().unwrap();
    kme_a(&network).inject(Fault::WrongLength, 1);
    // No call has fixed the size of keys yet.
    client.enc_keys("sae-b").send().await.unwrap();
    client.status("sae-b").await.unwrap();
    kme_a(&network).inject(Fault::WrongLength, 1);
    let error = failed(client.clone().enc_keys("sae-b").send().await);
    assert!(matches!(error.cause(), Error::Check { .. }), "{error}");
    client.enc_keys("sae-b").send().await.unwrap();
}

#[tokio::test]
async fn dec_keys_with_other_keys_than_asked_for_is_refused() {
    let network = network().await;
    let kme_b = network.kme("kme-b").unwrap();
    let master = once(&network).build().unwrap();
    let slave = network.client_builder("sae-b").retry(RetryPolicy::none()).build().unwrap();
    for fault in [Fault::OtherIds, Fault::KeyMissing, Fault::RepeatKeyId] {
        let key = master.enc_keys("sae-b").send().await.unwrap().into_single();
        kme_b.inject(fault.clone(), 1);
        let error = failed(slave.dec_keys("sae-a").key_id(key.key_id()).send().await);
        assert!(matches!(error, Error::KeyPossiblyConsumed { call: "dec_keys", .. }), "{error}");
        assert!(matches!(error.cause(), Error::Check { .. }), "{fault:?}: {error}");
    }
    let key = master.enc_keys("sae-b").send().await.unwrap().into_single();
    kme_b.inject(Fault::UpperCaseIds, 1);
    let same = slave.dec_keys("sae-a").key_id(key.key_id()).send().await.unwrap().into_single();
    assert_eq!(same.key_id(), key.key_id());
}

#[tokio::test]
async fn other_labels_need_their_quirk() {
    for (fault, quirk) in
        [(Fault::WrongMediaType, Quirks::ANY_MEDIA_TYPE), (Fault::Http10, Quirks::HTTP_1_0)]
    {
        let error = enc(fault.clone(), |b| b).await;
        assert!(matches!(error.cause(), Error::Malformed { .. }), "{fault:?}: {error}");
        let network = network().await;
        let client = once(&network).quirks(quirk).build().unwrap();
        kme_a(&network).inject(fault, 1);
        client.enc_keys("sae-b").send().await.unwrap();
    }
}

#[tokio::test]
async fn status_codes_keep_their_meaning() {
    let error = enc(Fault::Empty, |b| b).await;
    assert!(matches!(error, Error::Unavailable { .. }), "{error}");
    for (code, in_doubt) in [(301, false), (403, false), (404, false), (429, false)]
        .into_iter()
        .chain([(500, true), (502, true), (504, true), (204, true)])
    {
        let error = enc(Fault::Status(code), |b| b).await;
        assert_eq!(error.status_code(), Some(code), "{error}");
        assert_eq!(error.keys_may_be_consumed(), in_doubt, "{error}");
    }
}

#[tokio::test]
async fn retry_after_is_passed_on_and_obeyed_within_the_deadline() {
    let error = enc(Fault::Busy(7), |b| b).await;
    match error {
        Error::Unavailable { retry_after, message, .. } => {
            assert_eq!((retry_after, message.as_str()), (Some(Duration::from_secs(7)), "busy"));
        }
        other => panic!("{other}"),
    }
    let network = network().await;
    let client = once(&network).retry(quick(RetryPolicy::none().status(9))).build().unwrap();
    kme_a(&network).inject(Fault::Busy(3600), 1);
    assert!(client.status("sae-b").await.is_err());
    assert_eq!(kme_a(&network).counters().status_calls, 1, "an hour is beyond the deadline");
}

// Repeats

fn quick(policy: RetryPolicy) -> RetryPolicy {
    policy.pause(Duration::from_millis(1), Duration::from_millis(2))
}

#[tokio::test]
async fn status_is_repeated_as_often_as_the_policy_says() {
    let network = network().await;
    let client = once(&network).retry(quick(RetryPolicy::none().status(2))).build().unwrap();
    kme_a(&network).inject(Fault::CutAnswer, 2);
    client.status("sae-b").await.unwrap();
    kme_a(&network).inject(Fault::CutAnswer, 3);
    let error = client.status("sae-b").await.unwrap_err();
    assert!(matches!(error, Error::Interrupted { .. }), "{error}");
    assert_eq!(kme_a(&network).counters().status_calls, 6);
}

#[tokio::test]
async fn enc_keys_in_doubt_is_repeated_only_by_the_explicit_policy() {
    let network = network().await;
    let calls = || kme_a(&network).counters().enc_keys_calls;
    let enc = async |policy: RetryPolicy, fault: Fault| {
        let client: Client = once(&network).retry(quick(policy)).build().unwrap();
        kme_a(&network).clear_faults();
        kme_a(&network).inject(fault, 1);
        let before = calls();
        let result = client.enc_keys("sae-b").send().await;
        (result, calls() - before)
    };
    let (result, tries) = enc(RetryPolicy::default(), Fault::CutAnswer).await;
    assert!(failed(result).keys_may_be_consumed());
    assert_eq!(tries, 1);
    let (result, tries) = enc(RetryPolicy::none().enc_keys(3), Fault::CutAnswer).await;
    assert!(failed(result).keys_may_be_consumed());
    assert_eq!(tries, 1);
    let (result, tries) = enc(RetryPolicy::none().enc_keys(3), Fault::Empty).await;
    assert!(result.is_ok());
    assert_eq!(tries, 2);
    let policy = RetryPolicy::none().enc_keys(3).enc_keys_after_ambiguous_failure(true);
    let (result, tries) = enc(policy, Fault::CutAnswer).await;
    assert!(result.is_ok());
    assert_eq!(tries, 2);
}

#[tokio::test]
async fn a_repeated_dec_keys_stays_in_doubt_when_the_kme_has_forgotten_the_key() {
    let network = network().await;
    let kme_b = network.kme("kme-b").unwrap();
    let key = once(&network).build().unwrap().enc_keys("sae-b").send().await.unwrap().into_single();
    let slave =
        network.client_builder("sae-b").retry(quick(RetryPolicy::default())).build().unwrap();
    kme_b.inject(Fault::CutAnswer, 1);
    let error = failed(slave.dec_keys("sae-a").key_id(key.key_id()).send().await);
    // The second try says 400, unknown key; the first is why.
    assert!(matches!(error, Error::KeyPossiblyConsumed { call: "dec_keys", .. }), "{error}");
    assert!(matches!(error.cause(), Error::BadRequest { .. }), "{error}");
    assert_eq!(kme_b.counters().dec_keys_calls, 2);
}

#[tokio::test]
async fn a_deadline_bounds_all_repeats() {
    let network = network().await;
    let client = once(&network)
        .retry(quick(RetryPolicy::none().status(u32::MAX)))
        .timeout(Duration::from_millis(100))
        .deadline(Duration::from_millis(350))
        .build()
        .unwrap();
    kme_a(&network).inject(Fault::Silence, u32::MAX);
    let error = client.status("sae-b").await.unwrap_err();
    assert!(matches!(error, Error::Timeout { .. }), "{error}");
    assert!(kme_a(&network).counters().status_calls < 10);
}

#[tokio::test]
async fn a_cancelled_call_leaves_the_client_usable() {
    let network = network().await;
    let client = once(&network).build().unwrap();
    kme_a(&network).inject(Fault::Silence, 1);
    let call = client.enc_keys("sae-b").send();
    assert!(tokio::time::timeout(Duration::from_millis(200), call).await.is_err());
    client.enc_keys("sae-b").send().await.unwrap();
}
